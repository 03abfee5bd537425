"""Ctrl-C of a command, from its first line on: status 130, and no traceback."""

# What is imported here is there already: while a module loads, Python itself answers Ctrl-C, by a traceback.
import _signal  # type: ignore[import-not-found]  # the part of `signal` in C
import io
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType

    from _typeshed import ReadableBuffer

INTERRUPTED = 130


class Interrupts:
    """Ends the process at Ctrl-C while it loads; raises KeyboardInterrupt once while a command runs, then ends it."""

    def __init__(self) -> None:
        self.begun = False
        """The process is the command's own."""
        self.raising = False
        """A command runs, which may have something to clear up."""
        self.seen = False
        """Ctrl-C has come."""

    def begin(self) -> None:
        """Takes over, where this thread may: the buttons, and Ctrl-C unless it is ignored."""
        self.begun = True
        try:
            for button in (_signal.SIGUSR1, _signal.SIGUSR2):
                # Before a side has begun and after it has ended, they must not end the process.
                if _signal.getsignal(button) == _signal.SIG_DFL:
                    _signal.signal(button, _signal.SIG_IGN)
            # A shell without job control starts a background job with Ctrl-C ignored: it stays so, but for a side
            # that runs (`Stopped`). SIGTERM ends either.
            if _signal.getsignal(_signal.SIGINT) is not _signal.default_int_handler:
                return
            _signal.signal(_signal.SIGINT, self._handle)
        except ValueError:
            # Of another thread than the main one.
            return
        # Where nobody can take an exception, Python prints it and goes on.
        sys.unraisablehook = self._unraisable

    def _handle(self, _number: int, _frame: "FrameType | None") -> None:
        if self.seen or not self.raising:
            os._exit(INTERRUPTED)
        self.seen = True
        raise KeyboardInterrupt

    def _unraisable(self, unraisable: "sys.UnraisableHookArgs") -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            os._exit(INTERRUPTED)
        sys.__unraisablehook__(unraisable)


INTERRUPTS = Interrupts()
"""Of this process."""


class LostOutput(io.FileIO):
    """Standard output that was closed before the command began: what is written there is lost, which is known."""

    written = False
    """Whether anything was."""

    def write(self, part: "ReadableBuffer", /) -> int:
        """Loses what a command prints, so that it goes on to what it writes elsewhere."""
        self.written = True
        return memoryview(part).nbytes


def has_lost_output() -> bool:
    """Whether a command has printed something where standard output was closed before it began."""
    if isinstance(sys.stdout, io.TextIOWrapper) and isinstance(sys.stdout.buffer, io.BufferedWriter):
        sys.stdout.flush()
        raw = sys.stdout.buffer.raw
        return isinstance(raw, LostOutput) and raw.written
    return False


def open_standard_streams() -> None:
    """Open what is closed of standard input, output and error: the next file or socket would take its place.

    What is written to an output or error that was closed is lost; of output it is known, see `has_lost_output`.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != descriptor:
                os.dup2(opened, descriptor)
                os.close(opened)
            else:
                os.set_inheritable(descriptor, True)
    # What Python found closed at its start it does not have.
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(io.BufferedWriter(LostOutput(1, "w", closefd=False)))
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)
