"""Force and moment of the environment on the tool of a UR arm, in the frame of the base about the tool point."""

import math
from typing import Final

from haptether.slave.ur.kinematics.models import Six
from haptether.slave.ur.kinematics.pose import Array, matrix_from_rotvec
from haptether.slave.ur.options import Three
from haptether.slave.ur.state import Numbers

STANDARD_GRAVITY: Final = 9.80665
"""m/s²."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


class UrWrench:
    """Rotates, filters and cuts what the sensor shows to F_e, and its moment tau_e about the tool point.

    Low-pass `y += (1 - e^(-2 pi f dt)) (x - y)`, exact for an input that is held over each step. Then the length of the
    force less the deadband, its direction kept, so that what leaves the deadband begins at zero.

    `actual_TCP_force` is along the base's axes, its moment about the tool point, and has the payload taken away.
    `ft_raw_wrench` is in the frame of the flange and has not: for the flange's orientation R it shows

        b + R^T (F_e + m g)
        b_tau + R^T tau_e + t x R^T F_e + c x R^T m g

    with the tool point t and the payload's centre of gravity c in the frame of the flange. `zero` takes the sensor's
    bias, b and b_tau, from it. Without the mass m the weight is taken as part of it, which is right for one
    orientation.

    Args:
        raw: Whether the wrench is that of the sensor in the flange.
        tool: The tool's point in the frame of the flange, as a pose.
        filter_hz: Corner of the low-pass; None for none.
        deadband_n: What is taken away of the length of the force.
        payload_kg: All that the flange carries, for a wrench of the sensor; the base stands upright.
        payload_cog: c in m.
    """

    def __init__(
        self,
        *,
        raw: bool,
        tool: Six,
        filter_hz: float | None,
        deadband_n: float,
        payload_kg: float = 0.0,
        payload_cog: Three = ORIGIN,
    ) -> None:
        self._tool_from_flange = matrix_from_rotvec(tool[3:]).T if raw else None
        self._tool: Three = (tool[0], tool[1], tool[2])
        self._cog = payload_cog
        self._corner = None if filter_hz is None else 2.0 * math.pi * filter_hz
        self._deadband = deadband_n
        self._weight = -STANDARD_GRAVITY * payload_kg if raw else 0.0
        self._bias: Three = ORIGIN
        """As the sensor shows it, in the frame of the flange; along the base without one."""
        self._torque_bias: Three = ORIGIN
        self._smooth: tuple[Three, Three] | None = None

    def base_wrench(self, wrench: Numbers, pose: Numbers) -> tuple[Three, Three]:
        """Force in N and moment in N m along the axes of the base, less what `zero` took; neither filtered nor cut."""
        x, y, z = (shown - bias for shown, bias in zip(wrench[:3], self._bias, strict=True))
        torque = _minus((wrench[3], wrench[4], wrench[5]), self._torque_bias)
        if self._tool_from_flange is None:
            return (x, y, z - self._weight), torque
        rotation = self._base_from_flange(pose)
        weight = self._weight_at(rotation)
        about_tool = _minus(_minus(torque, _cross(self._cog, weight)), _cross(self._tool, _minus((x, y, z), weight)))
        x, y, z = (rotation @ (x, y, z)).tolist()
        a, b, c = (rotation @ about_tool).tolist()
        return (x, y, z - self._weight), (a, b, c)

    def zero(self, wrench: Numbers, pose: Numbers) -> None:
        """What it shows now, with nothing but the payload on the flange, becomes zero."""
        force, torque = (wrench[0], wrench[1], wrench[2]), (wrench[3], wrench[4], wrench[5])
        if self._tool_from_flange is not None:
            weight = self._weight_at(self._base_from_flange(pose))
            force, torque = _minus(force, weight), _minus(torque, _cross(self._cog, weight))
        self._bias, self._torque_bias = force, torque
        self._smooth = None

    def felt(self, wrench: Numbers, pose: Numbers, elapsed_s: float) -> tuple[Three, Three]:
        """F_e in N and tau_e in N m after a time in s since the last call."""
        force, torque = self.base_wrench(wrench, pose)
        if self._corner is not None:
            if self._smooth is not None:
                share = -math.expm1(-self._corner * elapsed_s)
                force, torque = _towards(self._smooth[0], force, share), _towards(self._smooth[1], torque, share)
            self._smooth = force, torque
        if self._deadband:
            length = math.hypot(*force)
            share = max(0.0, length - self._deadband) / length if length > 0.0 else 0.0
            force = force[0] * share, force[1] * share, force[2] * share
        return force, torque

    def _base_from_flange(self, pose: Numbers) -> Array:
        assert self._tool_from_flange is not None
        return matrix_from_rotvec(pose[3:]) @ self._tool_from_flange

    def _weight_at(self, base_from_flange: Array) -> Three:
        """Of the payload in N, in the frame of the flange."""
        x, y, z = (base_from_flange.T @ (0.0, 0.0, self._weight)).tolist()
        return x, y, z


def _towards(old: Three, new: Three, share: float) -> Three:
    return old[0] + share * (new[0] - old[0]), old[1] + share * (new[1] - old[1]), old[2] + share * (new[2] - old[2])


def _minus(a: Three, b: Three) -> Three:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Three, b: Three) -> Three:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
