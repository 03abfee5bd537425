"""Stopping a UR arm, and detection of a lost peer on both sides.

An arm is stopped by its mode, otherwise through the dashboard, otherwise by the controller's watchdog. `SoftStop` holds
the only state about motion; motion code reads it and calls its methods.
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
"""Timeout of a soft stop in s; five times the watchdog's longest period."""
REST_S: Final = 1.2
"""Time in s after which the joints must rest, whatever the controller answered."""
RESTING: Final = 0.05
"""Speed in rad/s of joints at rest; sensors show a tenth of it."""
STILL_S: Final = 0.05
"""Required resting time in s; at a reversal joints rest for one package."""
SILENCE_S: Final = 0.02
"""Time in s without a command after which a self-moving arm is stopped."""
PROGRAM_STOP_S: Final = PROGRAM_END_S + 0.5
"""Timeout for ending the program without the library; longer than the sum of its own timeouts."""
LEAVE_S: Final = 1.0
"""Timeout in s per pending stop at the driver's end."""

# ------------------------------------------------------------------------------------------------------- soft stop


class Phase(Enum):
    """Motion state of the driver.

    ```
    AT_REST --begin--> MOVING --stop--> STOPPING --rests--> AT_REST
                       MOVING --silence--> PAUSING --rests--> PAUSED --begin--> MOVING
    PAUSING, PAUSED --stop--> STOPPING
    any --cut--> CUT --acknowledge--> AT_REST
    ```
    """

    AT_REST = "at rest"
    """Another source moves the arm; a first command must be near the tool."""
    MOVING = "moving"
    """Commands move the arm."""
    PAUSING = "pausing"
    """Stopped because no command arrived in time."""
    PAUSED = "paused"
    """At rest after a pause; the next command continues from there."""
    STOPPING = "stopping"
    """Stopped, but not confirmed at rest yet."""
    CUT = "cut"
    """The connection is cut."""


class SoftStop:
    """Stop the arm without blocking.

    Only methods change the state, `update` first; properties only read it.

    Args:
        connection: Connections to the controller.
        host: Host of the controller.
        report: Takes lines for the operator.
    """

    def __init__(self, connection: RtdeConnection, host: str, report: Callable[[str], None]) -> None:
        self._connection = connection
        self._host = host
        self._report = report
        self._dashboard = TimedWorker("ur-stopper")
        self._phase = Phase.AT_REST
        self._call: Call | None = None
        """Last soft stop, including one after silence."""
        self._before: Call | None = None
        """Last pause of the worker at the start of motion."""
        self._still_since: float | None = None
        """Timestamp of the package since which the joints rest; initially of the previous package."""
        self._program_stop: Call | None = None

    @property
    def phase(self) -> Phase:
        """Phase as of the last method call."""
        return self._phase

    @property
    def commanded(self) -> bool:
        """True from an accepted first command until the arm is stopped or cut."""
        return self._phase in {Phase.MOVING, Phase.PAUSING, Phase.PAUSED}

    @property
    def ready(self) -> bool:
        """True if a command may move the arm: not while it comes to rest, nor after a cut."""
        return self._phase in {Phase.AT_REST, Phase.MOVING, Phase.PAUSED}

    @property
    def stopping(self) -> bool:
        """True until an arm that comes to rest is confirmed at rest."""
        return self._phase in {Phase.STOPPING, Phase.PAUSING}

    @property
    def heard(self) -> bool:
        """True if the watchdog currently hears a command or a stop and needs no kick."""
        if self._phase is Phase.STOPPING:
            return self._call is not None and not self._call.done
        return self._phase in {Phase.MOVING, Phase.PAUSED}

    def update(self) -> None:
        """Detect that the library thread paused the motion after silence."""
        idled = self._connection.worker.idled
        if self._phase is Phase.MOVING and idled is not None and idled is not self._before:
            self._phase, self._call, self._still_since = Phase.PAUSING, idled, None

    def begin(self) -> None:
        """Start a motion from rest."""
        self._phase, self._call, self._still_since = Phase.MOVING, None, None
        self._before = self._connection.worker.idled

    def after_silence(self, brake: Order) -> Idle:
        """Return the stop that the library thread makes by itself after silence."""
        control = self._connection.control
        return Idle(SILENCE_S, "stop", lambda: brake(control), STOP_S)

    def stop(self, brake: Order) -> None:
        """Begin a soft stop of a commanded arm without blocking."""
        if self.commanded:
            self._phase, self._still_since = Phase.STOPPING, None
            self._call = self._connection.start("stop", brake, STOP_S)

    def check(self, state: UrState, *, stale: bool) -> str | None:
        """Evaluate a package; return the reason why a soft stop failed while the program may still play.

        Args:
            state: Latest state.
            stale: True if it is too old to show the program's end.
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
        """Cut the connection, and make the controller end the program.

        If that fails too, the watchdog ends it.
        """
        self._phase, self._call = Phase.CUT, None
        self._connection.cut()
        self._program_stop = self._dashboard.start("end of the program", self._end_program, PROGRAM_STOP_S)

    def acknowledge(self) -> list[Call]:
        """Acknowledge a fixed fault; return the pending stops."""
        pending = self._pending
        self._phase, self._call, self._still_since = Phase.AT_REST, None, None
        if self._dashboard.stuck is not None:
            self._dashboard.end()
            self._dashboard = TimedWorker("ur-stopper")
        return pending

    def close(self) -> None:
        """Wait for pending stops within their timeouts."""
        for call in self._pending:
            call.wait(min(call.limit_s, LEAVE_S))
        self._dashboard.end()

    @property
    def _pending(self) -> list[Call]:
        return [call for call in (self._call, self._program_stop) if call is not None]

    def _rests(self, state: UrState) -> bool:
        """Return True if the joints have rested for a while since the stop was acknowledged."""
        if self._still_since is None or max(map(abs, state.qd)) > RESTING:
            # Count from the next package, because this one may precede the acknowledgement.
            self._still_since = state.timestamp
        return state.timestamp - self._still_since >= STILL_S

    def _end_program(self) -> None:
        try:
            end_program(self._host)
        except DashboardError as error:
            self._report(f"{error}: its watchdog ends the program; if the arm moves, press its emergency stop")


# --------------------------------------------------------------------------------------------------------- braking
#
# While the controller brakes, the vendor's library waits silently, and the watchdog would end the program during a stop
# longer than its period. A stop therefore uses the deceleration of the options, or more if it would take longer: `a =
# max(a_option, 2 |v| f)` for the watchdog's f in Hz, up to `MAX_DECELERATION`.

BRAKING_SHARE: Final = 0.5
"""Fraction of the watchdog's period for braking: silence precedes it, and some message cycles surround it."""
MAX_DECELERATION: Final = 20.0
"""Largest deceleration in m/s² or rad/s², also for the options. The watchdog stops a faster motion."""


def joint_deceleration(options: UrOptions, state: UrState) -> float:
    """Return the deceleration in rad/s² of the fastest joint."""
    return _deceleration(options, max(map(abs, state.qd)))


def tool_deceleration(options: UrOptions, state: UrState) -> float:
    """Return the tool deceleration in m/s² of its point and rad/s² of its rotation."""
    return _deceleration(options, max(math.hypot(*state.speed[:3]), math.hypot(*state.speed[3:])))


def _deceleration(options: UrOptions, speed: float) -> float:
    return max(options.stop_deceleration, min(speed * options.watchdog_hz / BRAKING_SHARE, MAX_DECELERATION))


# -------------------------------------------------------------------------------------------------------- watchdog

ARMED_S: Final = 1.0
KICKS: Final = 5.0
"""Kicks per watchdog period without commands."""
REMOTE_PERIOD_S: Final = 1.0
REMOTE_S: Final = CONNECT_S + 2.0 * REPLY_S + 1.0
REFUSED_S: Final = 0.05
"""Time in s for which commands may fail before a fault; a stop by the controller has its reason by then."""


class Watchdog:
    """Controller watchdog: arming, kicks without commands, and detection of refused commands.

    Args:
        options: Options of the driver.
        connection: Connections to the controller.
        watches_remote: True if the controller can report remote control.
    """

    def __init__(self, options: UrOptions, connection: RtdeConnection, *, watches_remote: bool) -> None:
        self._options = options
        self._connection = connection
        self._watches_remote = watches_remote
        self._arming: Call | None = None
        self._remote: Call | None = None
        self._acknowledged: Call | None = None
        """Last streamed command before the operator acknowledged a fault."""
        self._kicked_s = self._remote_s = self._taken_s = 0.0

    @property
    def armed(self) -> bool:
        """True if the watchdog is active."""
        return self._arming is not None and self._arming.done and self._arming.failure is None

    def service(self, now_s: float, aside: TimedWorker, *, idle: bool) -> None:
        """Make the due calls.

        Args:
            now_s: Monotonic time in s.
            aside: Worker for long calls, separate from the commanding thread.
            idle: True if the watchdog hears nothing else.
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
        """Return the fault of the library's calls with a remedy, or None."""
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
        """Rearm the watchdog after the operator's acknowledgement."""
        self._arming = self._remote = None
        self._acknowledged = self._connection.worker.streamed
