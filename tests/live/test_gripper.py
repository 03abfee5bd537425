"""A gripper beside an arm: both loops move it over sockets, by the trigger of a scene or of a device."""

import math
from pathlib import Path

import pytest
from tests.gripper.serving import served
from tests.gripper.virtual import gripper as emulated
from tests.live.control_client import Control
from tests.live.sides import Arm, Hand, how, until
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import (
    DeviceError,
    LiveMaster,
    MasterLoop,
    MasterRun,
    SlaveLoop,
    SlaveRun,
    load_scene,
    override_scene,
    scene_json,
)
from haptether.slave import Gripper, GripperCommand, GripperSample, RobotiqGripper

pytestmark = pytest.mark.live

GRIPPING = override_scene(
    load_scene("remote_push", ["environment.pushers=[]"]),
    ["slave.gripper={speed = 2.0, force_n = 30.0}", "operator.trigger=[[0.1, 0.0], [0.5, 1.0]]"],
)
SPEC = scene_json(GRIPPING)


class Jaws:
    """Gripper that is always at its commanded position, up to an object at 0.7, and records its commands."""

    def __init__(self) -> None:
        self.orders: list[GripperCommand | str] = []
        self.position = 0.0
        self.fault: str | None = None

    def open(self) -> None:
        self.orders.append("open")

    def read(self) -> GripperSample:
        holds = self.position >= 0.7
        force_n = 30.0 if holds else 0.0
        return GripperSample(
            position=self.position, velocity=0.0, force_n=force_n, holds_object=holds, fault=self.fault
        )

    def write(self, command: GripperCommand) -> None:
        self.orders.append(command)
        self.position = min(command.position, 0.7)

    def hold(self) -> None:
        self.orders.append("hold")

    def acknowledge(self) -> None:
        self.orders.append("acknowledge")
        self.fault = None

    def close(self) -> None:
        self.orders.append("close")


def slave_of(jaws: Gripper, spec: bytes = SPEC, **others: object) -> tuple[SlaveRun, Arm]:
    arm = Arm()
    loop = SlaveLoop(spec, listen="127.0.0.1:0", **how(**others))
    return SlaveRun(arm, loop, gripper=jaws), arm


@anew_after_stalls
def test_it_is_led_by_the_trigger_and_keeps_its_grip_when_the_master_ends() -> None:
    jaws = Jaws()
    slave, _ = slave_of(jaws)
    master = LiveMaster(SPEC, peer=slave.address, duration_s=1.2, patience_s=10.0, **how())
    until(lambda: master.finished, 20.0)
    led, _ = master.finish()
    until(lambda: "hold" in jaws.orders)
    done, _ = slave.finish()
    assert slave.error is None
    assert jaws.orders[0] == "open"
    assert jaws.orders[-2:] == ["hold", "close"], "its end is a hold, too"
    moves = [order for order in jaws.orders if isinstance(order, GripperCommand)]
    # Nothing moves the gripper after the first hold.
    assert jaws.orders.index("hold") == 1 + len(moves)
    positions = [move.position for move in moves]
    assert positions == sorted(positions)
    assert positions[-1] == 1.0
    assert {(move.speed, move.force_n) for move in moves} == {(2.0, 30.0)}
    assert jaws.position == 0.7
    assert led.trigger[-1] == 1.0
    assert (done.gripper[-1], done.holds_object[-1], done.gripper_force[-1]) == (0.7, 1, 30.0)


class JawsOfArm(Jaws):
    """Gripper on the bus of its arm."""

    def __init__(self, refused: str = "") -> None:
        super().__init__()
        self.refused = refused

    def attach(self, arm: object) -> None:
        self.orders.append(f"attach {type(arm).__name__}")
        if self.refused:
            raise ValueError(self.refused)


def test_one_that_is_on_the_bus_of_its_arm_learns_of_it_first() -> None:
    jaws = JawsOfArm()
    slave, _ = slave_of(jaws)
    until(slave.ready)
    slave.finish()
    assert slave.error is None
    assert jaws.orders == ["attach Arm", "open", "hold", "close"]


def test_one_that_cannot_be_at_this_arm_ends_the_run() -> None:
    jaws = JawsOfArm("must be at an arm of servos")
    slave, arm = slave_of(jaws)
    until(lambda: slave.finished)
    slave.finish()
    assert "ValueError: must be at an arm of servos" in str(slave.error)
    assert "open" not in jaws.orders
    assert arm.stops == 0


@anew_after_stalls
def test_a_fault_of_the_gripper_stops_the_arm_and_is_named_and_acknowledged() -> None:
    jaws = Jaws()
    slave, arm = slave_of(jaws)
    master = LiveMaster(SPEC, peer=slave.address, patience_s=10.0, **how())
    until(lambda: jaws.position > 0.1)
    jaws.fault = "silence: the server does not answer"
    until(lambda: slave.state == "fault")
    until(lambda: arm.stops > 0)
    until(lambda: "gripper: silence: the server does not answer" in (slave.cause() or ""))
    count = len(jaws.orders)
    assert jaws.orders[-1] == "hold"
    slave.acknowledge()
    until(lambda: slave.state != "fault")
    assert jaws.orders[count:] == ["acknowledge"], "the gripper moves no more: nobody has engaged anew"
    master.stop()
    master.finish()
    slave.finish()


@anew_after_stalls
def test_an_acknowledgement_at_the_control_socket_reaches_the_driver(tmp_path: Path) -> None:
    jaws = Jaws()
    slave, _ = slave_of(jaws, control=tmp_path / "slave")
    master = LiveMaster(SPEC, peer=slave.address, patience_s=10.0, **how())
    until(lambda: jaws.position > 0.1)
    jaws.fault = "silence: the server does not answer"
    until(lambda: slave.state == "fault")
    count = len(jaws.orders)
    with Control(tmp_path / "slave") as control:
        answer = control.set("acknowledge")
    assert (answer["done"], answer["text"]) == (True, "acknowledged, to the device as well")
    until(lambda: slave.state != "fault")
    assert "acknowledge" in jaws.orders[count:]
    master.stop()
    master.finish()
    slave.finish()


@anew_after_stalls
@pytest.mark.parametrize("trigger", [None, math.nan, -0.5, 1.5, math.inf])
def test_a_trigger_that_is_not_there_or_cannot_be_leads_nothing(trigger: float | None) -> None:
    jaws = Jaws()
    slave, _ = slave_of(jaws)
    spec = scene_json(override_scene(GRIPPING, ["operator.trigger=[]"]))
    loop = MasterLoop(spec, peer=slave.address, duration_s=0.4, patience_s=10.0, **how())
    master = MasterRun(Hand(trigger=trigger), loop)
    until(lambda: master.finished, 20.0)
    ticks, report = master.finish()
    slave.finish()
    assert (master.error, slave.error) == (None, None)
    assert report.engaged_s > 0.0
    assert set(map(str, ticks.trigger)) == {"nan"}
    assert not [order for order in jaws.orders if isinstance(order, GripperCommand)]


def test_a_side_without_a_gripper_and_one_with_it_do_not_engage() -> None:
    jaws = Jaws()
    slave, _ = slave_of(jaws)
    spec = scene_json(load_scene("remote_push", ["environment.pushers=[]"]))
    master = LiveMaster(spec, peer=slave.address, patience_s=1.0, **how())
    until(lambda: master.finished, 20.0)
    _, report = master.finish()
    _, of_slave = slave.finish()
    assert math.isnan(report.engaged_s) or math.isinf(report.engaged_s)
    assert of_slave.link.refused > 100
    assert not [order for order in jaws.orders if isinstance(order, GripperCommand)]


@anew_after_stalls
def test_an_error_of_the_gripper_names_it_and_the_arm_is_stopped_first() -> None:
    class Failing(Jaws):
        def write(self, command: GripperCommand) -> None:
            super().write(command)
            if self.position > 0.1:
                message = "the bus is busy"
                raise OSError(message)

        def hold(self) -> None:
            raise OSError

    jaws = Failing()
    slave, arm = slave_of(jaws)
    master = LiveMaster(SPEC, peer=slave.address, patience_s=10.0, **how())
    until(lambda: slave.finished)
    assert str(slave.error).startswith("Failing: OSError: the bus is busy")
    assert isinstance(slave.error, DeviceError)
    assert isinstance(slave.error.__cause__, OSError), "`--debug` shows where it came from"
    assert arm.stops == 1
    assert jaws.orders[-1] == "close"
    slave.finish()
    master.stop()
    master.finish()


def test_a_gripper_that_nobody_has_read_is_not_known() -> None:
    arm = Arm()
    slave = SlaveRun(arm, SlaveLoop(SPEC, listen="127.0.0.1:0", **how()))
    until(lambda: slave.ticks > 50)
    done, _ = slave.finish()
    assert set(map(str, done.gripper)) == {"nan"}


def test_a_gripper_that_does_not_open_ends_the_run_and_is_named() -> None:
    class Broken(Jaws):
        def open(self) -> None:
            message = "nobody there"
            raise ConnectionError(message)

    jaws = Broken()
    slave, arm = slave_of(jaws)
    until(lambda: slave.finished)
    assert isinstance(slave.error, DeviceError)
    assert "Broken: ConnectionError: nobody there" in str(slave.error)
    assert jaws.orders == ["close"]
    slave.give_up()
    assert arm.stops == 0


@anew_after_stalls
def test_robotiq_picks_something_up_through_both_loops() -> None:
    """Run the driver, its thread and the server of an emulated URCap; the trigger at the far end moves the gripper."""
    with served(emulated(40.0)) as server:
        jaws = RobotiqGripper(host="127.0.0.1", port=server.port)
        slave, _ = slave_of(jaws)
        until(slave.ready)
        assert slave.error is None
        master = LiveMaster(SPEC, peer=slave.address, duration_s=3.0, patience_s=10.0, **how())
        until(lambda: master.finished, 20.0)
        master.finish()
        done, _ = slave.finish()
        assert slave.error is None
        assert done.holds_object[-1] == 1
        assert 0.3 < done.gripper[-1] < 0.8, "40 mm of 85 are left open"
        assert done.gripper_force[-1] > 0.0
        commands = [line for line in server.requests if line.startswith("SET POS")]
        assert commands
