"""What moves a UR arm: from the command of the scene to a set point within the bounds of the options, to its mode."""

import math
import time
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from haptether.slave.ur.connection import RtdeConnection
from haptether.slave.ur.kinematics.constraints import WorkspacePlane
from haptether.slave.ur.modes import Mode, UnreachableError
from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.state import UrState
from haptether.slave.ur.stop import Phase, SoftStop

MAX_PERIODS: Final = 5.0
"""Time between two commands that is made up for at once."""
LAG_S: Final = 0.3
"""How late an arm may be beside its lookahead before it counts as one that does not follow."""
LAG_M: Final = 0.02
"""What contact and the controller's own errors may add."""
SETTLE_PERIODS: Final = 3.0
"""Samples within which the set point closes in on its target: smooths the jitter of the line; one would be a jump."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


class MotionError(ValueError):
    """The arm must not, or does not, go where it is sent."""


class Motion:
    """One arm in one mode; nothing here waits for the arm.

    Args:
        options: Of the driver.
        connection: Takes the commands.
        soft_stop: Stops the arm, and says whether it may be moved.
        mode: The command that moves it.
        period_s: Between two commands, in s.
    """

    def __init__(
        self, options: UrOptions, connection: RtdeConnection, soft_stop: SoftStop, mode: Mode, period_s: float
    ) -> None:
        self._options = options
        self._connection = connection
        self._soft_stop = soft_stop
        self.mode = mode
        self._period_s = period_s
        self.point = SetPoint(options.max_speed, options.max_acceleration, period_s, options.planes)
        self.latency = Latency(period_s)
        self._written_s = 0.0
        self._max_behind_m = LAG_M + options.max_speed * (LAG_S + options.lookahead_time)

    def send(self, state: UrState, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Sends the tool on towards a position in m with a velocity in m/s, along the axes of the scene.

        Nothing while it still comes to rest from what it did before.

        Raises:
            MotionError: It is not allowed, or not possible, from where the arm is.
        """
        now_s = time.monotonic()
        stop = self._soft_stop
        stop.update()
        if not stop.ready:
            return
        target = placed(self._options, position, self.point.position if stop.commanded else _three(state.pose))
        if not stop.commanded:
            self._begin(state, target)
        elif stop.phase is Phase.PAUSED:
            # On from where it is at rest, as fast as it may.
            self._at_rest(state)
            stop.begin()
            self._written_s = now_s - self._period_s
        elapsed_s = min(max(now_s - self._written_s, 0.25 * self._period_s), MAX_PERIODS * self._period_s)
        self._written_s = now_s
        point, mode = self.point, self.mode
        point.step(target, placed(self._options, velocity, ORIGIN), elapsed_s)
        self._check_follows(state)
        try:
            order = mode.order(point.position, point.velocity, state, elapsed_s)
        except UnreachableError as error:
            message = f"{error}: lead it elsewhere, then acknowledge"
            raise MotionError(message) from None
        idle = stop.after_silence(mode.brake(state)) if mode.goes_on else None
        self._connection.stream(mode.name, order, idle)
        self.latency.add(now_s, along(self._options, target), along(self._options, state.pose))

    def outside(self, state: UrState) -> float:
        """How far the tool is beyond the workspace, in m; 0 within."""
        return self.point.outside(_three(state.pose))

    def rehearse(self, state: UrState) -> None:
        """Makes an order and throws it away."""
        self._at_rest(state)
        self.mode.order(self.point.position, self.point.velocity, state, self._period_s)

    def _begin(self, state: UrState, target: Three) -> None:
        tool, max_m = _three(state.pose), self._options.max_jump
        away_m = math.dist(target, tool)
        if away_m > max_m:
            message = (
                f"commanded to begin {1e3 * away_m:.1f} mm away from where the tool is (max_jump {1e3 * max_m:g} mm):"
                " acknowledge and engage anew"
            )
            raise MotionError(message)
        if (beyond_m := self.outside(state)) > max_m:
            message = f"the tool is {1e3 * beyond_m:.1f} mm outside its workspace: move it inside, then acknowledge"
            raise MotionError(message)
        self._at_rest(state)
        self._soft_stop.begin()
        self.latency.clear()
        self._written_s = time.monotonic() - self._period_s

    def _at_rest(self, state: UrState) -> None:
        """Motion begins where the arm is."""
        self.point.begin(_three(state.pose))
        self.mode.begin(state)

    def _check_follows(self, state: UrState) -> None:
        """What an arm is behind it makes up for as soon as it can: so it must not be much."""
        behind_m = math.dist(self.point.position, _three(state.pose))
        if behind_m > self._max_behind_m:
            message = (
                f"the arm does not follow: {1e3 * behind_m:.0f} mm behind its command"
                f" (allowed {1e3 * self._max_behind_m:.0f} mm): see what holds it, then acknowledge"
            )
            raise MotionError(message)


def placed(options: UrOptions, vector: tuple[float, ...], at: Three) -> Three:
    """A vector of the scene in the frame of the base; one axis leaves the other two as they are in `at`."""
    if len(vector) == 3:
        return vector[0], vector[1], vector[2]
    unit = options.axis_unit
    off = vector[0] - sum(a * b for a, b in zip(unit, at, strict=True))
    return at[0] + off * unit[0], at[1] + off * unit[1], at[2] + off * unit[2]


def along(options: UrOptions, vector: tuple[float, ...]) -> float:
    """The part of a vector in the frame of the base that lies along the one axis."""
    unit = options.axis_unit
    return unit[0] * vector[0] + unit[1] * vector[1] + unit[2] * vector[2]


class SetPoint:
    """A point that follows a target, never faster or more suddenly than it may: what every mode follows.

    Its velocity goes to `v_target + e/|e| g(|e|)` for the distance e to the target, at most `max_acceleration` fast and
    never above `max_speed`. Braking with a takes `|e| = v²/2a`, so `g = sqrt(2 a (|e| - a T²/2))` where that is above
    `a T²`, and `|e|/T` below, which joins it smoothly and needs no more than a.

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
        near = limit * settle * settle
        braking = math.sqrt(2.0 * limit * max(0.0, distance - 0.5 * near))
        closing = distance / settle if distance <= near else braking
        towards = _scaled(error, closing / distance) if distance > 0.0 else ORIGIN
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


class Latency:
    """The delay d at which `x(t)` is nearest to `x_set(t - d)`, means taken away: the minimum of the sum of squares.

    A constant distance, as in contact, does not count. The arm is taken to be a pure delay; what it is besides smooths
    the minimum and moves it towards the lag that it has for slow motion.

    Args:
        period_s: Between two samples.
    """

    MAX_DELAY_S: Final = 0.4
    """Largest delay that is looked for."""
    STEP_S: Final = 0.001
    WINDOW_S: Final = 8.0
    MIN_MOTION_M: Final = 0.002
    """Standard deviation of the motion below which no delay can be found."""

    def __init__(self, period_s: float) -> None:
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=int(self.WINDOW_S / period_s))

    def add(self, time_s: float, commanded: float, measured: float) -> None:
        """A position along one axis in m, as commanded and as measured."""
        self._rows.append((time_s, commanded, measured))

    def clear(self) -> None:
        """Motion begins anew."""
        self._rows.clear()

    @property
    def seconds(self) -> float | None:
        """The delay in s; none where there was too little motion."""
        rows = np.array(self._rows)
        if len(rows) < 3:
            return None
        time_s, commanded, measured = rows.T
        late = time_s > time_s[0] + self.MAX_DELAY_S
        if late.sum() < 3 or float(measured[late].std()) < self.MIN_MOTION_M:
            return None
        delays = np.arange(0.0, self.MAX_DELAY_S, self.STEP_S)
        squares = np.empty(len(delays))
        for place, delay in enumerate(delays):
            off = measured[late] - np.interp(time_s[late] - delay, time_s, commanded)
            squares[place] = ((off - off.mean()) ** 2).sum()
        best = int(squares.argmin())
        if not 0 < best < len(delays) - 1:
            return float(delays[best])
        # The parabola through the three lowest.
        before, at, after = squares[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        return float(delays[best] + (0.5 * self.STEP_S * (before - after) / bend if bend > 0.0 else 0.0))


def _three(pose: tuple[float, ...]) -> Three:
    return pose[0], pose[1], pose[2]


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
