"""Journal of computed rows of a sweep: a folder beside its file, consistent whenever the process is killed."""

import contextlib
import fcntl
import json
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from haptether.private_file import refuse_link

REQUEST = "sweep.json"
"""File in the folder that holds the request."""
FINISHED = "finished.json"
"""Name of the request after the file has all rows and the folder awaits removal."""
_BATCH = re.compile(r"rows-(\d{12})-(\d{12})\.npz")
_UNFINISHED = ".part"


class Journal:
    """Batches of rows, each written to a file, synced, then renamed into place.

    Args:
        path: Target file of the sweep; the journal is the folder `path`.partial.
        request: Request of the sweep, in JSON types.
        resume: True to continue with an existing journal.

    Raises:
        ValueError: A journal exists without `resume`, has another request, or is in use; or there is no journal to
            resume while the file exists.
        OSError: The folder cannot be created or written, or is a symbolic link.
    """

    def __init__(self, path: Path, request: Mapping[str, Any], *, resume: bool) -> None:
        self.path = path
        self.damaged = 0
        """Rows of unreadable batches, which were removed."""
        self.folder = path.with_name(f"{path.name}.partial")
        refuse_link(self.folder)
        if (self.folder / FINISHED).is_file():
            _discard(self.folder)
        with contextlib.suppress(OSError):
            # A previous removal stopped before the folder itself.
            self.folder.rmdir()
        exists = (self.folder / REQUEST).is_file()
        if resume and not exists and path.exists():
            message = f"{path}: is there and {self.folder} is not: nothing is left to resume"
            raise ValueError(message)
        self.folder.mkdir(mode=0o700, exist_ok=True)
        self._lock = _locked(self.folder)
        try:
            self._begin(request, resume=resume)
        except BaseException:
            self._lock.close()
            raise

    @staticmethod
    def is_begun(path: Path) -> bool:
        """Return True if an interrupted sweep left rows for a file."""
        return (path.with_name(f"{path.name}.partial") / REQUEST).is_file()

    def _begin(self, request: Mapping[str, Any], *, resume: bool) -> None:
        for stale in self.folder.glob(f"*{_UNFINISHED}"):
            stale.unlink()
        file = self.folder / REQUEST
        batches = self._found()
        if not file.is_file():
            if batches:
                message = f"{self.folder}: has rows and no {REQUEST}: is no journal of a sweep; remove it"
                raise ValueError(message)
            with self.replacing(REQUEST) as head:
                head.write(json.dumps(request, indent=1).encode())
        elif not resume:
            rows = sum(end - first for first, end in batches)
            message = f"{self.folder}: has {rows} rows of a sweep that was interrupted: resume it, or remove it"
            raise ValueError(message)
        else:
            try:
                stored = json.loads(file.read_bytes())
                if not isinstance(stored, dict):
                    message = "no object"
                    raise ValueError(message)  # handled like invalid JSON
            except ValueError as error:
                message = f"{file}: is damaged ({error}): remove {self.folder} and begin again"
                raise ValueError(message) from None
            _refuse_other(self.folder, stored, json.loads(json.dumps(request)))
            batches = self._readable(batches)
        self._batches = batches

    def _readable(self, batches: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return the readable batches in sequence; remove the others for recomputation."""
        kept: list[tuple[int, int]] = []
        for first, end in batches:
            try:
                if kept and first < kept[-1][1]:
                    message = "overlaps the one before"
                    raise ValueError(message)  # handled like an unreadable journal
                with self._opened(first, end) as archive:
                    lengths = {name: len(archive[name]) for name in archive.files}
                rows = {length for name, length in lengths.items() if not name.endswith(".texts")}
                if end <= first or rows != {end - first} or "outcome.codes" not in lengths:
                    message = "has other rows than its name says"
                    raise ValueError(message)
            except (ValueError, OSError, KeyError):
                self._file(first, end).unlink()
            else:
                kept.append((first, end))
        self.damaged = sum(end - first for first, end in batches) - sum(end - first for first, end in kept)
        return kept

    def _file(self, first: int, end: int) -> Path:
        return self.folder / f"rows-{first:012d}-{end:012d}.npz"

    @property
    def done(self) -> int:
        """Number of rows in the journal."""
        return sum(end - first for first, end in self._batches)

    def missing(self, rows: int) -> list[tuple[int, int]]:
        """Return the missing ranges, first and end, of `rows` rows."""
        gaps, at = [], 0
        for first, end in [*self._batches, (rows, rows)]:
            if first > at:
                gaps.append((at, first))
            at = end
        return gaps

    def add(self, first: int, metrics: Mapping[str, npt.NDArray[Any]]) -> None:
        """Store the metrics of rows from `first` on.

        Raises:
            OSError: The batch cannot be written.
        """
        rows = len(metrics["outcome"])
        arrays: dict[str, Any] = {}
        for name, column in metrics.items():
            if column.dtype.kind == "U":
                # Store each distinct text once plus a code per row, because most rows share a few texts.
                arrays[f"{name}.texts"], codes = np.unique(column, return_inverse=True)
                arrays[f"{name}.codes"] = codes.reshape(-1).astype(np.uint32)
            else:
                arrays[name] = column
        with self.replacing(f"rows-{first:012d}-{first + rows:012d}.npz") as file:
            np.savez(file, **arrays)
        self._batches = sorted([*self._batches, (first, first + rows)])

    def batches(self) -> Iterator[tuple[int, dict[str, npt.NDArray[Any]]]]:
        """Yield first row and metrics of each batch in row order.

        Raises:
            ValueError: A batch is damaged.
        """
        for first, end in self._batches:
            with self._opened(first, end) as archive:
                metrics: dict[str, npt.NDArray[Any]] = {}
                for name in archive.files:
                    base, _, part = name.rpartition(".")
                    if part == "texts":
                        metrics[base] = archive[name][archive[f"{base}.codes"]]
                    elif part != "codes":
                        metrics[name] = archive[name]
            yield first, metrics

    def types(self) -> dict[str, np.dtype[Any]]:
        """Return the column types of the metrics of all batches.

        Raises:
            ValueError: A batch is damaged.
        """
        found: dict[str, np.dtype[Any]] = {}
        for first, end in self._batches:
            with self._opened(first, end) as archive:
                for name in archive.files:
                    metric = name.removesuffix(".texts")
                    if metric not in found and not name.endswith(".codes"):
                        found[metric] = archive[name].dtype
        return found

    @contextlib.contextmanager
    def _opened(self, first: int, end: int) -> Iterator[Any]:
        file = self._file(first, end)
        try:
            with zipfile.ZipFile(file):
                pass
            with np.load(file, allow_pickle=False) as archive:
                yield archive
        except (ValueError, zipfile.BadZipFile, EOFError, zlib.error, NotImplementedError, RuntimeError):
            # NumPy's own message would recommend pickles.
            message = f"{file}: is damaged: resume, and its rows are computed again"
            raise ValueError(message) from None

    @contextlib.contextmanager
    def replacing(self, name: str, target: Path | None = None) -> Iterator[IO[bytes]]:
        """Write a file, sync it, then rename it to `target`, or to `name` in the folder.

        Raises:
            OSError: The file cannot be written.
        """
        partial = self.folder / f"{name}{_UNFINISHED}"
        target = target or self.folder / name
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            with os.fdopen(os.open(partial, flags, 0o600), "wb") as file:
                os.fchmod(file.fileno(), 0o600)
                yield file
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        partial.replace(target)
        _sync_folder(target.parent)

    def close(self) -> None:
        """Release the lock, so that another process may resume."""
        self._lock.close()

    def remove(self) -> None:
        """Remove the folder after the file is complete."""
        (self.folder / REQUEST).rename(self.folder / FINISHED)
        _sync_folder(self.folder)
        self.close()
        _discard(self.folder)

    def _found(self) -> list[tuple[int, int]]:
        found = (_BATCH.fullmatch(file.name) for file in self.folder.iterdir())
        return sorted((int(each[1]), int(each[2])) for each in found if each)


def _discard(folder: Path) -> None:
    """Remove a finished journal; its mark goes last, so that a kill in between leaves a finished journal."""
    for file in folder.iterdir():
        if file.name != FINISHED:
            file.unlink()
    (folder / FINISHED).unlink()
    folder.rmdir()


def kept_rows(path: Path) -> int:
    """Return the number of rows in the journal of a sweep file; 0 without a journal."""
    folder = path.with_name(f"{path.name}.partial")
    names = [file.name for file in folder.iterdir()] if (folder / REQUEST).is_file() else []
    return sum(int(found[2]) - int(found[1]) for found in map(_BATCH.fullmatch, names) if found)


def _locked(folder: Path) -> IO[bytes]:
    """Lock a folder; the system releases the lock when the process ends."""
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    file = os.fdopen(descriptor, "r+b")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        message = f"{folder}: another process writes it"
        raise ValueError(message) from None
    return file


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _refuse_other(folder: Path, stored: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    """Refuse to resume the journal of another request."""
    now, before = dict(_fields(requested)), dict(_fields(stored))
    differing = [path for path in dict.fromkeys([*before, *now]) if before.get(path) != now.get(path)]
    if not differing:
        return
    shown = [f"{path} was {_short(before.get(path))}, is {_short(now.get(path))}" for path in differing[:MOST_SHOWN]]
    more = f", and {len(differing) - MOST_SHOWN} more" if len(differing) > MOST_SHOWN else ""
    message = f"{folder}: is of another sweep: {'; '.join(shown)}{more}: resume with what it was begun with"
    raise ValueError(message)


MOST_SHOWN = 4
"""Largest number of differences between two requests in a message."""
_LONGEST = 60


def _short(text: str | None) -> str:
    if text is None:
        return "absent"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({len(text)} characters)"


def _fields(table: object, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the fields of nested tables as JSON with dotted paths; a list is one field."""
    if isinstance(table, dict) and table:
        for key, value in table.items():
            yield from _fields(value, f"{path}.{key}" if path else key)
    else:
        yield path, json.dumps(table)
