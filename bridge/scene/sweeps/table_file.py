"""The file of a sweep, written row group by row group: the same rows yield the same bytes, whatever their batches."""

import csv
import importlib
import importlib.util
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
import numpy.typing as npt

from haptether.extras import require

ROW_GROUP = 65_536
"""Rows of a row group of Parquet."""
STREAMED = frozenset({".csv", ".parquet"})
"""Suffixes of files that are written without all rows in memory."""
SUFFIXES = (".csv", ".parquet", ".npz")
COUNTS = frozenset({"false_trips", "intervention_ticks"})
"""Columns of whole numbers that are float64, so that NaN can stand for what was not measured."""
UNMEASURED = frozenset({"never-engaged", "refused"})
"""Outcomes of rows in which nothing was measured."""


class _ArrowTable(Protocol):
    """What of a `pyarrow.Table` is used; Haptether depends on PyArrow only as an extra."""

    num_rows: int

    def slice(self, offset: int, length: int | None = None) -> "_ArrowTable":
        """Rows from `offset` on."""

    def combine_chunks(self) -> "_ArrowTable":
        """The same rows, each column in one piece."""


class _ParquetWriter(Protocol):
    """What of a `pyarrow.parquet.ParquetWriter` is used."""

    schema: object

    def write_table(self, table: _ArrowTable, row_group_size: int) -> None:
        """Writes a row group."""

    def close(self) -> None:
        """Writes the footer."""


class TableFile(Protocol):
    """A file that takes rows."""

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Writes rows below those that are there."""

    def close(self) -> None:
        """Writes what is pending; the file stays open."""


REQUEST_KEY = "haptether.sweep"
"""Key in the metadata of a Parquet file."""


def values_of(columns: Mapping[str, npt.NDArray[Any]], name: str) -> list[Any]:
    """A column of a sweep as raw values, none for what was not measured."""
    column = columns[name]
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f":
        if name in COUNTS:
            return [None if math.isnan(value) else int(value) for value in values]
        for row in np.flatnonzero(np.isnan(column)).tolist():
            values[row] = None
        return values
    if name == "reason":
        return [value or None for value in values]
    if name == "diverged" and "outcome" in columns:
        outcomes = columns["outcome"].tolist()
        return [None if of in UNMEASURED else value for of, value in zip(outcomes, values, strict=True)]
    return values


def check_suffix(path: Path) -> None:
    """Refuses a file of another kind, or one whose library is not installed.

    Raises:
        ValueError: Another suffix.
        ImportError: PyArrow is not installed.
    """
    if path.suffix not in SUFFIXES:
        message = f"{path}: must end in .csv, .parquet or .npz"
        raise ValueError(message)
    if path.suffix == ".parquet":
        require(str(path), "pyarrow")


def table_file(suffix: str, file: IO[bytes], metadata: Mapping[str, str]) -> TableFile:
    """What writes rows to a file that is open; `metadata` is for Parquet."""
    return ParquetTable(file, metadata) if suffix == ".parquet" else CsvTable(file)


class CsvTable:
    """Rows as CSV: what was not measured is empty."""

    def __init__(self, file: IO[bytes]) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        self._begun = False

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Writes rows, the first time below their names."""
        writer = csv.writer(self._text, lineterminator="\n")
        if not self._begun:
            writer.writerow(columns)
            self._begun = True
        writer.writerows(zip(*(values_of(columns, name) for name in columns), strict=True))

    def close(self) -> None:
        """Writes what is pending; the file stays open."""
        self._text.detach()


class ParquetTable:
    """Rows as Parquet, in row groups of `ROW_GROUP`: what was not measured is null, counts are whole numbers."""

    def __init__(self, file: IO[bytes], metadata: Mapping[str, str]) -> None:
        self._file = file
        self._metadata = metadata
        self._writer: _ParquetWriter | None = None
        self._pending: list[_ArrowTable] = []
        self._arrow = importlib.import_module("pyarrow")
        self._parquet = importlib.import_module("pyarrow.parquet")

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Takes rows, and writes each row group that they complete."""
        arrays = {
            name: self._arrow.array(values_of(columns, name), type=self._type(name, column))
            for name, column in columns.items()
        }
        if self._writer is None:
            self._writer = self._begun({name: array.type for name, array in arrays.items()})
        self._pending.append(self._arrow.table(list(arrays.values()), schema=self._writer.schema))
        if sum(table.num_rows for table in self._pending) >= ROW_GROUP:
            self._flush(self._writer, whole=True)

    def close(self) -> None:
        """Writes the last row group and the footer."""
        if self._writer is not None:
            if self._pending:
                self._flush(self._writer, whole=False)
            self._writer.close()

    def _begun(self, types: Mapping[str, object]) -> _ParquetWriter:
        fields = [self._arrow.field(name, kind) for name, kind in types.items()]
        schema = self._arrow.schema(fields, metadata=dict(self._metadata))
        writer: _ParquetWriter = self._parquet.ParquetWriter(self._file, schema, compression="zstd")
        return writer

    def _flush(self, writer: _ParquetWriter, *, whole: bool) -> None:
        """Writes the pending rows in row groups; with `whole` only those that are complete."""
        table: _ArrowTable = self._arrow.concat_tables(self._pending)
        end = table.num_rows // ROW_GROUP * ROW_GROUP if whole else table.num_rows
        for first in range(0, end, ROW_GROUP):
            # What a slice is made of would show in the pages that it becomes.
            group = table.slice(first, min(ROW_GROUP, end - first)).combine_chunks()
            writer.write_table(group, row_group_size=ROW_GROUP)
        self._pending = [table.slice(end)] if end < table.num_rows else []

    def _type(self, name: str, column: npt.NDArray[Any]) -> object:
        """The Arrow type of a column."""
        if column.dtype.kind == "U":
            kind: object = self._arrow.string()
        elif name in COUNTS or column.dtype.kind in "iu":
            kind = self._arrow.int64()
        else:
            kind = self._arrow.bool_() if column.dtype == np.bool_ else self._arrow.float64()
        return kind
