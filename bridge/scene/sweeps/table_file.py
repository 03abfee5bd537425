"""Sweep file, written by row group: the same rows give the same bytes, whatever their batches."""

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
STREAMED = frozenset({".csv", ".parquet"})
"""Suffixes of files written without all rows in memory."""
SUFFIXES = (".csv", ".parquet", ".npz")
COUNTS = frozenset({"false_trips", "intervention_ticks"})
"""Integer columns stored as float64, so that NaN can mark values not measured."""
UNMEASURED = frozenset({"never-engaged", "refused"})
"""Outcomes of rows without measurements."""


class _ArrowTable(Protocol):
    """Used part of a `pyarrow.Table`; PyArrow is only an extra."""

    num_rows: int

    def slice(self, offset: int, length: int | None = None) -> "_ArrowTable":
        """Return rows from `offset` on."""

    def combine_chunks(self) -> "_ArrowTable":
        """Return the same rows with each column contiguous."""


class _ParquetWriter(Protocol):
    """Used part of a `pyarrow.parquet.ParquetWriter`."""

    schema: object

    def write_table(self, table: _ArrowTable, row_group_size: int) -> None:
        """Write a row group."""

    def close(self) -> None:
        """Write the footer."""


class TableFile(Protocol):
    """File that accepts rows."""

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Append rows."""

    def close(self) -> None:
        """Write pending rows; the file stays open."""


REQUEST_KEY = "haptether.sweep"
"""Key in the metadata of a Parquet file."""


def values_of(columns: Mapping[str, npt.NDArray[Any]], name: str) -> list[Any]:
    """Return a sweep column as raw values, with None for values not measured."""
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
    """Refuse a file of another kind, or one whose library is not installed.

    Raises:
        ValueError: The file has another suffix.
        ImportError: PyArrow is not installed.
    """
    if path.suffix not in SUFFIXES:
        message = f"{path}: must end in .csv, .parquet or .npz"
        raise ValueError(message)
    if path.suffix == ".parquet":
        require(str(path), "pyarrow")


def table_file(suffix: str, file: IO[bytes], metadata: Mapping[str, str]) -> TableFile:
    """Return a writer of rows to an open file; `metadata` is for Parquet."""
    return ParquetTable(file, metadata) if suffix == ".parquet" else CsvTable(file)


class CsvTable:
    """Rows as CSV; values not measured are empty."""

    def __init__(self, file: IO[bytes]) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        self._begun = False

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Write rows, with a header before the first."""
        writer = csv.writer(self._text, lineterminator="\n")
        if not self._begun:
            writer.writerow(columns)
            self._begun = True
        writer.writerows(zip(*(values_of(columns, name) for name in columns), strict=True))

    def close(self) -> None:
        """Write pending rows; the file stays open."""
        self._text.detach()


class ParquetTable:
    """Rows as Parquet in row groups of `ROW_GROUP`: values not measured are null, counts are integers."""

    def __init__(self, file: IO[bytes], metadata: Mapping[str, str]) -> None:
        self._file = file
        self._metadata = metadata
        self._writer: _ParquetWriter | None = None
        self._pending: list[_ArrowTable] = []
        self._arrow = importlib.import_module("pyarrow")
        self._parquet = importlib.import_module("pyarrow.parquet")

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take rows, and write each completed row group."""
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
        """Write the last row group and the footer."""
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
        """Write the pending rows in row groups; with `whole` only complete ones."""
        table: _ArrowTable = self._arrow.concat_tables(self._pending)
        end = table.num_rows // ROW_GROUP * ROW_GROUP if whole else table.num_rows
        for first in range(0, end, ROW_GROUP):
            # The chunks of a slice would affect the Parquet pages.
            group = table.slice(first, min(ROW_GROUP, end - first)).combine_chunks()
            writer.write_table(group, row_group_size=ROW_GROUP)
        self._pending = [table.slice(end)] if end < table.num_rows else []

    def _type(self, name: str, column: npt.NDArray[Any]) -> object:
        """Return the Arrow type of a column."""
        if column.dtype.kind == "U":
            kind: object = self._arrow.string()
        elif name in COUNTS or column.dtype.kind in "iu":
            kind = self._arrow.int64()
        else:
            kind = self._arrow.bool_() if column.dtype == np.bool_ else self._arrow.float64()
        return kind
