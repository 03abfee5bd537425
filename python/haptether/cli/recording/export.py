"""`haptether export`."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    import polars as pl

    from haptether.bridge import Run

ROWS_AT_ONCE = 100_000
"""Rows of a text table that are written at once."""


@dataclass(frozen=True, kw_only=True)
class Export(FileOptions):
    """Write a recorded run as Parquet, CSV or NumPy arrays, a column an axis and a row a tick, or for Foxglove.

    The two sides tick at different times, so a table has one side; NumPy files have both.

    Examples:

    haptether export master.mcap --parquet master.parquet

    haptether export master.mcap slave.mcap --side slave --csv slave.csv

    haptether export master.mcap slave.mcap --foxglove both.mcap
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of `--record` of master or slave."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="OTHER")] = None
    """File of the other side."""
    slave_begun_s: float | None = None
    """Time in s from the beginning of the master's run to that of the slave's, if the clocks of two machines differ."""
    side: Literal["master", "slave"] | None = None
    """Side of the table of --parquet and --csv; by default the master if it was recorded."""
    parquet: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write a Parquet file."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write comma-separated values; - for standard output."""
    npz: Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")] = None
    """Write every signal as a NumPy array."""
    foxglove: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mcap")] = None
    """Write both sides into one MCAP file, with poses, frames and force arrows in Foxglove's schemas."""

    def run(self) -> int:
        """Write the files.

        Raises:
            ValueError: No recording, nothing to write, a binary format for standard output, a side without a table, or
                a side that was not recorded.
        """
        from haptether.cli.recording.files import read_run
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.cli.shared.screen import screen

        targets = (self.parquet, self.csv, self.npz, self.foxglove)
        if not any(targets):
            message = "what to write? Give --parquet, --csv, --npz or --foxglove and a file"
            raise ValueError(message)
        check_distinct(
            FILE=self.file, OTHER=self.other, parquet=self.parquet, csv=self.csv, npz=self.npz, foxglove=self.foxglove
        )
        self._check_binary()
        check_target(*targets, force=self.force)
        if self.side is not None and self.parquet is None and self.csv is None:
            message = f"--side {self.side}: without --parquet or --csv there is no table of one side: leave it out"
            raise ValueError(message)
        if self.npz is not None and self.npz.suffix != ".npz":
            message = f"{self.npz}: must end in .npz"
            raise ValueError(message)
        formats = {".parquet": self.parquet, ".csv": self.csv, ".npz": self.npz, ".mcap": self.foxglove}
        for suffix, target in formats.items():
            ending = "" if target is None else target.suffix.lower()
            if ending != suffix and ending in formats:
                message = f"{target}: would not be what its name says: must end in {suffix}"
                raise ValueError(message)
        run = read_run(self.file, self.other, self.slave_begun_s)
        if self.parquet is not None or self.csv is not None:
            self._write_tables(run)
        if self.npz is not None:
            run.save(self.npz)
        if self.foxglove is not None:
            from haptether.bridge import write_foxglove

            write_foxglove(self.foxglove, self.file, self.other, slave_begun_s=self.slave_begun_s)
        console = screen(self.csv)
        for target in targets:
            if target is not None and str(target) != "-":
                console.print(f"written: {target}")
        return 0

    def _check_binary(self) -> None:
        """Refuse standard output for binary formats.

        Raises:
            ValueError: A binary format for standard output; the message names the option.
        """
        for option, target in (("--parquet", self.parquet), ("--npz", self.npz), ("--foxglove", self.foxglove)):
            if str(target) == "-":
                message = f"{option} -: is binary, must be a file: only --csv goes to standard output"
                raise ValueError(message)

    def _write_tables(self, run: "Run") -> None:
        side = self.side or ("master" if "time_s" in run.signals else "slave")
        table = run.to_polars(side)
        if self.parquet is not None:
            _write_parquet(self.parquet, table)
        if self.csv is not None:
            _write_csv(self.csv, table)


def _write_parquet(target: Path, table: "pl.DataFrame") -> None:
    import polars as pl

    from haptether.private_file import private_file

    try:
        with private_file(target) as file:
            table.write_parquet(file)
    except pl.exceptions.ComputeError as error:
        # Polars reports a disk error as text that contains its number.
        if number := re.search(r"os error (\d+)", str(error)):
            raise OSError(int(number[1]), os.strerror(int(number[1])), str(target)) from None
        message = f"{target}: cannot be written: {error}"
        raise OSError(message) from None


def _write_csv(target: Path, table: "pl.DataFrame") -> None:
    """Write in slices through Python's own file: its errors are those of the disk, or of a closed pipe."""
    import contextlib
    import sys

    from haptether.private_file import private_file

    with contextlib.ExitStack() as stack:
        binary: IO[bytes] = sys.stdout.buffer
        if str(target) != "-":
            binary = stack.enter_context(private_file(target))
        for start in range(0, max(1, len(table)), ROWS_AT_ONCE):
            part = table.slice(start, ROWS_AT_ONCE).write_csv(include_header=start == 0)
            binary.write(part.encode())
        binary.flush()
