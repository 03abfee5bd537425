"""`haptether export`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from haptether.bridge import Run


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a recorded run as Parquet, CSV or NumPy arrays, a column an axis and a row a tick, or for Foxglove.

    The two sides tick at times of their own, so that a table has one side; NumPy files have both.

    Examples:

    haptether export master.mcap --parquet master.parquet

    haptether export master.mcap slave.mcap --side slave --csv slave.csv

    haptether export master.mcap slave.mcap --foxglove both.mcap
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """What `--record` of master or slave wrote."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="OTHER")] = None
    """What the other side wrote."""
    slave_begun_s: float | None = None
    """When the slave's run began after the master's in s, where the clocks of two machines differ."""
    side: Literal["master", "slave"] | None = None
    """Of which side the table is; by default the master where it was recorded."""
    parquet: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write a Parquet file."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write comma-separated values."""
    npz: Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")] = None
    """Write every signal as a NumPy array."""
    foxglove: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mcap")] = None
    """Write both sides into one MCAP file, with poses, frames and force arrows in Foxglove's schemas."""

    def run(self) -> int:
        """Writes the files.

        Raises:
            ValueError: No recording, nothing to write, or a side that was not recorded.
        """
        from haptether.cli.recording.files import read_run
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.cli.shared.screen import screen

        targets = (self.parquet, self.csv, self.npz, self.foxglove)
        if not any(targets):
            message = "what to write? Give --parquet, --csv, --npz or --foxglove and a file"
            raise ValueError(message)
        check_distinct(
            file=self.file, other=self.other, parquet=self.parquet, csv=self.csv, npz=self.npz, foxglove=self.foxglove
        )
        check_target(*targets)
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
        for target in targets:
            if target is not None:
                screen().print(f"written: {target}")
        return 0

    def _write_tables(self, run: "Run") -> None:
        from haptether.private_file import private_file

        side = self.side or ("master" if "time_s" in run.signals else "slave")
        try:
            table = run.to_polars(side)
        except ImportError:
            message = "tables need polars: install haptether[analysis]"
            raise ImportError(message) from None
        if self.parquet is not None:
            with private_file(self.parquet) as file:
                table.write_parquet(file)
        if self.csv is not None:
            with private_file(self.csv) as file:
                table.write_csv(file)
