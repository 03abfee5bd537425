"""`haptether sweep`."""

import contextlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from haptether.cli.scene.varied import count_of, drawn_law, spelled, values_of
from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import numpy as np
    import numpy.typing as npt

    from haptether.bridge import RowReason, Scene, StoredSweep
    from haptether.bridge import Sweep as SweepResult
    from haptether.bridge.scene.sweeps.design import Design
    from haptether.bridge.scene.sweeps.laws import SampleLaw
    from haptether.cli.shared.screen import Screen
    from haptether.studies import SummaryRow

ROWS_SHOWN = 20
SEED = "run.seed"
FAILED_ROWS = frozenset({"refused", "diverged", "never-engaged"})
"""Outcomes with which `haptether simulate` exits with 1 or 2."""


@dataclass(frozen=True, kw_only=True)
class Sweep(PictureOptions):
    """Run a scene for many values of some of its fields, every combination once.

    scene=A.toml,"B,1.toml" are whole scenes; --set changes each of them. A range a:b:n is n values from a to b, both
    included. A list is v1,v2,... of numbers or of other values of the field, as in --set (none is an empty list). The
    last path varies fastest. --samples runs each combination for so many seeds and draws, the same for all
    combinations. Prints the first rows; --out and --json have all. Exit status 2: the scene, or every row of it, is
    invalid; 1: every row was refused, diverged or never engaged.

    The outcome of a row is complete, settled, diverged, not-released (it ended before the release), never-engaged, or
    refused (an invalid scene: the reason is printed). If the sides were no longer coupled at the end, it is the state
    of the ladder. A value that was not measured is - here, null in JSON, empty in CSV and NaN in .npz: never 0.

    Examples:

    haptether sweep remote_push --vary link.forward.delay_s=0.01:0.1:10 --vary safety.window=50,100,200 --out push.csv

    haptether sweep remote_push --vary link.forward.delay_s=0.02:0.1:9 --vary run.seed=1,2,3,4,5 --plot delay.pdf

    haptether sweep remote_push --vary link.forward.delay_s=0.02:0.3:29 --samples 100 --out delay.csv --resume

    haptether sweep remote_push --vary 'safety.controllers=none,[hsc]' --samples 9 --draw operator.damping=normal:9:1

    haptether sweep remote_push --vary link.forward.delay_s=0.02:0.2:10 --samples 64 --population stylus-arm

    haptether sweep remote_push --vary link.forward.delay_s=0.02:0.2:10 --tie link.backward.delay_s --plot delay.png

    haptether sweep remote_push --vary scene=remote_push,my/scene.toml --samples 30 --summary peak_device_force

    haptether sweep remote_push --vary run.seed=1:1000:1000 --metrics max_ejection_velocity,false_trips --out a.csv

    haptether sweep remote_push --vary link.forward.delay_s=0.02:0.1:9 --style paper --plot paper.pdf --latex paper.tex

    haptether sweep paper_wall --vary environment.objects.0.contact.stiffness=200:800:7 --set 'safety.controllers=[hsc]'
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped scene, or path of a TOML file."""
    vary: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="PATH=A:B:N|V1,V2"),
    ] = ()
    """Paths and values to vary; may be given often."""
    tie: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="PATH[=PATH]")] = ()
    """A field that takes the values of a varied field: the second path, or the field of the same name."""
    samples: int | None = None
    """Number of samples of each combination; they cover all --draw, and run.seed unless it varies."""
    draw: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="PATH=LAW:A:B")] = ()
    """Law of a field in each sample: uniform:a:b, loguniform:a:b, normal:mean:deviation, lognormal:mean:deviation,
    quantiles:p=v:p=v (linear between them) or measured:FILE.csv:COLUMN; may be given often."""
    population: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE.toml")] = None
    """A population of hands; each sample draws one: stiffness, damping and other fields of [operator] that both the
    population and the scene have. Names: haptether list; docs/populations.md."""
    seed: int | None = None
    """Seed of the draws, 0 or more; by default 1."""
    sobol: bool = False
    """Draw a scrambled Sobol sequence instead of independent numbers: means over many samples settle sooner, best with
    a power of two of them. Needs SciPy."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="TABLE.KEY=VALUE"),
    ] = ()
    """Change a field in all rows; may be given often."""
    metrics: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="METRIC,METRIC")] = ()
    """Measure only these columns, beside the outcome of each row; names are those of the columns of --out. By default
    all. May be given often."""
    threads: int | None = None
    """Number of threads; by default the number of processors."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write all rows as JSON; - for standard output."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.csv|FILE.parquet|FILE.npz")] = None
    """Write all rows as CSV, as Parquet or as NumPy arrays. FILE.partial holds them while the sweep runs."""
    resume: bool = False
    """Continue with the kept rows of an interrupted sweep; all other options as before."""
    engine: Literal["local", "dask"] = "local"
    """Where rows are computed, with --out: by threads here, or by the workers of a Dask cluster."""
    address: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Address of the cluster's scheduler, whose workers have this version; by default worker processes on this
    machine."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw the metrics as .png, .pdf or .svg: over one path as lines, with 95 % bands where run.seed varies, too; over
    two paths as maps."""

    latex: Annotated[Path | None, tyro.conf.arg(metavar="FILE.tex")] = None
    """Write the mean of each combination with its 95 % interval as a LaTeX table, of --summary or of what --plot draws,
    and the picture of --plot as a figure; captions have the command, the version and the sources to cite."""
    summary: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="METRIC|CONDITION ...")] = None
    """Summary of the samples of each combination, with 95 %: metrics, or conditions: 'max_ejection_velocity>0.5'."""
    against: Annotated[str | None, tyro.conf.arg(metavar="PATH=VALUE")] = None
    """With --summary: each combination minus the combination with this value, sample by sample:
    safety.controllers=none."""

    def run(self) -> int:
        """Run all rows."""
        from haptether import __version__
        from haptether.bridge.scene.labels import labels_of
        from haptether.bridge.scene.sweep import labelled
        from haptether.bridge.scene.sweeps.design import design_of
        from haptether.bridge.scene.sweeps.scenes import with_scenes
        from haptether.cli.shared.controller_time import controller_timed
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.picture import asked_picture
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units
        from haptether.view.figures.sweep import check_varied, draw_sweep
        from haptether.view.style.figure import write_figure

        self._check_files()
        collect = any(each is not None for each in (self.json, self.plot, self.latex)) or bool(self.summary)
        self._check_rows(collect=collect)
        varied, ties = self._varied()
        varied = dict(with_scenes("--vary", varied, self.set) or {})
        drawn = self._drawn(varied)
        design = design_of(varied, drawn, ties)
        self._check_columns(design)
        paths = [*varied, *([SEED] if self.samples is not None and SEED not in varied else [])]
        if self.plot is not None:
            check_varied(paths, labelled({**design.factors, **design.samples}))
        picture = asked_picture(self.plot, self)
        console = screen(self.json)
        ask_units(console, *self._numbers({**varied, **drawn}, ties))
        with controller_timed(console, here=self.engine == "local"):
            whole, stored = self._run_rows(design, {"grid": varied, "samples": drawn, "ties": ties}, collect=collect)
        shown = whole if stored is None else stored.head
        assert shown is not None, "a sweep without a file is in memory"
        summary = self._summarised(console, whole, [path for path in design.factors if path != SEED])
        if self.json is not None and whole is not None:
            report = {"scene": self.scene, "version": __version__, "rows": list(whole.rows())}
            write_report(self.json, report | ({"summary": summary} if summary else {}))
        self._report(console, shown, len(varied) + len(drawn) + len(ties) + 1, stored)
        if picture is not None and whole is not None:
            labels = labels_of(whole.columns)
            write_figure(draw_sweep(self.scene, whole.columns, paths, self.page_columns, labels), picture)
            console.print(f"picture: {picture}")
        if self.latex is not None and whole is not None:
            self._write_latex(whole, summary, [path for path in design.factors if path != SEED], picture)
        outcomes = outcomes_of(shown, stored)
        if outcomes.keys() <= FAILED_ROWS:
            message = f"every row failed: {counted(outcomes)}"
            raise RuntimeError(message)
        return 0

    def _write_latex(
        self, whole: "SweepResult", summary: "tuple[SummaryRow, ...]", by: list[str], picture: Path | None
    ) -> None:
        """Write the summary, by default of the drawn metrics, and the picture, as LaTeX."""
        import numpy as np

        from haptether.bridge import load_scene
        from haptether.cli.shared.repeat import command_line
        from haptether.private_file import write_private
        from haptether.studies import sweep_summary
        from haptether.studies.latex import LatexCaption, latex_figure, latex_table, methods_of, summary_table
        from haptether.view.figures.sweep import METRICS, MOST

        measured = [name for name in METRICS if name in whole.columns and np.isfinite(whole[name].astype(float)).any()]
        head, rows = summary_table(summary or sweep_summary(whole, measured[:MOST], by))
        varied = [
            name for path in by if whole[path].dtype.kind == "U"
            for label in dict.fromkeys(whole[path].tolist()) for name in label.split("+")
        ]  # fmt: skip
        methods = methods_of(load_scene(self.scene, self.set))
        names = (*(name for path, of in methods.items() if path not in by for name in of), *varied)
        title, command = Path(self.scene).stem, command_line("sweep", self)
        of = f"scene {title}, {len(whole)} runs"
        text = (
            f"Means of {of}, with the larger half of their 95 % interval (shares with the interval) where several runs"
            " share a row."
        )
        parts = [latex_table(head, rows, LatexCaption(text, command, names), title)]
        if picture is not None and picture.suffix != ".svg":
            text = f"Metrics of {of}; with 95 % confidence where several runs share a point."
            parts.append(latex_figure(picture, LatexCaption(text, command, names), title, self.page_columns))
        assert self.latex is not None
        write_private(self.latex, "\n".join(parts).encode())

    def _summarised(self, console: "Screen", whole: "SweepResult | None", by: list[str]) -> "tuple[SummaryRow, ...]":
        """Print the summary of each combination if requested, and return it."""
        from haptether.cli.scene.simulate import shown
        from haptether.cli.shared.table import Column, Rows
        from haptether.studies import sweep_summary

        if not self.summary or whole is None:
            return ()
        baseline = self._baseline()
        summary = sweep_summary(whole, self.summary, by, baseline=baseline)

        def interval(pair: tuple[float, float] | None) -> str:
            return "-" if pair is None else f"{pair[0]:.4g} to {pair[1]:.4g}"

        marked = ["diverged"] if any(row.diverged for row in summary) else []
        names = ["rows", *marked, "mean", "95 %", *(["difference", "95 % of it"] if baseline else [])]
        for quantity in self.summary:
            of = quantity if baseline is None else f"{quantity}, difference to {self.against}"
            table = Rows(*by, *(Column(name, numbers=True) for name in names), keys=max(1, len(by)), title=of)
            for row in (row for row in summary if row.quantity == quantity):
                group = [f"{each:.10g}" if isinstance(each, float) else str(each) for each in row.group.values()]
                cells = [str(row.measured), *([str(row.diverged)] if marked else [])]
                cells += [shown(row.mean), interval(row.interval)]
                cells += [shown(row.difference), interval(row.difference_interval)] if baseline else []
                table.add(*group, *cells)
            console.print(table)
        return summary

    def _run_rows(
        self, design: "Design", given: dict[str, Any], *, collect: bool
    ) -> "tuple[SweepResult | None, StoredSweep | None]":
        """Return all rows, or the file that has them."""
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

        from haptether.bridge import load_scene, sweep, sweep_to_file
        from haptether.cli.shared.rate import RateColumn
        from haptether.cli.shared.screen import Screen

        # An invalid scene is refused before a bar begins.
        load_scene(self.scene, self.set)
        bar = Progress(
            BarColumn(), MofNCompleteColumn(), RateColumn(), TimeRemainingColumn(), console=Screen(stderr=True)
        )
        task = bar.add_task("", total=design.rows, start=False)

        def progress(done: int) -> None:
            if not bar.tasks[0].started:
                # Rows of an earlier run do not count in the rate.
                bar.update(task, completed=done)
                bar.reset(task, start=True, completed=done)
            bar.update(task, completed=done)

        whole: SweepResult | None
        stored: StoredSweep | None = None
        with bar:
            if self.out is not None:
                with self._resume_hint(design.rows):
                    stored = sweep_to_file(
                        self.scene,
                        self.out,
                        **given,
                        overrides=self.set,
                        threads=self.threads,
                        resume=self.resume,
                        replace=self.force,
                        collect=collect,
                        engine=self.engine,
                        address=self.address,
                        progress=progress,
                        metrics=self._asked(),
                    )
                whole = stored.whole
            else:
                progress(0)
                whole = sweep(
                    self.scene,
                    samples=design.columns(0, design.rows),
                    overrides=self.set,
                    threads=self.threads,
                    progress=progress,
                    metrics=self._asked(),
                )
            progress(design.rows)
        return whole, stored

    @contextlib.contextmanager
    def _resume_hint(self, rows: int) -> "Iterator[None]":
        """Print at Ctrl-C how many rows a resume would have."""
        from haptether.bridge.scene.sweeps.journal import kept_rows
        from haptether.cli.shared.screen import Screen

        try:
            yield
        except KeyboardInterrupt:
            if self.out is not None and (stored := kept_rows(self.out)):
                Screen(stderr=True).print(
                    f"{stored} of {rows} rows are kept in {self.out}.partial: the same command with --resume goes on",
                    soft_wrap=True,
                )
            raise

    def _varied(self) -> tuple[dict[str, list[Any]], dict[str, str]]:
        """Return the values of each path that varies, and the tied paths with their leaders."""
        from haptether.bridge.scene.sweep import label

        if not self.vary and self.samples is None:
            message = "nothing to vary: give --vary path=a:b:n or path=v1,v2, or --samples"
            raise ValueError(message)
        varied: dict[str, list[Any]] = {}
        for text in self.vary:
            path, values = values_of(text)
            path = spelled(path)
            if path in varied:
                message = f"--vary {path}: given twice: give all its values at once, as {path}=v1,v2"
                raise ValueError(message)
            # Values other than numbers are compared by their label in tables: lists have no hash.
            names = [one if type(one) in {int, float} else label(one) for one in values]
            if len(set(names)) < len(names):
                again = next(one for one, times in Counter(names).items() if times > 1)
                seen = f"{again:.10g}" if isinstance(again, float) else again
                message = f"--vary {path}: {seen} is there more than once"
                raise ValueError(message)
            varied[path] = values
        ties: dict[str, str] = {}
        for text in self.tie:
            path, given, leading = text.partition("=")
            path, leading = spelled(path), spelled(leading) if given else ""
            alike = [each for each in varied if each.rpartition(".")[2] == path.rpartition(".")[2]]
            if not given and len(alike) != 1:
                message = f"--tie {path}: {len(alike)} paths of that name vary: give {path}=PATH"
                raise ValueError(message)
            ties[path] = leading if given else alike[0]
        for path in _fields_of(self.set):
            for option, fields in (("--vary", varied.keys()), ("--tie", ties.keys())):
                if path in fields:
                    message = f"{option} {path}, --set {path}: one field is given twice: leave one of the two out"
                    raise ValueError(message)
        return varied, ties

    def _numbers(self, values: dict[str, Any], ties: dict[str, str]) -> "tuple[list[Scene], list[tuple[str, object]]]":
        """Return the scenes, and for each path the largest number and all values that are not numbers."""
        from haptether.bridge import load_scene
        from haptether.bridge.scene.sweeps.scenes import SCENE

        scenes = [choice.checked.scene for choice in values.get(SCENE, ())] or [load_scene(self.scene, self.set)]
        found: list[tuple[str, object]] = []
        of = {**values, **{path: values[leading] for path, leading in ties.items() if leading in values}}
        for path in of.keys() - {SCENE}:
            numbers = [float(each) for each in of[path] if isinstance(each, int | float)]
            found += [(path, max(numbers, key=abs))] if numbers else []
            found += [(path, each) for each in of[path] if not isinstance(each, int | float)]
        return scenes, sorted(found, key=lambda each: each[0])

    def _drawn(self, varied: dict[str, list[Any]]) -> dict[str, "npt.NDArray[np.float64]"]:
        """Return the samples of each combination."""
        import numpy as np

        from haptether.bridge import load_population, load_scene
        from haptether.bridge.scene.sweeps.laws import generator, sobol_points
        from haptether.bridge.scene.sweeps.population import refuse_both

        self._check_samples()
        if self.samples is None:
            return {}
        laws: dict[str, SampleLaw] = {}
        for path, law in map(drawn_law, self.draw):
            if laws.setdefault(path, law) is not law:
                message = f"--draw {path}: given twice"
                raise ValueError(message)
        for path in _fields_of(self.set):
            if path in laws:
                message = f"--draw {path}, --set {path}: one field is given twice: leave one of the two out"
                raise ValueError(message)
        population = None if self.population is None else load_population(self.population)
        seed = 1 if self.seed is None else self.seed
        points = None
        if self.sobol:
            dimensions = () if population is None else population.dimensions
            points = sobol_points([*laws, *dimensions], self.samples, seed)
            drawn = {path: law.quantile(points[path]) for path, law in laws.items()}
        else:
            drawn = {path: law.draw(generator(seed, path), self.samples) for path, law in laws.items()}
        if population is not None:
            scene = load_scene(self.scene, self.set)
            hands = population.draws(self.samples, seed, scene=scene, points=points)
            refuse_both(hands, [*drawn, *varied, *_fields_of(self.set)])
            drawn |= hands
        if SEED not in varied:
            drawn.setdefault(SEED, np.arange(1.0, self.samples + 1.0))
        for path in drawn:
            if path in varied:
                message = f"--draw {path}: varies by itself"
                raise ValueError(message)
        if not drawn:
            message = (
                f"--samples {self.samples}: nothing is drawn, for {SEED} varies: give --draw or --population, too, or"
                f" leave out --samples or --vary {SEED}"
            )
            raise ValueError(message)
        return drawn

    def _check_files(self) -> None:
        """Refuse files that cannot be written, and options that need another, before a row is run."""
        from haptether.bridge.scene.sweeps.table_file import check_suffix
        from haptether.cli.shared.output import check_distinct, check_target

        check_distinct(json=self.json, out=self.out, plot=self.plot, latex=self.latex)
        check_target(self.json, self.latex, force=self.force)
        # A sweep that --force began also replaces the file when it is resumed.
        check_target(self.out, force=self.force or self.resume)
        if self.out is not None:
            check_suffix(self.out)
        if self.address is not None and self.engine != "dask":
            message = f"--address {self.address}: give --engine dask, too"
            raise ValueError(message)
        if self.out is None and (self.resume or self.engine != "local"):
            option = "--resume" if self.resume else "--engine"
            message = f"{option}: give --out, the file whose rows are kept"
            raise ValueError(message)

    def _check_rows(self, *, collect: bool) -> None:
        """Refuse too many rows, by the given counts, before a value is created."""
        from haptether.bridge.scene.sweeps.limits import check_rows
        from haptether.bridge.scene.sweeps.table_file import STREAMED

        stored = self.out is not None and self.out.suffix in STREAMED and not collect
        check_rows({f"--vary {text}": count_of(text) for text in self.vary}, self.samples, stored=stored)

    def _asked(self) -> tuple[str, ...] | None:
        """Return the measured columns; None for all."""
        from haptether.bridge.scene.sweep import asked_metrics

        names = [name.strip() for text in self.metrics for name in text.split(",")]
        return asked_metrics(names or None)

    def _baseline(self) -> tuple[str, Any] | None:
        """Return the path and value of --against: a value as in --vary, or as in tables."""
        from haptether.bridge import SceneError
        from haptether.bridge.scene.sweep import label

        if self.against is None:
            return None
        path, _, text = self.against.partition("=")
        path, value = path.replace("-", "_"), text
        with contextlib.suppress(ValueError, SceneError):
            _, values = values_of(f"{path}={text}")
            value = values[0] if len(values) == 1 else text
        return path, value if isinstance(value, float) else label(value)

    def _check_columns(self, design: "Design") -> None:
        """Refuse unknown metrics, summaries and pictures before a row is run."""
        from haptether.bridge.scene.sweep import METRICS, labelled
        from haptether.studies.sampled import check_summary, metric_of
        from haptether.view.figures.sweep import METRICS as DRAWN

        asked = self._asked() or METRICS
        for quantity in self.summary or ():
            if (name := metric_of(quantity)) in METRICS and name not in asked:
                message = f"--summary {quantity}: {name} is not measured: name it with --metrics, too"
                raise ValueError(message)
        by = {path: values.tolist() for path, values in labelled(design.factors).items() if path != SEED}
        try:
            check_summary(self.summary or (), asked, labelled(design.columns(0, 1)), by, self._baseline())
        except ValueError as error:
            message = f"--summary {error}" if "baseline: " not in str(error) else str(error)
            raise ValueError(message.replace("baseline: ", "--against: ", 1)) from None
        if self.plot is not None and not set(DRAWN) & set(asked):
            message = f"--plot: nothing to draw: name with --metrics one or more of {', '.join(DRAWN)}"
            raise ValueError(message)

    def _check_samples(self) -> None:
        """Refuse an invalid number of samples or seed, and draws without samples."""
        from haptether.bridge.scene.sweep import thread_count
        from haptether.cli.shared.numbers import check_random_seed

        thread_count(self.threads)
        if self.summary == ():
            message = "--summary: nothing is named: give metrics, or conditions such as 'max_ejection_velocity>0.5'"
            raise ValueError(message)
        if self.against is not None and not self.summary:
            message = "--against: give --summary, what is compared"
            raise ValueError(message)
        if self.samples is not None and self.samples < 1:
            message = f"samples = {self.samples}: must be 1 or more"
            raise ValueError(message)
        for given, option in ((self.draw, "--draw"), (self.population, "--population")):
            if given and self.samples is None:
                message = f"{option}: give --samples, how many are drawn"
                raise ValueError(message)
        if self.seed is not None:
            check_random_seed(self.seed)
        if not self.draw and self.population is None:
            if self.sobol:
                message = "--sobol: give --draw or --population, what is drawn"
                raise ValueError(message)
            if self.seed is not None:
                message = (
                    f"--seed {self.seed}: give --draw or --population, what is drawn; the seed of all runs is"
                    f" --set {SEED}={self.seed}"
                )
                raise ValueError(message)

    def _report(self, console: "Screen", result: "SweepResult", keys: int, stored: "StoredSweep | None" = None) -> None:
        from haptether.cli.scene.simulate import shown

        shows = self._columns(result, stored)
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
        total = len(result) if stored is None else stored.rows
        if total > ROWS_SHOWN:
            console.print(f"and {total - ROWS_SHOWN} more rows; --out and --json have all")
        for line in reason_lines(*(_reasons(result) if stored is None else (stored.reasons, stored.other_reasons))):
            console.print(line, soft_wrap=True)
        console.print(f"{total} rows: {counted(outcomes_of(result, stored))}")
        if stored is not None:
            console.print(f"rows: {stored.path}" + (f", {stored.resumed} kept before" if stored.resumed else ""))

    def _columns(self, result: "SweepResult", stored: "StoredSweep | None") -> list[str]:
        """Return the columns of the table: without metrics that no row has, and with ticks as time."""
        import numpy as np

        floats = {name: column for name, column in result.columns.items() if column.dtype.kind == "f"}
        present = {name for name, column in floats.items() if not np.isnan(column).all()}
        absent = floats.keys() - (present if stored is None else stored.measured)
        if "intervention_s" in result.columns:
            absent |= {"intervention_ticks"}
        return [name for name in result.columns if name not in absent | {"reason"}]


def outcomes_of(result: "SweepResult", stored: "StoredSweep | None") -> Counter[str]:
    """Return how many rows of a sweep ended with each outcome."""
    return Counter(result.columns["outcome"].tolist() if stored is None else stored.outcomes)


def counted(outcomes: Counter[str]) -> str:
    """Return how many rows ended with each outcome, the most frequent first."""
    return ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())


def _reasons(result: "SweepResult") -> "tuple[tuple[RowReason, ...], int]":
    """Return why rows of a sweep in memory were refused or diverged, and the number of rows with other reasons."""
    from haptether.bridge.scene.sweeps.reasons import RowReasons

    found = RowReasons()
    found.add(0, result.columns)
    return found.first, found.others


def reason_lines(reasons: "Iterable[RowReason]", others: int) -> "Iterator[str]":
    """Yield why rows were refused or diverged, each reason once, with its first row."""
    for each in reasons:
        values = ", ".join(
            f"{path} = {value:.10g}" if isinstance(value, float) else f"{path} = {value}"
            for path, value in each.values.items()
        )
        also = f" ({each.rows} rows)" if each.rows > 1 else ""
        yield f"row {each.row}, {values}: {each.outcome}: {each.reason}{also}"
    if others:
        yield f"and {others} more rows with other reasons; --out and --json have all"


def _fields_of(assignments: "Iterable[str]") -> list[str]:
    """Return the fields of `path=value` assignments, as scenes spell them."""
    return [text.partition("=")[0].strip().replace("-", "_") for text in assignments]
