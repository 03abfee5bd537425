"""The key that both sides of a session share, as a file: two lines of text, for its owner's eyes only."""

import base64
import binascii
import errno
import os
import secrets
import stat
from pathlib import Path

KEY_BYTES = 32
HEADER = "haptether session key 1"
LONGEST_FILE = 4096


def write_key(path: Path, *, replace: bool = False) -> None:
    """Makes a key of 32 random bytes and writes it to `path`, which nobody but its owner may read or write.

    Args:
        path: Where to; the folder must exist.
        replace: Whether a file that is there gives way. The key in it is lost.

    Raises:
        FileExistsError: There is a file, and `replace` is not set.
        OSError: The file cannot be written.
    """
    text = f"{HEADER}\n{base64.b64encode(secrets.token_bytes(KEY_BYTES)).decode()}\n"
    if not replace:
        try:
            _write_new(path, text)
        except FileExistsError as error:
            message = f"{path}: is there already: --force replaces it, and its key is lost"
            raise FileExistsError(message) from error
        return
    if path.is_dir():
        message = f"{path}: is a folder, must be a file"
        raise OSError(message)
    if not path.is_symlink() and path.exists() and not path.is_file():
        message = f"{path}: is no plain file: give another"
        raise OSError(message)
    # Whole or not at all, and never for a moment with the mode of the file before.
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        _write_new(beside, text)
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise


def _write_new(path: Path, text: str) -> None:
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(path, flags, 0o600)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        # The umask may have taken the owner's own rights.
        os.fchmod(file.fileno(), 0o600)
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def read_key(path: Path) -> bytes:
    """The 32 bytes of a key file that :func:`write_key` made.

    Raises:
        ValueError: It is no plain file, others may read or write it, or it holds no key.
        OSError: It cannot be read.
    """
    try:
        # Not blocked by a pipe, and not led elsewhere by a link.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.ELOOP:
            message = f"{path}: is a symbolic link, must be the key file itself"
            raise ValueError(message) from error
        raise
    try:
        # Asked of the open file: what the path leads to may change in between.
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            message = f"{path}: is no plain file, must be a key file"
            raise ValueError(message)
        mode = stat.S_IMODE(status.st_mode)
        if mode & 0o077:
            message = f"{path}: others may use this key (mode {mode:04o}): run `chmod 600 {path}`"
            raise ValueError(message)
        content = os.read(descriptor, LONGEST_FILE + 1)
    finally:
        os.close(descriptor)
    return _parse(path, content)


def _parse(path: Path, content: bytes) -> bytes:
    lines = content.splitlines()
    if len(content) > LONGEST_FILE or len(lines) != 2 or lines[0].strip() != HEADER.encode():
        message = f"{path}: is no key file: must be the line {HEADER!r} and one with the key"
        raise ValueError(message)
    try:
        key = base64.b64decode(lines[1].strip(), validate=True)
    except binascii.Error as error:
        message = f"{path}: line 2 is no base64 text"
        raise ValueError(message) from error
    if len(key) != KEY_BYTES:
        message = f"{path}: a key of {len(key)} bytes, must have {KEY_BYTES}"
        raise ValueError(message)
    return key
