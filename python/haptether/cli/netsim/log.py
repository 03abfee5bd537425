"""The ground truth of `haptether netsim proxy`: CSV, or Parquet made of it at the end."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from haptether.cli.shared.output import check_target
from haptether.private_file import begin_private


@dataclass(frozen=True)
class Log:
    """Where the proxy writes, and where its user wants it."""

    target: Path
    """What was asked for."""
    csv: Path
    """What the proxy writes while it runs: the same, or for Parquet a file beside it."""

    @classmethod
    def checked(cls, target: Path) -> Self:
        """Refuses early what could not be written after the run.

        Raises:
            ValueError: Neither .csv nor .parquet.
            ImportError: Parquet without polars.
            OSError: No place to write to.
        """
        if target.suffix not in {".csv", ".parquet"}:
            message = f"log = {target}: must end in .csv or .parquet"
            raise ValueError(message)
        if target.suffix == ".csv":
            check_target(target)
            return cls(target, target)
        if importlib.util.find_spec("polars") is None:
            message = f"log = {target}: Parquet needs polars: install haptether[analysis], or give a .csv"
            raise ImportError(message)
        check_target(target)
        csv = target.with_name(f"{target.name}.csv")
        if csv.exists():
            message = f"{csv}: is there already; the log is written there until it is converted"
            raise OSError(message)
        return cls(target, csv)

    def end(self) -> None:
        """Converts what was written, in pieces, and leaves only what was asked for.

        Raises:
            OSError: No place to write to; the CSV stays.
        """
        if self.csv == self.target:
            return
        import polars as pl

        # Named, because a column that is empty at the top would be taken for text.
        numbers = dict.fromkeys(("index", "t_in_ns", "t_due_ns", "t_out_ns", "error_ns", "size"), pl.Int64)
        words = dict.fromkeys(("direction", "kind", "cause"), pl.String)
        try:
            begin_private(self.target)
            rows = pl.scan_csv(self.csv, schema_overrides={**numbers, **words})
            rows.with_columns(pl.col(*words).fill_null("")).sink_parquet(self.target)
        except (OSError, ValueError, pl.exceptions.PolarsError) as error:
            message = f"{self.target}: cannot be written: {error}; the log is in {self.csv}"
            raise OSError(message) from None
        self.csv.unlink()
