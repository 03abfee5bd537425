"""Recordings named by a scene: read from their files and embedded."""

import csv
import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path as FilePath

import numpy as np
from msgspec import convert
from msgspec.structs import replace

from haptether.bridge.scene.errors import SceneError, abridged
from haptether.bridge.scene.resolve import embedded_links
from haptether.bridge.scene.tables.master import AimsTable, SeriesTable
from haptether.bridge.scene.tables.session import Scene
from haptether.input_file import read_npz, read_text


def embed_recordings(scene: Scene, folder: FilePath) -> Scene:
    """Return the scene with the contents of its files embedded; paths are relative to `folder`.

    Raises:
        SceneError: A file cannot be read; gives the line.
    """
    operator, environment = scene.operator, scene.environment
    if operator is not None and operator.recorded is not None:
        operator = replace(operator, recorded=_embedded(operator.recorded, folder))
    if operator is not None and operator.aims is not None and operator.aims.file is not None and not operator.aims.rows:
        operator = replace(operator, aims=read_aims(folder / operator.aims.file))
    if environment is not None:
        pushers = tuple(
            pusher if pusher.recorded is None else replace(pusher, recorded=_embedded(pusher.recorded, folder))
            for pusher in environment.pushers
        )
        if any(new is not old for new, old in zip(pushers, environment.pushers, strict=True)):
            environment = replace(environment, pushers=pushers)
    link = scene.link and embedded_links(scene.link, folder)
    return replace(scene, operator=operator, environment=environment, link=link)


def _embedded(table: SeriesTable, folder: FilePath) -> SeriesTable:
    # The contradiction checks refuse a table that has both.
    if table.file is None or table.time_s is not None or table.values is not None:
        return table
    return read_series(folder / table.file)


def read_series(path: FilePath) -> SeriesTable:
    """Read a recording from a CSV or .npz file; times count from its first record.

    Raises:
        SceneError: The file does not exist or has another format, a number is not finite, or times do not increase.
    """
    readers = {".csv": _read_csv, ".npz": _read_npz}
    if path.suffix not in readers:
        message = f"{path}: must be a .csv or .npz file"
        raise SceneError(message)
    with _refused(path):
        times, values = readers[path.suffix](path)
        # Values from a file obey the same ranges as values in a scene.
        series = {"time_s": [time_s - times[0] for time_s in times], "values": values}
        return convert(series, SeriesTable)


AIM_COLUMNS = ("over_s", "stiffness", "damping", "strength_n")


def read_aims(path: FilePath) -> AimsTable:
    """Read aims from a CSV file; times count from the start of the run.

    Raises:
        SceneError: The file does not exist or has another format, a number is out of range, or times decrease.
    """
    with _refused(path):
        times, values = _read_csv(path, AIM_COLUMNS)
        rows = [
            {
                "at_s": at_s,
                "target": row[: -len(AIM_COLUMNS)],
                **dict(zip(AIM_COLUMNS, row[-len(AIM_COLUMNS) :], strict=True)),
            }
            for at_s, row in zip(times, values, strict=True)
        ]
        return convert({"rows": rows}, AimsTable)


@contextmanager
def _refused(path: FilePath) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SceneError(message) from None
    except (ValueError, csv.Error) as error:
        message = f"{path}: {error}"
        raise SceneError(message) from None


def _read_csv(path: FilePath, last: tuple[str, ...] = ()) -> tuple[list[float], list[list[float]]]:
    """Read times and rows of values; the last columns are named `last`, and then times may repeat."""
    times: list[float] = []
    values: list[list[float]] = []
    text = io.StringIO(read_text(path), newline="")
    lines = csv.reader(line for line in text if not line.startswith("#"))
    header = [name.strip() for name in next(lines, [])]
    if len(header) < 2 + len(last) or header[0] != "time_s" or (last and tuple(header[-len(last) :]) != last):
        after = "".join(f",{name}" for name in last)
        allowed = f"time_s,x{after} or time_s,x,y,z{after}: one column per axis"
        message = f"header {abridged(','.join(header))!r}: must be {allowed}"
        raise ValueError(message)
    for row, cells in enumerate(lines, start=1):
        numbers = [_number(cell) for cell in cells]
        if len(numbers) != len(header) or not all(math.isfinite(number) for number in numbers):
            seen = abridged(",".join(cells))
            message = f"row {row} {seen!r}: must be {len(header)} finite numbers with decimal points, commas between"
            raise ValueError(message)
        if times and (numbers[0] < times[-1] or (numbers[0] == times[-1] and not last)):
            allowed = "at least" if last else "above"
            message = f"row {row}: time_s = {numbers[0]:g}: must be {allowed} the one before it, {times[-1]:g}"
            raise ValueError(message)
        times.append(numbers[0])
        values.append(numbers[1:])
    if not times:
        message = "must have at least one row below its header"
        raise ValueError(message)
    return times, values


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _read_npz(path: FilePath) -> tuple[list[float], list[list[float]]]:
    arrays = read_npz(path)
    try:
        time_s, values = (np.asarray(arrays[name], dtype=np.float64) for name in ("time_s", "values"))
    except (KeyError, ValueError, TypeError) as error:
        message = f"must hold the arrays time_s and values of numbers: {error}"
        raise ValueError(message) from None
    values = values[:, np.newaxis] if values.ndim == 1 else values
    if time_s.ndim != 1 or values.ndim != 2 or len(time_s) != len(values) or len(time_s) == 0:
        message = f"time_s of shape {time_s.shape}, values {values.shape}: must be (n,) and (n, axes), n > 0"
        raise ValueError(message)
    if not (np.isfinite(time_s).all() and np.isfinite(values).all()):
        message = "must hold finite numbers"
        raise ValueError(message)
    if not (np.diff(time_s) > 0.0).all():
        row = int(np.flatnonzero(np.diff(time_s) <= 0.0)[0]) + 1
        message = f"time_s[{row}] = {time_s[row]:g}: must be above the one before it, {time_s[row - 1]:g}"
        raise ValueError(message)
    return time_s.tolist(), values.tolist()
