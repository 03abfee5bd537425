"""Where a UR arm is sent: a position and an orientation that follow those commanded, within bounds, for every mode."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from haptether.slave.ur.kinematics.constraints import ToolCone, WorkspacePlane, tool_axis
from haptether.slave.ur.kinematics.pose import Quaternion, quat_product, quat_wxyz_from_rotvec, turn_between
from haptether.slave.ur.options import Three

SETTLE_PERIODS: Final = 3.0
"""Samples within which the set point closes in on its target: smooths the jitter of the line; one would be a jump."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


def closing_speed(distance: float, deceleration: float, settle_s: float) -> float:
    """The largest speed towards what is at a distance from which braking with a deceleration a ends there.

    That takes `d = v²/2a`, so it is `sqrt(2 a (d - a T²/2))` where that is above `a T²`, and `d/T` below, which joins
    it smoothly and needs no more than a. T is the time in which it settles; m or rad, and s.
    """
    near = deceleration * settle_s * settle_s
    if distance <= near:
        return distance / settle_s
    return math.sqrt(2.0 * deceleration * max(0.0, distance - 0.5 * near))


class SetPoint:
    """A point that follows a target, never faster or more suddenly than it may: what every mode follows.

    Its velocity goes to `v_target + e/|e| g(|e|)` for the distance e to the target, at most `max_acceleration` fast and
    never above `max_speed`; g is `closing_speed`, in which the point can brake.

    The workspace takes targets to the nearest point of each plane in turn, and the point itself as well.

    Args:
        max_speed: In m/s.
        max_acceleration: In m/s².
        period_s: Between two steps, in s; T is three of these.
        planes: Of the workspace.
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

    def begin(self, position: Three) -> None:
        """It rests there."""
        self.position, self.velocity = position, ORIGIN

    def outside(self, position: Three) -> float:
        """How far a point is beyond the workspace, in m; 0 within."""
        return max((max(0.0, plane.offset_m - _dot(plane.normal, position)) for plane in self._planes), default=0.0)

    def step(self, target: Three, target_velocity: Three, elapsed_s: float) -> None:
        """Goes on for a time in s towards a target in m that moves with a velocity in m/s."""
        target, target_velocity = self._inside(target, target_velocity)
        limit, settle = self._max_acceleration, self._settle
        # From where the target was when this point was last moved: else it would run ahead by v times a period.
        error = _minus(_minus(target, _scaled(target_velocity, elapsed_s)), self.position)
        distance = math.hypot(*error)
        towards = _scaled(error, closing_speed(distance, limit, settle) / distance) if distance > 0.0 else ORIGIN
        wanted = _shortened(_plus(target_velocity, towards), self._max_speed)
        change = _shortened(_minus(wanted, self.velocity), limit * elapsed_s)
        velocity = _plus(self.velocity, change)
        # The mean of the old and the new velocity: exact for an even acceleration.
        moved = _plus(self.position, _scaled(_plus(self.velocity, velocity), 0.5 * elapsed_s))
        self.position, self.velocity = self._inside(moved, velocity, self.position)

    def _inside(self, position: Three, velocity: Three, before: Three | None = None) -> tuple[Three, Three]:
        """What lies beyond a plane is put onto it; a point that was beyond `before` goes no further, without a jump."""
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
    """An orientation, and how it changes."""

    orientation: Quaternion
    """base_from_tool, `quat_wxyz`, of length 1."""
    angular_velocity: Three
    """rad/s, along the axes of the base."""


AT_REST: Final = Attitude((1.0, 0.0, 0.0, 0.0), ORIGIN)


class OrientationSetPoint:
    """An orientation R that follows another as `SetPoint` follows a point: the same law on SO(3).

    Its angular velocity goes to `w_target + e/|e| g(|e|)` with `e = log(R_target R')`, the shorter way round, at most
    `max_acceleration` fast and never above `max_speed`: a target that runs half a turn ahead is met from the other
    side. `R <- exp(dt (w + w_before) / 2) R`.

    A cone takes targets to the nearest orientation in it, and R brakes before its edge: its tilt t grows at most at
    `g(t_max - t)` of half the acceleration. The other half turns the axis along the edge, which takes
    `v² cot(t_max)` at a speed v: so the axis is never faster than that allows.

    Args:
        max_speed: In rad/s.
        max_acceleration: In rad/s².
        period_s: Between two steps, in s; T is three of these.
        cone: For the tool's z axis; None for none.

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
        """Of the cone, or more where it began outside and has not come back yet."""
        self._max_axis_speed = math.inf
        if cone is not None and cone.half_angle < 0.5 * math.pi:
            self._max_axis_speed = math.sqrt(0.5 * max_acceleration * math.tan(cone.half_angle))
        self.attitude = AT_REST

    def begin(self, orientation: Quaternion) -> None:
        """It rests there."""
        self.attitude = Attitude(orientation, ORIGIN)
        if self._cone is not None:
            self._max_tilt = max(self._cone.half_angle, self._cone.tilt(orientation)[0])

    def outside(self, orientation: Quaternion) -> float:
        """How far an orientation is beyond the cone, in rad; 0 within."""
        return 0.0 if self._cone is None else max(0.0, self._cone.tilt(orientation)[0] - self._cone.half_angle)

    def step(self, target: Attitude, elapsed_s: float) -> None:
        """Goes on for a time in s towards a target that turns."""
        (goal, goal_velocity), (now, velocity) = self._inside(target), self.attitude
        limit = self._max_acceleration * elapsed_s
        # From where the target was when this was last moved, as for a position.
        error = turn_between(now, _turned(goal, _scaled(goal_velocity, -elapsed_s)))
        distance = math.hypot(*error)
        closing = closing_speed(distance, self._max_acceleration, self._settle)
        towards = _scaled(error, closing / distance) if distance > 0.0 else ORIGIN
        wanted = _shortened(_plus(goal_velocity, towards), self._max_speed)
        if self._cone is None:
            change = _shortened(_minus(wanted, velocity), limit)
        else:
            change = self._braked(self._cone, wanted, limit)
        after = _plus(velocity, change)
        orientation = _turned(now, _scaled(_plus(velocity, after), 0.5 * elapsed_s))
        self.attitude = Attitude(self._kept(orientation), after)

    def _inside(self, target: Attitude) -> Attitude:
        """The nearest in the cone."""
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
        """The change of the angular velocity, at most `limit`, of which braking before the edge comes first."""
        orientation, velocity = self.attitude
        axis = tool_axis(orientation)
        about = _scaled(axis, _dot(wanted, axis))
        wanted = _plus(about, _shortened(_minus(wanted, about), self._max_axis_speed))
        change = _shortened(_minus(wanted, velocity), limit)
        tilt, outward = cone.tilt(orientation)
        allowed = closing_speed(max(0.0, self._max_tilt - tilt), 0.5 * self._max_acceleration, self._settle)
        room, along = allowed - _dot(velocity, outward), _dot(change, outward)
        if along <= room:
            return change
        room = max(room, -limit)
        across = _minus(change, _scaled(outward, along))
        return _plus(_scaled(outward, room), _shortened(across, math.sqrt(limit * limit - room * room)))

    def _kept(self, orientation: Quaternion) -> Quaternion:
        """On the edge what a step has led beyond it: less than the path of the axis bends in a step."""
        if self._cone is None:
            return orientation
        tilt, outward = self._cone.tilt(orientation)
        if tilt > self._max_tilt:
            return _turned(orientation, _scaled(outward, self._max_tilt - tilt))
        self._max_tilt = max(self._cone.half_angle, tilt)
        return orientation


def _turned(orientation: Quaternion, rotvec: Three) -> Quaternion:
    """Turned by a rotation vector in the base frame, of length 1."""
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


def _shortened(a: Three, limit: float) -> Three:
    length = math.hypot(*a)
    return _scaled(a, limit / length) if length > limit else a
