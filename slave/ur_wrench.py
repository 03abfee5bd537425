"""The force of the environment on the tool of a UR arm, in the frame of the base."""

import math

from haptether.slave.ur_options import Six, Three
from haptether.slave.ur_pose import matrix_from_rotvec
from haptether.slave.ur_state import Numbers


class UrWrench:
    """Rotates, filters and cuts what the sensor shows to F_e.

    Low-pass `y += (1 - e^(-2 pi f dt)) (x - y)`, exact for an input that is held over each step. Then the length of the
    vector less the deadband, its direction kept, so that what leaves the deadband begins at zero.

    `actual_TCP_force` is along the base's axes and has the payload taken away; `ft_raw_wrench` is in the frame of the
    flange and has not, so that `zero` takes its value away: right as long as the orientation stays, which the driver
    keeps.

    Args:
        raw: Whether the wrench is that of the sensor in the flange.
        tool: The tool's point in the frame of the flange, as a pose.
        filter_hz: Corner of the low-pass; None for none.
        deadband_n: What is taken away of the length.
    """

    def __init__(self, *, raw: bool, tool: Six, filter_hz: float | None, deadband_n: float) -> None:
        self._tool_from_flange = matrix_from_rotvec(tool[3:]).T if raw else None
        self._corner = None if filter_hz is None else 2.0 * math.pi * filter_hz
        self._deadband = deadband_n
        self._bias: Three = (0.0, 0.0, 0.0)
        self._smooth: Three | None = None

    def base_force(self, wrench: Numbers, pose: Numbers) -> Three:
        """Force in N along the axes of the base, less what `zero` took; neither filtered nor cut."""
        x, y, z = wrench[:3]
        if self._tool_from_flange is not None:
            turn = matrix_from_rotvec(pose[3:]) @ self._tool_from_flange
            x, y, z = (turn @ (x, y, z)).tolist()
        a, b, c = self._bias
        return x - a, y - b, z - c

    def zero(self, wrench: Numbers, pose: Numbers) -> None:
        """What it shows now becomes zero."""
        self._bias = (0.0, 0.0, 0.0)
        self._bias = self.base_force(wrench, pose)
        self._smooth = None

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
