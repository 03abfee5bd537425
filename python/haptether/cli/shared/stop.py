"""Commands that run until they are stopped: Ctrl-C and the other signals, and waiting."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

from haptether.cli.interrupts import INTERRUPTS

if TYPE_CHECKING:
    from haptether.bridge import LiveMaster, LiveSlave, MasterLoop, SignalRelay, SlaveLoop

Loop = TypeVar("Loop", "LiveMaster", "LiveSlave", "MasterLoop", "SlaveLoop")

POLL_S = 0.05
SECOND = "ending: a second Ctrl-C ends at once, whatever a driver does"


class Stopped:
    """Set by Ctrl-C or a termination signal: the command then ends cleanly instead of at once.

    Signals reach its loops even if this thread waits: to stop them and, by SIGUSR1, to press the clutch. A second
    Ctrl-C ends the process.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, object] = {}
        """Earlier handlers, which are restored."""
        self._signals: SignalRelay | None = None
        self._wakeup = -1
        self._has_announced = False

    def __enter__(self) -> Self:
        from haptether.bridge import SignalRelay

        self._signals = SignalRelay()
        # Python's handler in C writes to it at once; the handler in Python only announces.
        self._wakeup = signal.set_wakeup_fd(self._signals.fileno(), warn_on_full_buffer=False)
        # Handle SIGINT even if it was ignored, as in a background job of a script: its sender wants the arm to stop.
        handled = [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2]
        # nohup ignores SIGHUP, to outlive its terminal.
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            handled.append(signal.SIGHUP)
        for number in handled:
            self._handlers[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._signals is not None:
            if kind is not None:
                # However this thread ended, no loop goes on without it.
                self._signals.stop()
            if self:
                # Only a report is left: the next Ctrl-C ends that at once.
                INTERRUPTS.raising = False
            for number, handler in self._handlers.items():
                signal.signal(number, handler)  # type: ignore[arg-type]  # the value came from signal
            signal.set_wakeup_fd(self._wakeup)
            self._signals.close()

    def attached(self, loop: Loop) -> Loop:
        """Attach a loop to the signals, which stop it and act as the button of its side; return the loop."""
        if self._signals is not None:
            self._signals.attach(loop)
        return loop

    def take_acknowledgement(self) -> bool:
        """Return true if SIGUSR2 has come within the last 0.5 s, and was not taken before."""
        return self._signals is not None and self._signals.take_acknowledgement()

    def spend_reserve(self) -> None:
        """End the loops with the reserved memory, because no other memory is left."""
        if self._signals is not None:
            self._signals.spend_reserve()

    @property
    def out_of_memory(self) -> bool:
        """True if the loops ended because no memory was left."""
        return self._signals is not None and self._signals.out_of_memory

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        """Print how to cut the end short; `SignalRelay` has handled the signal already."""
        if number == signal.SIGINT and not self._has_announced:
            self._has_announced = True
            # Printing may be impossible in the middle of another line.
            with contextlib.suppress(RuntimeError, ValueError, OSError):
                print(SECOND, file=sys.stderr, flush=True)

    def __bool__(self) -> bool:
        return self._signals is not None and self._signals.stopped

    def sleep(self, seconds: float) -> None:
        """Sleep, but not beyond a stop."""
        end = time.monotonic() + seconds
        while not self and (left := end - time.monotonic()) > 0.0:
            time.sleep(min(left, POLL_S))


def wait(
    headline: str,
    status: Callable[[], str],
    finished: Callable[[], bool],
    stopped: Stopped,
    duration_s: float | None,
    *,
    shown: bool = True,
) -> None:
    """Print `headline`, if any, then call `status` until the run has finished, is stopped, or `duration_s` is over.

    If `shown` and on a terminal, the status is a line beside a spinner.
    """
    from haptether.cli.shared.screen import Screen, plain

    console = Screen(stderr=True)
    # The operator or a parent process reads this line to learn that the socket is open.
    if headline:
        print(headline, file=sys.stderr, flush=True)
    end = time.monotonic() + duration_s if duration_s is not None else float("inf")
    with contextlib.suppress(MemoryError), console.status("starting") if shown else contextlib.nullcontext() as line:
        while not (finished() or stopped or stopped.out_of_memory or time.monotonic() >= end):
            try:
                text = status()
                if line is not None:
                    line.update(plain(f"{text}   (Ctrl-C ends)"))
            except MemoryError:
                stopped.spend_reserve()
            stopped.sleep(POLL_S)
