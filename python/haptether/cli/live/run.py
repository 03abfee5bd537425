"""What the live commands share: waiting, Ctrl-C, and the end of a run."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, ClassVar, Self, TypeVar

import msgspec

from haptether.cli.interrupts import INTERRUPTS
from haptether.cli.shared.queued_output import QueuedWriter
from haptether.printable import printable
from haptether.private_file import refuse_link, write_private

if TYPE_CHECKING:
    from haptether.bridge import (
        DeviceRun,
        LiveMaster,
        LiveSlave,
        LoopReport,
        MasterLoop,
        RecordingReport,
        SignalRelay,
        SlaveLoop,
    )

Loop = TypeVar("Loop", "LiveMaster", "LiveSlave", "MasterLoop", "SlaveLoop")

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
    """Set once Ctrl-C or a termination signal has come: the command then ends cleanly instead of at once.

    Its loops end by themselves, whatever this thread waits for; so are they pressed by SIGUSR1. A second Ctrl-C ends
    the process.
    """

    def __init__(self) -> None:
        super().__init__()
        self._signals: SignalRelay | None = None
        self._wakeup = -1

    def __enter__(self) -> Self:
        from haptether.bridge import SignalRelay

        self._signals = SignalRelay()
        # Python's handler in C writes to it, whatever Python itself does; the one in Python has nothing to add.
        self._wakeup = signal.set_wakeup_fd(self._signals.fileno(), warn_on_full_buffer=False)
        # SIGINT even where it was ignored, as in a background job of a script: whoever sends it wants the arm to stop.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
            self.handle(number, _nothing)
        # Of nohup, which outlives its terminal.
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            self.handle(signal.SIGHUP, _nothing)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._signals is not None:
            if kind is not None:
                # Whatever became of this thread: no loop goes on without it.
                self._signals.stop()
            if self:
                # What is left is a report: the next Ctrl-C ends that at once.
                INTERRUPTS.raising = False
            super().__exit__(kind, error, traceback)
            signal.set_wakeup_fd(self._wakeup)
            self._signals.close()

    def attached(self, loop: Loop) -> Loop:
        """A loop that signals reach: to stop it, and as the button of its side."""
        if self._signals is not None:
            self._signals.attach(loop)
        return loop

    def take_acknowledgement(self) -> bool:
        """Whether SIGUSR2 has come within the last 0.5 s, and was not taken before."""
        return self._signals is not None and self._signals.take_acknowledgement()

    def spend_reserve(self) -> None:
        """No memory is left: the loops end, with what was set aside for that."""
        if self._signals is not None:
            self._signals.spend_reserve()

    @property
    def out_of_memory(self) -> bool:
        """Whether the loops were ended because no memory was left."""
        return self._signals is not None and self._signals.out_of_memory

    def __bool__(self) -> bool:
        return self._signals is not None and self._signals.stopped

    def sleep(self, seconds: float) -> None:
        """Waits, but not beyond a stop."""
        end = time.monotonic() + seconds
        while not self and (left := end - time.monotonic()) > 0.0:
            time.sleep(min(left, POLL_S))


def _nothing(_number: int, _frame: FrameType | None) -> None:
    """`SignalRelay` has it."""


def wait(
    headline: str,
    status: Callable[[], str],
    finished: Callable[[], bool],
    stopped: Stopped,
    duration_s: float | None,
) -> None:
    """Says `headline`, then shows `status` until the run has finished, is stopped, or `duration_s` is over."""
    from haptether.cli.shared.screen import Screen, plain

    console = Screen(stderr=True)
    # A person or a parent process reads this line to learn that the socket is open.
    print(headline, file=sys.stderr, flush=True)
    end = time.monotonic() + duration_s if duration_s is not None else float("inf")
    with contextlib.suppress(MemoryError), console.status("starting") as shown:
        while not (finished() or stopped or stopped.out_of_memory or time.monotonic() >= end):
            try:
                shown.update(plain(f"{status()}   (Ctrl-C ends)"))
            except MemoryError:
                stopped.spend_reserve()
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


def acknowledge(side: "LiveMaster | LiveSlave | DeviceRun", stopped: Stopped) -> None:
    """Hands SIGUSR2 to a side; to one that has ended meanwhile it says nothing."""
    if stopped.take_acknowledgement():
        with contextlib.suppress(RuntimeError):
            side.acknowledge()


def check_memory(report: "LoopReport") -> None:
    """Refuses to go on with what needs much of it.

    Raises:
        MemoryError: The loop was ended because none was left.
    """
    if report.out_of_memory:
        message = "no memory was left: the run was ended, without force, and the other side was sent the end"
        raise MemoryError(message)


class Step(msgspec.Struct, frozen=True, kw_only=True):
    """Something to be done before two sides couple again."""

    at: str
    """"master", "slave" or "link"."""
    remedy: str
    """"acknowledge", "start", "wait" or "press"."""
    text: str


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """Why two sides are not coupled."""

    state: str
    """Of the ladder of the side that knows it."""
    at: str
    """Where it happened: "master", "slave" or "link"."""
    text: str
    steps: list[Step]
    """What to do, in this order."""


def cause_of(side: "LiveMaster | LiveSlave | DeviceRun") -> Cause | None:
    """Why a side is not coupled; none where all is well."""
    cause = side.cause()
    return None if cause is None else msgspec.json.decode(cause, type=Cause)


class Steps:
    """What a person must know of why two sides are not coupled, and what to do about it, in order."""

    SIGNALS: ClassVar = {
        ("master", "press"): "USR1",
        ("master", "acknowledge"): "USR2",
        ("slave", "acknowledge"): "USR2",
    }
    HELD: ClassVar = {"hold", "stop", "fault"}

    def __init__(self, side: str) -> None:
        self._side = side
        self._shown: Cause | None = None
        self._ineffective_presses = 0
        self._is_engaged = False

    def show(self, side: "LiveMaster | LiveSlave | DeviceRun") -> None:
        """Says on standard error where something has happened, what, and what to do; and why a press does nothing."""
        cause, before = cause_of(side), self._shown
        self._shown = cause
        if cause is not None and cause != before:
            self._print(f"{cause.state}: {cause.text}" if cause.state in self.HELD else cause.text, cause)
        presses, why = side.ineffective_presses
        if presses != self._ineffective_presses:
            self._ineffective_presses = presses
            if why is not None:
                print(f"the clutch was pressed for nothing: {why}", file=sys.stderr, flush=True)
            elif cause is not None:
                self._print(f"the clutch does nothing yet: {cause.text}", cause)
        is_engaged = side.state == "engaged"
        if is_engaged and not self._is_engaged:
            print(f"{self._side}: engaged", file=sys.stderr, flush=True)
        self._is_engaged = is_engaged

    def cause_at_end(self, side: "LiveMaster | LiveSlave | DeviceRun") -> Cause | None:
        """Why a side that has ended is not coupled; said if a driver ended it, maybe before anybody looked."""
        if getattr(side, "error", None) is not None:
            self.show(side)
        return cause_of(side)

    def _print(self, headline: str, cause: Cause) -> None:
        lines = [headline, *(f"  {number}. {self._words(step)}" for number, step in enumerate(cause.steps, start=1))]
        print("\n".join(printable(line) for line in lines), file=sys.stderr, flush=True)

    def _words(self, step: Step) -> str:
        name = self.SIGNALS.get((step.at, step.remedy))
        if name is None:
            return step.text
        where = f"here: kill -{name} {os.getpid()}" if step.at == self._side else f"there: kill -{name} PID"
        return f"{step.text} ({where})"


class FlightFile:
    """A file with the last states and commands, written anew whenever there are others.

    Raises:
        ValueError: A symbolic link: whoever may make one would choose what is overwritten.
    """

    def __init__(self, path: Path | None) -> None:
        if path is not None:
            refuse_link(path)
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
                # A pipe or a device stays what it is; one that nobody reads is not waited for.
                descriptor = os.open(self._path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
                writer = QueuedWriter(descriptor, "flight")
                writer.put(flight.encode())
                if writer.end(time.monotonic()):
                    os.close(descriptor)
                return
            write_private(self._path, flight.encode())
        except OSError as error:
            print(f"{self._path}: not written: {error.strerror or error}", file=sys.stderr, flush=True)
