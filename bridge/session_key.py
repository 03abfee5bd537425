"""File with the key that both sides of a session share: two lines of text, readable by the owner only."""

import base64
import binascii
import errno
import os
import secrets
import stat
from pathlib import Path
from typing import NoReturn

from haptether.input_file import BOM

KEY_BYTES = 32
HEADER = "haptether session key 1"
LONGEST_FILE = 4096
MIN_DISTINCT = 8
"""Smallest number of distinct byte values in a key; fewer cannot be random."""
_ENCODED = 44
_SEXTETS = {code: n for n, code in enumerate(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/")}


def write_key(path: Path, *, replace: bool = False) -> None:
    """Create a key of 32 random bytes and write it to `path` with mode 0600.

    Args:
        path: Target file; its folder must exist.
        replace: True to replace an existing file; its key is lost.

    Raises:
        FileExistsError: The file exists, and `replace` is not set.
        FileNotFoundError: The folder does not exist.
        OSError: The file cannot be written.
    """
    if not path.parent.is_dir():
        message = f"{path}: there is no folder {path.parent}: make it first, or give another path"
        raise FileNotFoundError(message)
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
    # Write atomically, and never with the mode of the previous file.
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
        # The umask may have removed permissions of the owner.
        os.fchmod(file.fileno(), 0o600)
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def read_key(path: Path) -> bytearray:
    """Read the 32 bytes of a key file from :func:`write_key` without further copies; :func:`wipe_key` erases them.

    Raises:
        ValueError: Not a plain file, accessible to others, or without a strong key.
        OSError: The file cannot be read.
    """
    try:
        # Do not block on a pipe, and do not follow a link.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.ELOOP:
            message = f"{path}: is a symbolic link, must be the key file itself"
            raise ValueError(message) from error
        raise
    try:
        # Use the open file, because the target of the path may change in between.
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            message = f"{path}: is no plain file, must be a key file"
            raise ValueError(message)
        mode = stat.S_IMODE(status.st_mode)
        if mode & 0o077:
            message = f"{path}: others may use this key (mode {mode:04o}): run `chmod 600 {path}`"
            raise ValueError(message)
        content = bytearray(LONGEST_FILE + 1)
        length = os.readv(descriptor, [content])
    finally:
        os.close(descriptor)
    try:
        key = _decoded(content, length)
        if key is None:
            _refuse(path, bytes(content[:length]))
    finally:
        wipe_key(content)
    if (distinct := len(set(key))) < MIN_DISTINCT:
        message = (
            f"{path}: a weak key, {distinct} different byte values: must be {KEY_BYTES} random bytes, "
            "`haptether keygen` makes one"
        )
        raise ValueError(message)
    return key


def wipe_key(key: bytearray) -> None:
    """Overwrite a key in place with zeros."""
    key[:] = bytes(len(key))


def _decoded(content: bytearray, length: int) -> bytearray | None:
    """Decode the key of a file in place; `base64` would leave copies that cannot be wiped."""
    start = content.find(b"\n", 0, length) + 1
    if length > LONGEST_FILE or bytes(content[:start]).removeprefix(BOM).strip() != HEADER.encode():
        return None
    while length > start and content[length - 1 : length].isspace():
        length -= 1
    while content[start] in b" \t" and start < length:
        start += 1
    if length - start != _ENCODED or content[length - 1] != ord("="):
        return None
    key = bytearray(KEY_BYTES)
    for n in range(_ENCODED - 1):
        sextet = _SEXTETS.get(content[start + n])
        if sextet is None:
            wipe_key(key)
            return None
        at, shift = divmod(6 * n, 8)
        # Place the sextet from bit `shift` of byte `at` on; the last one has two unused bits.
        bits = sextet << 10 - shift
        key[at] |= bits >> 8
        if at + 1 < KEY_BYTES:
            key[at + 1] |= bits & 0xFF
    return key


def _refuse(path: Path, content: bytes) -> NoReturn:
    """Raise an error that says why the content is not a key.

    Raises:
        ValueError: Always.
    """
    lines = content.removeprefix(BOM).splitlines()
    if len(content) > LONGEST_FILE or len(lines) != 2 or lines[0].strip() != HEADER.encode():
        message = f"{path}: is no key file: must be the line {HEADER!r} and one with the key"
        raise ValueError(message)
    try:
        key = base64.b64decode(lines[1].strip(), validate=True)
    except binascii.Error as error:
        message = f"{path}: line 2 is no base64 text"
        raise ValueError(message) from error
    message = f"{path}: a key of {len(key)} bytes, must have {KEY_BYTES}"
    raise ValueError(message)
