"""Where a UR arm is sent: what it was told, within bounds of speed, acceleration and workspace."""

import math
from collections.abc import Sequence

from haptether.slave.ur.options import Plane, Three

SETTLE_PERIODS = 3.0
"""Samples within which the set-point closes in on its target: smooths the jitter of the line; one would be a jump."""


class SetPoint:
    """A point that follows a target, never faster or more suddenly than it may.

    Its velocity goes to `v_target + e/|e| g(|e|)` for the distance e to the target, at most `max_acceleration` fast and
    never above `max_speed`. Braking with a takes `|e| = v²/2a`, so `g = sqrt(2 a (|e| - a T²/2))` where that is above
    `a T²`, and `|e|/T` below, which joins it smoothly and needs no more than a.

    The workspace takes targets to the nearest point of each plane in turn, and the point itself as well.

    Args:
        max_speed: In m/s.
        max_acceleration: In m/s².
        period_s: Between two steps, in s; T is three of these.
        planes: nx, ny, nz, d with the free side at n . p >= d.
    """

    def __init__(
        self, max_speed: float, max_acceleration: float, period_s: float, planes: Sequence[Plane] = ()
    ) -> None:
        self._settle = SETTLE_PERIODS * period_s
        self._max_speed = max_speed
        self._max_acceleration = max_acceleration
        self._planes = [_unit(plane) for plane in planes]
        self.position: Three = (0.0, 0.0, 0.0)
        """m."""
        self.velocity: Three = (0.0, 0.0, 0.0)
        """m/s."""

    def begin(self, position: Three) -> None:
        """It rests there."""
        self.position, self.velocity = position, (0.0, 0.0, 0.0)

    def outside(self, position: Three) -> float:
        """How far a point is beyond the workspace, in m; 0 within."""
        return max((max(0.0, d - _dot(n, position)) for n, d in self._planes), default=0.0)

    def step(self, target: Three, target_velocity: Three, elapsed_s: float) -> None:
        """Goes on for a time in s towards a target in m that moves with a velocity in m/s."""
        target, target_velocity = self._inside(target, target_velocity)
        most, settle = self._max_acceleration, self._settle
        # From where the target was when this point was last moved: else it would run ahead by v times a period.
        error = _less(_less(target, _scaled(target_velocity, elapsed_s)), self.position)
        distance = math.hypot(*error)
        near = most * settle * settle
        braking = math.sqrt(2.0 * most * max(0.0, distance - 0.5 * near))
        closing = distance / settle if distance <= near else braking
        towards = _scaled(error, closing / distance) if distance > 0.0 else (0.0, 0.0, 0.0)
        wanted = _shortened(_plus(target_velocity, towards), self._max_speed)
        change = _shortened(_less(wanted, self.velocity), most * elapsed_s)
        velocity = _plus(self.velocity, change)
        # The mean of the old and the new velocity: exact for an even acceleration.
        moved = _plus(self.position, _scaled(_plus(self.velocity, velocity), 0.5 * elapsed_s))
        self.position, self.velocity = self._inside(moved, velocity, self.position)

    def _inside(self, position: Three, velocity: Three, before: Three | None = None) -> tuple[Three, Three]:
        """What lies beyond a plane is put onto it; a point that was beyond `before` goes no further, without a jump."""
        for normal, d in self._planes:
            already = 0.0 if before is None else max(0.0, d - _dot(normal, before))
            beyond = d - _dot(normal, position) - already
            if beyond > 0.0:
                position = _plus(position, _scaled(normal, beyond))
                inward = _dot(normal, velocity)
                if inward < 0.0:
                    velocity = _less(velocity, _scaled(normal, inward))
        return position, velocity


def _unit(plane: Plane) -> tuple[Three, float]:
    x, y, z, d = plane
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length), d / length


def _dot(a: Three, b: Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _plus(a: Three, b: Three) -> Three:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _less(a: Three, b: Three) -> Three:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _scaled(a: Three, by: float) -> Three:
    return a[0] * by, a[1] * by, a[2] * by


def _shortened(a: Three, most: float) -> Three:
    length = math.hypot(*a)
    return _scaled(a, most / length) if length > most else a
