"""Files for their owner alone: mode 0600, no link followed, and never seen half written."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

STREAMS = frozenset(map(Path, ("/dev", "/dev/fd", "/proc/self/fd")))
"""Folders whose links only the system makes: to the streams of this process."""


def refuse_link(path: Path) -> None:
    """Refuses to write where a link leads: whoever may make one would choose what is overwritten.

    Raises:
        OSError: A symbolic link to a file, or to nothing: like another file that cannot be written.
    """
    if path.is_symlink() and not is_stream(path):
        message = f"{path}: is a symbolic link, must be a file"
        raise OSError(message)


def refuse_existing(path: Path) -> None:
    """Refuses to replace a file; pipes, devices and streams of this process are written to.

    Raises:
        FileExistsError: There is a file.
    """
    if path.is_file() and not is_stream(path):
        message = f"{path}: is there already: --force replaces it, or give another file"
        raise FileExistsError(message)


def is_stream(path: Path) -> bool:
    """Whether it is a pipe, a device or a stream of this process, which stays what it is."""
    return path.exists() and (not path.is_file() or path.parent in STREAMS)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Has an error of a disk say which file it was."""
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
    """Opens a pipe or a device to write to; a pipe that nobody reads is not waited for: no signal would end that."""
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
    """A file to write, which then replaces the one that is there, or the link; a pipe or a device is written to.

    Raises:
        OSError: It cannot be made, or not put into its place.
    """
    if is_stream(path):
        # What a redirected stream has already is not cut off.
        with _named(path), os.fdopen(_stream(path), "ab") as file:
            yield file
        return
    beside = path.with_name(f".{secrets.token_hex(8)}.part")
    # Nobody knows its name before, and what is there already is not opened.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(beside, flags, 0o600)
    except OSError as error:
        # Of the name that its user knows.
        raise type(error)(error.errno, error.strerror, str(path)) from None
    try:
        with _named(path), os.fdopen(descriptor, "wb") as file:
            # The umask may have taken the owner's own rights.
            os.fchmod(file.fileno(), 0o600)
            yield file
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def write_private(path: Path, content: bytes) -> None:
    """Writes all of a file, as `private_file`.

    Raises:
        OSError: It cannot be made, or not put into its place.
    """
    with private_file(path) as file:
        file.write(content)


def begin_private(path: Path) -> None:
    """Makes an empty file for what opens it by its name, and leaves a pipe or a device alone.

    Raises:
        OSError: It cannot be made, or not put into its place; a symbolic link.
    """
    refuse_link(path)
    if not is_stream(path):
        write_private(path, b"")
