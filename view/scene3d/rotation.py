"""Rigid transforms, (4, 4)."""

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def matrix_of(quat_wxyz: Array) -> Array:
    """Rotation matrices, (..., 3, 3), of quaternions, (..., 4), of length about 1."""
    q = np.asarray(quat_wxyz, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def transform(position: Array, rotation: Array | None = None) -> Array:
    """base_from_body of a position in m and a rotation matrix."""
    out = np.eye(4)
    out[:3, 3] = position
    if rotation is not None:
        out[:3, :3] = rotation
    return out


def rotation_to(direction: Array) -> Array:
    """Rotation whose z axis points along a non-zero vector."""
    a, b, c = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    # x is across z and the axis e_x or e_y that is further from it; y = z cross x.
    p, q, r = (0.0, -c, b) if abs(a) < 0.9 else (c, 0.0, -a)
    length = math.hypot(p, q, r)
    p, q, r = p / length, q / length, r / length
    return np.array([[p, b * r - c * q, a], [q, c * p - a * r, b], [r, a * q - b * p, c]])


def turn_about(axis: Array, angle: float) -> Array:
    """Rotation matrix of an angle in rad about a non-zero axis (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)
