"""Force and moment of the environment on a UR tool, in the base frame about the tool point."""

import math
from collections.abc import Sequence
from statistics import median
from typing import Final

from haptether.slave.ur.kinematics.models import Six
from haptether.slave.ur.kinematics.pose import Array, matrix_from_rotvec
from haptether.slave.ur.options import Three
from haptether.slave.ur.state import Numbers

STANDARD_GRAVITY: Final = 9.80665
"""Standard gravity in m/s²."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


class UrWrench:
    """Rotation, filter and deadband from the sensor's wrench to F_e, and its moment tau_e about the tool point.

    Low-pass `y += (1 - e^(-2 pi f dt)) (x - y)`, exact for a piecewise constant input. Then the deadband is subtracted
    from the force's length, which keeps direction and continuity.

    `actual_TCP_force` is in the base frame, with the moment about the tool point, without the payload. `ft_raw_wrench`
    is in the flange frame and includes the payload: for flange orientation R it shows

        b + R^T (F_e + m g)
        b_tau + R^T tau_e + t x R^T F_e + c x R^T m g

    with the tool point t and the payload's centre of gravity c in the flange frame. `zero` stores the sensor's bias, b
    and b_tau. Without the mass m the weight counts as bias, which is valid for one orientation.

    Args:
        raw: True for the raw wrench of the flange sensor.
        tool: Tool point in the flange frame, as a pose.
        filter_hz: Corner frequency of the low-pass; None for none.
        deadband_n: Deadband of the force's length.
        payload_kg: Mass on the flange, for a raw wrench; the base is upright.
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
        """Force bias in the flange frame, or in the base frame for a controller wrench."""
        self._torque_bias: Three = ORIGIN
        self._smooth: tuple[Three, Three] | None = None

    def base_wrench(self, wrench: Numbers, pose: Numbers) -> tuple[Three, Three]:
        """Return force in N and moment in N m in the base frame, without bias, unfiltered."""
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

    def zero(self, wrenches: Sequence[Numbers], pose: Numbers) -> None:
        """Make the component-wise median of some readings zero; only the payload may load the flange."""
        x, y, z, a, b, c = (median(component) for component in zip(*wrenches, strict=True))
        force, torque = (x, y, z), (a, b, c)
        if self._tool_from_flange is not None:
            weight = self._weight_at(self._base_from_flange(pose))
            force, torque = _minus(force, weight), _minus(torque, _cross(self._cog, weight))
        self._bias, self._torque_bias = force, torque
        self._smooth = None

    def felt(self, wrench: Numbers, pose: Numbers, elapsed_s: float) -> tuple[Three, Three]:
        """Return F_e in N and tau_e in N m after a time in s since the last call."""
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
        """Return the payload's weight in N in the flange frame."""
        x, y, z = (base_from_flange.T @ (0.0, 0.0, self._weight)).tolist()
        return x, y, z


def _towards(old: Three, new: Three, share: float) -> Three:
    return old[0] + share * (new[0] - old[0]), old[1] + share * (new[1] - old[1]), old[2] + share * (new[2] - old[2])


def _minus(a: Three, b: Three) -> Three:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Three, b: Three) -> Three:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
