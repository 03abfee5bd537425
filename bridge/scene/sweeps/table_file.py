"""The file of a sweep, written row group by row group: the same rows yield the same bytes, however they come."""

import csv
import importlib
import importlib.util
import io
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
import numpy.typing as npt

from haptether.bridge.scene.sweep import COUNTS, Sweep

ROW_GROUP = 65_536
"""Rows of a row group of Parquet."""
STREAMED = frozenset({".csv", ".parquet"})
"""Suffixes of files that are written without all rows in memory."""
SUFFIXES = (".csv", ".parquet", ".npz")


class TableFile(Protocol):
    """A file that takes rows."""

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Writes rows below those that are there."""

    def close(self) -> None:
        """Writes what is still held back."""


def check_suffix(path: Path) -> None:
    """Refuses a file of another kind, or one whose library is not installed.

    Raises:
        ValueError: Another suffix.
        ImportError: PyArrow is not installed.
    """
    if path.suffix not in SUFFIXES:
        message = f"{path}: must end in .csv, .parquet or .npz"
        raise ValueError(message)
    if path.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        message = f"{path}: Parquet needs pyarrow: install haptether[parquet]"
        raise ImportError(message)


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
        part = Sweep(columns)
        writer.writerows(zip(*map(part.values_of, columns), strict=True))

    def close(self) -> None:
        """Writes what is still held back, and leaves the file open."""
        self._text.detach()


class ParquetTable:
    """Rows as Parquet, in row groups of `ROW_GROUP`: what was not measured is null, counts are whole numbers."""

    def __init__(self, file: IO[bytes], metadata: Mapping[str, str]) -> None:
        self._file = file
        self._metadata = metadata
        self._writer: Any = None
        self._held: list[Any] = []
        self._arrow: Any = importlib.import_module("pyarrow")
        self._parquet: Any = importlib.import_module("pyarrow.parquet")

    def write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Takes rows, and writes each row group that they complete."""
        self._held.append(self._table(columns))
        if sum(table.num_rows for table in self._held) >= ROW_GROUP:
            self._flush(whole=True)

    def close(self) -> None:
        """Writes the last row group and the footer."""
        if self._held:
            self._flush(whole=False)
        if self._writer is not None:
            self._writer.close()

    def _flush(self, *, whole: bool) -> None:
        table = self._arrow.concat_tables(self._held)
        end = table.num_rows // ROW_GROUP * ROW_GROUP if whole else table.num_rows
        for at in range(0, end, ROW_GROUP):
            # What a slice is made of would show in the pages that it becomes.
            group = table.slice(at, min(ROW_GROUP, end - at)).combine_chunks()
            self._writer.write_table(group, row_group_size=ROW_GROUP)
        self._held = [table.slice(end)] if end < table.num_rows else []

    def _table(self, columns: Mapping[str, npt.NDArray[Any]]) -> Any:  # noqa: ANN401  # of pyarrow
        arrow, part = self._arrow, Sweep(columns)
        arrays = {
            name: arrow.array(part.values_of(name), type=self._type(name, column)) for name, column in columns.items()
        }
        if self._writer is None:
            fields = [arrow.field(name, array.type) for name, array in arrays.items()]
            schema = arrow.schema(fields, metadata=dict(self._metadata))
            self._writer = self._parquet.ParquetWriter(self._file, schema, compression="zstd")
        return arrow.table(list(arrays.values()), schema=self._writer.schema)

    def _type(self, name: str, column: npt.NDArray[Any]) -> Any:  # noqa: ANN401  # of pyarrow
        if column.dtype.kind == "U":
            return self._arrow.string()
        if name in COUNTS or column.dtype.kind in "iu":
            return self._arrow.int64()
        return self._arrow.bool_() if column.dtype == np.bool_ else self._arrow.float64()
