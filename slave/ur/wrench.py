"""The force of the environment on the tool of a UR arm, in the frame of the base."""

import math
from typing import TYPE_CHECKING, Final

from haptether.slave.ur.kinematics.models import Six
from haptether.slave.ur.kinematics.pose import matrix_from_rotvec
from haptether.slave.ur.options import Three
from haptether.slave.ur.state import Numbers

if TYPE_CHECKING:
    import numpy as np

STANDARD_GRAVITY: Final = 9.80665
"""m/s²."""


class UrWrench:
    """Rotates, filters and cuts what the sensor shows to F_e.

    Low-pass `y += (1 - e^(-2 pi f dt)) (x - y)`, exact for an input that is held over each step. Then the length of the
    vector less the deadband, its direction kept, so that what leaves the deadband begins at zero.

    `actual_TCP_force` is along the base's axes and has the payload taken away. `ft_raw_wrench` is in the frame of the
    flange and has not: it shows `b + R^T (F_e + m g)` for the flange's orientation R, from which `zero` has the
    sensor's bias b. Without the mass m the weight is taken as part of b, which is right for one orientation.

    Args:
        raw: Whether the wrench is that of the sensor in the flange.
        tool: The tool's point in the frame of the flange, as a pose.
        filter_hz: Corner of the low-pass; None for none.
        deadband_n: What is taken away of the length.
        payload_kg: All that the flange carries, for a wrench of the sensor; the base stands upright.
    """

    def __init__(
        self, *, raw: bool, tool: Six, filter_hz: float | None, deadband_n: float, payload_kg: float = 0.0
    ) -> None:
        self._tool_from_flange = matrix_from_rotvec(tool[3:]).T if raw else None
        self._corner = None if filter_hz is None else 2.0 * math.pi * filter_hz
        self._deadband = deadband_n
        self._weight = -STANDARD_GRAVITY * payload_kg if raw else 0.0
        self._bias: Three = (0.0, 0.0, 0.0)
        """As the sensor shows it, in the frame of the flange; along the base without one."""
        self._smooth: Three | None = None

    def base_force(self, wrench: Numbers, pose: Numbers) -> Three:
        """Force in N along the axes of the base, less what `zero` took; neither filtered nor cut."""
        x, y, z = (shown - bias for shown, bias in zip(wrench[:3], self._bias, strict=True))
        if self._tool_from_flange is not None:
            x, y, z = (self._base_from_flange(pose) @ (x, y, z)).tolist()
        return x, y, z - self._weight

    def zero(self, wrench: Numbers, pose: Numbers) -> None:
        """What it shows now, with nothing but the payload on the flange, becomes zero."""
        x, y, z = wrench[:3]
        if self._tool_from_flange is not None:
            a, b, c = (self._base_from_flange(pose).T @ (0.0, 0.0, self._weight)).tolist()
            x, y, z = x - a, y - b, z - c
        self._bias = (x, y, z)
        self._smooth = None

    def _base_from_flange(self, pose: Numbers) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
        assert self._tool_from_flange is not None
        return matrix_from_rotvec(pose[3:]) @ self._tool_from_flange

    def force(self, wrench: Numbers, pose: Numbers, elapsed_s: float) -> Three:
        """F_e in N after a time in s since the last call."""
        now = self.base_force(wrench, pose)
        if self._corner is not None:
            if self._smooth is not None:
                share = -math.expm1(-self._corner * elapsed_s)
                x, y, z = (old + share * (new - old) for old, new in zip(self._smooth, now, strict=True))
                now = (x, y, z)
            self._smooth = now
        if self._deadband:
            length = math.hypot(*now)
            share = max(0.0, length - self._deadband) / length if length > 0.0 else 0.0
            return now[0] * share, now[1] * share, now[2] * share
        return now
