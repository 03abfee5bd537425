"""Rotation vectors against SciPy's, from 0 to pi."""

import math
import sys
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from haptether.slave.ur.kinematics.pose import (
    matrix_from_quat_wxyz,
    matrix_from_rotvec,
    pose_from_transform,
    pose_trans,
    quat_product,
    quat_wxyz_from_matrix,
    quat_wxyz_from_rotvec,
    rotvec_from_matrix,
    rotvec_from_quat_wxyz,
    rotvec_near,
    transform_from_pose,
    turn_between,
)

Array = npt.NDArray[np.float64]

# A few roundings of numbers up to 1; a rotation vector near pi has 2 pi per unit of its quaternion.
ROUNDING = 8 * np.finfo(float).eps

axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: math.hypot(*axis) > 1e-3)
angles = st.one_of(
    st.floats(0, math.pi),
    st.floats(0, 1e-3),
    st.floats(math.pi - 1e-3, math.pi),
    st.sampled_from([0.0, 5e-324, 1e-300, 1e-160, 1e-16, 1e-8, 1e-4, 0.99999e-4, math.pi - 1e-15, math.pi]),
)


def along(axis: Sequence[float], angle: float) -> Array:
    return np.array(axis) / math.hypot(*axis) * angle


@given(axes, angles)
def test_a_matrix_is_scipys(axis: tuple[float, ...], angle: float) -> None:
    rotvec = along(axis, angle)
    expected = Rotation.from_rotvec(rotvec).as_matrix()
    np.testing.assert_allclose(matrix_from_rotvec(rotvec), expected, rtol=0, atol=ROUNDING)


@given(axes, angles)
def test_a_rotation_vector_comes_back(axis: tuple[float, ...], angle: float) -> None:
    rotvec = along(axis, angle)
    for back in (rotvec_from_quat_wxyz(quat_wxyz_from_rotvec(rotvec)), rotvec_from_matrix(matrix_from_rotvec(rotvec))):
        # Three rounded products are in between.
        assert math.hypot(*back) <= math.pi * (1.0 + 4.0 * sys.float_info.epsilon)
        # Within rounding of pi the result may have the opposite sign, which is the same rotation.
        away = min(np.abs(np.subtract(back, rotvec)).max(), np.abs(np.add(back, rotvec)).max() if angle > 3 else 9)
        assert away <= 4 * ROUNDING


@given(axes, st.floats(1e-200, 1e-5))
def test_a_small_rotation_keeps_its_digits(axis: tuple[float, ...], angle: float) -> None:
    rotvec = along(axis, angle)
    back = rotvec_from_quat_wxyz(quat_wxyz_from_rotvec(rotvec))
    np.testing.assert_allclose(back, rotvec, rtol=ROUNDING, atol=1e-300)


@pytest.mark.parametrize("edge", [1e-4, 0.9999999e-4, 1.0000001e-4, 2e-4, 2.0000001e-4])
def test_the_series_meets_the_formula(edge: float) -> None:
    np.testing.assert_allclose(
        quat_wxyz_from_rotvec((edge, 0.0, 0.0)), (math.cos(edge / 2), math.sin(edge / 2), 0.0, 0.0), rtol=ROUNDING
    )
    assert rotvec_from_quat_wxyz(quat_wxyz_from_rotvec((edge, 0.0, 0.0)))[0] == pytest.approx(edge, rel=ROUNDING)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (-1, 0, 1), (-1, 2, 3), (0, -1, -1)])
def test_half_a_turn_has_one_vector(axis: tuple[float, ...]) -> None:
    rotvec = along(axis, math.pi)
    first = next(component for component in rotvec if component)
    expected = rotvec if first > 0 else -rotvec
    w, x, y, z = (0.0, *along(axis, 1.0))
    for quat_wxyz in ((w, x, y, z), (-w, -x, -y, -z)):
        np.testing.assert_allclose(rotvec_from_quat_wxyz(quat_wxyz), expected, rtol=ROUNDING)


@given(axes, angles)
def test_a_quaternion_of_a_matrix_has_length_one_and_no_negative_w(axis: tuple[float, ...], angle: float) -> None:
    quat_wxyz = quat_wxyz_from_matrix(matrix_from_rotvec(along(axis, angle)))
    assert quat_wxyz[0] >= 0
    assert math.hypot(*quat_wxyz) == pytest.approx(1, rel=0, abs=ROUNDING)


@given(st.lists(st.floats(-2, 2), min_size=12, max_size=12))
def test_poses_compose(numbers: list[float]) -> None:
    a_from_b, b_from_c = numbers[:6], numbers[6:]
    expected = transform_from_pose(a_from_b) @ transform_from_pose(b_from_c)
    np.testing.assert_allclose(transform_from_pose(pose_trans(a_from_b, b_from_c)), expected, rtol=0, atol=1e-14)


def test_urscripts_example() -> None:
    # URScript manual, pose_trans: a turn of the frame carries the second pose along.
    rotated = pose_trans((0.2, 0.5, 0.1, 0, 0, math.pi / 2), (0.1, 0, 0, 0, 0, 0))
    np.testing.assert_allclose(rotated, (0.2, 0.6, 0.1, 0, 0, math.pi / 2), rtol=0, atol=ROUNDING)


REFUSED: list[tuple[Callable[[], object], str]] = [
    (lambda: quat_wxyz_from_rotvec((0.0, 0.0)), "3 finite numbers"),
    (lambda: quat_wxyz_from_rotvec((0.0, 0.0, math.nan)), "3 finite numbers"),
    (lambda: rotvec_from_quat_wxyz((1.0, 0.1, 0.0, 0.0)), "length 1"),
    (lambda: rotvec_from_quat_wxyz((0.0, 0.0, 0.0, 0.0)), "length 1"),
    (lambda: matrix_from_quat_wxyz((1.0, 0.0, 0.0, math.inf)), "4 finite numbers"),
    (lambda: quat_wxyz_from_matrix(np.eye(4)), "3 rows"),
    (lambda: quat_wxyz_from_matrix(-np.eye(3)), "must be a rotation"),
    (lambda: quat_wxyz_from_matrix(1.001 * np.eye(3)), "must be a rotation"),
    (lambda: transform_from_pose((0.0,) * 5), "6 finite numbers"),
    (lambda: pose_from_transform(np.full((4, 4), math.nan)), "3 finite numbers"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_is_no_rotation_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


@given(axes, angles, axes, angles)
def test_products_and_the_turn_between_two_are_scipys(
    axis: tuple[float, ...], angle: float, other: tuple[float, ...], by: float
) -> None:
    one, two = along(axis, angle), along(other, by)
    p, q = quat_wxyz_from_rotvec(one), quat_wxyz_from_rotvec(two)
    product = Rotation.from_rotvec(one) * Rotation.from_rotvec(two)
    np.testing.assert_allclose(matrix_from_quat_wxyz(quat_product(p, q)), product.as_matrix(), rtol=0, atol=ROUNDING)
    between = Rotation.from_rotvec(two) * Rotation.from_rotvec(one).inv()
    # Compare as rotations: near pi a rounding reverses the vector.
    np.testing.assert_allclose(matrix_from_rotvec(turn_between(p, q)), between.as_matrix(), rtol=0, atol=2 * ROUNDING)


@given(axes)
def test_a_rotation_vector_goes_on_past_half_a_turn(axis: tuple[float, ...]) -> None:
    before = along(axis, 0.0)
    for angle in np.linspace(0.0, 3.0 * math.pi, 200)[1:]:
        at = along(axis, angle)
        before = np.array(rotvec_near(quat_wxyz_from_rotvec(at), before))
        np.testing.assert_allclose(before, at, rtol=0, atol=1e-7)
    for angle in np.linspace(3.0 * math.pi, -3.0 * math.pi, 200):
        at = along(axis, angle)
        before = np.array(rotvec_near(quat_wxyz_from_rotvec(at), before))
        np.testing.assert_allclose(before, at, rtol=0, atol=1e-7)
