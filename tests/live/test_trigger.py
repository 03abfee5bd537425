"""A trigger with force feedback, live: against virtual time, through a driver, and with drivers without a motor."""

import math
import time

import numpy as np
import pytest
from msgspec.structs import replace
from tests.live.sides import Hand, how, until
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import (
    DeviceError,
    LiveMaster,
    LiveSlave,
    MasterLoop,
    MasterRun,
    load_scene,
    override_scene,
    scene_json,
    simulate,
)

pytestmark = pytest.mark.live

GRIPPING = override_scene(
    load_scene("remote_push", ["environment.pushers=[]"]),
    [
        "slave.gripper={speed = 2.0, force_n = 40.0, object = 0.6}",
        "operator.trigger=[[0.1, 0.0], [0.6, 1.0]]",
        "run.duration_s=2.0",
        "record.every=1",
    ],
)
FELT = override_scene(GRIPPING, ["master.gripper={travel_m = 0.03, mass_kg = 0.05}"])
FINGER_N = 0.05 * 40.0


class FeelingHand(Hand):
    """The same with a motor; it records its forces."""

    def __init__(self) -> None:
        super().__init__(trigger=0.0)
        self.felt: list[float] = []
        self.error: Exception | None = None

    def write_trigger(self, force_n: float) -> None:
        self.felt.append(force_n)
        if self.error is not None and force_n:
            raise self.error


@anew_after_stalls
def test_live_and_virtual_time_feel_alike() -> None:
    """Compare live and virtual time: the same trigger and forces, at the same time since engagement."""
    spec = scene_json(FELT)
    slave = LiveSlave(spec, listen="127.0.0.1:0", **how())
    master = LiveMaster(spec, peer=slave.address, duration_s=1.6, patience_s=10.0, **how())
    until(lambda: master.finished, 20.0)
    near, _ = master.finish()
    slave.stop()
    slave.finish()
    # Loopback has no delay.
    run = simulate(replace(FELT, link=None))
    assert run.reports is not None
    offset_s = run.reports[0].engaged_s
    assert near.trigger_device_force is not None
    assert near.trigger_velocity is not None
    assert near.trigger_rendered_force is not None
    begun_s = near.time_s[int(np.flatnonzero(near.state == 2)[0])]
    for time_s in (0.05, 0.3, 0.45, 0.7, 1.0, 1.5):
        tick = int(np.searchsorted(near.time_s, begun_s + time_s - 5e-4))
        there = round((offset_s + time_s) * 1e3)
        # Loopback and the phase of two loops shift by a few ticks; meanwhile the trigger closes at 2 / s and the force
        # grows by 10 N/s.
        assert near.trigger[tick] == pytest.approx(run.signals["trigger"][there], abs=0.02)
        expected = run.signals["trigger_device_force"][there]
        assert near.trigger_device_force[tick] == pytest.approx(expected, abs=0.15)
    assert near.trigger_device_force[-1] == pytest.approx(-FINGER_N, abs=1e-9)
    np.testing.assert_array_equal(near.trigger_device_force.max(), 0.0)


def test_a_trace_of_a_trigger_that_is_not_felt_has_nothing_of_it() -> None:
    slave = LiveSlave(scene_json(GRIPPING), listen="127.0.0.1:0", **how())
    master = LiveMaster(scene_json(GRIPPING), peer=slave.address, duration_s=0.2, patience_s=10.0, **how())
    until(lambda: master.finished, 20.0)
    near, _ = master.finish()
    slave.stop()
    slave.finish()
    assert near.trigger_velocity is None
    assert near.trigger_rendered_force is None
    assert near.trigger_safety_force is None
    assert near.trigger_device_force is None
    assert near.trigger_tripped is None


def driven(hand: Hand, *, duration_s: float = 1.5) -> tuple[MasterRun, LiveSlave, MasterLoop]:
    spec = scene_json(override_scene(FELT, ["operator.trigger=[]"]))
    slave = LiveSlave(spec, listen="127.0.0.1:0", **how())
    loop = MasterLoop(spec, peer=slave.address, duration_s=duration_s, patience_s=10.0, **how())
    return MasterRun(hand, loop), slave, loop


@anew_after_stalls
def test_a_driver_exerts_what_the_jaws_press_with_and_ends_at_rest() -> None:
    hand = FeelingHand()
    master, slave, loop = driven(hand)
    until(lambda: loop.state == "engaged" or master.finished)
    hand.trigger = 0.0
    # The trigger closes no faster than the jaws follow.
    for step in range(81):
        hand.trigger = 0.01 * step
        time.sleep(0.005)
    until(lambda: bool(hand.felt) and abs(hand.felt[-1] + FINGER_N) < 1e-9)
    assert loop.trigger_force == pytest.approx(-FINGER_N)
    hand.trigger = None
    until(lambda: hand.felt[-1] == 0.0)
    until(lambda: master.finished, 20.0)
    near, _ = master.finish()
    slave.stop()
    slave.finish()
    assert master.error is None
    assert hand.felt[0] == hand.felt[-1] == 0.0
    assert max(hand.felt) == 0.0
    assert near.trigger_device_force is not None
    assert near.trigger_device_force.min() == pytest.approx(-FINGER_N)


@anew_after_stalls
def test_an_error_at_the_trigger_ends_the_run_without_force() -> None:
    hand = FeelingHand()
    master, slave, loop = driven(hand, duration_s=5.0)
    until(lambda: loop.state == "engaged" or master.finished)
    hand.error = OSError("the bus is busy")
    for step in range(81):
        hand.trigger = 0.01 * step
        time.sleep(0.005)
    until(lambda: master.finished, 20.0)
    slave.stop()
    slave.finish()
    assert isinstance(master.error, DeviceError)
    assert "the bus is busy" in str(master.error)
    assert hand.felt[-1] == 0.0


@pytest.mark.parametrize("trigger", [math.nan, -0.5, 1.5, math.inf])
@anew_after_stalls
def test_a_trigger_that_cannot_be_is_no_force_and_no_fault(trigger: float) -> None:
    hand = FeelingHand()
    hand.trigger = trigger
    master, slave, _ = driven(hand, duration_s=0.3)
    until(lambda: master.finished, 20.0)
    near, _ = master.finish()
    slave.stop()
    slave.finish()
    assert master.error is None
    assert not near.fault.any()
    assert hand.felt
    assert not any(hand.felt)


def test_a_driver_without_a_motor_at_its_trigger_is_refused_before_it_is_opened() -> None:
    class Unopened(Hand):
        def open(self) -> None:
            raise AssertionError

    master, slave, _ = driven(Unopened())
    until(lambda: master.finished)
    slave.stop()
    slave.finish()
    assert isinstance(master.error, DeviceError)
    assert "Unopened: has no write_trigger" in str(master.error)
    assert "leave [master.gripper] out of the scene" in str(master.error)


def test_a_motor_at_the_trigger_is_left_alone_where_it_is_not_felt() -> None:
    hand = FeelingHand()
    slave = LiveSlave(scene_json(GRIPPING), listen="127.0.0.1:0", **how())
    spec = scene_json(override_scene(GRIPPING, ["operator.trigger=[]"]))
    loop = MasterLoop(spec, peer=slave.address, duration_s=0.2, patience_s=10.0, **how())
    assert loop.trigger_force is None
    master = MasterRun(hand, loop)
    until(lambda: master.finished, 20.0)
    master.finish()
    slave.stop()
    slave.finish()
    assert (hand.felt, loop.trigger_force, master.error) == ([], None, None)
