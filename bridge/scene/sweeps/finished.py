"""Check whether a finished file belongs to this sweep: the same sweep gives the same bits."""

import csv
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge.scene.sweep import labelled
from haptether.bridge.scene.sweeps.design import Design
from haptether.bridge.scene.sweeps.table_file import stored_request, values_of
from haptether.input_file import read_npz

COMPARED = 1000
"""Number of rows whose values are compared."""
Columns = Mapping[str, npt.NDArray[Any]]


def is_of_another(path: Path, design: Design, request: Mapping[str, Any], first_row: Callable[[], Columns]) -> bool:
    """Return True if a file has the rows of another sweep.

    A Parquet file names its sweep. For other files, compare the number of rows, the varied values of the first
    `COMPARED` rows, and the metrics of the first row.

    Args:
        path: The file.
        design: Design of this sweep.
        request: Request of this sweep, as in JSON.
        first_row: Computes the metrics of the first row of this sweep.
    """
    if not path.is_file():
        return False
    if path.suffix == ".parquet":
        return stored_request(path) not in {b"", msgspec.json.encode(dict(request))}
    stored, rows = _stored(path)
    if "outcome" not in stored:
        # The file is not a sweep.
        return False
    count = min(rows, design.rows, COMPARED)
    varied, first = labelled(design.columns(0, count)), first_row()
    return rows != design.rows or any(
        [_text(value) for value in values_of(columns, name)] != stored.get(name, [])[: len(columns[name])]
        for columns in (varied, first)
        for name in columns
    )


def _stored(path: Path) -> tuple[dict[str, list[str]], int]:
    """Return the first rows of each column as text and the number of rows; empty if the file is not a table."""
    if path.suffix == ".npz":
        try:
            arrays = read_npz(path)
        except (OSError, ValueError):
            return {}, 0
        heads = {name: array[:COMPARED] for name, array in arrays.items() if array.ndim == 1}
        rows = len(arrays["outcome"]) if "outcome" in heads else 0
        return {name: list(map(_text, values_of(heads, name))) for name in heads}, rows
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = csv.reader(file)
        try:
            header = next(lines, [])
            head: list[list[str]] = []
            rows = 0
            for line in lines if "outcome" in header else ():
                rows += 1
                if rows <= COMPARED:
                    head.append(line)
        except csv.Error:
            return {}, 0
    return {name: [line[place] for line in head if place < len(line)] for place, name in enumerate(header)}, rows


def _text(value: object) -> str:
    """Format a value as CSV."""
    return "" if value is None else repr(value) if isinstance(value, float | np.floating) else str(value)
