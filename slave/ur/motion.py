"""Motion of a UR arm: from the scene's command to a bounded set point, and to the mode."""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np

from haptether.slave.ur.checks import MODEL_M
from haptether.slave.ur.connection import RtdeConnection
from haptether.slave.ur.kinematics.pose import finite, quat_wxyz_from_rotvec, turn_between, unit_quaternion
from haptether.slave.ur.modes import DirectTorque, Mode, UnreachableError, model_distance
from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.set_point import ORIGIN, Attitude, OrientationSetPoint, SetPoint
from haptether.slave.ur.state import UrState
from haptether.slave.ur.stop import Phase, SoftStop

MAX_PERIODS: Final = 5.0
"""Longest time between commands, in periods, that is caught up at once."""
LAG_S: Final = 0.3
"""Largest lag in s in addition to the lookahead before the arm counts as not following."""
LAG_M: Final = 0.02
"""Additional lag in m by contact and control errors."""
LAG_RAD: Final = 0.3
"""Same for the orientation in rad, which yields near a singularity."""
TURNED_OVER: Final = 0.02
"""Sine of joint 5 above which a wrist that passed its singularity counts as turned over."""


class MotionError(ValueError):
    """The arm must not, or does not, follow its command."""


class Motion:
    """One arm in one mode, without blocking.

    Args:
        options: Options of the driver.
        connection: Takes the commands.
        soft_stop: Stops the arm, and permits motion.
        mode: Motion command.
        period_s: Period of commands in s.
        report: Takes lines for the operator.
    """

    def __init__(
        self,
        options: UrOptions,
        connection: RtdeConnection,
        soft_stop: SoftStop,
        mode: Mode,
        period_s: float,
        *,
        report: Callable[[str], None],
    ) -> None:
        self._options = options
        self._connection = connection
        self._soft_stop = soft_stop
        self.mode = mode
        self._period_s = period_s
        self._report = report
        self.point = SetPoint(options.max_speed, options.max_acceleration, period_s, options.planes)
        self.turning = OrientationSetPoint(
            options.max_angular_speed, options.max_angular_acceleration, period_s, options.cone
        )
        self._turns = False
        """True if an orientation was commanded since the start of motion; otherwise the initial one is kept."""
        self._pushes = False
        """True if the last command was a force."""
        self._goal = self.turning.attitude
        self._wrist = 0.0
        """Sine of joint 5 on its last side of the singularity."""
        self.latency = Latency(period_s)
        self._written_s = 0.0
        self._max_behind_m = LAG_M + options.max_speed * (LAG_S + options.lookahead_time)
        self._max_behind_rad = LAG_RAD + options.max_angular_speed * (LAG_S + options.lookahead_time)

    def send(
        self,
        state: UrState,
        position: tuple[float, ...],
        velocity: tuple[float, ...],
        orientation: tuple[float, ...] | None = None,
        angular_velocity: tuple[float, ...] | None = None,
    ) -> None:
        """Move the tool towards a position in m with a velocity in m/s, along the scene axes.

        No effect while the arm comes to rest. An orientation is base_from_tool as `quat_wxyz` and turns in rad/s;
        without one the tool keeps the initial or last commanded one.

        Raises:
            MotionError: The motion is not allowed or not possible from the arm's pose, or the orientation is invalid.
        """
        commanded = None if orientation is None else _attitude(orientation, angular_velocity)
        now_s = time.monotonic()
        stop = self._soft_stop
        stop.update()
        if not stop.ready:
            return
        goes_on = stop.commanded and not self._pushes
        target = placed(self._options, position, self.point.position if goes_on else _three(state.pose))
        if not stop.commanded:
            self._begin(state, target, commanded)
        elif self._pushes:
            self._take_over(state, target, commanded)
        if stop.phase is Phase.PAUSED:
            self._resume(state, now_s)
        elapsed_s = min(max(now_s - self._written_s, 0.25 * self._period_s), MAX_PERIODS * self._period_s)
        self._written_s = now_s
        point, mode = self.point, self.mode
        point.step(target, placed(self._options, velocity, ORIGIN), elapsed_s)
        attitude = self._turn(commanded, elapsed_s)
        self._check_follows(state)
        try:
            order = mode.order(point.position, point.velocity, state, elapsed_s, attitude)
        except UnreachableError as error:
            message = f"{error}: lead it elsewhere, then acknowledge"
            raise MotionError(message) from None
        idle = stop.after_silence(mode.brake(state)) if mode.goes_on else None
        self._connection.stream(mode.name, order, idle)
        self.latency.add(now_s, along(self._options, target), along(self._options, state.pose))

    def push(self, state: UrState, force: tuple[float, ...], torque: tuple[float, ...] | None = None) -> None:
        """Exert a force in N, along the scene axes, and a moment in N m about the tool point in the base frame.

        No effect while the arm comes to rest. Without a moment the tool keeps its orientation, and along one axis its
        place in the other two directions: those of the last motion, or of the arm at rest.

        Raises:
            MotionError: The mode takes no forces, the force is invalid, the arm must not move from its pose, or it is
                pushed too far from a direction that it keeps.
        """
        mode = self.mode
        if not isinstance(mode, DirectTorque):
            message = f"commanded a force: mode = '{self._options.mode}' takes positions: direct-torque takes both"
            raise MotionError(message)
        along_base, moment = _wrench(self._options, force, torque)
        now_s = time.monotonic()
        stop = self._soft_stop
        stop.update()
        if not stop.ready:
            return
        if not stop.commanded:
            self._check_place(state)
            self._at_rest(state)
            self._start()
        elif stop.phase is Phase.PAUSED:
            self._resume(state, now_s)
        if not self._pushes:
            mode.forces.hold(self.point.position, self.turning.attitude.orientation)
        self._pushes, self._written_s = True, now_s
        order = mode.push(along_base, moment, state)
        self._check_held(mode)
        self._connection.stream(mode.name, order, stop.after_silence(mode.brake(state)))

    def outside(self, state: UrState) -> float:
        """Return the distance of the tool beyond the workspace in m; 0 inside."""
        return self.point.outside(_three(state.pose))

    def tilted(self, state: UrState) -> float:
        """Return the angle of the tool's axis beyond its cone in rad; 0 inside."""
        return self.turning.outside(quat_wxyz_from_rotvec(state.pose[3:]))

    def rehearse(self, state: UrState) -> None:
        """Create and discard an order of each kind."""
        self._at_rest(state)
        for attitude in (None, self.turning.attitude)[: 2 if self._options.axes == 3 else 1]:
            self.mode.order(self.point.position, self.point.velocity, state, self._period_s, attitude)
        if isinstance(self.mode, DirectTorque):
            self.mode.forces.hold(self.point.position, self.turning.attitude.orientation)
            self.mode.push(ORIGIN, None, state)

    def _turn(self, commanded: Attitude | None, elapsed_s: float) -> Attitude | None:
        """Return the set orientation; None to keep the initial one."""
        if not self._turns:
            if commanded is not None:
                message = "commanded to turn in the middle of a motion that keeps its orientation: engage anew"
                raise MotionError(message)
            return None
        self._goal = commanded or Attitude(self._goal.orientation, ORIGIN)
        self.turning.step(self._goal, elapsed_s)
        return self.turning.attitude

    def _begin(self, state: UrState, target: Three, commanded: Attitude | None) -> None:
        tool, max_m = _three(state.pose), self._options.max_jump
        away_m = math.dist(target, tool)
        if away_m > max_m:
            message = (
                f"commanded to begin {1e3 * away_m:.1f} mm away from where the tool is (max_jump {1e3 * max_m:g} mm):"
                " acknowledge and engage anew"
            )
            raise MotionError(message)
        self._check_place(state)
        self._turns = commanded is not None
        self._at_rest(state)
        if commanded is not None:
            self._check_poses()
            self._check_turn(commanded)
        self._start()

    def _start(self) -> None:
        """Start from rest."""
        self._soft_stop.begin()
        self.latency.clear()
        self._written_s = time.monotonic() - self._period_s

    def _resume(self, state: UrState, now_s: float) -> None:
        """Continue from rest after a pause, at full speed."""
        self._at_rest(state)
        self._soft_stop.begin()
        self._written_s = now_s - self._period_s

    def _take_over(self, state: UrState, target: Three, commanded: Attitude | None) -> None:
        """Continue a motion that forces have made, from the arm's pose and velocity."""
        assert isinstance(self.mode, DirectTorque)
        away_m = math.dist(target, _three(state.pose))
        if away_m > self._max_behind_m:
            message = (
                f"commanded {1e3 * away_m:.1f} mm away from the tool after a force (allowed"
                f" {1e3 * self._max_behind_m:.0f} mm): acknowledge and engage anew"
            )
            raise MotionError(message)
        self._turns = commanded is not None
        if commanded is not None:
            self._check_poses()
        self._place(state, _three(state.speed), _three(state.speed[3:]))
        self.mode.resume(state)
        self.latency.clear()

    def _check_place(self, state: UrState) -> None:
        """Check that the arm may move from its pose."""
        max_m = self._options.max_jump
        if (beyond_m := self.outside(state)) > max_m:
            message = f"the tool is {1e3 * beyond_m:.1f} mm outside its workspace: move it inside, then acknowledge"
            raise MotionError(message)
        if (beyond_rad := self.tilted(state)) > self._options.max_turn:
            message = f"the tool is tilted {beyond_rad:.3f} rad beyond tool_cone: turn it back, then acknowledge"
            raise MotionError(message)

    def _check_turn(self, commanded: Attitude) -> None:
        """Check that a turn may start from rest here."""
        options = self._options
        away_rad = math.hypot(*turn_between(self.turning.attitude.orientation, commanded.orientation))
        if away_rad > options.max_turn:
            message = (
                f"commanded to begin {away_rad:.3f} rad away from the tool's orientation (max_turn"
                f" {options.max_turn:g} rad): acknowledge and engage anew"
            )
            raise MotionError(message)

    def _check_poses(self) -> None:
        """Check that this arm can turn its tool."""
        options = self._options
        if options.axes != 3:
            message = "commanded an orientation along one axis: axes = 3 in the options takes poses, acknowledge then"
            raise MotionError(message)
        distance_m = model_distance(self.mode)
        if distance_m is not None and distance_m > MODEL_M:
            message = (
                f"the tool of a {options.model} would be {1e3 * distance_m:.0f} mm from where the controller has it:"
                " mend model or tool in the options"
            )
            raise MotionError(message)

    def _at_rest(self, state: UrState) -> None:
        """Start a motion at the arm's pose."""
        self._place(state)
        self.mode.begin(state)

    def _place(self, state: UrState, velocity: Three = ORIGIN, angular_velocity: Three = ORIGIN) -> None:
        """Place the set point at the arm's pose."""
        self.point.begin(_three(state.pose), velocity)
        self.turning.begin(quat_wxyz_from_rotvec(state.pose[3:]), angular_velocity)
        self._goal = self.turning.attitude
        self._pushes = False
        self._wrist = math.sin(state.q[4])

    def _check_follows(self, state: UrState) -> None:
        """Limit the lag, because the arm corrects it as soon as it can."""
        behind_m = math.dist(self.point.position, _three(state.pose))
        if behind_m > self._max_behind_m:
            message = (
                f"the arm does not follow: {1e3 * behind_m:.0f} mm behind its command"
                f" (allowed {1e3 * self._max_behind_m:.0f} mm): see what holds it, then acknowledge"
            )
            raise MotionError(message)
        if self._turns:
            self._check_turns(state)

    def _check_held(self, mode: DirectTorque) -> None:
        """Limit the deviation from a held direction, because the arm corrects it as soon as it can."""
        away_m, away_rad = mode.forces.away_m, mode.forces.away_rad
        if away_m > self._max_behind_m or away_rad > self._max_behind_rad:
            message = (
                f"the arm is pushed off its place: {1e3 * away_m:.0f} mm beside its line (allowed"
                f" {1e3 * self._max_behind_m:.0f} mm), turned by {away_rad:.2f} rad (allowed"
                f" {self._max_behind_rad:.2f} rad): see what pushes it, then acknowledge"
            )
            raise MotionError(message)

    def _check_turns(self, state: UrState) -> None:
        """Limit the orientation lag, and detect a turned wrist."""
        tool = quat_wxyz_from_rotvec(state.pose[3:])
        behind_rad = math.hypot(*turn_between(tool, self.turning.attitude.orientation))
        if behind_rad > self._max_behind_rad:
            message = (
                f"the arm does not follow: {behind_rad:.2f} rad behind its command"
                f" (allowed {self._max_behind_rad:.2f} rad): see what holds it, then acknowledge"
            )
            raise MotionError(message)
        wrist = math.sin(state.q[4])
        if abs(wrist) > TURNED_OVER:
            if wrist * self._wrist < 0.0:
                self._report(f"the wrist has turned over: joint 5 is at {state.q[4]:.2f} rad, past its singularity")
            self._wrist = wrist


def placed(options: UrOptions, vector: tuple[float, ...], at: Three) -> Three:
    """Convert a scene vector to the base frame; one axis keeps the other two from `at`."""
    if len(vector) == 3:
        return vector[0], vector[1], vector[2]
    unit = options.axis_unit
    off = vector[0] - sum(a * b for a, b in zip(unit, at, strict=True))
    return at[0] + off * unit[0], at[1] + off * unit[1], at[2] + off * unit[2]


def along(options: UrOptions, vector: tuple[float, ...]) -> float:
    """Return the component of a base-frame vector along the one axis."""
    unit = options.axis_unit
    return unit[0] * vector[0] + unit[1] * vector[1] + unit[2] * vector[2]


def _attitude(orientation: tuple[float, ...], angular_velocity: tuple[float, ...] | None) -> Attitude:
    """Return the checked command."""
    try:
        unit = unit_quaternion("orientation", orientation)
        x, y, z = finite("angular_velocity", ORIGIN if angular_velocity is None else angular_velocity, 3)
    except ValueError as error:
        message = f"commanded {error}: see the master, then acknowledge"
        raise MotionError(message) from None
    return Attitude(unit, (x, y, z))


def _wrench(
    options: UrOptions, force: tuple[float, ...], torque: tuple[float, ...] | None
) -> tuple[Three, Three | None]:
    """Return the checked force and moment in the base frame."""
    try:
        numbers = finite("force", force, options.axes)
        moment = None if torque is None else finite("torque", torque, 3)
    except ValueError as error:
        message = f"commanded {error}: see the master, then acknowledge"
        raise MotionError(message) from None
    if moment is not None and options.axes != 3:
        message = "commanded a torque along one axis: axes = 3 in the options takes poses, acknowledge then"
        raise MotionError(message)
    return placed(options, tuple(numbers), ORIGIN), None if moment is None else _three(tuple(moment))


class Latency:
    """Delay d at which `x(t)` best matches `x_set(t - d)` without means: minimum of the sum of squares.

    A constant offset, as in contact, does not count. The arm is modelled as a pure delay; its other dynamics smooth the
    minimum and shift it towards the lag at slow motion.

    Args:
        period_s: Sample period.
    """

    MAX_DELAY_S: Final = 0.4
    """Largest searched delay in s."""
    STEP_S: Final = 0.001
    WINDOW_S: Final = 8.0
    MIN_MOTION_M: Final = 0.002
    """Standard deviation of the motion in m below which no delay can be found."""

    def __init__(self, period_s: float) -> None:
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=int(self.WINDOW_S / period_s))

    def add(self, time_s: float, commanded: float, measured: float) -> None:
        """Add a commanded and a measured position along one axis in m."""
        self._rows.append((time_s, commanded, measured))

    def clear(self) -> None:
        """Restart with the next motion."""
        self._rows.clear()

    @property
    def seconds(self) -> float | None:
        """Return the delay in s; None without enough motion."""
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
        # Parabola through the three lowest points.
        before, at, after = squares[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        return float(delays[best] + (0.5 * self.STEP_S * (before - after) / bend if bend > 0.0 else 0.0))


def _three(pose: tuple[float, ...]) -> Three:
    return pose[0], pose[1], pose[2]
