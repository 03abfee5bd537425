"""Standard output and error of a command that must go on, and end, whether anybody reads them or not."""

import contextlib
import io
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, TextIO, cast

MAX_WAITING = 1 << 16
"""Bytes that wait for a reader; what comes then is dropped and counted. One message may be larger."""
CHUNK = 4096
"""Bytes at a time: that a reader is slow shows before all is written."""
STUCK_S = 1.0
"""A reader that takes nothing for so long at the end of a command is given up."""


class QueuedWriter:
    """Bytes for a descriptor, written by a thread of their own: whoever hands them over never waits."""

    def __init__(self, descriptor: int, name: str) -> None:
        self.error: OSError | None = None
        """Why nothing is written any more."""
        self.dropped = 0
        """Messages that found no room."""
        self._descriptor = descriptor
        self._messages: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._waiting = 0
        self._taken_s = 0.0
        threading.Thread(target=self._run, name=f"haptether-{name}", daemon=True).start()

    def put(self, message: bytes) -> None:
        """Hands a message over."""
        with self._lock:
            if self._waiting >= MAX_WAITING:
                self.dropped += 1
                return
            self._waiting += len(message)
        self._messages.put(message)

    def end(self, asked_s: float) -> bool:
        """Waits until all is written, but not for a reader that takes nothing for 1 s; gives whether it is.

        Args:
            asked_s: When the end was asked for, in s of the monotonic clock.
        """
        self._messages.put(None)
        while self._waiting > 0:
            if time.monotonic() >= max(asked_s, self._taken_s) + STUCK_S:
                return False
            time.sleep(0.005)
        return True

    def _run(self) -> None:
        told = 0
        while True:
            try:
                message = self._messages.get()
                if message is None:
                    return
                if (dropped := self.dropped) != told:
                    self._write(b"[%d messages were dropped: nobody read them in time]\n" % (dropped - told))
                    told = dropped
                self._write(message)
                with self._lock:
                    self._waiting -= len(message)
            except MemoryError:
                # A message is lost, the thread is not.
                continue

    def _write(self, message: bytes) -> None:
        left = memoryview(message)
        while left and self.error is None:
            try:
                count = os.write(self._descriptor, left[:CHUNK])
            except BlockingIOError:
                # Whoever started this process wants it so.
                select.select([], [self._descriptor], [])
                continue
            except OSError as error:
                self.error = error
                return
            left = left[count:]
            self._taken_s = time.monotonic()


class QueuedBuffer(io.RawIOBase):
    """The bytes of a queued stream."""

    def __init__(self, writer: QueuedWriter, descriptor: int) -> None:
        super().__init__()
        self._writer = writer
        self._descriptor = descriptor

    def writable(self) -> bool:
        """It is."""
        return True

    def fileno(self) -> int:
        """Of what it is written to in the end."""
        return self._descriptor

    def deliver(self) -> None:
        """Waits until all is written, within the bounds of `QueuedWriter.end`."""
        self._writer.end(time.monotonic())

    def isatty(self) -> bool:
        """Whether that is a terminal."""
        return os.isatty(self._descriptor)

    def write(self, message: object) -> int:
        """Hands bytes over."""
        held = bytes(message)  # type: ignore[call-overload]  # whatever has bytes
        self._writer.put(held)
        return len(held)


@dataclass
class QueuedOutput:
    """What became of standard output; known at its end."""

    delivered: bool = True
    """Whether all of it was taken."""
    error: OSError | None = None
    """Why it was not written to its end."""


def _queued(stream: TextIO, name: str) -> tuple[QueuedWriter | None, TextIO]:
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        # No file, and nothing that blocks: somebody in this process wants it.
        return None, stream
    stream.flush()
    writer = QueuedWriter(descriptor, name)
    buffer = cast("BinaryIO", QueuedBuffer(writer, descriptor))
    # Nothing is held back: what is written is handed over at once.
    return writer, io.TextIOWrapper(buffer, encoding=stream.encoding, errors=stream.errors, write_through=True)


@contextlib.contextmanager
def queued_output() -> Iterator[QueuedOutput]:
    """Within it nothing that is printed waits; at its end what was printed is waited for, within bounds."""
    before = sys.stdout, sys.stderr
    out, stdout = _queued(before[0], "stdout")
    err, stderr = _queued(before[1], "stderr")
    sys.stdout, sys.stderr = stdout, stderr
    output = QueuedOutput()
    try:
        yield output
    finally:
        sys.stdout, sys.stderr = before
        asked_s = time.monotonic()
        if err is not None:
            err.end(asked_s)
        if out is not None:
            output.delivered = out.end(asked_s) and not out.dropped
            output.error = out.error


def deliver_output() -> None:
    """Waits, within bounds, until what was printed is written: before an exit that waits for nothing."""
    for stream in (sys.stdout, sys.stderr):
        buffer = getattr(stream, "buffer", None)
        if isinstance(buffer, QueuedBuffer):
            buffer.deliver()
        else:
            stream.flush()
