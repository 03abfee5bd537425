"""Reader of user files: plain files up to a size limit, text in UTF-8."""

import os
import stat
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy.typing as npt

MAX_BYTES = 256 * 2**20
"""Largest recording in bytes; a longer one must be cut or thinned out."""
BOM = b"\xef\xbb\xbf"
"""Byte order mark that some editors put before UTF-8."""
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def refuse_special(path: str | os.PathLike[str]) -> None:
    """Refuse anything but a plain file: opening a pipe may block for ever, and opening a device may act on it.

    Raises:
        OSError: The file does not exist, or cannot be accessed.
        ValueError: A folder, pipe, device or socket. The message omits the path.
    """
    _refuse_kind(Path(path).stat().st_mode)


def read_bytes(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> bytes:
    """Read a plain file or the target of a link, without a byte order mark.

    Raises:
        OSError: The file does not exist, or cannot be read.
        ValueError: Not a plain file, or longer than `limit` bytes. The message omits the path.
    """
    refuse_special(path)
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    with os.fdopen(descriptor, "rb") as file:
        # Check the open file, because the path may lead elsewhere now.
        _refuse_kind(os.fstat(descriptor).st_mode)
        try:
            content = file.read(limit + 1)
        except OSError as error:
            # Python omits the file name if a read fails.
            raise type(error)(error.errno, error.strerror, os.fspath(path)) from None
    if len(content) > limit:
        message = f"more than {limit} bytes: give a shorter file"
        raise ValueError(message)
    return content.removeprefix(BOM)


def read_text(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> str:
    """Read the text of a plain UTF-8 file; see `read_bytes`.

    Raises:
        OSError: The file does not exist, or cannot be read.
        ValueError: Same as `read_bytes`, or another encoding. The message omits the path.
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
    """Read the arrays of a NumPy `.npz` file.

    Raises:
        OSError: The file does not exist, or cannot be read.
        ValueError: Not a plain file, not an `.npz` file, or not only arrays. The message omits the path.
    """
    import numpy as np  # noqa: PLC0415  # not for a key

    refuse_special(path)
    try:
        with zipfile.ZipFile(path):
            # NumPy would take a non-archive for a pickle, and advise to allow pickles.
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
