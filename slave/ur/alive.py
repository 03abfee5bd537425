"""Signs of life between the driver and a UR controller: its watchdog, and whether it still takes commands."""

import time
from typing import TYPE_CHECKING, Final

from haptether.slave.ur.dashboard import is_in_remote_control

if TYPE_CHECKING:
    from haptether.slave.ur.connection import UrLink
    from haptether.slave.ur.options import UrOptions
    from haptether.slave.ur.worker import Bounded, Call

ARMED_S: Final = 1.0
KICKS: Final = 5.0
"""Signs of life in each period of the watchdog, while nothing is commanded."""
REMOTE_EVERY_S: Final = 1.0
REFUSED_S: Final = 0.05
"""For how long commands may fail before that is a fault: a stop of the controller's has its own reason by then."""


class SignsOfLife:
    """Arms the watchdog, kicks it while nothing is commanded, asks after remote control, and says what is wrong.

    Args:
        options: Of the driver.
        link: Its connections.
        watches_remote: Whether the controller can be asked for remote control.
    """

    def __init__(self, options: "UrOptions", link: "UrLink", *, watches_remote: bool) -> None:
        self._options = options
        self._link = link
        self._watches_remote = watches_remote
        self._guard: Call | None = None
        """Arming the watchdog."""
        self._remote: Call | None = None
        self._kicked_s = self._remote_s = self._taken_s = 0.0

    @property
    def armed(self) -> bool:
        """Whether the watchdog listens."""
        return self._guard is not None and self._guard.over and self._guard.failed is None

    def give(self, now_s: float, aside: "Bounded", *, idle: bool) -> None:
        """What is due.

        Args:
            now_s: The time of the monotonic clock in s.
            aside: Makes calls that may take long; not the thread that commands.
            idle: Whether no command is due, and the library is not told to stop the arm: both are heard themselves.
        """
        hz = self._options.watchdog_hz
        if self._guard is None:
            control = self._link.control
            self._guard = self._link.worker.start("setWatchdog", lambda: control.setWatchdog(hz), ARMED_S)
        elif idle and self._guard.over and now_s - self._kicked_s > 1.0 / (KICKS * hz):
            self._link.kick()
            self._kicked_s = now_s
        if self._watches_remote and now_s - self._remote_s > REMOTE_EVERY_S:
            self._remote_s = now_s
            if self._remote is None or self._remote.over:
                host = self._options.host
                self._remote = aside.start("remote control", lambda: is_in_remote_control(host), 2.0)

    def trouble(self) -> str | None:
        """What is wrong with the calls of the library, and what to do about it."""
        worker = self._link.worker
        if (stuck := worker.stuck) is not None:
            return f"{stuck.name} has not returned: the controller does not answer: see the network, then acknowledge"
        if (guard := self._guard) is not None and guard.failed is not None:
            return f"the watchdog was not armed: {guard.failed}"
        streamed = worker.streamed
        if streamed is None or streamed.failed is None:
            self._taken_s = time.monotonic()
        elif time.monotonic() - self._taken_s > REFUSED_S:
            return f"the controller takes no commands: {streamed.failed}: see the pendant, then acknowledge"
        remote = self._remote
        if remote is not None and remote.over:
            if remote.error is None and remote.result is False:
                return "remote control was switched off on the pendant: switch it on there, then acknowledge"
            if remote.error is not None:
                return f"{remote.error}: remote control cannot be looked after"
        return None

    def forget(self) -> None:
        """A person has seen to it: all begins anew."""
        self._guard = self._remote = None
