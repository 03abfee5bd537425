"""What sends a UR arm on: from what the scene asks for to a command of the mode, within the bounds of the options."""

import math
import time
from typing import TYPE_CHECKING, Final

from haptether.slave.ur.connection import STREAM_S, UrLink
from haptether.slave.ur.joints import UnreachableError
from haptether.slave.ur.latency import Latency
from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.setpoint import SetPoint
from haptether.slave.ur.state import UrState
from haptether.slave.ur.stop import STOP_S, Halting
from haptether.slave.ur.worker import Idle

if TYPE_CHECKING:
    from haptether.slave.ur.modes import Mode

SILENCE_S: Final = 0.02
"""After which an arm is stopped that would go on by itself and is not led."""
MAX_PERIODS: Final = 5.0
"""Time between two commands that is made up for at once."""
LAG_S: Final = 0.3
"""How late an arm may be beside its lookahead before it counts as one that does not follow."""
LAG_M: Final = 0.02
"""What contact and the controller's own errors may add."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


class MotionError(ValueError):
    """The arm must not, or does not, go where it is sent."""


class Motion:
    """One arm in one mode; nothing here waits for the arm.

    Args:
        options: Of the driver.
        link: Its connections.
        halting: What stops it.
        mode: The command that moves it.
        period_s: Between two commands, in s.
    """

    def __init__(self, options: UrOptions, link: UrLink, halting: Halting, mode: "Mode", period_s: float) -> None:
        self._options = options
        self._link = link
        self._halting = halting
        self.mode = mode
        self._period_s = period_s
        self.point = SetPoint(options.max_speed, options.max_acceleration, period_s, options.workspace)
        self.latency = Latency(period_s)
        self.moving = False
        self._written_s = 0.0
        self._most_behind_m = LAG_M + options.max_speed * (LAG_S + options.lookahead_time)

    def send(self, state: UrState, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Sends the tool on towards a position in m with a velocity in m/s, along the axes of the scene.

        Nothing while it still comes to rest from what it did before.

        Raises:
            MotionError: It is not allowed, or not possible, from where the arm is.
        """
        now_s = time.monotonic()
        target = placed(self._options, position, self.point.position if self.moving else _three(state.pose))
        if self._halting.busy:
            return
        if not self.moving:
            self._begin(state, target)
        elif self._link.worker.idled is not None:
            # It was stopped meanwhile: on from where it came to rest, as fast as it may.
            self.at_rest(state)
            self._written_s = now_s - self._period_s
        elapsed_s = min(max(now_s - self._written_s, 0.25 * self._period_s), MAX_PERIODS * self._period_s)
        self._written_s = now_s
        self.point.step(target, placed(self._options, velocity, ORIGIN), elapsed_s)
        self._check_follows(state)
        mode, control = self.mode, self._link.control
        try:
            order = mode.order(self.point, state, elapsed_s)
        except UnreachableError as error:
            message = f"{error}: lead it elsewhere, then acknowledge"
            raise MotionError(message) from None
        idle = None
        if mode.goes_on:
            brake = mode.brake(state)
            idle = Idle(SILENCE_S, "stop", lambda: brake(control), STOP_S)
        self._link.worker.stream(mode.name, lambda: order(control), STREAM_S, idle)
        self.latency.add(now_s, along(self._options, target), along(self._options, state.pose))

    def stop(self, state: UrState) -> None:
        """Has the arm come to rest softly, if it moves; does not wait for it."""
        if self.moving:
            self.moving = False
            self._halting.stop(self.mode, state)

    def outside(self, state: UrState) -> float:
        """How far the tool is beyond the workspace, in m; 0 within."""
        return self.point.outside(_three(state.pose))

    def rehearse(self, state: UrState) -> None:
        """Makes an order and throws it away."""
        self.at_rest(state)
        self.mode.order(self.point, state, self._period_s)

    def at_rest(self, state: UrState) -> None:
        """Motion begins where the arm is."""
        self._halting.go_on()
        self.point.begin(_three(state.pose))
        self.mode.begin(state)

    def _begin(self, state: UrState, target: Three) -> None:
        tool, most_m = _three(state.pose), self._options.max_jump
        away_m = math.dist(target, tool)
        if away_m > most_m:
            message = (
                f"told to begin {1e3 * away_m:.1f} mm away from where the tool is (max_jump {1e3 * most_m:g} mm):"
                " acknowledge and engage anew"
            )
            raise MotionError(message)
        if (beyond_m := self.outside(state)) > most_m:
            message = f"the tool is {1e3 * beyond_m:.1f} mm outside its workspace: move it inside, then acknowledge"
            raise MotionError(message)
        self.at_rest(state)
        self.latency.clear()
        self._written_s = time.monotonic() - self._period_s
        self.moving = True

    def _check_follows(self, state: UrState) -> None:
        """What an arm is behind it makes up for as soon as it can: so it must not be much."""
        behind_m = math.dist(self.point.position, _three(state.pose))
        if behind_m > self._most_behind_m:
            message = (
                f"the arm does not follow: {1e3 * behind_m:.0f} mm behind where it was sent"
                f" (allowed {1e3 * self._most_behind_m:.0f} mm): see what holds it, then acknowledge"
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


def _three(pose: tuple[float, ...]) -> Three:
    return pose[0], pose[1], pose[2]
