"""`haptether sweep`."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from haptether.bridge import Sweep as SweepResult
    from haptether.cli.shared.screen import Screen

ROWS_SHOWN = 20
MAX_ROWS = 10_000_000
SEED = "run.seed"
RANGE = re.compile(r"[^:,\[{'\"]*:[^:,]*:[^:,]*")


@dataclass(frozen=True, kw_only=True)
class Sweep(PictureOptions):
    """Run a scene for many values of some of its fields, every combination once.

    A range a:b:n is n values from a to b, both included; a list is v1,v2,... of numbers or of whatever else the field
    takes, as --set has it (none is an empty list). The last path varies fastest. --samples runs each combination for so
    many seeds and draws, the same for all combinations. Prints the first rows; --out and --json have all. Exit status 2
    says that the scene cannot be, or no row of it.

    The outcome of a row is complete, settled, diverged, not-released (it ended before the release), never-engaged,
    refused (a scene that cannot be built: the reason is printed), or the state of the ladder where the two were coupled
    no more at the end. What was not measured is - here, null in JSON, empty in CSV and NaN in .npz: never 0.

    Examples:

    haptether sweep remote_push --vary link.forward.delay_s=0.01:0.1:10 --vary safety.window=50,100,200 --out push.csv

    haptether sweep remote_push --vary link.forward.delay_s=0:0.1:11 --vary run.seed=1,2,3,4,5 --plot delay.pdf

    haptether sweep remote_push --vary safety.controllers=none,[hsc] --samples 9 --draw operator.damping=normal:9:1

    haptether sweep remote_push --vary link.forward.delay_s=0.02:0.2:10 --tie link.backward.delay_s --plot delay.png

    haptether sweep paper_wall --vary environment.objects.0.contact.stiffness=200:1000:9 --set safety.controllers=[hsc]
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped scene, or path of a TOML file."""
    vary: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="PATH=A:B:N|V1,V2"),
    ] = ()
    """What varies; may be given often."""
    tie: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="PATH[=PATH]")] = ()
    """A field that takes the values of one that varies: the second path, or the one of the same name."""
    samples: int | None = None
    """How many samples each combination has; of all --draw, and of run.seed unless that varies."""
    draw: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="PATH=LAW:A:B")] = ()
    """What is drawn in each sample: uniform:a:b, loguniform:a:b or normal:mean:deviation; may be given often."""
    seed: int = 1
    """Of what is drawn, 0 or more."""
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
        varied, ties = self._varied()
        columns, rows = self._columns_of(varied)
        picture = None
        if self.plot is not None:
            check_varied(list(varied))
            picture = picture_file(self.plot, self.format)
        bar = Progress(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=Screen(stderr=True))
        with bar:
            task = bar.add_task("", total=rows)
            result = sweep(
                self.scene,
                samples=columns,
                ties=ties,
                overrides=self.set,
                threads=self.threads,
                progress=lambda done: bar.update(task, completed=done),
            )
            bar.update(task, completed=rows)
        console = screen(self.json)
        self._report(console, result, len(columns) + len(ties) + 1)
        if picture is not None:
            drawn = [*varied, *([SEED] if self.samples is not None and SEED not in varied else [])]
            write_figure(draw_sweep(self.scene, result.columns, drawn, self.columns), picture)
            console.print(f"picture: {picture}")
        return 0

    def _varied(self) -> tuple[dict[str, list[Any]], dict[str, str]]:
        """The values of each path that varies, and which path takes whose."""
        if not self.vary and self.samples is None:
            message = "nothing to vary: give --vary path=a:b:n or path=v1,v2, or --samples"
            raise ValueError(message)
        varied: dict[str, list[Any]] = {}
        for text in self.vary:
            path, values = values_of(text)
            if path in varied:
                message = f"--vary {path}: given twice: give all its values at once, as {path}=v1,v2"
                raise ValueError(message)
            varied[path] = values
        ties: dict[str, str] = {}
        for text in self.tie:
            path, given, leading = text.partition("=")
            alike = [each for each in varied if each.rpartition(".")[2] == path.rpartition(".")[2]]
            if not given and len(alike) != 1:
                message = f"--tie {path}: {len(alike)} paths of that name vary: give {path}=PATH"
                raise ValueError(message)
            ties[path] = leading if given else alike[0]
        return varied, ties

    def _columns_of(self, varied: dict[str, list[Any]]) -> tuple[dict[str, list[Any]], int]:
        """All rows: every combination, and in each of them the same samples."""
        from itertools import product
        from math import prod

        import numpy as np

        if self.samples is not None and self.samples < 1:
            message = f"samples = {self.samples}: must be 1 or more"
            raise ValueError(message)
        if self.draw and self.samples is None:
            message = "--draw: give --samples, how many are drawn"
            raise ValueError(message)
        if self.seed < 0:
            message = f"seed = {self.seed}: must be 0 or more"
            raise ValueError(message)
        count = self.samples or 1
        rows = count * prod(len(values) for values in varied.values())
        if rows > MAX_ROWS:
            message = f"{rows} rows: must be at most {MAX_ROWS}"
            raise ValueError(message)
        combinations = list(zip(*product(*varied.values()), strict=True)) if varied else []
        columns: dict[str, list[Any]] = {
            path: [value for value in values for _ in range(count)]
            for path, values in zip(varied, combinations, strict=True)
        }
        drawn = {path: draw_of(law, count, self.seed, path) for path, law in map(law_of, self.draw)}
        if self.samples is not None and SEED not in varied:
            drawn.setdefault(SEED, np.arange(1.0, count + 1.0))
        for path, values in drawn.items():
            if path in columns:
                message = f"--draw {path}: varies by itself"
                raise ValueError(message)
            columns[path] = values.tolist() * (rows // count)
        return columns, rows

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
            name: [
                f"{row[name]:.10g}" if place < keys - 1 and isinstance(row[name], float) else shown(row[name])
                for row in rows
            ]
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


def values_of(text: str) -> tuple[str, list[Any]]:
    """The path and the values of `path=a:b:n` or `path=v1,v2,...`.

    Raises:
        ValueError: Another form, or a count that is none.
        SceneError: What is no number, of a path that is not in the schema or in no form of TOML.
    """
    import math

    import numpy as np

    from haptether.bridge import SceneError

    path, _, values = text.partition("=")
    found: list[Any] = []
    try:
        if RANGE.fullmatch(values):
            first, last, count = values.split(":")
            if not (math.isfinite(float(last) - float(first)) and int(count) <= MAX_ROWS):
                raise ValueError
            found = np.linspace(float(first), float(last), int(count)).tolist()
        else:
            found = [_value_of(path, item) for item in _items(values)]
        if not all(math.isfinite(value) for value in found if isinstance(value, float)):
            raise ValueError
    except SceneError:
        raise
    except ValueError:
        found = []
    if not path or not found or len(found) > MAX_ROWS:
        message = (
            f"--vary {text}: must be path=a:b:n with n of at least 1, or path=v1,v2,... of finite numbers or of what"
            " else the field takes"
        )
        raise ValueError(message)
    return path, found


def _items(text: str) -> list[str]:
    """What commas separate outside of brackets and quotes."""
    items, depth, quoted = [""], 0, ""
    for letter in text:
        if letter == "," and depth == 0 and not quoted:
            items.append("")
            continue
        if letter in "'\"":
            quoted = "" if quoted == letter else quoted or letter
        elif not quoted:
            depth += (letter in "[{") - (letter in "]}")
        items[-1] += letter
    if "" in map(str.strip, items):
        raise ValueError
    return items


def _value_of(path: str, item: str) -> Any:  # noqa: ANN401  # whatever a field takes
    from msgspec import inspect

    from haptether.bridge.scene.errors import types_at
    from haptether.bridge.scene.load import path_of, toml_value

    try:
        return float(item)
    except ValueError:
        if ":" in item and not item.strip().startswith(("[", "{", "'", '"')):
            raise
    steps = path_of(path)
    if item.strip() == "none" and any(isinstance(kind, inspect.VarTupleType) for kind in types_at(steps)):
        return []
    return toml_value(item.strip(), steps)


def law_of(text: str) -> tuple[str, tuple[str, float, float]]:
    """The path and the law of `path=law:a:b`.

    Raises:
        ValueError: Another form, or numbers that the law does not take.
    """
    from math import isfinite

    path, _, law = text.partition("=")
    name, *numbers = law.split(":")
    try:
        first, second = map(float, numbers)
    except ValueError:
        first = second = float("nan")
    holds = {"uniform": first < second, "loguniform": 0.0 < first < second, "normal": second > 0.0}
    if not path or not holds.get(name) or not isfinite(first + second):
        message = (
            f"--draw {text}: must be path=uniform:a:b with a < b, path=loguniform:a:b with 0 < a < b, or"
            " path=normal:mean:deviation with a deviation above 0"
        )
        raise ValueError(message)
    return path, (name, first, second)


def draw_of(law: tuple[str, float, float], count: int, seed: int, path: str) -> "npt.NDArray[np.float64]":
    """So many numbers of a law; each path has its own, the same for the same seed."""
    import numpy as np

    name, first, second = law
    rng = np.random.default_rng([seed, *path.encode()])
    if name == "normal":
        return rng.normal(first, second, count)
    if name == "uniform":
        return rng.uniform(first, second, count)
    return np.asarray(np.exp(rng.uniform(np.log(first), np.log(second), count)), dtype=np.float64)
