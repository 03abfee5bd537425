"""Ctrl-C of a command, from its first line on: status 130, and no traceback."""

# These modules are loaded already: while another module loads, Python itself answers Ctrl-C with a traceback.
import _signal  # type: ignore[import-not-found]  # the part of `signal` in C
import atexit
import io
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType

    from _typeshed import ReadableBuffer

INTERRUPTED = 130


class Interrupts:
    """Ctrl-C of a process: it ends a process that loads, interrupts a running command once, and then ends it."""

    def __init__(self) -> None:
        self.begun = False
        """True if the process belongs to the command."""
        self.raising = False
        """True while a command runs that may have to clean up."""
        self.seen = False
        """True once Ctrl-C has come."""
        self.status: object = 1
        """Exit status of the command, as `sys.exit` takes it; an exception that nothing catches gives 1."""

    def begin(self) -> None:
        """Install the handlers where this thread may: for the buttons, and for Ctrl-C unless it is ignored."""
        self.begun = True
        # The first registered function is called last, when all others have cleaned up.
        atexit.register(self._leave_threads)
        try:
            for button in (_signal.SIGUSR1, _signal.SIGUSR2):
                # The buttons must not end the process before a side has begun or after it has ended.
                if _signal.getsignal(button) == _signal.SIG_DFL:
                    _signal.signal(button, _signal.SIG_IGN)
            # A shell without job control starts a background job with Ctrl-C ignored. It stays ignored, except for a
            # running side (`Stopped`). SIGTERM ends either.
            if _signal.getsignal(_signal.SIGINT) is not _signal.default_int_handler:
                return
            _signal.signal(_signal.SIGINT, self._handle)
        except ValueError:
            # Only the main thread may install handlers.
            return
        # Python prints an exception that nothing can catch, and goes on.
        sys.unraisablehook = self._unraisable

    def _handle(self, _number: int, _frame: "FrameType | None") -> None:
        if self.seen or not self.raising:
            os._exit(INTERRUPTED)
        self.seen = True
        raise KeyboardInterrupt

    def _leave_threads(self) -> None:
        """End the process at once if a daemon thread is left; its interpreter must not end before that thread.

        A daemon thread may be in a vendor's library, for example while a device connects. Its call returns and asks for
        the interpreter. After the interpreter's end Python ends the thread, and C++ code below aborts the process.
        """
        threading = sys.modules.get("threading")
        if threading is None or not any(thread.daemon for thread in threading.enumerate()):
            return
        import contextlib

        for stream in (sys.stdout, sys.stderr):
            # Closed, or its reader has gone; the status tells that already.
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
        status = self.status
        os._exit(status & 0xFF if isinstance(status, int) else 0 if status is None else 1)

    def _unraisable(self, unraisable: "sys.UnraisableHookArgs") -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            os._exit(INTERRUPTED)
        sys.__unraisablehook__(unraisable)


INTERRUPTS = Interrupts()
"""Interrupts of this process."""


class LostOutput(io.FileIO):
    """Standard output that was closed before the command began: it discards what is written, and records that."""

    written = False
    """True if anything was written."""

    def write(self, part: "ReadableBuffer", /) -> int:
        """Discard the output, so that the command goes on and writes its files."""
        self.written = True
        return memoryview(part).nbytes


def has_lost_output() -> bool:
    """Return true if a command has printed to a standard output that was closed before it began."""
    if isinstance(sys.stdout, io.TextIOWrapper) and isinstance(sys.stdout.buffer, io.BufferedWriter):
        sys.stdout.flush()
        raw = sys.stdout.buffer.raw
        return isinstance(raw, LostOutput) and raw.written
    return False


def open_standard_streams() -> None:
    """Open those of standard input, output and error that are closed: the next file or socket would take their place.

    Output and errors written to them are lost; `has_lost_output` reports lost output.
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
    # Python has no stream for a descriptor that was closed at its start.
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(io.BufferedWriter(LostOutput(1, "w", closefd=False)))
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)
