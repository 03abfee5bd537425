"""Rotation vectors and poses in the UR controller's form; internally rotations are matrices or `quat_wxyz`.

A pose is `(x, y, z, rx, ry, rz)`: metres, and axis times angle in rad. All conversions use the unit quaternion, whose
half angle is well conditioned from 0 to pi. Results are floats and NumPy arrays; arguments are sequences of numbers.

Source: K. Shoemake, "Animating Rotation with Quaternion Curves", 1985; S. W. Shepperd, "Quaternion from Rotation
Matrix", J. Guidance and Control 1(3), 1978.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
Numbers: TypeAlias = Sequence[float] | Array
Quaternion: TypeAlias = tuple[float, float, float, float]
Vector: TypeAlias = tuple[float, float, float]

# Allowed deviation of a rotation: accepts seven digits, rejects non-rotations.
NOT_UNIT = 1e-6
# Angle below which the next term of the series of sin(x)/x is less than half an ulp of 1.
SMALL = 1e-4


def finite(name: str, values: Numbers, count: int) -> list[float]:
    """Return `count` finite numbers.

    Raises:
        ValueError: The count differs, or a value is not finite.
    """
    numbers = [float(value) for value in values]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        message = f"{name} = {numbers}: must be {count} finite numbers"
        raise ValueError(message)
    return numbers


def quat_wxyz_from_rotvec(rotvec: Numbers) -> Quaternion:
    """Return the unit quaternion of a rotation vector: `(cos(t/2), sin(t/2) r/t)` with `t = |r|`; w >= 0 for t <= pi.

    Raises:
        ValueError: Not three finite numbers.
    """
    x, y, z = finite("rotvec", rotvec, 3)
    angle = math.hypot(x, y, z)
    # sin(t/2)/t = 1/2 - t^2/48 + t^4/3840 - ...
    scale = 0.5 - angle * angle / 48 if angle < SMALL else math.sin(angle / 2) / angle
    return math.cos(angle / 2), x * scale, y * scale, z * scale


def rotvec_from_quat_wxyz(quat_wxyz: Numbers) -> Vector:
    """Return the rotation vector of a quaternion, angle from 0 to pi: `2 atan2(|v|, w) v/|v|`.

    The quaternion and its negative are the same rotation. At pi so are `r` and `-r`; then the first non-zero component
    is positive.

    Raises:
        ValueError: Not four finite numbers, or not of length 1 within 1e-6.
    """
    w, x, y, z = unit_quaternion("quat_wxyz", quat_wxyz)
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    length = math.hypot(x, y, z)
    if w == 0 and (x, y, z) < (0.0, 0.0, 0.0):
        x, y, z = -x, -y, -z
    # 2 atan2(s, w)/s = (2/w) (1 - (s/w)^2/3 + ...)
    scale = 2 / w * (1 - (length / w) ** 2 / 3) if length < SMALL else 2 * math.atan2(length, w) / length
    return x * scale, y * scale, z * scale


def rotvec_near(quat_wxyz: Numbers, near: Numbers) -> Vector:
    """Return the rotation vector `r + 2 pi k r/|r|` nearest to another one; continues beyond an angle of pi.

    Raises:
        ValueError: Not four finite numbers, or not of length 1 within 1e-6.
    """
    x, y, z = rotvec_from_quat_wxyz(quat_wxyz)
    angle = math.hypot(x, y, z)
    if angle == 0:
        return x, y, z
    along = (x * near[0] + y * near[1] + z * near[2]) / angle
    scale = 1 + math.tau * round((along - angle) / math.tau) / angle
    return x * scale, y * scale, z * scale


def quat_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the Hamilton product of two quaternions, `quat_wxyz`."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def turn_between(quat_wxyz: Quaternion, other: Quaternion) -> Vector:
    """Return `log(R_other R')`: the rotation vector in the base frame between two orientations in rad.

    Raises:
        ValueError: Not four finite numbers, or not of length 1 within 1e-6.
    """
    w, x, y, z = quat_wxyz
    return rotvec_from_quat_wxyz(quat_product(other, (w, -x, -y, -z)))


def unit_quaternion(name: str, quaternion: Numbers) -> Quaternion:
    """Return the quaternion normalised to length 1.

    Raises:
        ValueError: Not four finite numbers, or not of length 1 within 1e-6.
    """
    w, x, y, z = finite(name, quaternion, 4)
    length = math.hypot(w, x, y, z)
    if abs(length - 1) > NOT_UNIT:
        message = f"{name} = {[w, x, y, z]}: must have length 1, has {length:.9g}"
        raise ValueError(message)
    return w / length, x / length, y / length, z / length


def matrix_from_quat_wxyz(quat_wxyz: Numbers) -> Array:
    """Return the rotation matrix, shape (3, 3), of a unit quaternion.

    Raises:
        ValueError: Not four finite numbers, or not of length 1 within 1e-6.
    """
    w, x, y, z = unit_quaternion("quat_wxyz", quat_wxyz)
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


def quat_wxyz_from_matrix(matrix: Array | Sequence[Sequence[float]]) -> Quaternion:
    """Return the unit quaternion with w >= 0 of a rotation matrix, from its largest component (Shepperd).

    Raises:
        ValueError: Not of shape (3, 3), not finite, or `R'R` not 1 within 1e-6 or a reflection.
    """
    given = np.asarray(matrix, dtype=np.float64)
    if given.shape != (3, 3) or not np.isfinite(given).all():
        message = f"matrix = {given.tolist()}: must be 3 rows of 3 finite numbers"
        raise ValueError(message)
    off = float(np.abs(given.T @ given - np.eye(3)).max())
    if off > NOT_UNIT or np.linalg.det(given) < 0:
        message = f"matrix = {given.tolist()}: must be a rotation, R'R is off by {off:.3g}"
        raise ValueError(message)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = given.tolist()
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    largest = squares.index(max(squares))
    # Each row is the quaternion times four times its largest component.
    w, x, y, z = (
        (squares[0], zy - yz, xz - zx, yx - xy),
        (zy - yz, squares[1], xy + yx, xz + zx),
        (xz - zx, xy + yx, squares[2], yz + zy),
        (yx - xy, xz + zx, yz + zy, squares[3]),
    )[largest]
    length = math.copysign(math.hypot(w, x, y, z), w)
    return w / length, x / length, y / length, z / length


def matrix_from_rotvec(rotvec: Numbers) -> Array:
    """Return the rotation matrix, shape (3, 3), of a rotation vector.

    Raises:
        ValueError: Not three finite numbers.
    """
    return matrix_from_quat_wxyz(quat_wxyz_from_rotvec(rotvec))


def rotvec_from_matrix(matrix: Array | Sequence[Sequence[float]]) -> Vector:
    """Return the rotation vector, angle from 0 to pi, of a rotation matrix.

    Raises:
        ValueError: Not of shape (3, 3), not finite, or not a rotation within 1e-6.
    """
    return rotvec_from_quat_wxyz(quat_wxyz_from_matrix(matrix))


def transform_from_pose(pose: Numbers) -> Array:
    """Return the homogeneous transform, shape (4, 4), of a pose.

    Raises:
        ValueError: Not six finite numbers.
    """
    numbers = finite("pose", pose, 6)
    transform = np.eye(4)
    transform[:3, 3] = numbers[:3]
    transform[:3, :3] = matrix_from_rotvec(numbers[3:])
    return transform


def pose_from_transform(transform: Array) -> Array:
    """Return the pose, shape (6,), of a homogeneous transform of shape (4, 4), or of its upper three rows.

    Raises:
        ValueError: Not a rotation, or not finite.
    """
    x, y, z = finite("position", transform[:3, 3], 3)
    return np.array((x, y, z, *rotvec_from_matrix(transform[:3, :3])))


def pose_trans(a_from_b: Numbers, b_from_c: Numbers) -> Array:
    """Return the pose of c in a, shape (6,), same as URScript's `pose_trans`.

    Raises:
        ValueError: Not six finite numbers.
    """
    return pose_from_transform(transform_from_pose(a_from_b) @ transform_from_pose(b_from_c))
