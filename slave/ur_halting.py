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
"""For a soft stop: the watchdog's longest period is a fifth of it."""
REST_S: Final = 1.2
"""After which the joints must rest, whatever the controller has said."""
RESTING: Final = 0.05
"""rad/s; what sensors show of joints at rest is a tenth of it."""
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
        self._last_way: Call | None = None

    @property
    def busy(self) -> bool:
        """Whether a soft stop is on its way."""
        return self._halt is not None and not self._halt.over

    def stop(self, mode: "Mode", state: UrState) -> None:
        """Begins a soft stop."""
        control, brake = self._link.control, mode.brake(state)
        if control is not None:
            self._halt = self._link.worker.start("stop", lambda: brake(control), STOP_S)

    def failed(self, state: UrState, *, stale: bool) -> str | None:
        """Why a soft stop did not succeed, where the program may still play."""
        halt = self._halt or self._link.worker.idled
        if halt is None or halt is self._rested or self._link.control is None:
            return None
        since_s = 0.0 if halt.begun_s is None else time.monotonic() - halt.begun_s
        if halt.failed is not None or (not halt.over and since_s > STOP_S):
            why = "was not acknowledged"
        elif halt.over and max(map(abs, state.qd)) <= RESTING:
            self._rested = halt
            return None
        elif since_s > REST_S:
            why = "was acknowledged, and the arm still moves"
        else:
            return None
        self._halt = self._link.worker.idled = None
        return why if state.runtime_state == PLAYING or stale else None

    def go_on(self) -> None:
        """Motion begins again: the stop before it is over."""
        self._halt = self._link.worker.idled = None

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
        if self._aside.stuck is not None:
            self._aside.end()
            self._aside = Bounded("ur-stopper")

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
