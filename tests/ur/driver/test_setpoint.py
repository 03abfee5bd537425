"""Bounds on where a UR arm is sent: never faster or more suddenly than it may, and there in the end."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.slave.ur.motion import SetPoint
from haptether.slave.ur.options import ur_options

PERIOD_S = 0.002
coordinates = st.floats(-0.3, 0.3)
points = st.tuples(coordinates, coordinates, coordinates)


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
            # Moved by the mean velocity: no step is longer than the speed allows.
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
    # Straight, and with no swing beyond what a period of the largest acceleration moves.
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
    # Fed forward, what is left is from the acceleration within the settling time, 3 periods: a T² = 0.3 * 36e-6 m.
    assert worst < 0.03 * math.pi**2 * (3 * PERIOD_S) ** 2 * 1.5


@given(points, st.tuples(coordinates, coordinates, coordinates).filter(lambda n: math.hypot(*n) > 0.01))
def test_it_never_leaves_the_workspace(target: tuple[float, float, float], normal: tuple[float, float, float]) -> None:
    # A plane 50 mm behind the start, its normal of any length.
    length = math.hypot(*normal)
    plane = (*normal, -0.05 * length)
    point = SetPoint(0.25, 5.0, PERIOD_S, ur_options({"host": "fake", "workspace": [plane]}).planes)
    point.begin((0.0, 0.0, 0.0))
    for _ in range(1000):
        point.step(target, (-1.0, 1.0, -1.0), PERIOD_S)
        assert point.outside(point.position) < 1e-12
    assert point.outside(target) == pytest.approx(max(0.0, -0.05 - float(np.dot(normal, target)) / length), abs=1e-12)
