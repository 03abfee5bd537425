"""How a UR arm is stopped: by its mode, else through the dashboard, else by its watchdog."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from haptether.slave.ur_bounded import Bounded, Call
from haptether.slave.ur_dashboard import DashboardError, stop_program
from haptether.slave.ur_state import PLAYING, UrState

if TYPE_CHECKING:
    from haptether.slave.ur_link import UrLink
    from haptether.slave.ur_modes import Mode

STOP_S: Final = 1.0
"""For a soft stop: 0.25 m/s and the least deceleration allowed take longer, and then the program is ended."""
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
        self._last_way: Call | None = None

    @property
    def busy(self) -> bool:
        """Whether a soft stop is on its way."""
        return self._halt is not None and not self._halt.over

    def stop(self, mode: "Mode") -> None:
        """Begins a soft stop."""
        control = self._link.control
        if control is not None:
            self._halt = self._link.worker.start("stop", lambda: mode.stop(control), STOP_S)

    def failed(self, state: UrState, *, stale: bool) -> bool:
        """Whether a soft stop did not succeed and the program may still play."""
        halt = self._halt or self._link.worker.idled
        if halt is None or self._link.control is None:
            return False
        overdue = not halt.over and halt.begun_s is not None and time.monotonic() - halt.begun_s > STOP_S
        if not (overdue or halt.failed is not None):
            return False
        self._halt = self._link.worker.idled = None
        return state.runtime_state == PLAYING or stale

    def cut(self) -> None:
        """Nothing leads the arm any more: the connection is cut, and the dashboard asked to end the program.

        Where that does not come through either, the watchdog ends it.
        """
        self._halt = None
        self._link.cut()
        self._last_way = self._aside.start("dashboard stop", self._end_program, LAST_WAY_S)

    def clear(self) -> None:
        """A person has seen to it."""
        self._halt = None

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
