"""The panel of a side on its terminal, drawn by a process of its own that reads the side's telemetry.

The side passes it what it has to say, line by line; the end of these is its end. What draws shares no interpreter with
a driver at 1 kHz, and a terminal that takes nothing holds up this process and not the loop.
"""

import contextlib
import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TextIO, cast

from haptether.child import child_environment, module_command
from haptether.cli.shared.output import QueuedBuffer, QueuedWriter

if TYPE_CHECKING:
    from haptether.bridge import TelemetryReader
    from haptether.cli.shared.screen import Screen

END_S = 0.5
"""How long the process may take to end once nothing more is said to it."""
SHOW_CURSOR = "\x1b[?25h"
REFRESH_HZ = 10
NICE = 10
POLL_S = 0.05


class PanelProcess:
    """The process that draws, as its side has it.

    Args:
        telemetry: The socket of the side, which may not be there yet.
    """

    def __init__(self, telemetry: Path) -> None:
        self._process = subprocess.Popen(
            module_command("haptether.cli.live.panel_process", str(telemetry)),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env=child_environment(),
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin
        self._writer = QueuedWriter(self._pipe.fileno(), "panel")
        buffer = cast("BinaryIO", QueuedBuffer(self._writer, self._pipe.fileno()))
        self._stream = io.TextIOWrapper(buffer, encoding="utf-8", errors="backslashreplace", write_through=True)

    @property
    def draws(self) -> bool:
        """Whether it is there, and takes what is said."""
        return self._writer.error is None and self._process.poll() is None

    @contextlib.contextmanager
    def says(self) -> Iterator[None]:
        """Within it, what is printed stands above the panel; standard output, too, where that is a terminal."""
        with contextlib.ExitStack() as stack:
            if sys.stdout.isatty():
                stack.enter_context(contextlib.redirect_stdout(cast("TextIO", self._stream)))
            stack.enter_context(contextlib.redirect_stderr(cast("TextIO", self._stream)))
            yield

    def end(self) -> None:
        """End it, whatever its terminal does."""
        self._writer.end(time.monotonic())
        with contextlib.suppress(OSError):
            self._pipe.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            # One that the system holds is not waited for.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
            print(SHOW_CURSOR, end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def panel_process(telemetry: Path | None, *, quiet: bool) -> Iterator[PanelProcess | None]:
    """The panel of a side, where standard error is a terminal that can show it, until the end of the block."""
    from haptether.cli.shared.screen import Screen

    screen = Screen(stderr=True)
    if quiet or telemetry is None or not screen.is_terminal or screen.is_dumb_terminal:
        yield None
        return
    try:
        panel = PanelProcess(telemetry)
    except OSError:
        # No room for another process: there is a line instead.
        yield None
        return
    try:
        yield panel
    finally:
        panel.end()


# ------------------------------------------------------------------------------------------------- the process itself


class _Said:
    """What the side says, printed by a thread at once: also while no samples come, as of a driver that blocks."""

    def __init__(self, screen: "Screen") -> None:
        self._screen = screen
        self.ended = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            for line in sys.stdin.buffer:
                # A console has a lock: the panel is drawn anew below it.
                self._screen.print(line.decode(errors="replace").rstrip("\n"), soft_wrap=True)
        finally:
            self.ended.set()


def draw(telemetry: Path) -> None:
    """Draw the panel until the side says nothing more."""
    from rich.live import Live

    from haptether.bridge import TelemetryReader
    from haptether.cli.shared.screen import Screen
    from haptether.view import SideState, panel

    # Ctrl-C is for the side, whose end this process shows.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICE)
    screen = Screen(stderr=True)
    said = _Said(screen)
    while not said.ended.is_set():
        try:
            reader = TelemetryReader(telemetry)
        except (OSError, ValueError):
            said.ended.wait(POLL_S)
            continue
        # The end of what is said ends the wait for a sample.
        threading.Thread(target=_close_after, args=(said.ended, reader), daemon=True).start()
        state, next_s = SideState(reader.hello), 0.0
        with reader, Live(console=screen, auto_refresh=False, transient=True) as live, contextlib.suppress(OSError):
            for message in reader:
                state.take(message)
                if said.ended.is_set():
                    break
                if state.ticks and (now_s := time.monotonic()) >= next_s:
                    next_s = now_s + 1.0 / REFRESH_HZ
                    live.update(panel(state, min(80, screen.width), screen.height), refresh=True)
        # A driver that blocks sends no samples: it is waited for anew.
        if state.has_ended:
            said.ended.wait()


def _close_after(ended: threading.Event, reader: "TelemetryReader") -> None:
    ended.wait()
    reader.close()


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        draw(Path(sys.argv[1]))
