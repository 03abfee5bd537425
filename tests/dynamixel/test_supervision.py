"""Checks of an arm with torque and before: watchdogs, shadows, and the servos' startup configuration."""

import dataclasses
import math
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.dynamixel.test_arm import TIMEOUT_S, arm_of, opened, refused, torques, until
from tests.ur.stalls import anew_after_stalls

from haptether.checklist import Checklist
from haptether.dynamixel import DynamixelBus
from haptether.dynamixel.arm import ArmRefusedError, ArmSettings, FaultKind, ServoArm, ServoSettings, read_calibration
from haptether.dynamixel.arm.calibration import calibration_text
from haptether.dynamixel.description import load_arm

pytestmark = pytest.mark.live

WATCHDOG, STARTUP, SECONDARY_ID = 98, 60, 12
ONE = (ServoSettings(servo_id=1, model="XM430-W350"),)


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", "1=XM430-W350", "2=XM430-W350") as running:
        yield running


def set_register(emulated: EmulatedBus, servo_id: int, address: int, value: int) -> None:
    bus = DynamixelBus(emulated.port, baud=4_000_000, timeout_s=TIMEOUT_S)
    bus.write(servo_id, address, bytes((value,)))
    bus.close()


# ------------------------------------------------------------------------------------------------------- watchdogs


def test_a_watchdog_that_somebody_has_switched_off_is_a_fault(emulated: EmulatedBus) -> None:
    with opened(emulated, servos=ONE) as arm:
        assert arm.read()
        arm._opened.write(1, WATCHDOG, b"\0")
        until(lambda: not arm.read())
        assert arm.fault_kind == FaultKind.WATCHDOG
        assert "its watchdog is 0 ms: was 500" in str(arm.fault)
        until(lambda: not torques(emulated)[0])


@pytest.mark.parametrize(("seconds", "units"), [(0.02, 1), (0.03, 1), (0.059, 2), (0.1, 5), (0.54, 27), (2.54, 127)])
def test_a_watchdog_is_never_longer_than_is_set(seconds: float, units: int) -> None:
    assert ArmSettings(port="/dev/null", servos=ONE, watchdog_s=seconds).watchdog_units == units


def test_torque_that_cannot_be_looked_at_is_a_fault(emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured values alone do not prove that the servos have torque."""
    with opened(emulated, servos=ONE) as arm:
        assert arm.read()
        real = type(arm._opened).sync_read
        looks = arm._watchdogs, arm._status

        class Deaf:
            """The bus without answers about its torque."""

            def __getattr__(self, name: str) -> object:
                return getattr(bus, name)

            def sync_read(self, read: object) -> bytes:
                if read in looks:
                    message = "id 1 did not answer"
                    raise TimeoutError(message)
                return real(bus, read)  # type: ignore[arg-type]

        bus = arm._opened
        monkeypatch.setattr(arm, "_bus", Deaf())
        until(lambda: not arm.read())
        assert arm.fault_kind == FaultKind.SILENT
        until(lambda: not torques(emulated)[0])


# -------------------------------------------------------------------------------------------------------- registers


@pytest.mark.parametrize(
    ("address", "value", "said"),
    [
        (STARTUP, 1, "startup configuration 1: it must not start with torque: clear bit 0 of address 60"),
        (SECONDARY_ID, 2, "obeys id 2, too: it would do what is meant for that one"),
    ],
)
def test_forbidden_register_value_is_refused(address: int, value: int, said: str) -> None:
    # The table of this model has all three registers.
    servos = (ServoSettings(servo_id=1, model="XL330-M288"),)
    with emulated_bus("--servos", "1=XL330-M288") as emulated:
        set_register(emulated, 1, address, value)
        assert said in refused(arm_of(emulated.port, servos=servos))
        assert torques(emulated) == [False]


# ---------------------------------------------------------------------------------------------------------- shadows

PAIR = (ServoSettings(servo_id=1, model="XM430-W350", shadows=(2,)),)


def test_a_shadow_is_checked_driven_watched_and_let_go(emulated: EmulatedBus) -> None:
    assert "servo 2: secondary id 255: it turns the joint of servo 1: set address 12 to 1" in refused(
        arm_of(emulated.port, servos=PAIR)
    )
    set_register(emulated, 2, SECONDARY_ID, 1)
    with opened(emulated, servos=PAIR, verify_watchdog=True) as arm:
        assert torques(emulated) == [True] * 2
        assert [servo["bus_watchdog"] for servo in emulated.status()["servos"]] == [25] * 2
        assert arm.read()
        arm.write_currents([0.1])
        until(lambda: all(servo["current_a"] > 0.05 for servo in emulated.status()["servos"]))
    assert torques(emulated) == [False] * 2
    assert arm.kept == ()


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ("hardware-error 2 overload", {FaultKind.OVERLOAD}),
        # The look at all torques detects a single silent servo.
        ("silent 2 on", {FaultKind.SILENT}),
    ],
)
@anew_after_stalls
def test_what_is_wrong_with_a_shadow_ends_the_torque_of_both(
    emulated: EmulatedBus, fault: str, kinds: set[FaultKind]
) -> None:
    set_register(emulated, 2, SECONDARY_ID, 1)
    with opened(emulated, servos=PAIR, timeout_s=0.02) as arm:
        assert arm.read()
        arm.write_currents([0.1])
        emulated.do(fault)
        until(lambda: arm.fault is not None or not arm.read())
        # Silent servos are searched for with the following reads.
        until(lambda: arm.read() or "servo 2" in str(arm.fault))
        assert arm.fault_kind in kinds
        until(lambda: torques(emulated) == [False] * 2)


def test_shadows_are_ids_of_their_own_and_in_the_file_of_an_arm(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="id 253: must be 0 to 252"):
        ServoSettings(servo_id=1, model="XM430-W350", shadows=(253,))
    other = ServoSettings(servo_id=2, model="XM430-W350")
    with pytest.raises(ValueError, match="servo 2 is given twice"):
        ArmSettings(port="/dev/null", servos=(*PAIR, other))
    path = tmp_path / "arm.toml"
    path.write_text(calibration_text(4_000_000, PAIR))
    assert read_calibration(path)[1][0].shadows == (2,)


def test_a_described_arm_with_shadows_is_opened_with_them() -> None:
    from haptether.master.dynamixel import DynamixelMaster

    with emulated_bus("--arm", "aloha-wx250s") as bus:
        for servo in bus.status()["servos"]:
            bus.do(f"hand {servo['id']} {servo['position_rad']} 40 1")
        joints = load_arm("aloha-wx250s").joints
        unit: dict[str, Any] = {"offsets": [0.0] * len(joints), "signs": [joint.sign for joint in joints]}
        leader = DynamixelMaster(port=bus.port, arm="aloha-wx250s", watchdog_s=0.5, timeout_s=0.1, **unit)
        try:
            leader.open()
            assert not any(torques(bus))
            leader.read()
            servos = {servo["id"]: servo["torque"] for servo in bus.status()["servos"]}
            assert servos == dict.fromkeys(range(1, 9), True)
        finally:
            leader.close()
        assert not any(torques(bus))


# ------------------------------------------------------------------------------------------------ open and recover


def test_an_arm_that_waits_has_no_torque_until_it_begins(emulated: EmulatedBus) -> None:
    said: list[str] = []
    arm = ServoArm(ArmSettings(port=emulated.port, servos=ONE, watchdog_s=0.1, timeout_s=0.1), said.append)
    arm.open(give_torque=False)
    assert torques(emulated)[0] is False
    # The wait is longer than the watchdog, which is not armed.
    time.sleep(0.3)
    arm.begin()
    assert arm.read()
    assert (arm.fault, torques(emulated)[0]) == (None, True)
    assert [line for line in said if "torque" in line][-2:] == [
        f"dynamixel {emulated.port}: ok       arm: took torque, and moved 0.000 rad meanwhile",
        f"dynamixel {emulated.port}: has torque",
    ]
    # A second `begin` has no effect, even if the torque has ended meanwhile.
    arm.stop(FaultKind.JUMP, "of a test")
    until(lambda: torques(emulated)[0] is False)
    arm.begin()
    time.sleep(0.05)
    assert torques(emulated)[0] is False
    arm.close()


def test_an_arm_that_nobody_reads_for_long_is_given_no_torque(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = arm_of(emulated.port, servos=ONE, watchdog_s=0.1)
    arm.open(give_torque=False)
    # The machine seems to have slept.
    later_s = time.clock_gettime(time.CLOCK_BOOTTIME) + 3600.0
    monkeypatch.setattr("haptether.dynamixel.arm.arm._awake_s", lambda: later_s)
    with pytest.raises(ArmRefusedError, match="not read since: start anew"):
        arm.begin()
    assert torques(emulated)[0] is False
    arm.close()


def test_a_process_that_was_halted_in_its_open_or_its_recovery_gives_no_torque(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    awake = [0.0]
    monkeypatch.setattr("haptether.dynamixel.arm.arm._awake_s", lambda: awake[0])
    placed = ServoArm._place

    def halted(arm: ServoArm, checklist: Checklist) -> None:
        placed(arm, checklist)
        awake[0] += 60.0

    arm = arm_of(emulated.port, servos=ONE, watchdog_s=0.1)
    monkeypatch.setattr(ServoArm, "_place", halted)
    with pytest.raises(ArmRefusedError, match="stood still for 60 s: whoever began it may be gone"):
        arm.open()
    assert torques(emulated)[0] is False
    monkeypatch.setattr(ServoArm, "_place", placed)
    arm.open()
    assert arm.read()
    arm.stop(FaultKind.JUMP, "of a test")
    monkeypatch.setattr(ServoArm, "_place", halted)
    arm.acknowledge(arm.fault)
    until(lambda: not arm.read() and arm.fault_kind == FaultKind.NOT_READY)
    until(lambda: torques(emulated)[0] is False)
    arm.close()


def test_a_process_that_was_halted_before_its_first_read_gets_no_torque_back(emulated: EmulatedBus) -> None:
    arm = arm_of(emulated.port, servos=ONE, watchdog_s=0.1)
    arm.open()
    # Like a SIGSTOP: the watchdogs end the torque, and nobody looks.
    time.sleep(0.3)
    arm.begin()
    until(lambda: not arm.read() and arm.fault is not None)
    assert arm.fault_kind == FaultKind.WATCHDOG
    until(lambda: torques(emulated)[0] is False)
    arm.close()


def test_an_adapter_that_is_pulled_while_it_recovers_recovers_at_the_next_acknowledgement(tmp_path: Path) -> None:
    link = tmp_path / "leader"
    with emulated_bus("--servos", "1=XM430-W350", "--link", str(link)) as emulated:
        emulated.host = str(link)
        with opened(emulated, servos=ONE, timeout_s=0.02) as arm:
            assert arm.read()
            arm.stop(FaultKind.JUMP, "of a test")
            # The open port is gone, and the arm does not know yet.
            emulated.do("unplug")
            for _ in range(2):
                arm.acknowledge(arm.fault)
                until(lambda: not (arm.recovering and not arm.read() and arm.recovering))
                assert arm.fault_kind == FaultKind.NOT_READY
            emulated.do("plug")
            arm.acknowledge(arm.fault)
            until(lambda: arm.read() or not arm.recovering)
            until(lambda: arm.read() and arm.fault is None)


def test_a_recovery_that_has_not_begun_does_not_begin_in_the_next_life(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = arm_of(emulated.port, servos=ONE)
    arm.open()
    arm.stop(FaultKind.JUMP, "of a test")
    begun = threading.Event()
    recover = arm._recover

    def late() -> None:
        begun.wait(0.3)
        recover()

    monkeypatch.setattr(arm, "_recover", late)
    arm.acknowledge(arm.fault)
    arm.close()
    arm.open()
    time.sleep(0.4)
    assert arm.read(), arm.fault
    assert torques(emulated)[0] is True
    arm.close()


def test_other_than_one_number_for_each_servo_is_refused(emulated: EmulatedBus) -> None:
    """One number does not stand for all servos."""
    both = (*ONE, dataclasses.replace(ONE[0], servo_id=2))
    with opened(emulated, servos=both) as arm:
        with pytest.raises(ValueError, match="1 currents: must be 2"):
            arm.write_currents([0.1])
        with pytest.raises(ValueError, match="1 angles: must be 0"):
            arm.write_positions([math.pi])


# ---------------------------------------------------------------------------------------------------- another program


def test_another_program_on_the_bus_ends_in_a_fault_and_no_torque(emulated: EmulatedBus) -> None:
    """The program does not lock the port: the answers to it mix with our reads."""
    with opened(emulated, servos=ONE, timeout_s=0.02) as arm:
        assert arm.read()
        other = os.open(emulated.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            # A write of 0 to Torque Enable of all servos, as another program's stop.
            packet = bytes.fromhex("fffffd00fe060003400000")
            from haptether.dynamixel.emulator.protocol import crc16

            os.write(other, packet + crc16(packet).to_bytes(2, "little"))
            until(lambda: not arm.read() and arm.fault is not None)
            assert arm.fault_kind in {FaultKind.TORQUE_OFF, FaultKind.UNREADABLE, FaultKind.SILENT}
        finally:
            os.close(other)
    assert torques(emulated)[0] is False


def test_an_arm_is_closed_as_often_as_one_likes_and_opened_once(emulated: EmulatedBus) -> None:
    arm = ServoArm(dataclasses.replace(arm_of(emulated.port, servos=ONE).settings), report=lambda _line: None)
    arm.close()
    arm.open()
    with pytest.raises(ValueError, match="is open"):
        arm.open()
    second = arm_of(emulated.port, servos=ONE)
    assert "another process has the port" in refused(second)
    assert torques(emulated)[0] is True
    assert arm.read()
    arm.close()
    arm.close()
    assert torques(emulated)[0] is False
