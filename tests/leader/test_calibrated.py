"""An arm whose servos are mounted differently from its description: calibrated by a person, then used to lead."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.dynamixel.test_calibrate import Calibration, at_least_one_read
from tests.dynamixel.test_description import TWO_LINKS
from tests.leader.test_driver import motors, run

from haptether.dynamixel.arm import read_calibration
from haptether.dynamixel.description import ArmDescription, ArmKinematics, load_arm
from haptether.dynamixel.emulator import mounted
from haptether.master.dynamixel import DynamixelMaster

OFFSETS, SIGNS = (1.1, -0.7), (-1, 1)
STIFF = "800 8"
"""Hand that holds a joint, in N m/rad and N m s/rad: it yields to the weight by 1 mrad."""


@pytest.fixture
def two(tmp_path: Path) -> Path:
    path = tmp_path / "two.toml"
    path.write_text(TWO_LINKS)
    return path


@pytest.fixture
def bus(two: Path) -> Iterator[EmulatedBus]:
    built_in = ("--mount-offsets", *map(str, OFFSETS), "--mount-signs", *map(str, SIGNS))
    with emulated_bus("--arm", str(two), *built_in, "--start", "0.2", "0.5") as running:
        yield running


def held(bus: EmulatedBus, arm: ArmDescription, *q: float) -> None:
    """Hold the joints at angles of the real arm."""
    for joint, angle in zip(arm.joints, q, strict=True):
        bus.do(f"hand {joint.servo} {joint.sign * angle + joint.offset_rad} {STIFF} 0.1")
    at_least_one_read()


def calibrated(bus: EmulatedBus, arm: ArmDescription, path: Path) -> None:
    calibration = Calibration(bus, path, "--baud", "4000000")
    try:
        calibration.until("hold the arm")
        calibration.enter()
        calibration.until("put the arm into the pose (0, 0)")
        held(bus, arm, 0.0, 0.0)
        calibration.enter()
        calibration.until("turn joint 1")
        held(bus, arm, 0.5, 0.0)
        calibration.enter()
        calibration.until("turn joint 2")
        held(bus, arm, 0.5, 0.6)
        calibration.enter()
        calibration.until("move each joint")
        for q in ((-1.5, -1.2), (0.0, 0.0), (1.5, 1.2)):
            held(bus, arm, *q)
        calibration.enter()
        status, said = calibration.end()
        assert status == 0, said
    finally:
        calibration.close()


@pytest.mark.alone
@pytest.mark.timeout(120)
def test_a_calibrated_arm_is_compensated_in_its_own_frame_and_one_that_is_not_is_not(
    two: Path, bus: EmulatedBus, tmp_path: Path
) -> None:
    built = mounted(load_arm(two), OFFSETS, SIGNS)
    file = tmp_path / "unit.toml"
    calibrated(bus, built, file)
    _, servos = read_calibration(file)
    for servo, joint in zip(servos, built.joints, strict=True):
        assert servo.sign == joint.sign
        assert math.remainder(servo.offset_rad - joint.offset_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=5e-3)
    q = (0.4, -0.6)
    held(bus, built, *q)
    bus.do("hand 3 0.6 40 1")
    weight = ArmKinematics(load_arm(two)).gravity(q)
    wanted = [joint.sign * torque for joint, torque in zip(built.joints, weight, strict=True)]
    constants = [joint.servo_model.nominal_nm_per_a for joint in built.joints]
    patient: dict[str, Any] = {"ramp_s": 0.1, "watchdog_s": 0.5, "verify_watchdog": False, "torque_constant": constants}
    found = {}
    for name, given in (("calibrated", {"calibration": str(file)}), ("described", {})):
        leader = DynamixelMaster(port=bus.port, arm=str(two), **patient, **given)
        leader.open()
        try:
            run(leader, 0.4, (0.0, 0.0))
            sample = leader.read()
            assert sample.fault is None
            found[name] = list(sample.position), motors(bus)[:2]  # type: ignore[arg-type]
        finally:
            leader.close()
    position, torques = found["calibrated"]
    assert position == pytest.approx(q, abs=0.01)
    assert torques == pytest.approx(wanted, abs=0.01)
    position, torques = found["described"]
    assert position != pytest.approx(q, abs=0.3)
    assert torques != pytest.approx(wanted, abs=0.2)


def test_how_servos_are_built_in_is_one_number_of_each_joint(two: Path) -> None:
    arm = load_arm(two)
    assert mounted(arm) == arm
    built = mounted(arm, OFFSETS, SIGNS)
    assert [joint.sign for joint in built.joints] == [-1, -1]
    assert [joint.offset_rad for joint in built.joints] == pytest.approx([1.1, -0.3])
    with pytest.raises(ValueError, match="offsets: 1: must be 2, one of each joint of two"):
        mounted(arm, (0.1,))
    with pytest.raises(ValueError, match="signs: 3: must be 2"):
        mounted(arm, (), (1, 1, 1))
    with pytest.raises(ValueError, match="sign = 2: must be 1 or -1"):
        mounted(arm, (), (1, 2))
    with pytest.raises(ValueError, match="offset = nan: must be at most 13 rad"):
        mounted(arm, (0.0, math.nan))
