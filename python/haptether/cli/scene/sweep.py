"""`haptether sweep`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from haptether.bridge import Sweep as SweepResult
    from haptether.cli.shared.screen import Screen

ROWS_SHOWN = 20
MAX_ROWS = 10_000_000


@dataclass(frozen=True, kw_only=True)
class Sweep(PictureOptions):
    """Run a scene for many values of some of its numbers, every combination once.

    A range a:b:n is n values from a to b, both included; a list is v1,v2,... The last path varies fastest. Prints the
    first rows; --out and --json have all. Exit status 2 says that the scene cannot be, or no row of it.

    The outcome of a row is complete, settled, diverged, not-released (it ended before the release), never-engaged,
    refused (a scene that cannot be built: the reason is printed), or the state of the ladder where the two were coupled
    no more at the end. What was not measured is - here, null in JSON, empty in CSV and NaN in .npz: never 0.

    Examples:

    haptether sweep remote_push --vary link.forward.delay_s=0.01:0.1:10 --vary safety.window=50,100,200 --out push.csv

    haptether sweep remote_push --vary link.forward.delay_s=0:0.1:11 --vary run.seed=1,2,3,4,5 --plot delay.pdf

    haptether sweep paper_wall --vary environment.objects.0.contact.stiffness=200:1000:9 --set safety.controllers=[hsc]
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped scene, or path of a TOML file."""
    vary: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="PATH=A:B:N|V1,V2"),
    ] = ()
    """What varies; may be given often."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="TABLE.KEY=VALUE"),
    ] = ()
    """Change a field in all rows; may be given often."""
    threads: int | None = None
    """Threads to run in; as many as there are processors if not given."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write all rows as JSON; - for standard output."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.csv|FILE.npz")] = None
    """Write all rows as CSV or as NumPy arrays."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw the metrics as .png, .pdf or .svg: over one path as lines, with 95 % bands where run.seed varies, too; over
    two paths as maps."""

    def run(self) -> int:
        """Runs all rows."""
        from math import prod

        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

        from haptether.bridge import sweep
        from haptether.cli.shared.output import check_target
        from haptether.cli.shared.picture import picture_file
        from haptether.cli.shared.screen import Screen, screen
        from haptether.view.figures.sweep import check_varied, draw_sweep
        from haptether.view.style.figure import write_figure

        check_target(self.json, self.out)
        if self.out is not None and self.out.suffix not in {".csv", ".npz"}:
            message = f"{self.out}: must end in .csv or .npz"
            raise ValueError(message)
        if not self.vary:
            message = "nothing to vary: give --vary path=a:b:n or path=v1,v2"
            raise ValueError(message)
        grid: dict[str, list[float]] = {}
        for text in self.vary:
            path, values = values_of(text)
            if path in grid:
                message = f"--vary {path}: given twice: give all its values at once, as {path}=v1,v2"
                raise ValueError(message)
            grid[path] = values
        rows = prod(len(values) for values in grid.values())
        if rows > MAX_ROWS:
            message = f"{rows} rows: must be at most {MAX_ROWS}"
            raise ValueError(message)
        picture = None
        if self.plot is not None:
            check_varied(list(grid))
            picture = picture_file(self.plot, self.format)
        bar = Progress(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=Screen(stderr=True))
        with bar:
            task = bar.add_task("", total=rows)
            result = sweep(
                self.scene,
                grid,
                overrides=self.set,
                threads=self.threads,
                progress=lambda done: bar.update(task, completed=done),
            )
            bar.update(task, completed=rows)
        console = screen(self.json)
        self._report(console, result, len(grid) + 1)
        if picture is not None:
            write_figure(draw_sweep(self.scene, result.columns, list(grid), self.columns), picture)
            console.print(f"picture: {picture}")
        return 0

    def _report(self, console: "Screen", result: "SweepResult", keys: int) -> None:
        from collections import Counter

        from haptether import __version__
        from haptether.cli.scene.simulate import shown
        from haptether.cli.shared.output import write_report

        # First what was computed, then what may not be read to its end.
        if self.out is not None:
            result.save(self.out)
        if self.json is not None:
            report = {"scene": self.scene, "version": __version__, "rows": list(result.rows())}
            write_report(self.json, report)
        shows = self._columns(result)
        rows = [row for row, _ in zip(result.rows(), range(ROWS_SHOWN), strict=False)]
        columns = {
            name: [f"{row[name]:.10g}" if place < keys - 1 else shown(row[name]) for row in rows]
            for place, name in enumerate(shows)
        }
        console.print_columns(columns, keys)
        console.print()
        if len(result) > ROWS_SHOWN:
            console.print(f"and {len(result) - ROWS_SHOWN} more rows; --out and --json have all")
        for number, row in enumerate(rows):
            if row.get("reason"):
                console.print(f"row {number}: {row['outcome']}: {row['reason']}", soft_wrap=True)
        outcomes = Counter(result.columns["outcome"].tolist())
        counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())
        console.print(f"{len(result)} rows: {counts}")
        if self.out is not None:
            console.print(f"rows: {self.out}")

    def _columns(self, result: "SweepResult") -> list[str]:
        """What the table has: a metric that no row has is left out, and ticks are shown as time."""
        import numpy as np

        floats = {name: column for name, column in result.columns.items() if column.dtype.kind == "f"}
        absent = {name for name, column in floats.items() if np.isnan(column).all()}
        return [name for name in result.columns if name not in absent | {"intervention_ticks", "reason"}]


def values_of(text: str) -> tuple[str, list[float]]:
    """The path and the values of `path=a:b:n` or `path=v1,v2,...`.

    Raises:
        ValueError: Another form, or a count that is none.
    """
    import math

    import numpy as np

    path, _, values = text.partition("=")
    try:
        if ":" in values:
            first, last, count = values.split(":")
            if not (math.isfinite(float(last) - float(first)) and int(count) <= MAX_ROWS):
                raise ValueError
            numbers: list[float] = np.linspace(float(first), float(last), int(count)).tolist()
        else:
            numbers = [float(value) for value in values.split(",")]
        if not all(map(math.isfinite, numbers)):
            raise ValueError
    except ValueError:
        numbers = []
    if not path or not numbers or len(numbers) > MAX_ROWS:
        message = f"--vary {text}: must be path=a:b:n with n of at least 1, or path=v1,v2,... of finite numbers"
        raise ValueError(message)
    return path, numbers
