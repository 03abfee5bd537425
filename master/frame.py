"""Rotation from a device frame to the scene frame: right-handed, z up."""

import math
from collections.abc import Sequence
from typing import Final, TypeAlias

from haptether.options import refused

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

REST: Final = (0.0, 0.0, 0.0)
"""Zero force, torque or velocity."""
AXES: Final = ("x", "y", "z")
UNIT_WITHIN: Final = 0.02
"""Allowed deviation of an orientation's norm from 1; 14-bit orientations are within 1e-3."""


class DeviceFrame:
    """Map from device axes to scene axes.

    A device vector v becomes C v. A handle orientation R becomes C R C^T, so that a handle aligned with the device base
    is aligned with the scene base.

    Args:
        axes: Device axis for each scene axis: `x`, `y`, `z`, optionally with a minus.
        origin: Scene origin in m in the device frame.

    Raises:
        ValueError: Invalid names, a duplicate axis, or a left-handed set.
    """

    def __init__(self, axes: Sequence[str], origin: Vector = (0.0, 0.0, 0.0)) -> None:
        self.axes = tuple(axes)
        self.origin = origin
        names = [axis.removeprefix("-") for axis in axes]
        if not (1 <= len(names) <= 3 and set(names) <= set(AXES) and len(set(names)) == len(names)):
            message = (
                f"axes = {list(axes)}: must be one to three of x, y, z, each once, with a minus where it is turned"
            )
            raise ValueError(message)
        self._index = tuple(AXES.index(name) for name in names)
        self._sign = tuple(-1.0 if axis.startswith("-") else 1.0 for axis in axes)
        if len(names) == 3:
            i, j, k = self._index
            handedness = (i - j) * (j - k) * (k - i) / 2.0 * math.prod(self._sign)
            if handedness != 1.0:
                message = f"axes = {list(axes)}: left-handed: must be right-handed, as x, y, z or -y, x, z"
                raise ValueError(message)

    def position(self, point: Sequence[float]) -> tuple[float, ...]:
        """Convert a device point to the scene frame."""
        return tuple(s * (point[i] - self.origin[i]) for i, s in zip(self._index, self._sign, strict=True))

    def vector(self, vector: Sequence[float]) -> tuple[float, ...]:
        """Convert a device velocity, force or rotation vector to the scene frame."""
        return tuple(s * vector[i] for i, s in zip(self._index, self._sign, strict=True))

    def to_device(self, vector: Sequence[float]) -> Vector:
        """Convert a scene vector to the device frame; missing axes are 0."""
        turned = [0.0, 0.0, 0.0]
        for value, i, s in zip(vector, self._index, self._sign, strict=True):
            turned[i] = s * value
        return turned[0], turned[1], turned[2]

    def orientation(self, quat_wxyz: Sequence[float]) -> Quaternion:
        """Convert a handle orientation to the scene frame, with norm 1.

        Raises:
            ValueError: The norm is not 1, or the orientation is not finite.
        """
        norm = math.sqrt(sum(part * part for part in quat_wxyz))
        if not abs(norm - 1.0) <= UNIT_WITHIN:
            message = f"orientation {tuple(quat_wxyz)} has norm {norm:g}: must be 1"
            raise ValueError(message)
        x, y, z = self.vector([part / norm for part in quat_wxyz[1:]])
        return quat_wxyz[0] / norm, x, y, z


def check_frame(device: str, axes: Sequence[str], origin: Vector) -> None:
    """Refuse options that describe no frame; `device` names the driver in the message.

    Raises:
        ValueError: Invalid axes, or an origin more than 1 m away along an axis.
    """
    try:
        DeviceFrame(axes, origin)
    except ValueError as error:
        message = f"{device}: {error}"
        raise ValueError(message) from None
    if not all(abs(part) <= 1.0 for part in origin):
        raise refused(device, "origin", origin, "must be within 1 m")


def quaternion(matrix: Sequence[Sequence[float]]) -> Quaternion:
    """Return the unit quaternion w, x, y, z of a rotation matrix.

    Source: Shepperd 1978, Quaternion from rotation matrix, Journal of Guidance and Control 1(3).

    Raises:
        ValueError: Not a rotation: row norms differ from 1, or it is a reflection.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    rows = [math.sqrt(sum(part * part for part in row)) for row in matrix]
    if not all(abs(norm - 1.0) <= UNIT_WITHIN for norm in (*rows, determinant)):
        message = f"orientation {[list(row) for row in matrix]}: must be a rotation matrix"
        raise ValueError(message)
    squares = (1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i)
    largest = max(range(4), key=squares.__getitem__)
    rest = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )[largest]
    norm = math.sqrt(sum(part * part for part in rest))
    w, x, y, z = (part / norm for part in rest)
    return w, x, y, z


def clipped(vector: Sequence[float], limit: float) -> tuple[float, ...]:
    """Return the vector shortened to a norm of `limit`; zero if it is not finite."""
    norm = math.sqrt(sum(part * part for part in vector))
    if not math.isfinite(norm):
        return (0.0,) * len(vector)
    return tuple(vector) if norm <= limit else tuple(part * (limit / norm) for part in vector)
