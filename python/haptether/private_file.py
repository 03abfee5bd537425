"""Owner-only output files: mode 0600, symbolic links are not followed, replaced atomically."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

STREAMS = frozenset(map(Path, ("/dev", "/dev/fd", "/proc/self/fd")))
"""Folders with system-made links to the streams of this process."""


def refuse_link(path: Path) -> None:
    """Refuse to write through a symbolic link, whose creator could choose the overwritten file.

    Raises:
        OSError: The path is a symbolic link to a file, or a dangling one.
    """
    if path.is_symlink() and not is_stream(path):
        message = f"{path}: is a symbolic link, must be a file"
        raise OSError(message)


def refuse_existing(path: Path) -> None:
    """Refuse to replace a file; pipes, devices and streams of this process are permitted.

    Raises:
        FileExistsError: The file exists.
    """
    if path.is_file() and not is_stream(path):
        message = f"{path}: is there already: --force replaces it, or give another file"
        raise FileExistsError(message)


def is_stream(path: Path) -> bool:
    """Return True for a pipe, a device or a stream of this process, which must not be replaced."""
    return path.exists() and (not path.is_file() or path.parent in STREAMS)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Add the file name to a disk error."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        if error.errno is None:
            message = f"{path}: {error}"
            raise OSError(message) from None
        raise type(error)(error.errno, error.strerror, str(path)) from None


def _stream(path: Path) -> int:
    """Open a pipe or a device for writing; fail if the pipe has no reader, because no signal would end the wait."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ENXIO:
            message = "nobody reads this pipe: start its reader first"
            raise OSError(error.errno, message, str(path)) from None
        raise
    os.set_blocking(descriptor, True)
    return descriptor


@contextmanager
def private_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file that replaces an existing file or link on success; write directly to a pipe or a device.

    Raises:
        OSError: The file cannot be created, or cannot replace the target.
    """
    if is_stream(path):
        # Do not truncate the content of a redirected stream.
        with _named(path), os.fdopen(_stream(path), "ab") as file:
            yield file
        return
    beside = path.with_name(f".{secrets.token_hex(8)}.part")
    # The name is unpredictable, and an existing file is never opened.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(beside, flags, 0o600)
    except OSError as error:
        # Report the name that the user knows.
        raise type(error)(error.errno, error.strerror, str(path)) from None
    try:
        with _named(path), os.fdopen(descriptor, "wb") as file:
            # The umask may have removed permissions of the owner.
            os.fchmod(file.fileno(), 0o600)
            yield file
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def write_private(path: Path, content: bytes) -> None:
    """Write a whole file like `private_file`.

    Raises:
        OSError: The file cannot be created, or cannot replace the target.
    """
    with private_file(path) as file:
        file.write(content)


def begin_private(path: Path) -> None:
    """Create an empty file to be opened by name; leave a pipe or a device unchanged.

    Raises:
        OSError: The file cannot be created, cannot replace the target, or is a symbolic link.
    """
    refuse_link(path)
    if not is_stream(path):
        write_private(path, b"")
