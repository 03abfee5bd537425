"""Inverse kinematics of UR arms: every branch leads back to the pose, and the nearest is close to the last posture."""

import math
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pytest

from haptether.slave import UR_MODELS, UrCalibration, UrInverse, UrKinematics, UrModel, ur_model
from haptether.slave.ur.kinematics.chain import chain_transform, dh_rows
from ur.arms import CALIBRATIONS, TOOL

Array = npt.NDArray[np.float64]

ARMS: dict[str, tuple[UrModel, UrCalibration | None]] = {
    **{name: (model, None) for name, model in UR_MODELS.items()},
    **CALIBRATIONS,
}
# Required tolerance; ours is 1e-14 for a model, and 2e-13 for common normals 446 m away.
TIGHT = 1e-12


def postures(count: int, seed: int = 11) -> Array:
    return np.random.default_rng(seed).uniform(-2 * math.pi, 2 * math.pi, (count, 6))


def apart(one: Array, other: Array) -> float:
    """Return the largest difference of two postures, modulo turns."""
    return float(np.abs(np.remainder(one - other + math.pi, 2 * math.pi) - math.pi).max())


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("tool", [np.eye(4), TOOL], ids=["flange", "tool"])
def test_the_round_trip_over_random_poses(arm: str, tool: Array) -> None:
    model, calibration = ARMS[arm]
    forward, inverse = UrKinematics(model, calibration, tool), UrInverse(model, calibration, tool)
    for q in postures(120):
        pose = forward.forward(q).copy()
        found = inverse.all(pose)
        assert 1 <= len(found) <= 8
        for posture in found:
            np.testing.assert_allclose(forward.forward(posture), pose, rtol=0, atol=TIGHT)
        nearest = inverse.nearest(pose, q)
        assert nearest is not None, inverse.reason
        np.testing.assert_allclose(forward.forward(nearest), pose, rtol=0, atol=TIGHT)
        # The inverse of the Jacobian carries the remaining error of the pose into the joints.
        left = TIGHT if calibration else 1e-14
        jacobian = forward.forward_and_jacobian(q)[1]
        assert np.abs(nearest - q).max() <= 1e-10 + left * 100 * np.linalg.cond(jacobian)


@pytest.mark.parametrize("arm", ["ur3", "ur5e", "ur10e", "ur20"])
def test_a_posture_without_singularity_has_branches_that_differ(arm: str) -> None:
    inverse = UrInverse(ur_model(arm))
    forward = UrKinematics(ur_model(arm))
    q = np.array((0.4, -1.3, 1.6, 0.7, 0.9, -2.0))
    found = inverse.all(forward.forward(q))
    assert len(found) == 8
    assert min(apart(one, other) for one, other in combinations(found, 2)) > 0.1
    assert min(apart(q, posture) for posture in found) < 1e-12


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    ("name", "middle", "step"),
    [
        ("wrist", (0.4, -1.3, 1.1, 0.6, 0.0, -2.0), (0.3, -0.2, 0.5, 0.1, 1.0, -0.7)),
        ("wrist, the other way", (0.4, -1.3, 1.1, 0.6, math.pi, -2.0), (0.0, 0.0, 0.0, 0.0, 1.0, 0.0)),
        ("elbow, stretched", (0.4, -1.3, 0.0, 0.6, 1.2, -2.0), (0.2, 0.4, 1.0, -0.3, 0.5, 0.1)),
        ("wrist and elbow", (0.4, -1.3, 0.0, 0.6, 0.0, -2.0), (0.2, 0.4, 1.0, -0.3, 0.9, 0.1)),
        ("upright", (0.0, -math.pi / 2, 0.0, -math.pi / 2, 0.0, 0.0), (0.5, 0.4, 1.0, -0.3, 0.9, 0.1)),
    ],
)
def test_a_path_goes_on_through_a_singularity(arm: str, name: str, middle: list[float], step: list[float]) -> None:
    model, calibration = ARMS[arm]
    inverse, rows = UrInverse(model, calibration), dh_rows(model, calibration)
    path = np.array(middle) + np.linspace(-0.05, 0.05, 101)[:, None] * np.array(step)
    before, posture = path[0], path[0]
    for q in path:
        # Search from the next expected posture: where two branches meet, both are equally near to the last one.
        found = inverse.nearest(chain_transform(rows, q), 2 * posture - before)
        assert found is not None, f"{name}: {inverse.reason}"
        before, posture = posture, found
        # A step is 1e-3 rad long. In the middle, q3 may be off by the root of rounding over the shortest reach, and q6
        # by a step where it is free. The other branches are much farther, except where they meet.
        np.testing.assert_allclose(posture, q, rtol=0, atol=5e-3)
        np.testing.assert_allclose(chain_transform(rows, posture), chain_transform(rows, q), rtol=0, atol=TIGHT)


@pytest.mark.parametrize("near", [(0.0,) * 6, (6.2, -6.2, 3.0, -3.0, 1.0, 6.2), (-6.2,) * 6])
def test_the_nearest_is_the_nearest_of_all_branches_and_turns(near: tuple[float, ...]) -> None:
    model = ur_model("ur5e")
    inverse, forward = UrInverse(model), UrKinematics(model)
    for q in postures(100):
        pose = forward.forward(q)
        found = inverse.nearest(pose, np.array(near))
        assert found is not None
        distances = []
        for posture in inverse.all(pose):
            turns = posture[:, None] + 2 * math.pi * np.arange(-2, 3)
            allowed = np.abs(turns) <= 2 * math.pi
            away = np.where(allowed, np.abs(turns - np.array(near)[:, None]), np.inf)
            distances.append(float((away.min(axis=1) ** 2).sum()))
        assert np.square(found - near).sum() == pytest.approx(min(distances), rel=1e-9, abs=1e-12)
        assert (np.abs(found) <= 2 * math.pi).all()


def test_limits_of_the_model_are_kept() -> None:
    narrow = replace(ur_model("ur5e"), position_min=(-1.0,) * 6, position_max=(1.0,) * 6)
    forward = UrKinematics(narrow)
    inverse = UrInverse(narrow)
    inside, outside = np.array((0.2, -0.9, 0.8, 0.1, 0.7, -0.5)), np.array((0.2, -0.9, 1.6, 0.1, 0.7, -0.5))
    found = inverse.nearest(forward.forward(inside), inside)
    assert found is not None
    assert apart(found, inside) < 1e-12
    assert inverse.nearest(forward.forward(outside), inside) is None
    assert "joint 3 at 1.6" in inverse.reason
    # The next call that gives a posture clears the reason.
    assert inverse.nearest(forward.forward(inside), inside) is not None
    assert inverse.reason == ""


def test_a_wrist_without_end_follows_its_turns() -> None:
    model = ur_model("ur3e")
    q = np.array((0.4, -1.3, 1.6, 0.7, 0.9, 40.0))
    found = UrInverse(model).nearest(UrKinematics(model).forward(q), q)
    assert found is not None
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (3.0, r"wrist 2\.\d+ m from the shoulder: must be within 0\.032800 to 0\.817200 m"),
        (0.05, r"wrist centre 0\.050000 m from the axis of the base: must be at least 0\.133300 m"),
    ],
)
def test_what_is_out_of_reach_is_none_with_a_reason(x: float, message: str) -> None:
    pose = np.eye(4)
    pose[0, 3] = x
    inverse = UrInverse(ur_model("ur5e"))
    assert inverse.nearest(pose, np.zeros(6)) is None
    assert re.fullmatch(message, inverse.reason)
    assert inverse.all(pose).shape == (0, 6)


def test_sequences_will_do() -> None:
    model = ur_model("ur5e")
    q = np.array((0.4, -1.3, 1.6, 0.7, 0.9, -2.0))
    pose = UrKinematics(model).forward(q)
    found = UrInverse(model).nearest(pose.tolist(), q.tolist())
    assert found is not None
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-12)
    assert len(UrInverse(model).all(pose.tolist())) == 8


@pytest.mark.parametrize(
    ("pose", "near", "message"),
    [
        (np.eye(3), np.zeros(6), r"shape \[3, 3\], must be \(4, 4\)"),
        (np.full((4, 4), math.nan), np.zeros(6), "last row"),
        (np.diag((1.0, 1.0, 1.0, 2.0)), np.zeros(6), "last row"),
        (np.diag((1.0, 1.0, -1.0, 1.0)), np.zeros(6), "must be a rotation"),
        (np.diag((1.0, 1.0, 1.01, 1.0)), np.zeros(6), "must be a rotation"),
        (np.eye(4) + np.diag([math.inf], 3), np.zeros(6), "must be finite"),
        (np.eye(4), np.zeros(5), r"q_near: shape \[5\], must be \(6,\)"),
        (np.eye(4), np.full(6, math.nan), "q_near: NaN, must be finite"),
    ],
)
def test_what_cannot_be_a_pose_or_a_posture_is_refused(pose: Array, near: Array, message: str) -> None:
    inverse = UrInverse(ur_model("ur5e"))
    with pytest.raises(ValueError, match=message):
        inverse.nearest(pose, near)


def test_a_calibration_of_another_arm_is_refused() -> None:
    with pytest.raises(ValueError, match="deltas move the flange of a ur5"):
        UrInverse(ur_model("ur5"), CALIBRATIONS["ur10 far"][1])
