"""Output of commands: files, JSON for machines, and streams whose readers cannot block the command."""

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
from json import dumps as _dumps
from pathlib import Path
from typing import BinaryIO, TextIO, cast

from haptether.extras import require
from haptether.private_file import is_stream, refuse_existing, refuse_link, write_private


def write_report(target: Path | None, report: object) -> None:
    """Write an object that msgspec can encode as indented JSON; do nothing without a target."""
    import msgspec

    if target is not None:
        write_json(target, msgspec.json.format(msgspec.json.encode(report), indent=2))


def write_json(target: Path, text: bytes) -> None:
    """Write JSON to a file, or to standard output for `-`."""
    if str(target) == "-":
        sys.stdout.buffer.write(_inert(text) + b"\n")
        sys.stdout.buffer.flush()
    else:
        write_private(target, _inert(text) + b"\n")


def _inert(json: bytes) -> bytes:
    """Escape the characters of JSON that no screen shows: it may go to a terminal."""
    if json.isascii():
        return json
    shown = (c if c.isprintable() or c == "\n" else _dumps(c)[1:-1] for c in json.decode())
    return "".join(shown).encode()


def table_goes_to_stderr(json: Path | None) -> bool:
    """Return true if standard output belongs to the JSON."""
    return json is not None and str(json) == "-"


def require_matplotlib() -> None:
    """Refuse early where pictures cannot be drawn.

    Raises:
        ImportError: matplotlib is not installed; the message says what to install.
    """
    require("pictures", "matplotlib")


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Option of a command that writes files."""

    force: bool = False
    """Replace existing files; without it they are refused."""


def check_target(*targets: Path | None, force: bool) -> None:
    """Refuse files that cannot be written, before the run rather than after it.

    Args:
        targets: Paths of files; `-` is standard output.
        force: If true, existing files are replaced.

    Raises:
        FileExistsError: The file exists, and `force` is false.
        OSError: The message names the path and the obstacle, which may be a symbolic link.
        ValueError: One file twice: the later write would destroy the earlier one.
    """
    seen = set[Path]()
    for target in targets:
        if target is None or str(target) == "-":
            continue
        if target.resolve() in seen and not is_stream(target):
            message = f"{target}: is to be written twice: give two files"
            raise ValueError(message)
        seen.add(target.resolve())
        if target.is_dir():
            message = f"{target}: is a folder, must be a file"
            raise OSError(message)
        refuse_link(target)
        if not force:
            refuse_existing(target)
        if not os.access(target if is_stream(target) else target.parent, os.W_OK):
            message = f"{target}: cannot be written: is the folder there, and yours?"
            raise OSError(message)


def check_distinct(**files: Path | None) -> None:
    """Refuse arguments that name one file twice: the later write would destroy the earlier file, even a key.

    Args:
        files: Paths by the names of options; positional arguments in capitals, as in the help.

    Raises:
        ValueError: Two arguments name one file; the message names both.
    """
    seen: dict[Path, str] = {}
    for name, path in files.items():
        if path is None or str(path) == "-":
            continue
        option = name if name.isupper() else f"--{name.replace('_', '-')}"
        other = seen.setdefault(path.resolve(), option)
        if other != option:
            message = f"{other}, {option}: both name {path}: give two files"
            raise ValueError(message)


def make_folder(folder: Path) -> None:
    """Make a folder for pictures, before the run rather than after it.

    Raises:
        ValueError: The path has the suffix of a picture, or is standard output.
        OSError: The message names the path and the obstacle.
    """
    if str(folder) == "-":
        message = "-: must be a folder: what is written are several files"
        raise ValueError(message)
    if folder.suffix.lower() in {".png", ".pdf", ".svg"}:
        message = (
            f"{folder}: must be a folder, whose pictures are named by what they show; try {folder.with_suffix('')}"
        )
        raise ValueError(message)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"{folder}: cannot be made: {error.strerror}; give another folder"
        raise OSError(message) from None
    if not os.access(folder, os.W_OK):
        message = f"{folder}: cannot be written into; give another folder"
        raise OSError(message)


# ------------------------------------------------------------- streams of a command that must go on, and end, unread

MAX_WAITING = 1 << 16
"""Bytes that may wait for a reader; later messages are dropped and counted. One message may be larger."""
CHUNK = 4096
"""Bytes per write, so that a slow reader shows before all is written."""
STUCK_S = 1.0
"""Time in s at the end of a command after which a reader that takes nothing is given up."""


class QueuedWriter:
    """Bytes for a descriptor, written by a thread of its own: the caller never waits."""

    def __init__(self, descriptor: int, name: str) -> None:
        self.error: OSError | None = None
        """Error after which nothing is written any more."""
        self.dropped = 0
        """Number of messages that found no room."""
        self._descriptor = descriptor
        self._messages: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._waiting = 0
        self._taken_s = 0.0
        threading.Thread(target=self._run, name=f"haptether-{name}", daemon=True).start()

    def put(self, message: bytes) -> None:
        """Pass a message to the thread."""
        with self._lock:
            if self._waiting >= MAX_WAITING:
                self.dropped += 1
                return
            self._waiting += len(message)
        self._messages.put(message)

    def end(self, requested_s: float) -> bool:
        """Wait until all is written, but at most 1 s for a reader that takes nothing; return true if all is written.

        Args:
            requested_s: Time of the request to end, in s of the monotonic clock.
        """
        self._messages.put(None)
        while self._waiting > 0:
            if time.monotonic() >= max(requested_s, self._taken_s) + STUCK_S:
                return False
            time.sleep(0.005)
        return True

    def _run(self) -> None:
        reported = 0
        while True:
            try:
                message = self._messages.get()
                if message is None:
                    return
                if (dropped := self.dropped) != reported:
                    self._write(b"[%d messages were dropped: nobody read them in time]\n" % (dropped - reported))
                    reported = dropped
                self._write(message)
                with self._lock:
                    self._waiting -= len(message)
            except MemoryError:
                # The message is lost; the thread goes on.
                continue

    def _write(self, message: bytes) -> None:
        left = memoryview(message)
        while left and self.error is None:
            try:
                count = os.write(self._descriptor, left[:CHUNK])
            except BlockingIOError:
                # The descriptor is non-blocking because the parent process set it so.
                select.select([], [self._descriptor], [])
                continue
            except OSError as error:
                self.error = error
                return
            left = left[count:]
            self._taken_s = time.monotonic()


class QueuedBuffer(io.RawIOBase):
    """Bytes of a queued stream."""

    def __init__(self, writer: QueuedWriter, descriptor: int) -> None:
        super().__init__()
        self._writer = writer
        self._descriptor = descriptor

    def writable(self) -> bool:
        """Return true."""
        return True

    def fileno(self) -> int:
        """Return the descriptor that is written to in the end."""
        return self._descriptor

    def deliver(self) -> None:
        """Wait until all is written, within the bounds of `QueuedWriter.end`."""
        self._writer.end(time.monotonic())

    def isatty(self) -> bool:
        """Return true if the descriptor is a terminal."""
        return os.isatty(self._descriptor)

    def write(self, message: object) -> int:
        """Pass bytes to the writer."""
        held = bytes(message)  # type: ignore[call-overload]  # whatever has bytes
        self._writer.put(held)
        return len(held)


@dataclass
class QueuedOutput:
    """Fate of standard output, known at its end."""

    delivered: bool = True
    """True if all of it was taken."""
    error: OSError | None = None
    """Error that ended the writing early."""


def _queued(stream: TextIO, name: str) -> tuple[QueuedWriter | None, TextIO]:
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        # A stream without a descriptor belongs to a caller in this process and cannot block.
        return None, stream
    stream.flush()
    writer = QueuedWriter(descriptor, name)
    buffer = cast("BinaryIO", QueuedBuffer(writer, descriptor))
    # Nothing is buffered: each write goes to the thread at once.
    return writer, io.TextIOWrapper(buffer, encoding=stream.encoding, errors=stream.errors, write_through=True)


@contextlib.contextmanager
def queued_output() -> Iterator[QueuedOutput]:
    """Queue all printed output within this context; at its end wait for it, within bounds."""
    before = sys.stdout, sys.stderr
    out, stdout = _queued(before[0], "stdout")
    err, stderr = _queued(before[1], "stderr")
    sys.stdout, sys.stderr = stdout, stderr
    output = QueuedOutput()
    try:
        yield output
    finally:
        sys.stdout, sys.stderr = before
        requested_s = time.monotonic()
        if err is not None:
            err.end(requested_s)
        if out is not None:
            output.delivered = out.end(requested_s) and not out.dropped
            output.error = out.error


def deliver_output() -> None:
    """Wait, within bounds, until the printed output is written: before an exit that does not wait."""
    for stream in (sys.stdout, sys.stderr):
        buffer = getattr(stream, "buffer", None)
        if isinstance(buffer, QueuedBuffer):
            buffer.deliver()
        else:
            stream.flush()
