"""The panel of a side on its terminal, drawn by a process of its own that reads the side's telemetry.

The side sends its messages line by line; closing the pipe ends the process. The process shares no interpreter with a
driver at 1 kHz. A terminal that accepts no output blocks this process and not the loop.
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
"""Time in s that the process may take to end after its last message."""
SHOW_CURSOR = "\x1b[?25h"
REFRESH_HZ = 10
NICE = 10
POLL_S = 0.05


class PanelProcess:
    """The drawing process, as its side sees it.

    Args:
        telemetry: The socket of the side, which may not exist yet.
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
        """Return true if the process runs and accepts messages."""
        return self._writer.error is None and self._process.poll() is None

    @contextlib.contextmanager
    def says(self) -> Iterator[None]:
        """Print above the panel within this context; standard output, too, if it is a terminal."""
        with contextlib.ExitStack() as stack:
            if sys.stdout.isatty():
                stack.enter_context(contextlib.redirect_stdout(cast("TextIO", self._stream)))
            stack.enter_context(contextlib.redirect_stderr(cast("TextIO", self._stream)))
            yield

    def end(self) -> None:
        """End the process, even if its terminal blocks."""
        self._writer.end(time.monotonic())
        with contextlib.suppress(OSError):
            self._pipe.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            # A process that the system holds is not waited for.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
            print(SHOW_CURSOR, end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def panel_process(telemetry: Path | None, *, quiet: bool) -> Iterator[PanelProcess | None]:
    """Yield the panel of a side until the end of the block; None where standard error cannot show it."""
    from haptether.cli.shared.screen import Screen

    screen = Screen(stderr=True)
    if quiet or telemetry is None or not screen.is_terminal or screen.is_dumb_terminal:
        yield None
        return
    try:
        panel = PanelProcess(telemetry)
    except OSError:
        # Without a process there is a plain line instead.
        yield None
        return
    try:
        yield panel
    finally:
        panel.end()


# ------------------------------------------------------------------------------------------------- the process itself


class _Said:
    """The messages of the side, printed at once by a thread, even while a blocking driver sends no samples."""

    def __init__(self, screen: "Screen") -> None:
        self._screen = screen
        self.ended = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            for line in sys.stdin.buffer:
                # The console has a lock: the panel is redrawn below the message.
                self._screen.print(line.decode(errors="replace").rstrip("\n"), soft_wrap=True)
        finally:
            self.ended.set()


def draw(telemetry: Path) -> None:
    """Draw the panel until the side closes the pipe."""
    from rich.live import Live

    from haptether.bridge import TelemetryReader
    from haptether.cli.shared.screen import Screen
    from haptether.view import SideState, panel

    # Ctrl-C is for the side; this process shows how the side ends.
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
        # The end of the messages ends the wait for a sample.
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
        # A driver that blocks sends no samples: wait for it again.
        if state.has_ended:
            said.ended.wait()


def _close_after(ended: threading.Event, reader: "TelemetryReader") -> None:
    ended.wait()
    reader.close()


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        draw(Path(sys.argv[1]))
