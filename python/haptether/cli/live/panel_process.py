"""The panel of a side on its terminal, drawn by a process of its own that reads the side's telemetry.

The side passes it what it has to say, line by line; the end of these is its end. What draws shares no interpreter with
a driver at 1 kHz, and a terminal that takes nothing holds up this process and not the loop.
"""

import contextlib
import io
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TextIO, cast

from haptether.cli.shared.output import QueuedBuffer, QueuedWriter

if TYPE_CHECKING:
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
            [sys.executable, "-m", "haptether.cli.live.panel_process", str(telemetry)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
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
        """Ends it, whatever its terminal does."""
        self._writer.end(time.monotonic())
        with contextlib.suppress(OSError):
            self._pipe.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            print(SHOW_CURSOR, end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def panel_process(telemetry: Path | None, *, quiet: bool) -> Iterator[PanelProcess | None]:
    """The panel of a side, where standard error is a terminal that can show it, until the end of the block."""
    from haptether.cli.shared.screen import Screen

    screen = Screen(stderr=True)
    if quiet or telemetry is None or not screen.is_terminal or screen.is_dumb_terminal:
        yield None
        return
    panel = PanelProcess(telemetry)
    try:
        yield panel
    finally:
        panel.end()


# ------------------------------------------------------------------------------------------------- the process itself


class _Said:
    """What the side has said, read by a thread."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.has_ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line.rstrip("\n"))
        self.has_ended = True

    def print(self, screen: "Screen") -> None:
        while not self._lines.empty():
            screen.print(self._lines.get(), soft_wrap=True)


def draw(telemetry: Path) -> None:
    """Draws the panel until the side says nothing more."""
    from rich.live import Live

    from haptether.bridge import TelemetryReader
    from haptether.cli.shared.screen import Screen
    from haptether.view import SideState, panel

    # Ctrl-C is for the side, whose end this process shows.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICE)
    said, screen = _Said(), Screen(stderr=True)
    while not said.has_ended:
        try:
            reader = TelemetryReader(telemetry)
        except (OSError, ValueError):
            said.print(screen)
            time.sleep(POLL_S)
            continue
        state, next_s = SideState(reader.hello), 0.0
        with reader, Live(console=screen, auto_refresh=False, transient=True) as live, contextlib.suppress(OSError):
            for message in reader:
                state.take(message)
                if said.has_ended:
                    break
                if state.ticks and (now_s := time.monotonic()) >= next_s:
                    next_s = now_s + 1.0 / REFRESH_HZ
                    said.print(screen)
                    live.update(panel(state, min(80, screen.width)), refresh=True)
        # A driver that blocks sends no samples: it is waited for anew.
        while state.has_ended and not said.has_ended:
            said.print(screen)
            time.sleep(POLL_S)
    said.print(screen)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        draw(Path(sys.argv[1]))
