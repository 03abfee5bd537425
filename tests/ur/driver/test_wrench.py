"""Force and moment at the tool of a UR arm: frame, sign, point, filter, deadband."""

import math

import numpy as np
import pytest
from scipy import signal
from scipy.spatial.transform import Rotation

from haptether.slave.ur.wrench import UrWrench

POSE = (0.1, -0.4, 0.2, 0.3, -1.2, 0.7)
TOOL = (0.0, 0.0, 0.15, 0.4, 0.1, -0.3)


def test_the_controllers_force_is_along_the_base_already() -> None:
    wrench = UrWrench(raw=False, tool=TOOL, filter_hz=None, deadband_n=0.0)
    assert wrench.felt((1.0, -2.0, 3.0, 9.0, 8.0, 7.0), POSE, 0.002) == ((1.0, -2.0, 3.0), (9.0, 8.0, 7.0))


def test_the_raw_force_is_turned_from_the_flange_to_the_base() -> None:
    wrench = UrWrench(raw=True, tool=TOOL, filter_hz=None, deadband_n=0.0)
    base_from_tool, flange_from_tool = Rotation.from_rotvec(POSE[3:]), Rotation.from_rotvec(TOOL[3:])
    pushed = np.array((5.0, -1.0, 2.0))
    shown = (base_from_tool * flange_from_tool.inv()).inv().apply(pushed)
    assert wrench.felt((*shown, 0.0, 0.0, 0.0), POSE, 0.002)[0] == pytest.approx(tuple(pushed), abs=1e-12)
    wrench.zero([(*shown, 0.0, 0.0, 0.0)], POSE)
    assert wrench.felt((*shown, 0.0, 0.0, 0.0), POSE, 0.002)[0] == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_the_payload_is_taken_away_in_every_orientation() -> None:
    """Zero a sensor with a bias and 1.5 kg on it once, and then turn it; SciPy gives the rotations."""
    flange_from_tool = Rotation.from_rotvec(TOOL[3:])
    bias, weight = np.array((2.0, -3.0, 0.5)), np.array((0.0, 0.0, -1.5 * 9.80665))

    def shown(rotvec: tuple[float, ...], pushed: tuple[float, ...]) -> tuple[float, ...]:
        base_from_flange = Rotation.from_rotvec(rotvec) * flange_from_tool.inv()
        return (*(bias + base_from_flange.inv().apply(np.array(pushed) + weight)), 0.0, 0.0, 0.0)

    wrench = UrWrench(raw=True, tool=TOOL, filter_hz=None, deadband_n=0.0, payload_kg=1.5)
    wrench.zero([shown(POSE[3:], (0.0, 0.0, 0.0))], POSE)
    for rotation in ((0.0, 0.0, 0.0), (1.2, 0.0, 0.0), (0.3, -2.0, 0.9)):
        pose = (*POSE[:3], *rotation)
        for pushed in ((0.0, 0.0, 0.0), (5.0, -1.0, 2.0)):
            assert wrench.base_wrench(shown(rotation, pushed), pose)[0] == pytest.approx(pushed, abs=1e-12)


def test_one_wrong_force_does_not_move_the_zero() -> None:
    wrench = UrWrench(raw=True, tool=(0.0,) * 6, filter_hz=None, deadband_n=0.0)
    right = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    wrench.zero([right, (40.0, *right[1:]), right, (*right[:5], -9.0), right], POSE)
    assert wrench.base_wrench(right, POSE) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_the_filter_is_the_discrete_one_of_its_corner() -> None:
    """Compare with SciPy's zero-order hold of 1/(1 + s/2 pi f)."""
    corner, period_s = 2 * math.pi * 30.0, 0.002
    b, a, _ = signal.cont2discrete((np.array([corner]), np.array([1.0, corner])), period_s)
    x = np.random.default_rng(1).normal(size=200)
    wrench = UrWrench(raw=False, tool=(0.0,) * 6, filter_hz=30.0, deadband_n=0.0)
    y = [wrench.felt((value, 0.0, 0.0, 0.0, 0.0, 0.0), POSE, period_s)[0][0] for value in x]
    # SciPy's output comes one sample after an input that acts at once; both begin at the first.
    want = signal.lfilter(b.ravel()[1:], a, x, zi=[x[0] * (1 - b.ravel()[1])])[0]
    assert y == pytest.approx(want, abs=1e-12)


def test_the_moment_is_that_about_the_tool_point_whatever_the_flange_carries() -> None:
    """Use a sensor of moments about the flange, with a bias and 1.5 kg off its axis; SciPy gives the rotations."""
    flange_from_tool = Rotation.from_rotvec(TOOL[3:])
    bias, cog = np.array((2.0, -3.0, 0.5, 0.1, 0.2, -0.3)), np.array((0.02, -0.01, 0.08))
    weight = np.array((0.0, 0.0, -1.5 * 9.80665))

    def shown(rotvec: tuple[float, ...], force: tuple[float, ...], torque: tuple[float, ...]) -> tuple[float, ...]:
        base_from_flange = Rotation.from_rotvec(rotvec) * flange_from_tool.inv()
        about_flange = (
            np.array(torque)
            + np.cross(base_from_flange.apply(TOOL[:3]), force)
            + np.cross(base_from_flange.apply(cog), weight)
        )
        inverse = base_from_flange.inv()
        return tuple(bias + np.concatenate((inverse.apply(np.array(force) + weight), inverse.apply(about_flange))))

    nothing = (0.0, 0.0, 0.0)
    wrench = UrWrench(
        raw=True, tool=TOOL, filter_hz=None, deadband_n=0.0, payload_kg=1.5, payload_cog=(0.02, -0.01, 0.08)
    )
    wrench.zero([shown(POSE[3:], nothing, nothing)], POSE)
    for rotation in (nothing, (1.2, 0.0, 0.0), (0.3, -2.0, 0.9)):
        for force, torque in ((nothing, nothing), ((5.0, -1.0, 2.0), nothing), ((5.0, -1.0, 2.0), (0.3, 0.1, -0.2))):
            felt = wrench.felt(shown(rotation, force, torque), (*POSE[:3], *rotation), 0.002)
            assert felt[0] == pytest.approx(force, abs=1e-12)
            assert felt[1] == pytest.approx(torque, abs=1e-12)


def test_the_moment_goes_through_the_same_filter() -> None:
    wrench = UrWrench(raw=False, tool=(0.0,) * 6, filter_hz=30.0, deadband_n=0.0)
    for value in np.random.default_rng(1).normal(size=20):
        force, torque = wrench.felt((value, 0.0, 0.0, value, 0.0, 0.0), POSE, 0.002)
        assert force == torque


def test_the_deadband_takes_the_same_of_every_direction_and_leaves_no_step() -> None:
    wrench = UrWrench(raw=False, tool=(0.0,) * 6, filter_hz=None, deadband_n=2.0)
    assert wrench.felt((1.2, 1.6, 0.0, 0.0, 0.0, 0.0), POSE, 0.002)[0] == (0.0, 0.0, 0.0)
    assert wrench.felt((3.0, 4.0, 0.0, 0.0, 0.0, 0.0), POSE, 0.002)[0] == pytest.approx((1.8, 2.4, 0.0))
    assert wrench.felt((0.0,) * 6, POSE, 0.002)[0] == (0.0, 0.0, 0.0)
    assert math.hypot(*wrench.felt((2.0 + 1e-9, 0.0, 0.0, 0.0, 0.0, 0.0), POSE, 0.002)[0]) < 1e-8
