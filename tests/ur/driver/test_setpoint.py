"""Bounds on the set point of a UR arm: speed and acceleration within limits, and the target reached in the end."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.slave.ur.kinematics.constraints import ToolCone
from haptether.slave.ur.kinematics.pose import quat_wxyz_from_rotvec, turn_between
from haptether.slave.ur.options import ur_options
from haptether.slave.ur.set_point import Attitude, OrientationSetPoint, SetPoint

PERIOD_S = 0.002
coordinates = st.floats(-0.3, 0.3)
points = st.tuples(coordinates, coordinates, coordinates)
parts = st.floats(-1.0, 1.0)
# Each orientation is far from the previous one: jumps of up to half a turn.
orientations = (
    st.tuples(parts, parts, parts, parts)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(part / math.hypot(*q) for part in q))
)
rates = st.sampled_from([(0.0, 0.0, 0.0), (0.5, -0.2, 0.1), (4.0, 3.0, -8.0)])
cones = st.one_of(
    st.none(), st.builds(lambda x, y, half: ToolCone.around(x, y, 1.0, half), parts, parts, st.floats(0.1, 3.0))
)
REST = (0.0, 0.0, 0.0)


@given(st.lists(points, min_size=1, max_size=8), st.sampled_from([0.002, 0.008]))
def test_speed_and_acceleration_are_kept_whatever_is_asked(targets: list[tuple[float, ...]], period_s: float) -> None:
    point = SetPoint(0.25, 5.0, period_s)
    point.begin((0.0, 0.0, 0.0))
    before = point.position, point.velocity
    for target in targets:
        for _ in range(40):
            point.step(target, (3.0, -3.0, 3.0), period_s)  # type: ignore[arg-type]  # three numbers
            change = math.dist(point.velocity, before[1])
            assert math.hypot(*point.velocity) <= 0.25 * (1 + 1e-12)
            assert change <= 5.0 * period_s * (1 + 1e-12)
            # It moves by the mean velocity: no step is longer than the speed allows.
            assert math.dist(point.position, before[0]) <= 0.25 * period_s * (1 + 1e-12)
            before = point.position, point.velocity


@given(points, st.sampled_from([0.002, 0.008]))
def test_it_comes_to_rest_on_a_target_that_rests(target: tuple[float, float, float], period_s: float) -> None:
    point = SetPoint(0.25, 5.0, period_s)
    point.begin((0.0, 0.0, 0.0))
    away = [math.hypot(*target)]
    for _ in range(int(6.0 / period_s)):
        point.step(target, (0.0, 0.0, 0.0), period_s)
        away.append(math.dist(point.position, target))
    assert away[-1] < 1e-9
    assert math.hypot(*point.velocity) < 1e-9
    # The path is straight, and overshoots at most by the motion of one period at the largest acceleration.
    line = np.array(point.position) / max(away[0], 1e-12)
    assert float(np.dot(line, target)) <= away[0] + 5.0 * period_s**2


def test_what_may_be_followed_is_followed_without_lag() -> None:
    point = SetPoint(0.25, 5.0, PERIOD_S)
    point.begin((0.0, 0.0, 0.0))
    worst = 0.0
    for tick in range(1, 2000):
        t = tick * PERIOD_S
        x, v = 0.03 * (1 - math.cos(math.pi * t)), 0.03 * math.pi * math.sin(math.pi * t)
        point.step((x, 0.0, 0.0), (v, 0.0, 0.0), PERIOD_S)
        worst = max(worst, abs(point.position[0] - x))
    # With feed-forward, the error is that of the acceleration within the settling time, 3 periods: a T² = 0.3 * 36e-6
    # m.
    assert worst < 0.03 * math.pi**2 * (3 * PERIOD_S) ** 2 * 1.5


@given(points, st.tuples(coordinates, coordinates, coordinates).filter(lambda n: math.hypot(*n) > 0.01))
def test_it_never_leaves_the_workspace(target: tuple[float, float, float], normal: tuple[float, float, float]) -> None:
    # A plane 50 mm behind the start; its normal has any length.
    length = math.hypot(*normal)
    plane = (*normal, -0.05 * length)
    point = SetPoint(0.25, 5.0, PERIOD_S, ur_options({"host": "fake", "workspace": [plane]}).planes)
    point.begin((0.0, 0.0, 0.0))
    for _ in range(1000):
        point.step(target, (-1.0, 1.0, -1.0), PERIOD_S)
        assert point.outside(point.position) < 1e-12
    assert point.outside(target) == pytest.approx(max(0.0, -0.05 - float(np.dot(normal, target)) / length), abs=1e-12)


@given(
    st.lists(st.tuples(orientations, rates), min_size=1, max_size=6),
    cones,
    st.sampled_from([0.002, 0.008]),
    st.sampled_from([(1.0, 10.0), (6.0, 50.0), (6.0, 10.0), (0.3, 50.0)]),
)
def test_turns_keep_to_speed_acceleration_and_cone_whatever_is_asked(
    targets: list[tuple[tuple[float, ...], tuple[float, ...]]],
    cone: ToolCone | None,
    period_s: float,
    bounds: tuple[float, float],
) -> None:
    speed, acceleration = bounds
    set_point = OrientationSetPoint(speed, acceleration, period_s, cone)
    # The tool's axis is on that of the cone.
    begin = (1.0, 0.0, 0.0, 0.0) if cone is None else pointing(cone.axis)
    set_point.begin(begin)
    before = set_point.attitude
    for orientation, velocity in targets:
        for _ in range(60):
            set_point.step(Attitude(orientation, velocity), period_s)  # type: ignore[arg-type]  # four and three numbers
            now = set_point.attitude
            assert math.hypot(*now.angular_velocity) <= speed * (1 + 1e-12)
            change = math.dist(now.angular_velocity, before.angular_velocity)
            assert change <= acceleration * period_s * (1 + 1e-12)
            turned = math.hypot(*turn_between(before.orientation, now.orientation))
            assert turned <= speed * period_s * (1 + 1e-9) + 1e-15
            assert math.hypot(*now.orientation) == pytest.approx(1.0, abs=1e-15)
            assert set_point.outside(now.orientation) < 1e-12
            before = now


def pointing(axis: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Return an orientation with the tool's z axis along an axis of the upper half."""
    x, y, z = axis
    length = math.hypot(x, y)
    angle = math.atan2(length, z)
    return quat_wxyz_from_rotvec((-y / length * angle, x / length * angle, 0.0) if length > 0.0 else REST)


@given(orientations, st.sampled_from([0.002, 0.008]))
def test_a_turn_comes_to_rest_on_an_orientation_that_rests(target: tuple[float, ...], period_s: float) -> None:
    set_point = OrientationSetPoint(1.0, 10.0, period_s)
    set_point.begin((1.0, 0.0, 0.0, 0.0))
    away = [math.hypot(*turn_between(set_point.attitude.orientation, target))]  # type: ignore[arg-type]
    for _ in range(int(6.0 / period_s)):
        set_point.step(Attitude(target, REST), period_s)  # type: ignore[arg-type]
        away.append(math.hypot(*turn_between(set_point.attitude.orientation, target)))  # type: ignore[arg-type]
    assert away[-1] < 1e-8
    assert math.hypot(*set_point.attitude.angular_velocity) < 1e-8
    # It takes the shorter way round, and brakes a period late: it overshoots at most by the turn of one period.
    assert np.diff(away).max() <= 1.0 * period_s


def test_a_turn_that_may_be_followed_is_followed_without_lag() -> None:
    set_point = OrientationSetPoint(3.0, 20.0, PERIOD_S)
    set_point.begin((1.0, 0.0, 0.0, 0.0))
    axis, worst = (0.6, 0.0, 0.8), 0.0
    for tick in range(1, 2000):
        t = tick * PERIOD_S
        # To and fro through more than half a turn.
        angle, rate = 2.0 * (1 - math.cos(t)), 2.0 * math.sin(t)
        wanted = quat_wxyz_from_rotvec([angle * part for part in axis])
        set_point.step(Attitude(wanted, (rate * axis[0], 0.0, rate * axis[2])), PERIOD_S)
        worst = max(worst, math.hypot(*turn_between(set_point.attitude.orientation, wanted)))
    # The error is that of the acceleration within the settling time, 3 periods: a T² = 2 * 36e-6 rad.
    assert worst < 2.0 * (3 * PERIOD_S) ** 2 * 1.5


def test_a_tool_that_begins_outside_its_cone_comes_back_and_does_not_leave_again() -> None:
    cone = ToolCone(axis=(0.0, 0.0, 1.0), half_angle=0.5)
    set_point = OrientationSetPoint(1.0, 10.0, PERIOD_S, cone)
    set_point.begin(quat_wxyz_from_rotvec((0.6, 0.0, 0.0)))
    beyond = [set_point.outside(set_point.attitude.orientation)]
    for angle in (1.5, 0.0, 1.5):
        for _ in range(1000):
            set_point.step(Attitude(quat_wxyz_from_rotvec((angle, 0.0, 0.0)), REST), PERIOD_S)
            beyond.append(set_point.outside(set_point.attitude.orientation))
    assert beyond[0] == pytest.approx(0.1)
    # It never goes further out, and once inside it stays there.
    assert max(np.diff(beyond)) < 1e-12
    assert max(beyond[1200:]) < 1e-12
    tilt, _ = cone.tilt(set_point.attitude.orientation)
    assert tilt == pytest.approx(0.5, abs=1e-6)
