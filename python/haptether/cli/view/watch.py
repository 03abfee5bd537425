"""`haptether watch`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.view.connecting import WaitOptions

if TYPE_CHECKING:
    from haptether.bridge import TelemetryReader
    from haptether.cli.shared.screen import Screen
    from haptether.view import SideState

REFRESH_HZ = 10
LINE_S = 1.0
"""Time in s between two lines without a terminal."""


@dataclass(frozen=True, kw_only=True)
class Watch(WaitOptions):
    """Show a running side: ladder, forces, observers against their thresholds, link, loop, gripper.

    It reads the telemetry of `--telemetry PATH` of master or slave, in a process of its own. The loop is not affected,
    and nothing can be commanded from here. Without a terminal it prints a line a second, and each event. It ends with
    the run, status 0, or with status 1 if the run fails or is killed.

    Examples:

    haptether watch

    haptether master --peer 127.0.0.1:9000 --key arm.key --telemetry /tmp/master.sock

    haptether watch /tmp/master.sock
    """

    path: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")] = None
    """Unix socket of --telemetry of the running side; by default that of this user's one side that runs here."""
    duration_s: float | None = None
    """End after this time in s; without it, with the run."""

    def run(self) -> int:
        """Show the side until its end.

        Raises:
            OSError: Nobody sends there, or the telemetry ended without its last message.
            ValueError: The sender does not send telemetry; without a path, none or several sides run here.
        """
        from haptether.cli.shared.numbers import check_duration
        from haptether.cli.shared.screen import Screen
        from haptether.cli.view.connecting import connected, only_side
        from haptether.view import SideState

        check_duration("duration_s", self.duration_s)
        screen = Screen()
        path = only_side() if self.path is None else self.path
        with connected(path, self.wait_s) as telemetry:
            state = SideState(telemetry.hello)
            (self._live if screen.is_terminal else self._lines)(screen, telemetry, state)
        if not state.has_ended and not self._is_over(state):
            message = f"{path}: ended after {state.time_s:.3f} s without a word: the side has failed or was killed"
            raise ConnectionError(message)
        return 0

    def _is_over(self, state: "SideState") -> bool:
        return self.duration_s is not None and state.watched_s >= self.duration_s

    def _live(self, screen: "Screen", telemetry: "TelemetryReader", state: "SideState") -> None:
        from rich.live import Live

        from haptether.view import panel

        next_s = 0.0
        with Live(console=screen, auto_refresh=False, transient=False) as live:
            for message in telemetry:
                state.take(message)
                if (now_s := time.monotonic()) >= next_s:
                    next_s = now_s + 1.0 / REFRESH_HZ
                    live.update(panel(state, height=screen.height), refresh=True)
                if self._is_over(state):
                    break
            live.update(panel(state), refresh=True)

    def _lines(self, screen: "Screen", telemetry: "TelemetryReader", state: "SideState") -> None:
        from haptether.view import headline

        next_s = 0.0
        seen = 0
        for message in telemetry:
            state.take(message)
            new = state.events_seen - seen
            seen = state.events_seen
            for time_s, text in list(state.events)[len(state.events) - new :]:
                screen.print(f"{time_s:.4f} s  {text}", soft_wrap=True)
            if state.time_s >= next_s and state.ticks:
                next_s = state.time_s + LINE_S
                screen.print(f"{state.time_s:.1f} s  {headline(state)}", soft_wrap=True)
            if self._is_over(state):
                break
