"""How a UR arm is brought to rest, and how the two sides notice that the other is gone.

An arm is stopped by its mode, else through the dashboard, else by the watchdog of the controller. What it does about
motion is one state, that of `SoftStop`; what moves the arm reads it and calls its methods, and changes nothing else.
"""

import math
import time
from collections.abc import Callable
from enum import Enum
from typing import Final

from haptether.slave.ur.connection import Order, RtdeConnection
from haptether.slave.ur.options import UrOptions
from haptether.slave.ur.services import (
    CONNECT_S,
    PROGRAM_END_S,
    REPLY_S,
    DashboardError,
    end_program,
    is_in_remote_control,
)
from haptether.slave.ur.state import RuntimeState, UrState
from haptether.slave.ur.worker import Call, Idle, TimedWorker

STOP_S: Final = 1.0
"""For a soft stop: the watchdog's longest period is a fifth of it."""
REST_S: Final = 1.2
"""After which the joints must rest, whatever the controller has answered."""
RESTING: Final = 0.05
"""rad/s; what sensors show of joints at rest is a tenth of it."""
STILL_S: Final = 0.05
"""For which joints must rest: at a reversal they do for a package."""
SILENCE_S: Final = 0.02
"""After which an arm is stopped that would go on by itself and is not commanded."""
PROGRAM_STOP_S: Final = PROGRAM_END_S + 0.5
"""For the program to be ended without the library; longer than its own limits together."""
LEAVE_S: Final = 1.0
"""How long the end of the driver waits for each stop that is under way."""

# ------------------------------------------------------------------------------------------------------- soft stop


class Phase(Enum):
    """What the driver does about motion.

    ```
    AT_REST --begin--> MOVING --stop--> STOPPING --rests--> AT_REST
                       MOVING --silence--> PAUSING --rests--> PAUSED --begin--> MOVING
    PAUSING, PAUSED --stop--> STOPPING
    any --cut--> CUT --acknowledge--> AT_REST
    ```
    """

    AT_REST = "at rest"
    """What moves the arm now is somebody else; a first command must be near the tool."""
    MOVING = "moving"
    """Commands lead it."""
    PAUSING = "pausing"
    """No command was made in time, so that it is stopped."""
    PAUSED = "paused"
    """It was seen at rest after that; the next command leads it on from there."""
    STOPPING = "stopping"
    """It is stopped, and was not seen at rest yet."""
    CUT = "cut"
    """The connection is cut."""


class SoftStop:
    """Stops the arm without waiting for it.

    What it knows changes with its methods alone, `update` first; properties only read it.

    Args:
        connection: The connections.
        host: The controller.
        report: Takes lines for the operator.
    """

    def __init__(self, connection: RtdeConnection, host: str, report: Callable[[str], None]) -> None:
        self._connection = connection
        self._host = host
        self._report = report
        self._dashboard = TimedWorker("ur-stopper")
        self._phase = Phase.AT_REST
        self._call: Call | None = None
        """The last soft stop, be it because nothing more was commanded."""
        self._before: Call | None = None
        """What the worker's last pause was when motion began."""
        self._still_since: float | None = None
        """Time stamp of the package since which the joints rest; at first of the one before."""
        self._program_stop: Call | None = None

    @property
    def phase(self) -> Phase:
        """Of the motion, as of the last call of a method."""
        return self._phase

    @property
    def commanded(self) -> bool:
        """Whether the arm is led: from an accepted first command until it is stopped or cut."""
        return self._phase in {Phase.MOVING, Phase.PAUSING, Phase.PAUSED}

    @property
    def ready(self) -> bool:
        """Whether a command may move the arm: not while it comes to rest, nor once it is cut."""
        return self._phase in {Phase.AT_REST, Phase.MOVING, Phase.PAUSED}

    @property
    def stopping(self) -> bool:
        """Whether the arm comes to rest: until it was seen to."""
        return self._phase in {Phase.STOPPING, Phase.PAUSING}

    @property
    def heard(self) -> bool:
        """Whether the watchdog hears a command or a stop just now, so that it needs no kick."""
        if self._phase is Phase.STOPPING:
            return self._call is not None and not self._call.done
        return self._phase in {Phase.MOVING, Phase.PAUSED}

    def update(self) -> None:
        """Takes in whether the thread of the library has paused the motion because commands stayed away."""
        idled = self._connection.worker.idled
        if self._phase is Phase.MOVING and idled is not None and idled is not self._before:
            self._phase, self._call, self._still_since = Phase.PAUSING, idled, None

    def begin(self) -> None:
        """Commands lead the arm from where it rests."""
        self._phase, self._call, self._still_since = Phase.MOVING, None, None
        self._before = self._connection.worker.idled

    def after_silence(self, brake: Order) -> Idle:
        """The stop that the thread of the library makes by itself where commands stay away."""
        control = self._connection.control
        return Idle(SILENCE_S, "stop", lambda: brake(control), STOP_S)

    def stop(self, brake: Order) -> None:
        """Begins a soft stop of an arm that is led; does not wait for it."""
        if self.commanded:
            self._phase, self._still_since = Phase.STOPPING, None
            self._call = self._connection.start("stop", brake, STOP_S)

    def check(self, state: UrState, *, stale: bool) -> str | None:
        """Looks at a package: why a soft stop did not succeed, where the program may still play.

        Args:
            state: The newest.
            stale: Whether it is too old to show that the program has ended.
        """
        self.update()
        if not self.stopping or self._connection.control is None:
            return None
        call = self._call
        assert call is not None
        since_s = 0.0 if call.started_s is None else time.monotonic() - call.started_s
        stuck = self._connection.worker.stuck is not None
        why: str | None
        if call.failure is not None or (not call.done and (since_s > STOP_S or stuck)):
            why = "was not acknowledged"
        elif call.done and self._rests(state):
            why = None
        elif since_s > REST_S:
            why = "was acknowledged, and the arm still moves"
        else:
            return None
        self._phase = Phase.AT_REST if self._phase is Phase.STOPPING else Phase.PAUSED
        return why if state.runtime_state == RuntimeState.PLAYING or stale else None

    def cut(self) -> None:
        """Cuts the connection, so that nothing leads the arm any more, and has the controller end the program.

        Where that does not come through either, the watchdog ends it.
        """
        self._phase, self._call = Phase.CUT, None
        self._connection.cut()
        self._program_stop = self._dashboard.start("end of the program", self._end_program, PROGRAM_STOP_S)

    def acknowledge(self) -> list[Call]:
        """The operator has removed the fault; returns the stops that have not ended."""
        pending = self._pending
        self._phase, self._call, self._still_since = Phase.AT_REST, None, None
        if self._dashboard.stuck is not None:
            self._dashboard.end()
            self._dashboard = TimedWorker("ur-stopper")
        return pending

    def close(self) -> None:
        """Waits for the stops that are under way, within their limits."""
        for call in self._pending:
            call.wait(min(call.limit_s, LEAVE_S))
        self._dashboard.end()

    @property
    def _pending(self) -> list[Call]:
        return [call for call in (self._call, self._program_stop) if call is not None]

    def _rests(self, state: UrState) -> bool:
        """Whether the joints have rested for a while since the stop was acknowledged."""
        if self._still_since is None or max(map(abs, state.qd)) > RESTING:
            # A package that rests counts from the next on: it may be older than the acknowledgement.
            self._still_since = state.timestamp
        return state.timestamp - self._still_since >= STILL_S

    def _end_program(self) -> None:
        try:
            end_program(self._host)
        except DashboardError as error:
            self._report(f"{error}: its watchdog ends the program; if the arm moves, press its emergency stop")


# --------------------------------------------------------------------------------------------------------- braking
#
# While the controller brakes, the vendor's library waits and says nothing, and the watchdog would end the program in
# the middle of a stop that takes longer than its period. So a stop is as hard as the options want it, and harder where
# it would take longer: `a = max(a_option, 2 |v| f)` for the watchdog's f in Hz, up to `MAX_DECELERATION`.

BRAKING_SHARE: Final = 0.5
"""Of the watchdog's period that braking may take: there is silence before, and a few cycles of messages around it."""
MAX_DECELERATION: Final = 20.0
"""m/s² or rad/s²; the most that the options allow, too. What is too fast for that the watchdog stops."""


def joint_deceleration(options: UrOptions, state: UrState) -> float:
    """Deceleration in rad/s² of the fastest joint."""
    return _deceleration(options, max(map(abs, state.qd)))


def tool_deceleration(options: UrOptions, state: UrState) -> float:
    """Deceleration of the tool, in m/s² of its point and rad/s² of its rotation."""
    return _deceleration(options, max(math.hypot(*state.speed[:3]), math.hypot(*state.speed[3:])))


def _deceleration(options: UrOptions, speed: float) -> float:
    return max(options.stop_deceleration, min(speed * options.watchdog_hz / BRAKING_SHARE, MAX_DECELERATION))


# -------------------------------------------------------------------------------------------------------- watchdog

ARMED_S: Final = 1.0
KICKS: Final = 5.0
"""In each period of the watchdog, while nothing is commanded."""
REMOTE_PERIOD_S: Final = 1.0
REMOTE_S: Final = CONNECT_S + 2.0 * REPLY_S + 1.0
REFUSED_S: Final = 0.05
"""For how long commands may fail before that is a fault: a stop of the controller's has its own reason by then."""


class Watchdog:
    """The controller's watchdog: armed, kicked while nothing is commanded; and whether commands are still accepted.

    Args:
        options: Of the driver.
        connection: Its connections.
        watches_remote: Whether the controller can say whether it is in remote control.
    """

    def __init__(self, options: UrOptions, connection: RtdeConnection, *, watches_remote: bool) -> None:
        self._options = options
        self._connection = connection
        self._watches_remote = watches_remote
        self._arming: Call | None = None
        self._remote: Call | None = None
        self._acknowledged: Call | None = None
        """The last command that was streamed before the operator acknowledged a fault."""
        self._kicked_s = self._remote_s = self._taken_s = 0.0

    @property
    def armed(self) -> bool:
        """Whether the watchdog listens."""
        return self._arming is not None and self._arming.done and self._arming.failure is None

    def service(self, now_s: float, aside: TimedWorker, *, idle: bool) -> None:
        """Makes the calls that are due.

        Args:
            now_s: The time of the monotonic clock in s.
            aside: Makes calls that may take long; not the thread that commands.
            idle: Whether the watchdog hears nothing else.
        """
        hz = self._options.watchdog_hz
        if self._arming is None:
            self._arming = self._connection.start("setWatchdog", lambda control: control.setWatchdog(hz), ARMED_S)
        elif idle and self._arming.done and now_s - self._kicked_s > 1.0 / (KICKS * hz):
            self._connection.stream("kickWatchdog", lambda control: control.kickWatchdog())
            self._kicked_s = now_s
        if self._watches_remote and now_s - self._remote_s > REMOTE_PERIOD_S:
            self._remote_s = now_s
            if self._remote is None or self._remote.done:
                host = self._options.host
                self._remote = aside.start("remote control", lambda: is_in_remote_control(host), REMOTE_S)

    def fault(self) -> str | None:
        """What is wrong with the calls of the library, and what to do about it."""
        worker = self._connection.worker
        if (stuck := worker.stuck) is not None:
            return f"{stuck.name} has not returned: the controller does not answer: see the network, then acknowledge"
        if (arming := self._arming) is not None and arming.failure is not None:
            return f"the watchdog was not armed: {arming.failure}"
        streamed = worker.streamed
        if streamed is None or streamed is self._acknowledged or streamed.failure is None:
            self._taken_s = time.monotonic()
        elif time.monotonic() - self._taken_s > REFUSED_S:
            return f"the controller takes no commands: {streamed.failure}: see the pendant, then acknowledge"
        remote = self._remote
        if remote is not None and remote.done:
            if remote.error is None and remote.result is False:
                return "remote control was switched off on the pendant: switch it on there, then acknowledge"
            if remote.error is not None:
                return f"{remote.error}: remote control cannot be looked after"
        return None

    def reset(self) -> None:
        """The operator has acknowledged: the watchdog is armed anew."""
        self._arming = self._remote = None
        self._acknowledged = self._connection.worker.streamed
