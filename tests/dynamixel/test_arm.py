"""An arm of servos on an emulated bus: its checklist, joint frame and caps, and the end of each fault."""

import math
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus

from haptether.checklist import Checklist
from haptether.dynamixel import DynamixelBus, OperatingMode
from haptether.dynamixel.arm import ArmRefusedError, ArmSettings, FaultKind, ServoArm, ServoSettings, checks
from haptether.dynamixel.arm.arm import HELD_S
from haptether.dynamixel.arm.checks import check_port, check_present, check_servo

pytestmark = pytest.mark.live

PATIENCE_S = 10.0
TIMEOUT_S = 0.1
"""Longest time of an answer on a loaded test machine."""
SERVOS = ("1=XM430-W350", "2=XL330-M288", "3=XL330-M288")


def arm_of(port: str, **changes: Any) -> ServoArm:  # noqa: ANN401  # fields of the settings
    """Return two joints led by current, the second reversed with an offset, and one that holds an angle."""
    servos = (
        ServoSettings(servo_id=1, model="XM430-W350"),
        ServoSettings(servo_id=2, model="XL330-M288", sign=-1, offset_rad=math.pi / 2),
        ServoSettings(servo_id=3, model="XL330-M288", mode=OperatingMode.CURRENT_BASED_POSITION, low_rad=-1.0),
    )
    # The times are long because a test machine may halt a process for longer than an arm permits.
    settings = {
        "servos": servos, "timeout_s": TIMEOUT_S, "watchdog_s": 0.5, "lost_after_s": 0.05, "ramp_s": 0.0,
        "release_s": 0.0, "verify_watchdog": False,
    }  # fmt: skip
    return ServoArm(ArmSettings(port=port, **{**settings, **changes}), report=lambda _line: None)


def opened(emulated: EmulatedBus, **changes: Any) -> closing[ServoArm]:  # noqa: ANN401  # fields of the settings
    arm = arm_of(emulated.port, **changes)
    arm.open()
    return closing(arm)


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", *SERVOS, "--start", "0.3", "0.5", "0.2") as running:
        yield running


def until(condition: Callable[[], bool], patience_s: float = PATIENCE_S) -> float:
    """Return the time in s until a condition holds."""
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < patience_s
        time.sleep(0.002)
    return time.monotonic() - begin


def torques(emulated: EmulatedBus) -> list[bool]:
    return [servo["torque"] for servo in emulated.status()["servos"]]


def at_rest(emulated: EmulatedBus) -> bool:
    """Return true if no servo has current."""
    return all(servo["current_a"] == 0.0 for servo in emulated.status()["servos"])


# ------------------------------------------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"servo_id": 253}, "id 253: must be 0 to 252"),
        ({"model": "XM999"}, "servo 1: model = 'XM999': must be one of XL330-M077"),
        ({"sign": 0}, "sign = 0: must be 1 or -1"),
        ({"offset_rad": math.nan}, "offset_rad = nan: must be within"),
        ({"low_rad": 1.0, "high_rad": 1.0}, "low_rad = 1: must be below high_rad = 1"),
        ({"near_rad": 4.0}, "near_rad = 4: must be -3.14159 to 3.14159"),
        ({"mode": OperatingMode.PWM}, "mode = 16: a XM430-W350 must have one of 0 .current."),
        ({"cap_a": 3.3}, "cap_a = 3.3: a XM430-W350 must be above 0 and at most 3.209"),
        ({"cap_a": math.nan}, "cap_a = nan"),
        ({"model": "XL430-W250"}, "mode = 0: a XL430-W250 must have one of 4"),
        ({"model": "XL430-W250", "mode": OperatingMode.EXTENDED_POSITION, "cap_a": 1.0}, "has no current control"),
    ],
)
def test_settings_that_cannot_be(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ServoSettings(**{"servo_id": 1, "model": "XM430-W350", **change})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"servos": ()}, "servos: 0: must be 1 to 32"),
        ({"servos": (ServoSettings(servo_id=1, model="XM430-W350"),) * 2}, "servo 1 is given twice"),
        ({"watchdog_s": 0.0}, "watchdog_s = 0: must be 0.02 to 2.54"),
        ({"ramp_s": math.nan}, "ramp_s = nan"),
    ],
)
def test_arms_that_cannot_be(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ArmSettings(**{"port": "/dev/null", "servos": (ServoSettings(servo_id=1, model="XM430-W350"),), **change})


# ------------------------------------------------------------------------------------------------------ checklist


def refused(arm: ServoArm) -> str:
    with pytest.raises(ArmRefusedError) as error:
        arm.open()
    return str(error.value)


def test_a_port_that_is_not_there() -> None:
    assert "port: is not there: plug the adapter in" in refused(arm_of("/dev/ttyUSB99"))


@pytest.mark.parametrize(("found", "good"), [("1", True), ("16", False)])
def test_the_latency_timer_of_an_adapter(tmp_path: Path, found: str, good: bool) -> None:
    port = tmp_path / "ttyUSB7"
    port.touch()
    timer = tmp_path / "sys/class/tty/ttyUSB7/device/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text(f"{found}\n")
    lines: list[str] = []
    checklist = Checklist("arm", lines.append)
    check_port(str(port), checklist, tmp_path / "sys")
    assert f"latency timer: {found} ms" in lines[-1]
    assert bool(checklist.refused) is not good
    assert good or "sudo tee" in checklist.refused[0]


def test_all_that_is_wrong_is_told_at_once(emulated: EmulatedBus) -> None:
    emulated.do("silent 1 on")
    emulated.do("voltage 4.9 2")
    emulated.do("hardware-error 2 overheating")
    emulated.do("temperature 3 69")
    text = refused(arm_of(emulated.port))
    for part in (
        "servo 1: does not answer at 4000000 bit/s: see its power and cable",
        "servo 2: hardware error: overheating: mend its cause",
        "servo 3: 69 of 70 degC: let it cool down",
    ):
        assert part in text
    assert torques(emulated) == [False] * 3


@pytest.mark.parametrize("fault", ["mute 1", "mute 2", "corrupt 1"])
def test_a_lost_answer_does_not_say_that_nobody_is_there(emulated: EmulatedBus, fault: str) -> None:
    lines: list[str] = []
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    emulated.do(fault)
    checklist = Checklist("arm", lines.append)
    answered, _ = check_present(bus, arm_of(emulated.port).settings, checklist, lambda: None)
    bus.close()
    assert answered == {1, 2, 3}
    assert not checklist.refused
    tries = int(fault[-1]) + 1
    assert f"XM430-W350, firmware 52, answered at try {tries}" in lines[0]
    assert "try" not in "".join(lines[1:])


def test_another_model_and_an_error_of_the_shutdown_mask(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    bus.write(1, 63, b"\0")
    bus.write(3, 10, b"\x08")
    bus.close()
    servos = (
        ServoSettings(servo_id=1, model="XM430-W350"),
        ServoSettings(servo_id=2, model="XL330-M077"),
        ServoSettings(servo_id=3, model="XL330-M288"),
    )
    text = refused(arm_of(emulated.port, servos=servos))
    assert "servo 2: XL330-M288, firmware 52: the options have a XL330-M077 there" in text
    assert "servo 1: shutdown 0: it must end its torque when overheated or overloaded: set address 63 to 36" in text
    assert "servo 3: drive mode 8: a goal must not switch torque on" in text


def test_another_rate_is_found(emulated: EmulatedBus) -> None:
    arm = arm_of(emulated.port, baud=57_600, timeout_s=0.02)
    assert "baud: servos answer at 4000000 bit/s: set baud = 4000000" in refused(arm)


def test_a_joint_beyond_its_limits(emulated: EmulatedBus) -> None:
    emulated.do("place 3 -1.5")
    assert "servo 3: stands at -1.500 rad of -1.000 to +3.142: move it within" in refused(arm_of(emulated.port))
    assert torques(emulated) == [False] * 3


@pytest.mark.parametrize("level", [0, 1])
def test_a_servo_that_answers_little_is_told_to_answer_all(emulated: EmulatedBus, level: int) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    bus.write(2, 68, bytes((level,)))
    bus.close()
    lines: list[str] = []
    arm = ServoArm(arm_of(emulated.port).settings, report=lines.append)
    arm.open()
    try:
        assert torques(emulated) == [True] * 3
    finally:
        arm.close()
    assert [line for line in lines if "return level" in line] == [
        f"dynamixel {emulated.port}: ok       servo 2: status return level was {level}, and is 2 now"
    ]
    # Torque was not reported for any joint.
    assert not any("HOLD THE ARM" in line for line in lines)


def test_no_servo_with_newer_firmware_starts_with_torque(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    for servo_id in (1, 2):
        bus.write(servo_id, 60, b"\1")
    bus.close()
    text = refused(arm_of(emulated.port))
    for servo_id in (1, 2):
        assert f"servo {servo_id}: startup configuration 1: it must not start with torque" in text


def test_older_firmware_has_no_startup_configuration() -> None:
    class Older:
        """A servo that refuses to read a missing register."""

        def __init__(self, said: str) -> None:
            self.said = said

        def read(self, *_arguments: int) -> bytes:
            raise RuntimeError(self.said)

    servo = ServoSettings(servo_id=1, model="XM430-W350")
    registers = checks.ServoRegisters(Older("servo 1: access error (7)"), servo)  # type: ignore[arg-type]
    assert checks._startup(registers) is None
    garbled = checks.ServoRegisters(Older("servo 1: data length error (5)"), servo)  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match="data length"):
        checks._startup(garbled)


def test_that_the_arm_bears_nothing_while_its_watchdogs_are_tried_is_said_before(emulated: EmulatedBus) -> None:
    lines: list[tuple[str, list[bool]]] = []
    settings = arm_of(emulated.port, verify_watchdog=True).settings
    arm = ServoArm(settings, report=lambda line: lines.append((line, torques(emulated) if "SUPPORT" in line else [])))
    arm.open()
    arm.close()
    (said, torque), *more = [one for one in lines if "SUPPORT" in one[0]]
    assert not more
    assert "CAUTION  bus watchdogs: are tried now: for 0.55 s the arm bears nothing" in said
    assert torque == [True] * 3


def test_what_is_set_before_torque(emulated: EmulatedBus) -> None:
    with opened(emulated, verify_watchdog=True) as arm:
        assert torques(emulated) == [True] * 3
        assert at_rest(emulated)
        assert [servo["bus_watchdog"] for servo in emulated.status()["servos"]] == [25] * 3
        assert [servo["mode"] for servo in emulated.status()["servos"]] == [
            "current", "current", "current_based_position",
        ]  # fmt: skip
        assert arm.fault is None
    assert torques(emulated) == [False] * 3
    assert [servo["bus_watchdog"] for servo in emulated.status()["servos"]] == [0] * 3
    assert arm.kept == ()


# ---------------------------------------------------------------------------------------------------- joint frame


def test_joints_are_in_their_own_frame(emulated: EmulatedBus) -> None:
    with opened(emulated) as arm:
        assert np.isnan(arm.position).sum() == 0
        assert arm.read()
        # q = sign (p - offset): p is 0.3, 0.5 and 0.2.
        assert arm.position == pytest.approx([0.3, math.pi / 2 - 0.5, 0.2], abs=1e-3)
        arm.write_currents([0.1, 0.1])
        # A current that is positive in the joint's frame drives the joint forwards: the second servo turns backwards.
        until(lambda: emulated.servo(2)["position_rad"] < 0.45)
        assert emulated.servo(2)["current_a"] == pytest.approx(-0.1, abs=1e-3)
        assert arm.read()
        assert arm.current[1] == pytest.approx(0.1, abs=2e-3)
        assert arm.velocity[1] > 0.0


def test_the_turn_is_that_within_the_limits(emulated: EmulatedBus) -> None:
    emulated.do("place 1 2.0")
    servos = (ServoSettings(servo_id=1, model="XM430-W350", offset_rad=-3.0, low_rad=-3.0, high_rad=1.0),)
    # 2 + 3 rad is beyond the limits; one turn less is -1.28.
    with opened(emulated, servos=servos) as arm:
        assert arm.read()
        assert arm.position[0] == pytest.approx(5.0 - 2.0 * math.pi, abs=2e-3)
        # The angle passes the end of the servo's turn.
        emulated.do("place 1 3.5")
        assert arm.read()
        assert arm.position[0] == pytest.approx(6.5 - 2.0 * math.pi, abs=2e-3)


def test_currents_are_capped_and_rise(emulated: EmulatedBus) -> None:
    with opened(emulated, ramp_s=1e-9) as arm:
        arm.write_currents([99.0, -99.0])
        goals = written(emulated, arm, 1), written(emulated, arm, 2)
        # The caps are not rounded up, and the second has the sign of its servo.
        assert goals == (math.floor(0.3 * 1193 + 1e-9), math.floor(0.3 * 1750 + 1e-9))
    with opened(emulated, ramp_s=10.0) as arm:
        arm.write_currents([99.0, -99.0])
        assert arm.ramp < 0.5
        assert written(emulated, arm, 1) <= arm.ramp * 0.3 * 1193


def written(_emulated: EmulatedBus, arm: ServoArm, servo_id: int) -> int:
    """Return Goal Current of the servo."""
    return int(struct.unpack("<h", arm._opened.read(servo_id, 102, 2))[0])


def test_angles_are_kept_within_the_limits(emulated: EmulatedBus) -> None:
    with opened(emulated) as arm:
        deadline = time.monotonic() + PATIENCE_S
        while not (arm.read() and abs(arm.position[2] + 1.0) < 0.02):
            arm.write_positions([-2.0])
            assert time.monotonic() < deadline
        until(lambda: abs(emulated.servo(3)["velocity_rad_s"]) < 1e-3)
        assert arm.read()
        assert arm.position[2] > -1.02


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_ends_the_torque(emulated: EmulatedBus, number: float) -> None:
    with opened(emulated) as arm:
        arm.write_currents([0.1, number])
        assert arm.fault_kind == FaultKind.NOT_FINITE
        until(lambda: torques(emulated) == [False] * 3)
    with opened(emulated) as arm:
        arm.write_positions([number])
        assert arm.fault_kind == FaultKind.NOT_FINITE


# --------------------------------------------------------------------------------------------------------- faults


def driven_into(emulated: EmulatedBus, arm: ServoArm, fault: str) -> float:
    """Command a current until the arm has a fault; return the time in s from the fault until no servo has current."""
    begin = time.monotonic()
    while emulated.servo(1)["current_a"] == 0.0:
        assert arm.read(), arm.fault
        arm.write_currents([0.1, 0.1])
        assert time.monotonic() - begin < PATIENCE_S
    begin = time.monotonic()
    emulated.do(fault)
    while arm.fault is None:
        if arm.read():
            arm.write_currents([0.1, 0.1])
        else:
            # Neither zeros nor old values stand in for missing positions.
            assert np.isnan(arm.position).all() or arm.fault is not None
        assert time.monotonic() - begin < PATIENCE_S
    until(lambda: at_rest(emulated))
    return time.monotonic() - begin


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("unplug", FaultKind.UNPLUGGED),
        ("silent 2 on", FaultKind.SILENT),
        ("mute 1000000", FaultKind.BROWN_OUT),
        ("brown-out 1", FaultKind.BROWN_OUT),
        ("brown-out 0", FaultKind.REBOOTED),
        ("hardware-error 2 input-voltage", FaultKind.INPUT_VOLTAGE),
        ("hardware-error 2 overheating", FaultKind.OVERHEATING),
        ("hardware-error 2 encoder", FaultKind.ENCODER),
        ("hardware-error 2 electrical-shock", FaultKind.ELECTRICAL_SHOCK),
        ("hardware-error 2 overload", FaultKind.OVERLOAD),
        ("temperature 3 71", FaultKind.OVERHEATING),
        ("voltage 3.0 2", FaultKind.INPUT_VOLTAGE),
    ],
)
def test_a_fault_has_a_name_and_ends_the_current(emulated: EmulatedBus, fault: str, kind: FaultKind) -> None:
    with opened(emulated) as arm:
        took_s = driven_into(emulated, arm, fault)
        # Silent servos are searched for once there is no torque, by the following reads.
        until(lambda: arm.read() or arm.fault_kind == kind)
        assert arm.fault_kind == kind
        # The watchdog takes half a second if nothing can be sent; the rest is for a loaded machine.
        assert took_s < 5.0
        # The fault stays, and nothing is sent.
        arm.write_currents([0.1, 0.1])
        arm.read()
        assert arm.fault_kind == kind
        assert at_rest(emulated)


@pytest.mark.parametrize("fault", ["mute 1000000", "corrupt 1000000"])
def test_no_read_of_a_bus_that_fails_waits_for_more_than_one_servo(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    with opened(emulated) as arm:
        assert arm.read()
        bus, pings = arm._opened, [0]

        class Counted:
            """The bus with a counter of pings."""

            def __getattr__(self, name: str) -> object:
                pings[-1] += name == "ping"
                return getattr(bus, name)

        monkeypatch.setattr(arm, "_bus", Counted())
        emulated.do(fault)
        found, begin_s = {FaultKind.BROWN_OUT, FaultKind.UNREADABLE}, time.monotonic()
        while arm.fault_kind not in found:
            assert time.monotonic() < begin_s + PATIENCE_S
            pings.append(0)
            arm.read()
        assert max(pings) <= 1
        emulated.do("reset")


@pytest.mark.parametrize("fault", ["corrupt 1000000", "drop 1000000"])
def test_answers_that_cannot_be_read(emulated: EmulatedBus, fault: str) -> None:
    with opened(emulated) as arm:
        driven_into(emulated, arm, fault)
        assert arm.fault_kind in {FaultKind.UNREADABLE, FaultKind.SILENT, FaultKind.BROWN_OUT}
        emulated.do("corrupt 1")
        emulated.do("drop 1")


@pytest.mark.parametrize("fault", ["corrupt 1", "drop 1", "mute 1"])
def test_one_read_that_fails_is_no_fault_and_no_value(emulated: EmulatedBus, fault: str) -> None:
    with opened(emulated, lost_after_s=1.0, watchdog_s=2.0) as arm:
        assert arm.read()
        before = arm.position.copy()
        emulated.do(fault)
        assert not arm.read()
        assert np.isnan(np.concatenate([arm.position, arm.velocity, arm.current])).all()
        assert arm.read()
        assert arm.position == pytest.approx(before)
        assert arm.fault is None


def test_a_halt_is_seen_by_the_watchdog(emulated: EmulatedBus) -> None:
    with opened(emulated, watchdog_s=0.1) as arm:
        assert arm.read()
        arm.write_currents([0.1, 0.1])
        time.sleep(0.4)
        assert at_rest(emulated)
        assert not arm.read()
        assert arm.fault_kind == FaultKind.WATCHDOG


@pytest.mark.sampled(1)
@pytest.mark.parametrize("fault", ["hardware-error 2 overload", "brown-out 0.3", "unplug"])
def test_an_acknowledged_fault_is_mended(tmp_path: Path, fault: str) -> None:
    link = tmp_path / "leader"
    with emulated_bus("--servos", *SERVOS, "--link", str(link)) as emulated:
        emulated.host = str(link)
        with opened(emulated) as arm:
            driven_into(emulated, arm, fault)
            if fault == "unplug":
                arm.acknowledge(arm.fault)
                until(lambda: not (arm.recovering and not arm.read() and arm.recovering))
                # The adapter is not plugged in yet.
                assert arm.fault_kind == FaultKind.NOT_READY
                assert "is not there" in str(arm.fault)
                emulated.do("plug")
            time.sleep(0.4)
            arm.acknowledge(arm.fault)
            until(lambda: arm.read() or not arm.recovering)
            until(lambda: arm.read() and arm.fault is None)
            assert torques(emulated) == [True] * 3
            assert at_rest(emulated)
            arm.write_currents([0.1, 0.1])
            until(lambda: emulated.servo(1)["current_a"] > 0.05)


def test_the_end_says_who_keeps_torque(emulated: EmulatedBus) -> None:
    lines: list[str] = []
    arm = arm_of(emulated.port, timeout_s=0.02)
    arm._report = lines.append
    arm.open()
    emulated.do("silent 2 on")
    arm.close()
    assert arm.kept == (2,)
    assert "servo 2 may KEEP torque" in lines[-1]
    # It receives commands all the same.
    until(lambda: torques(emulated) == [False] * 3)


def test_closing_does_not_wait_for_servos_that_are_silent() -> None:
    near, far = os.openpty()
    arm = arm_of(os.ttyname(far), timeout_s=0.1)
    refusals: list[str] = []

    def run() -> None:
        try:
            arm.open()
        except ArmRefusedError as error:
            refusals.append(str(error))

    try:
        opening = threading.Thread(target=run)
        opening.start()
        # It has begun to ask, with three servos and seven rates to go.
        assert os.read(near, 1)
        arm.close()
        opening.join(PATIENCE_S)
        assert not opening.is_alive()
        assert "closed before it was open" in refusals[0]
    finally:
        os.close(near)
        os.close(far)


def test_an_arm_that_is_closed_while_it_opens_has_no_torque(emulated: EmulatedBus) -> None:
    arm = arm_of(emulated.port, verify_watchdog=True, watchdog_s=2.0)
    refusals = []

    def run() -> None:
        try:
            arm.open()
        except ArmRefusedError as error:
            refusals.append(str(error))

    opening = threading.Thread(target=run)
    opening.start()
    # It waits for its watchdogs to fire.
    until(lambda: all(torques(emulated)))
    arm.close()
    opening.join(PATIENCE_S)
    assert not opening.is_alive()
    assert "closed before it was open" in refusals[0]
    assert torques(emulated) == [False] * 3


def test_an_arm_that_is_closed_while_it_recovers_has_no_torque(emulated: EmulatedBus) -> None:
    arm = arm_of(emulated.port, verify_watchdog=True, watchdog_s=1.0)
    arm.open()
    arm.stop(FaultKind.JUMP, "of a test")
    until(lambda: not any(torques(emulated)))
    arm.acknowledge(arm.fault)
    until(lambda: all(torques(emulated)))
    arm.close()
    assert torques(emulated) == [False] * 3
    time.sleep(0.3)
    assert torques(emulated) == [False] * 3


def test_an_arm_is_let_down(emulated: EmulatedBus) -> None:
    arm = arm_of(emulated.port, release_s=0.5)
    arm.open()
    emulated.do("push 1 0.5")
    begin = time.monotonic()
    falling = []
    closing = threading.Thread(target=arm.close)
    closing.start()
    while closing.is_alive():
        falling.append(emulated.servo(1))
        assert time.monotonic() - begin < PATIENCE_S
    closing.join()
    # Its own weight turns the arm, and the motor brakes.
    assert min(servo["current_a"] for servo in falling) < -0.02
    assert torques(emulated) == [False] * 3


# ------------------------------------------------------------------------------------------------ ends of a process

CLIENT = """
import sys, time
from haptether.dynamixel.arm import ArmSettings, ServoArm, ServoSettings

servos = (ServoSettings(servo_id=1, model="XM430-W350"),)
arm = ServoArm(ArmSettings(port=sys.argv[1], servos=servos, watchdog_s=0.2, ramp_s=0.0, release_s=0.0, timeout_s=0.1,
                           lost_after_s=1.0, verify_watchdog=False))
arm.open()
try:
    begin = time.monotonic()
    while time.monotonic() - begin < 20.0:
        arm.read()
        arm.write_currents([0.1])
        if sys.argv[2] == "raise" and time.monotonic() - begin > 0.5:
            raise ValueError("of the driver")
        time.sleep(0.002)
finally:
    arm.close()
"""


@pytest.mark.sampled(2)
@pytest.mark.parametrize("end", ["SIGINT", "SIGKILL", "SIGSTOP", "raise"])
def test_the_current_ends_with_the_process(emulated: EmulatedBus, end: str) -> None:
    with subprocess.Popen([sys.executable, "-c", CLIENT, emulated.port, end], stderr=subprocess.PIPE) as process:
        try:
            until(lambda: emulated.servo(1)["current_a"] > 0.05, 20.0)
            if end != "raise":
                os.kill(process.pid, getattr(signal, end))
            took_s = until(lambda: emulated.servo(1)["current_a"] == 0.0)
            assert took_s < 5.0
            if end in {"SIGINT", "raise"}:
                process.wait(PATIENCE_S)
                assert torques(emulated)[0] is False
            else:
                # The servo's own watchdog has ended the torque, without a command.
                assert emulated.servo(1)["bus_watchdog"] == -1
        finally:
            process.kill()
            process.wait()


@pytest.mark.parametrize("mode", [OperatingMode.CURRENT_BASED_POSITION, OperatingMode.EXTENDED_POSITION])
def test_a_profile_of_another_program_is_ended(emulated: EmulatedBus, mode: OperatingMode) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    # The mode is already right, because a change of mode would reset the profile: 2 units are 0.05 rad/s.
    for address, value in ((11, bytes((mode,))), (108, struct.pack("<I", 7)), (112, struct.pack("<I", 2))):
        bus.write(3, address, value)
    bus.close()
    servos = (ServoSettings(servo_id=3, model="XL330-M288", mode=mode),)
    lines: list[str] = []
    arm = arm_of(emulated.port, servos=servos)
    arm._report = lines.append
    try:
        arm.open()
        (line,) = [line for line in lines if "operating mode" in line]
        assert "profile acceleration was 7, and is 0 now, profile velocity was 2, and is 0 now" in line
        end_s = time.monotonic() + PATIENCE_S
        goal = arm.position + 0.5
        while not (arm.read() and arm.velocity[0] > 0.3):
            arm.write_positions(goal)
            assert time.monotonic() < end_s
    finally:
        arm.close()


@pytest.mark.parametrize(("address", "name"), [(108, "profile acceleration"), (112, "profile velocity")])
def test_a_servo_that_keeps_its_profile_is_refused(emulated: EmulatedBus, address: int, name: str) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    servo = ServoSettings(servo_id=3, model="XL330-M288", mode=OperatingMode.CURRENT_BASED_POSITION)
    bus.write(3, 11, b"\5")
    bus.write(3, address, struct.pack("<I", 9))

    class Keeps:
        """A servo that ignores one write."""

        read = staticmethod(bus.read)

        @staticmethod
        def write(servo_id: int, at: int, value: bytes) -> None:
            if at != address:
                bus.write(servo_id, at, value)

    checklist = Checklist("arm", lambda _line: None, ArmRefusedError)
    check_servo(Keeps(), servo, checklist)  # type: ignore[arg-type]  # as much of one as is called
    bus.close()
    assert len(checklist.refused) == 1
    assert checklist.refused[0].startswith(f"servo 3: {name} is 9: it does not take 0")


def test_an_arm_that_another_program_holds_is_named_before_its_torque_is_taken_off(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    for servo_id in (1, 3):
        bus.write(servo_id, 64, b"\1")
    bus.close()
    held: list[dict[int, bool]] = []
    begun_s: list[float] = []
    lines: list[str] = []

    def report(line: str) -> None:
        lines.append(line)
        if "CAUTION" in line:
            begun_s.append(time.monotonic())
            held.append({servo_id: emulated.servo(servo_id)["torque"] for servo_id in (1, 2, 3)})
        if "had torque" in line:
            begun_s.append(time.monotonic())

    arm = arm_of(emulated.port)
    arm._report = report
    try:
        arm.open()
    finally:
        arm.close()
    (caution,) = [line for line in lines if "CAUTION" in line]
    assert "servo 1, 3: has torque already" in caution
    assert "HOLD THE ARM: what it bears falls" in caution
    assert held == [{1: True, 2: False, 3: True}]
    assert len(begun_s) == 3
    assert begun_s[1] - begun_s[0] >= HELD_S
    # There is no torque to hold, and no wait.
    lines.clear()
    arm.open()
    arm.close()
    assert not any("CAUTION" in line for line in lines)


def test_torque_of_another_program_is_announced_where_the_arm_is_refused_too(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Servo 2 is of another model than configured, and has torque; servo 9 is missing and not reported."""
    monkeypatch.setattr("haptether.dynamixel.arm.arm.HELD_S", 0.3)
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    bus.write(2, 64, b"\1")
    bus.close()
    lines: list[str] = []
    held: list[bool] = []

    def report(line: str) -> None:
        lines.append(line)
        if "CAUTION" in line:
            held.append(emulated.servo(2)["torque"])

    arm = arm_of(emulated.port, servos=tuple(ServoSettings(servo_id=one, model="XM430-W350") for one in (2, 9)))
    arm._report = report
    begin = time.monotonic()
    with pytest.raises(ArmRefusedError, match="the options have a XM430-W350 there"):
        arm.open()
    assert time.monotonic() - begin > 0.3
    assert held == [True]
    # It answered, so its rate is not searched for.
    assert not any("baud" in line for line in lines)
    assert not emulated.servo(2)["torque"]


def test_a_refusal_before_that_leaves_the_torque_of_another_program_alone(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    bus.write(1, 64, b"\1")
    bus.close()

    def gone(*_arguments: object) -> object:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("haptether.dynamixel.arm.arm.check_present", gone)
    arm = arm_of(emulated.port)
    with pytest.raises(ArmRefusedError, match="Input/output error"):
        arm.open()
    arm.close()
    assert emulated.servo(1)["torque"]


def test_a_servo_that_does_not_say_whether_it_has_torque_is_announced(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("haptether.dynamixel.arm.arm.HELD_S", 0.2)
    lines: list[str] = []
    arm = arm_of(emulated.port)
    arm._report = lines.append
    present = checks.check_present

    def then_silent(*arguments: Any) -> object:  # noqa: ANN401  # passed on
        found = present(*arguments)
        emulated.do("silent 1 on")
        return found

    monkeypatch.setattr("haptether.dynamixel.arm.arm.check_present", then_silent)
    with pytest.raises(ArmRefusedError):
        arm.open()
    (caution,) = [line for line in lines if "CAUTION" in line]
    assert "servo 1: has torque already, or does not say" in caution


def test_an_arm_is_closed_while_a_person_takes_hold_of_it(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    bus.write(1, 64, b"\1")
    bus.close()
    arm = arm_of(emulated.port)
    cautioned = threading.Event()
    arm._report = lambda line: cautioned.set() if "CAUTION" in line else None
    ended: list[BaseException] = []

    def opens() -> None:
        try:
            arm.open()
        except ArmRefusedError as error:
            ended.append(error)

    thread = threading.Thread(target=opens)
    thread.start()
    assert cautioned.wait(PATIENCE_S)
    arm.close()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert "closed before it was open" in str(ended[0])
