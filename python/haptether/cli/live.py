"""What the live commands share: waiting, Ctrl-C, and the end of a run."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, ClassVar, Self

from haptether.printable import printable

if TYPE_CHECKING:
    from haptether.bridge import RecordingReport

POLL_S = 0.05


class Handlers:
    """Handlers of signals that are put back at the end."""

    def __init__(self) -> None:
        self._before: dict[int, object] = {}

    def handle(self, number: int, handler: "Callable[[int, FrameType | None], None] | signal.Handlers") -> None:
        """Sets one."""
        self._before[number] = signal.signal(number, handler)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # it is what signal gave


class Stopped(Handlers):
    """Set once Ctrl-C or a termination signal has come: the command then ends cleanly instead of at once."""

    def __init__(self) -> None:
        # A plain flag: an Event has a lock, and a handler that runs while this thread holds it would wait for ever.
        super().__init__()
        self._is_set = False

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            self.handle(number, self._set)
        # Buttons of a side, before it has begun and after it has ended: they must not end the process.
        for number in (signal.SIGUSR1, signal.SIGUSR2):
            self.handle(number, signal.SIG_IGN)
        return self

    def _set(self, _number: int, _frame: FrameType | None) -> None:
        self._is_set = True

    def __bool__(self) -> bool:
        return self._is_set

    def sleep(self, seconds: float) -> None:
        """Waits, but not beyond a stop."""
        end = time.monotonic() + seconds
        while not self._is_set and (left := end - time.monotonic()) > 0.0:
            time.sleep(min(left, POLL_S))


def wait(
    headline: str,
    status: Callable[[], str],
    finished: Callable[[], bool],
    stopped: Stopped,
    duration_s: float | None,
) -> None:
    """Says `headline`, then shows `status` until the run has finished, is stopped, or `duration_s` is over."""
    from haptether.cli.screen import Screen, plain

    console = Screen(stderr=True)
    # A person or a parent process reads this line to learn that the socket is open.
    print(headline, file=sys.stderr, flush=True)
    end = time.monotonic() + duration_s if duration_s is not None else float("inf")
    with console.status("starting") as shown:
        while not (finished() or stopped or time.monotonic() >= end):
            shown.update(plain(f"{status()}   (Ctrl-C ends)"))
            stopped.sleep(POLL_S)


def recording_status(recording: "RecordingReport | None") -> str:
    """What the line of a run that goes on says of its recording: that it has ended, or nothing."""
    if recording is None or recording.end is None:
        return ""
    return f", recording ended: {recording.end}"


def tell(events: list[str]) -> str | None:
    """Says on standard error what has happened; gives why the slave refused, if it did."""
    refused = None
    for event in events:
        print(printable(event), file=sys.stderr, flush=True)
        refused = event if event.startswith("refused") else refused
    return refused


class Steps:
    """What a person must know of the ladder while it runs, and what to do about it."""

    REMEDIES: ClassVar = {
        "hold": "release the clutch and press it again",
        "stop": "release the clutch and press it again",
        "fault": "mend the cause, acknowledge it, then release the clutch and press it again",
    }

    def __init__(self, press: str) -> None:
        self._press = press
        self._shown = ""

    def show(self, state: str) -> None:
        """Says on standard error that a side has come to hold, stop or fault."""
        before, self._shown = self._shown, state
        if state != before and state in self.REMEDIES:
            acknowledge = f" (here kill -USR2 {os.getpid()})" if state == "fault" else ""
            print(f"{state}: {self.REMEDIES[state]}{acknowledge}{self._press}", file=sys.stderr, flush=True)


class Acts(Handlers):
    """Signals as what a person does: SIGUSR1 is the button of this side, SIGUSR2 acknowledges."""

    def __init__(self, *, acknowledge: Callable[[], None], press: Callable[[], None]) -> None:
        super().__init__()
        self._acts = {signal.SIGUSR1: press, signal.SIGUSR2: acknowledge}

    def __enter__(self) -> Self:
        for number, act in self._acts.items():
            self.handle(number, _told(act))
        return self


def _told(act: Callable[[], None]) -> Callable[[int, FrameType | None], None]:
    def handle(_number: int, _frame: FrameType | None) -> None:
        # A loop that has ended meanwhile has nothing left to do.
        with contextlib.suppress(RuntimeError):
            act()

    return handle


class FlightFile:
    """A file with the last states and commands, written anew whenever there are others."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._written: str | None = None

    def write(self, flight: str | None) -> None:
        """Writes them, if there are any and they are new; the file is never seen half written."""
        if self._path is None or flight is None or flight == self._written:
            return
        # Tried once: a disk that is full, at the very stop that the file is to explain, must not end the run.
        self._written = flight
        try:
            if self._path.exists() and not self._path.is_file():
                # A pipe or a device stays what it is.
                self._path.write_text(flight, encoding="utf-8")
                return
            path = self._path.resolve()
            beside = path.with_name(f".{path.name}.part")
            beside.write_text(flight, encoding="utf-8")
            beside.replace(path)
        except OSError as error:
            print(f"{self._path}: not written: {error.strerror or error}", file=sys.stderr, flush=True)
