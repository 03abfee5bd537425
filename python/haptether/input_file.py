"""Files that a user gives, read whole: plain files up to a size, text in UTF-8."""

import os
import stat
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy.typing as npt

MAX_BYTES = 256 * 2**20
"""Largest recording; a longer one needs to be cut or thinned out."""
BOM = b"\xef\xbb\xbf"
"""The byte order mark that some editors put before UTF-8."""
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def refuse_special(path: str | os.PathLike[str]) -> None:
    """Refuses what is no plain file: to open a pipe may wait for ever, and to open a device may act on it.

    Raises:
        OSError: It is not there, or cannot be reached.
        ValueError: A folder, pipe, device or socket. The message is without the path.
    """
    _refuse_kind(Path(path).stat().st_mode)


def read_bytes(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> bytes:
    """Read a plain file or the target of a link, without a byte order mark.

    Raises:
        OSError: It is not there, or cannot be read.
        ValueError: No plain file, or longer than `limit` bytes. The message is without the path.
    """
    refuse_special(path)
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    with os.fdopen(descriptor, "rb") as file:
        # The path may lead elsewhere since.
        _refuse_kind(os.fstat(descriptor).st_mode)
        try:
            content = file.read(limit + 1)
        except OSError as error:
            # Python does not say which file a failing read was of.
            raise type(error)(error.errno, error.strerror, os.fspath(path)) from None
    if len(content) > limit:
        message = f"more than {limit} bytes: give a shorter file"
        raise ValueError(message)
    return content.removeprefix(BOM)


def read_text(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> str:
    """The text of a plain file in UTF-8, as `read_bytes`.

    Raises:
        OSError: It is not there, or cannot be read.
        ValueError: As `read_bytes`, or another encoding. The message is without the path.
    """
    content = read_bytes(path, limit)
    if content[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        message = "must be UTF-8, is UTF-16: save it as UTF-8"
        raise ValueError(message)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        message = f"must be UTF-8: {error.reason} at byte {error.start}"
        raise ValueError(message) from None


def read_npz(path: str | os.PathLike[str]) -> "dict[str, npt.NDArray[Any]]":
    """The arrays of a NumPy `.npz` file.

    Raises:
        OSError: It is not there, or cannot be read.
        ValueError: No plain file, no such file, or one of something else than arrays. The message is without the path.
    """
    import numpy as np  # noqa: PLC0415  # not for a key

    refuse_special(path)
    try:
        with zipfile.ZipFile(path):
            # NumPy would take what is no archive for a pickle, and advise to allow those.
            pass
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, EOFError, zlib.error, NotImplementedError, RuntimeError):
        message = "is no .npz file of NumPy, or a damaged one"
        raise ValueError(message) from None
    except ValueError:
        arrays = {"": None}
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        message = "holds something else than arrays of numbers or text"
        raise ValueError(message)
    return arrays


def _refuse_kind(mode: int) -> None:
    if not stat.S_ISREG(mode):
        message = f"is {_KINDS.get(stat.S_IFMT(mode), 'no file')}, must be a plain file"
        raise ValueError(message)
