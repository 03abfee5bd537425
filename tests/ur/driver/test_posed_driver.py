"""Poses through the driver, against a controller of plain objects: samples, refusals and texts."""

import itertools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.ur.fake_rtde import START_POSE, STOPPED, Arm, install

from haptether.slave import SlaveSample, UrSlave
from haptether.slave.ur.checks import UrRefusedError
from haptether.slave.ur.kinematics.pose import quat_product, quat_wxyz_from_rotvec

pytestmark = pytest.mark.slow

Three = tuple[float, float, float]
REST: Three = (0.0, 0.0, 0.0)
HOME = START_POSE[:3]
BEGIN = quat_wxyz_from_rotvec(START_POSE[3:])
LONG_S = 20.0


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Iterator[Arm]:
    arm = Arm(version=(5, 26, 0, 0))
    install(monkeypatch, arm)
    yield arm
    arm.released.set()


def turned(x: float, y: float, z: float) -> tuple[float, ...]:
    """Return the first orientation, turned by a rotation vector of the base."""
    return quat_product(quat_wxyz_from_rotvec((x, y, z)), BEGIN)


class Driven:
    """An open driver, stepped with poses as by a loop."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        self.driver = UrSlave(host="fake", **({"axes": 3, "mode": "servol", "watchdog_hz": 5} | options))
        self.driver.open()
        self.until(lambda _: self.driver._watchdog.armed)

    def step(
        self, orientation: tuple[float, ...] | None, angular_velocity: tuple[float, ...] | None = None
    ) -> SlaveSample:
        self.driver.read()
        # A machine that stalls makes a pause, after which packages must confirm the state again.
        sample = self.until(lambda sample: sample.fault is not None or self.driver._states.confirmed)
        if sample.fault is None:
            self.driver.write(HOME, REST, orientation, angular_velocity)
        return sample

    def until(self, holds: Callable[[SlaveSample], bool], orientation: tuple[float, ...] = ()) -> SlaveSample:
        end_s = time.monotonic() + LONG_S
        while not holds(sample := self.step(orientation) if orientation else self.driver.read()):
            assert time.monotonic() < end_s, sample
        return sample

    def fault(self, orientation: tuple[float, ...]) -> str:
        """Return the fault of an orientation that is commanded until it appears."""
        sample = self.until(lambda sample: sample.fault is not None, orientation)
        assert sample.fault is not None
        return sample.fault


@pytest.mark.parametrize("axes", [1, 3])
def test_a_sample_has_orientation_angular_velocity_and_torque(arm: Arm, axes: int) -> None:
    arm.speed = [0.01, 0.02, 0.03, 0.1, -0.2, 0.3]
    arm.force = [1.0, 2.0, 3.0, 0.4, 0.5, 0.6]
    driver = UrSlave(host="fake", axes=axes, mode="servol", force_filter_hz=1000.0)
    assert driver.kinds == (("linear", "pose") if axes == 3 else ("linear",))
    driver.open()
    for _ in range(20):
        sample = driver.read()
    assert sample.orientation is not None
    apart = Rotation.from_quat(sample.orientation, scalar_first=True) * Rotation.from_rotvec(START_POSE[3:]).inv()
    assert apart.magnitude() < 1e-12
    assert sample.angular_velocity == (0.1, -0.2, 0.3)
    assert sample.torque == pytest.approx((0.4, 0.5, 0.6), abs=1e-6)
    driver.close()


@pytest.mark.parametrize(
    ("orientation", "angular_velocity", "said"),
    [
        ((1.0, 0.0, 0.0), None, "commanded orientation = [1.0, 0.0, 0.0]: must be 4 finite numbers"),
        ((1.0, 0.0, 0.0, math.nan), None, "must be 4 finite numbers"),
        ((1.0, math.inf, 0.0, 0.0), None, "must be 4 finite numbers"),
        ((0.0, 0.0, 0.0, 0.0), None, "must have length 1, has 0"),
        ((1.0, 0.01, 0.0, 0.0), None, "must have length 1, has 1.00005"),
        (BEGIN, (0.0, 0.0, math.nan), "commanded angular_velocity = [0.0, 0.0, nan]: must be 3 finite numbers"),
        (BEGIN, (0.0, 0.0), "must be 3 finite numbers"),
        (turned(0.06, 0.0, 0.0), None, "commanded to begin 0.060 rad away from the tool's orientation (max_turn 0.05"),
    ],
)
def test_an_orientation_that_cannot_be_is_refused_before_anything_moves(
    arm: Arm,
    orientation: tuple[float, ...],
    angular_velocity: tuple[float, ...] | None,
    said: str,
) -> None:
    driven = Driven()
    driven.step(orientation, angular_velocity)
    assert said in str(driven.driver.read().fault)
    assert "servoL" not in arm.names
    driven.driver.close()


def test_an_orientation_and_its_negative_are_the_same(arm: Arm) -> None:
    driven = Driven()
    for sign in (1.0, -1.0, 1.0):
        driven.until(lambda _: arm.names[-1] == "servoL", tuple(sign * part for part in BEGIN))
        driven.step(tuple(sign * part for part in BEGIN))
    assert driven.driver.read().fault is None
    poses = [call[1] for call in arm.said if call[0] == "servoL"]
    assert max(abs(a - b) for pose in poses for a, b in zip(pose, START_POSE, strict=True)) < 1e-5
    driven.driver.close()


def test_an_orientation_comes_from_the_begin_on_or_not_at_all(arm: Arm) -> None:
    driven = Driven()
    driven.step(None)
    driven.step(BEGIN)
    assert "in the middle of a motion that keeps its orientation" in str(driven.driver.read().fault)
    assert arm.names.count("servoL") <= 1
    driven.driver.close()


def test_one_that_stays_away_leaves_the_tool_as_it_was_commanded_last(arm: Arm) -> None:
    driven = Driven()
    driven.step(BEGIN)
    driven.step(turned(0.0, 0.0, 0.02), (0.0, 0.0, 1.0))
    for _ in range(300):
        driven.step(None)
    pose = [call[1] for call in arm.said if call[0] == "servoL"][-1]
    off = Rotation.from_rotvec(pose[3:]) * Rotation.from_quat(turned(0.0, 0.0, 0.02), scalar_first=True).inv()
    assert off.magnitude() < 1e-4
    driven.driver.close()


def test_along_one_axis_there_is_no_orientation(arm: Arm) -> None:
    driver = UrSlave(host="fake", axes=1, mode="servol")
    driver.open()
    while not (driver._watchdog.armed and driver._states.confirmed):
        driver.read()
    driver.write((START_POSE[0],), (0.0,), BEGIN)
    assert "axes = 3 in the options takes poses" in str(driver.read().fault)
    assert "servoL" not in arm.names
    driver.close()


@pytest.mark.parametrize("mode", ["servoj", "servol", "speedl", "direct-torque"])
def test_an_arm_that_does_not_turn_is_a_fault(arm: Arm, mode: str) -> None:
    driven = Driven(mode=mode, max_angular_speed=0.5)
    driven.step(BEGIN)
    # It accepts every command and stands still: the limit is 0.3 rad, plus 0.3 s and the lookahead at 0.5 rad/s.
    fault = driven.fault(turned(0.0, 0.0, 1.0))
    assert "the arm does not follow: 0.48 rad behind its command (allowed 0.47 rad)" in fault
    stop = {"servoj": "servoStop", "servol": "servoStop", "speedl": "speedStop", "direct-torque": "stopJ"}[mode]
    driven.until(lambda _: stop in arm.names)
    driven.driver.close()


def test_the_cone_is_looked_at_before_the_arm_moves(arm: Arm, capsys: pytest.CaptureFixture[str]) -> None:
    # The tool points down, tilted by 0.05 rad.
    driver = UrSlave(host="fake", axes=3, mode="servol", tool_cone=[0, 0, -1, 0.1])
    driver.open()
    driver.close()
    arm.runtime_state = STOPPED
    assert "ok       tool cone: the tool's axis inside" in capsys.readouterr().err
    with pytest.raises(UrRefusedError, match=r"tool cone: the tool's axis 1\.442 rad outside: turn the tool back"):
        UrSlave(host="fake", axes=3, mode="servol", tool_cone=[1, 0, 0, 0.1]).open()
    assert "servoL" not in arm.names


def test_a_model_that_is_another_cannot_be_led_by_poses(arm: Arm) -> None:
    # Without an orientation servol needs no model.
    driven = Driven(model="ur10e")
    driven.until(lambda _: arm.names[-1] == "servoL" or driven.step(None) is None)
    driven.driver.stop()
    driven.until(lambda _: not driven.driver._soft_stop.stopping)
    driven.step(BEGIN)
    assert "the tool of a ur10e would be" in str(driven.driver.read().fault)
    driven.driver.close()


def test_a_wrist_that_turns_over_is_announced_once(arm: Arm, capsys: pytest.CaptureFixture[str]) -> None:
    driven = Driven()
    driven.step(BEGIN)
    turns = (float(arm.q[4]), 0.5, 0.01, -0.01, 0.01, -0.1, -0.3, -0.3)
    for before, after in itertools.pairwise(turns):
        # No joint turns faster than `MAX_JOINT_RAD_S`.
        for q5 in np.linspace(before, after, 3 + int(abs(after - before) / 0.015)):
            arm.q[4] = q5
            driven.step(BEGIN)
    said = capsys.readouterr().err
    assert said.count("the wrist has turned over: joint 5 is at -0.0") == 1
    assert said.count("turned over") == 1
    driven.driver.close()
