"""An arm led by joint angles stays within the planes of its workspace and clear of itself."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.ur.fake_rtde import START_Q

from haptether.slave import SelfKeepOut, StreamingLimits, UrKinematics, UrModel, UrStreaming, ur_model
from haptether.slave.ur.kinematics import program
from haptether.slave.ur.kinematics.constraints import arm_body
from haptether.slave.ur.kinematics.pose import pose_from_transform
from haptether.slave.ur.modes import JointTracking, UnreachableError
from haptether.slave.ur.options import ur_options
from haptether.slave.ur.set_point import SetPoint
from haptether.slave.ur.state import UrState

Array = npt.NDArray[np.float64]

MODEL = ur_model("ur5e")
INWARD = np.array((0.143, 0.436, 0.0)) / math.hypot(0.143, 0.436)
"""Direction from the tool at the start to the axis of the base."""


@dataclass
class Led:
    """Path of an arm that was led."""

    q: Array
    """Joint angles at each period, (n, 6)."""
    away: Array
    """Displacement of the controller's tool from its start, (n, 3), m."""
    behind: Array
    """Distance of the tool from its set point, (n, 3), m."""
    fault: str


def led(
    towards: Array,
    length_m: float,
    *,
    speed: float = 0.25,
    period_s: float = 0.002,
    off: tuple[float, float, float] = (0.0, 0.0, 0.0),
    q: tuple[float, ...] = START_Q,
    model: UrModel = MODEL,
    **given: Any,  # noqa: ANN401  # options
) -> Led:
    """Lead the tool along a straight line at a speed, and let it settle; the controller's tool is `off` away."""
    kinematics = UrKinematics(model)
    pose = pose_from_transform(np.array(kinematics.forward(q)))
    pose[:3] += off
    state = UrState(1.0, q, q, (0.0,) * 6, tuple(pose.tolist()), (0.0,) * 6, (0.0,) * 6, 7, 1, 1, 2, 1.0)
    options = ur_options({"host": "fake", "model": model.name, "max_speed": speed} | given)
    joints = JointTracking(kinematics, options, period_s)
    point = SetPoint(options.max_speed, options.max_acceleration, period_s, options.planes)
    home = np.array(pose[:3])
    joints.begin(state)
    point.begin((home[0], home[1], home[2]))
    angles, away, behind, fault = [], [], [], ""
    for index in range(round((length_m / speed + 1.0) / period_s)):
        x, y, z = (home + towards * min(length_m, speed * period_s * index)).tolist()
        v = speed if speed * period_s * index < length_m else 0.0
        vx, vy, vz = (v * towards).tolist()
        point.step((x, y, z), (vx, vy, vz), period_s)
        try:
            joints.follow(point.position, point.velocity, period_s)
        except UnreachableError as error:
            fault = str(error)
            break
        angles.append(joints.q)
        there = kinematics.forward(joints.q)[:3, 3] + off
        away.append(there - home)
        behind.append(np.array(point.position) - there)
    return Led(np.array(angles), np.array(away), np.array(behind), fault)


def plane_ahead(towards: Array, at_m: float, off: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[float]:
    """Return the plane across the path, at this distance from the start; its normal has a length of 3."""
    home = np.array(UrKinematics(MODEL).forward(START_Q))[:3, 3] + off
    return [*(-3.0 * towards).tolist(), -3.0 * (float(towards @ home) + at_m)]


@pytest.mark.parametrize("period_s", [0.002, 0.008])
@pytest.mark.parametrize(
    ("speed", "acceleration"), [(0.25, 5.0), (1.0, 5.0), (1.0, 20.0), (3.0, 20.0)], ids=lambda value: f"{value:g}"
)
def test_an_arm_that_is_led_beyond_a_plane_stops_at_it(speed: float, acceleration: float, period_s: float) -> None:
    towards = np.array((1.0, 0.0, -0.3)) / math.hypot(1.0, 0.3)
    arm = led(
        towards, 0.15, speed=speed, period_s=period_s, max_acceleration=acceleration,
        workspace=[plane_ahead(towards, 0.06)],
    )  # fmt: skip
    assert arm.fault == ""
    along = arm.away @ towards
    # It approaches the plane from within at a rate of 10 Hz, or less where that would exceed 10 m/s^2. The path of a
    # period bends by less than 1 um.
    assert along.max() <= 0.06 + 1e-6
    assert along[-1] == pytest.approx(0.06, abs=1e-4 + 0.06 * math.exp(-10.0 / max(1.0, speed)))


@pytest.mark.parametrize("period_s", [0.002, 0.008])
@pytest.mark.parametrize("across", [[(0.0, 0.0)], [(0.0, 0.9), (-0.2, 0.2)]], ids=["one plane", "a wedge"])
def test_an_arm_that_comes_to_a_plane_at_full_speed_does_not_fault(
    across: list[tuple[float, float]], period_s: float
) -> None:
    # The arm is a UR20 across its front: none of the smaller ones is as fast as the options allow.
    model, q, towards = ur_model("ur20"), (0.0, -0.4, 1.0, -2.17, -1.57, 0.0), np.array((0.0, 1.0, 0.0))
    home = np.array(UrKinematics(model).forward(q))[:3, 3]
    normals = [np.array((x, -1.0, z)) for x, z in across]
    planes = [[*normal.tolist(), float(normal @ (home + 0.95 * towards))] for normal in normals]
    arm = led(
        towards, 1.1, speed=3.0, period_s=period_s, q=q, model=model, max_acceleration=20.0, workspace=planes,
    )  # fmt: skip
    assert arm.fault == ""
    assert (np.diff(arm.away, axis=0) @ towards).max() > 2.6 * period_s
    # The set point stops at once, and the tool from 0.9 m before it on.
    assert np.linalg.norm(arm.behind, axis=1).max() > 0.25
    for normal in normals:
        assert (arm.away @ normal).min() >= 0.95 * normal[1] - 1e-6


@pytest.mark.parametrize("speed", [1.5, 3.0])
@pytest.mark.parametrize(
    ("towards", "ahead_m"),
    [((1.0, 0.0, 0.0), (0.4, 0.9)), ((-1.0, 0.0, 0.0), (0.4, 0.9)), ((0.0, 0.0, 1.0), (0.6, 0.9))],
    ids=["outwards", "inwards", "up"],
)
def test_an_arm_that_cannot_follow_faults_before_a_plane_as_it_does_without(
    towards: tuple[float, ...], ahead_m: tuple[float, ...], speed: float
) -> None:
    # If the joints cannot follow, the fault does not blame a plane at which the arm would also brake.
    direction = np.array(towards)
    free = led(direction, 1.2, speed=speed, max_acceleration=20.0)
    assert "the tool cannot follow" in free.fault
    for at_m in ahead_m:
        bounded = led(direction, 1.2, speed=speed, max_acceleration=20.0, workspace=[plane_ahead(direction, at_m)])
        assert "the tool cannot follow" in bounded.fault
        assert len(free.q) <= len(bounded.q) <= len(free.q) + 5
        assert np.linalg.norm(bounded.behind[-1]) < 0.03


def test_the_plane_is_where_the_controller_has_the_tool() -> None:
    # The offset equals the error of another model of the same size, and exceeds the tool's distance from the plane.
    off = (0.004, -0.003, 0.002)
    towards = np.array((1.0, 0.0, 0.0))
    arm = led(towards, 0.1, off=off, workspace=[plane_ahead(towards, 0.003, off)])
    along = arm.away @ towards
    assert arm.fault == ""
    assert along.max() <= 0.003 + 1e-6
    assert along[-1] == pytest.approx(0.003, abs=1e-4)


def test_far_from_planes_and_from_itself_commands_are_the_same_to_the_bit() -> None:
    towards = np.array((0.6, 0.0, 0.8))
    free = led(towards, 0.15)
    bounded = led(towards, 0.15, workspace=[plane_ahead(towards, 0.4), [0.0, 0.0, 1.0, -0.5]])
    assert free.fault == bounded.fault == ""
    assert free.q.tobytes() == bounded.q.tobytes()


def clearances(path: Array) -> tuple[Array, tuple[str, ...]]:
    """Return the arm's distances from itself minus the driver's margin, for the joint angles of a path."""
    steps = UrStreaming(UrKinematics(MODEL), StreamingLimits(self_keep_out=SelfKeepOut()), period_s=0.002)
    found = []
    for q in path:
        # Without bounds the row of a distance d has the lower bound -10 d; below 0 it is cut at 1 mm/s.
        steps.velocity(q, np.zeros(6), np.zeros(6))
        found.append(-steps.program.lower[6:] / 10.0)
    return np.array(found), steps.rows


def test_an_arm_that_is_led_into_itself_stays_clear_and_says_why() -> None:
    arm = led(INWARD, 0.44)
    distances, rows = clearances(arm.q)
    assert distances.min() >= -1e-5
    nearest = rows[int(distances[-1].argmin())]
    assert "the tool cannot follow" in arm.fault
    assert f"held back by {nearest}" in arm.fault


def test_without_the_keep_out_it_would_hit_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    # Links so thin that they hardly meet: the test above must owe its result to the keep-out alone.
    with monkeypatch.context() as patch:
        patch.setattr(program, "arm_body", lambda model, _: arm_body(model, 1e-3))
        arm = led(INWARD, 0.44)
    distances, _ = clearances(arm.q)
    assert distances.min() < -9e-5


@pytest.mark.parametrize("towards", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_an_arm_that_begins_closer_to_itself_than_it_may_does_not_move_by_itself(towards: tuple[float, ...]) -> None:
    folded = (0.0, -1.57, 2.7, -1.2, -1.57, 0.0)
    distances, _ = clearances(np.array([folded]))
    assert distances.min() < 0
    still = led(np.array(towards), 0.0, q=folded)
    assert still.fault == ""
    assert np.abs(still.q - folded).max() < 1e-9
