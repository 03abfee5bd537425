"""Set point of a UR arm: position and orientation that follow the command within bounds, for every mode."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from haptether.slave.ur.kinematics.constraints import ToolCone, WorkspacePlane, tool_axis
from haptether.slave.ur.kinematics.pose import Quaternion, quat_product, quat_wxyz_from_rotvec, turn_between
from haptether.slave.ur.options import Three

SETTLE_PERIODS: Final = 3.0
"""Samples in which the set point closes in on its target; smooths network jitter, while 1 would be a jump."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


def closing_speed(distance: float, deceleration: float, settle_s: float) -> float:
    """Return the largest speed towards a target at a distance from which braking with deceleration a ends there.

    Braking takes `d = v²/2a`, so the speed is `sqrt(2 a (d - a T²/2))` where that is above `a T²`, and `d/T` below,
    which joins smoothly and needs at most a. T is the settling time; m or rad, and s.
    """
    near = deceleration * settle_s * settle_s
    if distance <= near:
        return distance / settle_s
    return math.sqrt(2.0 * deceleration * max(0.0, distance - 0.5 * near))


class SetPoint:
    """Point that follows a target within speed and acceleration bounds, used by every mode.

    Its velocity approaches `v_target + e/|e| g(|e|)` for the error e, with at most `max_acceleration` and never above
    `max_speed`; g is `closing_speed`, which allows braking.

    The workspace projects targets, and the point itself, onto each violated plane in turn.

    Args:
        max_speed: Speed bound in m/s.
        max_acceleration: Acceleration bound in m/s².
        period_s: Step period in s; T is three periods.
        planes: Planes of the workspace.
    """

    def __init__(
        self, max_speed: float, max_acceleration: float, period_s: float, planes: Sequence[WorkspacePlane] = ()
    ) -> None:
        self._settle = SETTLE_PERIODS * period_s
        self._max_speed = max_speed
        self._max_acceleration = max_acceleration
        self._planes = planes
        self.position: Three = ORIGIN
        """m."""
        self.velocity: Three = ORIGIN
        """m/s."""

    def begin(self, position: Three, velocity: Three = ORIGIN) -> None:
        """Start at a position with a velocity."""
        self.position, self.velocity = position, velocity

    def outside(self, position: Three) -> float:
        """Return the distance of a point beyond the workspace in m; 0 inside."""
        return max((max(0.0, plane.offset_m - _dot(plane.normal, position)) for plane in self._planes), default=0.0)

    def step(self, target: Three, target_velocity: Three, elapsed_s: float) -> None:
        """Advance for a time in s towards a target in m that moves with a velocity in m/s."""
        target, target_velocity = self._inside(target, target_velocity)
        limit, settle = self._max_acceleration, self._settle
        # Relative to the target at the last step; otherwise the point would lead by v times a period.
        error = _minus(_minus(target, _scaled(target_velocity, elapsed_s)), self.position)
        distance = math.hypot(*error)
        towards = _scaled(error, closing_speed(distance, limit, settle) / distance) if distance > 0.0 else ORIGIN
        wanted = shortened(_plus(target_velocity, towards), self._max_speed)
        change = shortened(_minus(wanted, self.velocity), limit * elapsed_s)
        velocity = _plus(self.velocity, change)
        # Mean of old and new velocity: exact for constant acceleration.
        moved = _plus(self.position, _scaled(_plus(self.velocity, velocity), 0.5 * elapsed_s))
        self.position, self.velocity = self._inside(moved, velocity, self.position)

    def _inside(self, position: Three, velocity: Three, before: Three | None = None) -> tuple[Three, Three]:
        """Project onto violated planes; a point already beyond one goes no further, without a jump."""
        for plane in self._planes:
            normal, d = plane.normal, plane.offset_m
            already = 0.0 if before is None else max(0.0, d - _dot(normal, before))
            beyond = d - _dot(normal, position) - already
            if beyond > 0.0:
                position = _plus(position, _scaled(normal, beyond))
                inward = _dot(normal, velocity)
                if inward < 0.0:
                    velocity = _minus(velocity, _scaled(normal, inward))
        return position, velocity


class Attitude(NamedTuple):
    """Orientation and its rate."""

    orientation: Quaternion
    """base_from_tool, `quat_wxyz`, of length 1."""
    angular_velocity: Three
    """Angular velocity in rad/s in the base frame."""


AT_REST: Final = Attitude((1.0, 0.0, 0.0, 0.0), ORIGIN)


class OrientationSetPoint:
    """Orientation R that follows another like `SetPoint` follows a point: the same law on SO(3).

    Its angular velocity approaches `w_target + e/|e| g(|e|)` with `e = log(R_target R')` by the shorter way, with at
    most `max_acceleration` and never above `max_speed`. A target more than half a turn ahead is met from the other
    side. `R <- exp(dt (w + w_before) / 2) R`.

    A cone projects targets to the nearest orientation inside, and R brakes before its edge: its tilt t grows at most at
    `g(t_max - t)` with half the acceleration. The other half turns the axis along the edge, which needs `v² cot(t_max)`
    at speed v and limits the axis speed.

    Args:
        max_speed: Angular speed bound in rad/s.
        max_acceleration: Angular acceleration bound in rad/s².
        period_s: Step period in s; T is three periods.
        cone: Cone of the tool's z axis; None for none.

    Source: F. Bullo, R. M. Murray, "Tracking for fully actuated mechanical systems: a geometric framework", Automatica
    35(1), 1999: errors of rotation by the logarithm.
    """

    def __init__(
        self, max_speed: float, max_acceleration: float, period_s: float, cone: ToolCone | None = None
    ) -> None:
        self._settle = SETTLE_PERIODS * period_s
        self._max_speed = max_speed
        self._max_acceleration = max_acceleration
        self._cone = cone
        self._max_tilt = math.pi
        """Tilt limit of the cone, or more while a start outside has not returned."""
        self._max_axis_speed = math.inf
        if cone is not None and cone.half_angle < 0.5 * math.pi:
            self._max_axis_speed = math.sqrt(0.5 * max_acceleration * math.tan(cone.half_angle))
        self.attitude = AT_REST

    def begin(self, orientation: Quaternion, angular_velocity: Three = ORIGIN) -> None:
        """Start at an orientation with a rate."""
        self.attitude = Attitude(orientation, angular_velocity)
        if self._cone is not None:
            self._max_tilt = max(self._cone.half_angle, self._cone.tilt(orientation)[0])

    def outside(self, orientation: Quaternion) -> float:
        """Return the angle of an orientation beyond the cone in rad; 0 inside."""
        return 0.0 if self._cone is None else max(0.0, self._cone.tilt(orientation)[0] - self._cone.half_angle)

    def step(self, target: Attitude, elapsed_s: float) -> None:
        """Advance for a time in s towards a rotating target."""
        (goal, goal_velocity), (now, velocity) = self._inside(target), self.attitude
        limit = self._max_acceleration * elapsed_s
        # Relative to the target at the last step, as for a position.
        error = turn_between(now, _turned(goal, _scaled(goal_velocity, -elapsed_s)))
        distance = math.hypot(*error)
        closing = closing_speed(distance, self._max_acceleration, self._settle)
        towards = _scaled(error, closing / distance) if distance > 0.0 else ORIGIN
        wanted = shortened(_plus(goal_velocity, towards), self._max_speed)
        if self._cone is None:
            change = shortened(_minus(wanted, velocity), limit)
        else:
            change = self._braked(self._cone, wanted, limit)
        after = _plus(velocity, change)
        orientation = _turned(now, _scaled(_plus(velocity, after), 0.5 * elapsed_s))
        self.attitude = Attitude(self._kept(orientation), after)

    def _inside(self, target: Attitude) -> Attitude:
        """Return the nearest attitude inside the cone."""
        if self._cone is None:
            return target
        tilt, outward = self._cone.tilt(target.orientation)
        beyond = tilt - self._cone.half_angle
        if beyond <= 0.0:
            return target
        leaving = max(0.0, _dot(target.angular_velocity, outward))
        velocity = _minus(target.angular_velocity, _scaled(outward, leaving))
        return Attitude(_turned(target.orientation, _scaled(outward, -beyond)), velocity)

    def _braked(self, cone: ToolCone, wanted: Three, limit: float) -> Three:
        """Return the change of angular velocity, at most `limit`, with priority for braking before the edge."""
        orientation, velocity = self.attitude
        axis = tool_axis(orientation)
        about = _scaled(axis, _dot(wanted, axis))
        wanted = _plus(about, shortened(_minus(wanted, about), self._max_axis_speed))
        change = shortened(_minus(wanted, velocity), limit)
        tilt, outward = cone.tilt(orientation)
        allowed = closing_speed(max(0.0, self._max_tilt - tilt), 0.5 * self._max_acceleration, self._settle)
        room, along = allowed - _dot(velocity, outward), _dot(change, outward)
        if along <= room:
            return change
        room = max(room, -limit)
        across = _minus(change, _scaled(outward, along))
        return _plus(_scaled(outward, room), shortened(across, math.sqrt(limit * limit - room * room)))

    def _kept(self, orientation: Quaternion) -> Quaternion:
        """Project onto the edge a step beyond it, which is smaller than the curvature of the axis path per step."""
        if self._cone is None:
            return orientation
        tilt, outward = self._cone.tilt(orientation)
        if tilt > self._max_tilt:
            return _turned(orientation, _scaled(outward, self._max_tilt - tilt))
        self._max_tilt = max(self._cone.half_angle, tilt)
        return orientation


def _turned(orientation: Quaternion, rotvec: Three) -> Quaternion:
    """Rotate by a rotation vector in the base frame, normalised."""
    w, x, y, z = quat_product(quat_wxyz_from_rotvec(rotvec), orientation)
    length = math.hypot(w, x, y, z)
    return w / length, x / length, y / length, z / length


def _dot(a: Three, b: Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _plus(a: Three, b: Three) -> Three:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _minus(a: Three, b: Three) -> Three:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _scaled(a: Three, by: float) -> Three:
    return a[0] * by, a[1] * by, a[2] * by


def shortened(a: Three, limit: float) -> Three:
    """Return a vector with its length limited."""
    length = math.hypot(*a)
    return _scaled(a, limit / length) if length > limit else a
