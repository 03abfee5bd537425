"""How a UR arm is stopped: by its mode, else through the dashboard, else by its watchdog."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from haptether.slave.ur.dashboard import DashboardError, stop_program
from haptether.slave.ur.state import PLAYING, UrState
from haptether.slave.ur.worker import Bounded, Call

if TYPE_CHECKING:
    from haptether.slave.ur.connection import UrLink
    from haptether.slave.ur.modes import Mode

STOP_S: Final = 1.0
"""For a soft stop: the watchdog's longest period is a fifth of it."""
REST_S: Final = 1.2
"""After which the joints must rest, whatever the controller has said."""
RESTING: Final = 0.05
"""rad/s; what sensors show of joints at rest is a tenth of it."""
STILL_S: Final = 0.05
"""For which joints must rest: at a reversal they do for a package."""
LAST_WAY_S: Final = 1.0


class Halting:
    """Stops without waiting for it.

    Args:
        link: The connections.
        host: The controller.
        tell: Takes lines for people.
    """

    def __init__(self, link: "UrLink", host: str, tell: Callable[[str], None]) -> None:
        self._link = link
        self._host = host
        self._tell = tell
        self._aside = Bounded("ur-stopper")
        self._halt: Call | None = None
        self._rested: Call | None = None
        """The stop after which the arm was seen at rest: what moves it later is somebody else."""
        self._still_since: float | None = None
        """Time stamp of the package since which the joints rest; at first of the one before."""
        self._last_way: Call | None = None

    @property
    def calls(self) -> bool:
        """Whether the library is told to stop the arm just now."""
        return self._halt is not None and not self._halt.over

    @property
    def busy(self) -> bool:
        """Whether the arm comes to rest: until it was seen to."""
        halt = self._newest
        return halt is not None and halt is not self._rested

    @property
    def _newest(self) -> Call | None:
        """The last soft stop, be it because nothing more was commanded."""
        return self._halt or self._link.worker.idled

    def stop(self, mode: "Mode", state: UrState) -> None:
        """Begins a soft stop."""
        control, brake = self._link.control, mode.brake(state)
        if control is not None:
            self._halt = self._link.worker.start("stop", lambda: brake(control), STOP_S)
            self._still_since = None

    def failed(self, state: UrState, *, stale: bool) -> str | None:
        """Looks at a package: why a soft stop did not succeed, where the program may still play."""
        halt = self._newest
        if halt is None or halt is self._rested or self._link.control is None:
            return None
        since_s = 0.0 if halt.begun_s is None else time.monotonic() - halt.begun_s
        stuck = self._link.worker.stuck is not None
        if halt.failed is not None or (not halt.over and (since_s > STOP_S or stuck)):
            why = "was not acknowledged"
        elif halt.over and self._rests(state):
            self._rested = halt
            return None
        elif since_s > REST_S:
            why = "was acknowledged, and the arm still moves"
        else:
            return None
        self._halt = self._link.worker.idled = None
        return why if state.runtime_state == PLAYING or stale else None

    def _rests(self, state: UrState) -> bool:
        """Whether the joints have rested for a while since the stop was acknowledged."""
        if self._still_since is None or max(map(abs, state.qd)) > RESTING:
            # A package that rests counts from the next on: it may be older than the acknowledgement.
            self._still_since = state.timestamp
        return state.timestamp - self._still_since >= STILL_S

    def go_on(self) -> None:
        """Motion begins again: the stop before it is over."""
        self._halt = self._link.worker.idled = self._still_since = None

    def cut(self) -> None:
        """Nothing leads the arm any more: the connection is cut, and the dashboard asked to end the program.

        Where that does not come through either, the watchdog ends it.
        """
        self._halt = None
        self._link.cut()
        self._last_way = self._aside.start("dashboard stop", self._end_program, LAST_WAY_S)

    def clear(self) -> list[Call]:
        """A person has seen to it; gives what is still on its way."""
        on_its_way = [call for call in (self._halt, self._last_way) if call is not None]
        self._halt = self._still_since = None
        if self._aside.stuck is not None:
            self._aside.end()
            self._aside = Bounded("ur-stopper")
        return on_its_way

    def end(self) -> None:
        """Waits for what is on its way, within its limits."""
        for call in (self._halt, self._last_way):
            if call is not None:
                call.wait(call.limit_s)

    def close(self) -> None:
        """Ends its thread."""
        self._aside.end()

    def _end_program(self) -> None:
        try:
            stop_program(self._host)
        except DashboardError as error:
            self._tell(f"{error}: its watchdog ends the program; if the arm moves, press its emergency stop")
