"""Sweep: one scene, run for many values of some of its numbers."""

import importlib
import importlib.util
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from os import PathLike
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any, TypeAlias, cast

import msgspec
import numpy as np
import numpy.typing as npt

from haptether import _core
from haptether.bridge.codes import LADDER_STATES
from haptether.bridge.scene.checks import checked_spec
from haptether.bridge.scene.errors import Path, Raw, SceneError, closest, place, shown
from haptether.bridge.scene.load import (
    Checked,
    Leaf,
    leaf_values,
    override_texts,
    path_of,
    typed_scene,
    with_value,
)
from haptether.bridge.scene.research import Research, research_of
from haptether.bridge.scene.run import named_scene
from haptether.bridge.scene.series import embed_recordings
from haptether.bridge.scene.sweeps.design import Values, counts_of, design_of
from haptether.bridge.scene.sweeps.limits import EXACT, LARGEST_EXACT, as_typed, check_rows, out_of_range, whole_number
from haptether.bridge.scene.sweeps.population import Population, with_population
from haptether.bridge.scene.sweeps.scenes import SCENE, SceneChoice, with_scenes
from haptether.bridge.scene.sweeps.table_file import check_suffix, table_file, values_of
from haptether.bridge.scene.tables.session import Scene
from haptether.extras import require
from haptether.private_file import private_file, refuse_link

Array: TypeAlias = npt.NDArray[np.float64]

# Numbers on which no check and no default of another number depends: each value is checked once, by itself. All others
# are checked together, row by row.
_ALONE = re.compile(
    r"run\.seed|operator\.(stiffness|damping|grip_strength_n|legs\.\d+\..*|release\..*|regrasp\..*|tremor\..*)"
    r"|environment\.objects\.\d+\.(contact\.(stiffness|damping)|body\..*)|environment\.pushers\.\d+\.(at_s|force_n.*)"
    r"|coupling\.(position_scale|force_scale|command_.*|changes\.\d+\..*_scale)|slave\.(bandwidth_hz|max_.*|force_sensor\..*)"
    r"|safety\.(velocity_.*|vfc_.*|grasp_.*|hsc_.*|wsc_.*|energy_threshold_j|window|hold_off_s|release_ramp_s)"
)
METRICS = ("outcome", *_core.METRICS, "diverged", "ticks", "reason")
"""Metric columns in order; the rotation columns exist for poses only."""
ENDING = frozenset(METRICS) - frozenset(_core.METRICS)
"""Columns on how a row ended, which every table has."""
OUTCOMES = (
    "complete", "settled", "diverged", "not-released", "never-engaged", "refused",
    *(state for state in LADDER_STATES if state not in {"engaged", "stale"}),
)  # fmt: skip
"""Possible outcomes of a row; from the ladder, the states in which the sides are not coupled."""
MAX_THREADS = 1024
"""Thread limit of a sweep; creating more takes longer than running their rows."""


class Sweep:
    """Scenarios, one per row. Columns: the varied parameters, the outcome, then the metrics.

    `outcome` is complete, settled, diverged, not-released (the run ended before the release), never-engaged, the final
    ladder state if the sides were no longer coupled, or refused for an invalid scenario. A value that was not measured
    is NaN in a column and None in `rows()`, in files and in Polars, never 0. `reason` says why a row was refused or
    diverged.
    """

    def __init__(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        self.columns: Mapping[str, npt.NDArray[Any]] = MappingProxyType(dict(columns))
        """Columns by name, of equal length."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        if name not in self.columns:
            message = f"no column {name!r}: there is {', '.join(self.columns)}"
            raise KeyError(message)
        return self.columns[name]

    def __repr__(self) -> str:
        return f"Sweep({len(self)} rows: {', '.join(self.columns)})"

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield the rows as a dictionary of column values."""
        for values in zip(*map(self.values_of, self.columns), strict=True):
            yield dict(zip(self.columns, values, strict=True))

    def values_of(self, name: str) -> list[Any]:
        """Return a column as raw values, with None for values not measured."""
        return values_of(self.columns, name)

    def save(self, path: str | PathLike[str]) -> None:
        """Write all columns to a `.csv`, `.parquet` or `.npz` file with mode 0600.

        The Parquet file has no metadata; `sweep_to_file` stores scene, design and version there.

        Raises:
            ValueError: The file has another suffix.
            ImportError: Parquet requires PyArrow (`haptether[parquet]`).
            OSError: The file cannot be written, or is a symbolic link.
        """
        path = FilePath(path)
        check_suffix(path)
        refuse_link(path)
        with private_file(path) as file:
            if path.suffix == ".npz":
                arrays: dict[str, Any] = dict(self.columns)
                np.savez_compressed(file, **arrays)
            else:
                table = table_file(path.suffix, file, {})
                table.write(self.columns)
                table.close()

    def to_polars(self) -> Any:  # noqa: ANN401  # polars is not ours to depend on
        """Return the columns as a `polars.DataFrame`.

        Raises:
            ImportError: Polars is not installed.
        """
        require("to_polars", "polars")
        return importlib.import_module("polars").DataFrame({name: self.values_of(name) for name in self.columns})


def sweep(
    scene: Scene | str | PathLike[str],
    grid: Mapping[str, Values] | None = None,
    samples: Mapping[str, Values] | None = None,
    *,
    population: Population | str | PathLike[str] | None = None,
    seed: int = 1,
    ties: Mapping[str, str] | None = None,
    overrides: Iterable[str] = (),
    threads: int | None = None,
    lanes: bool = True,
    progress: Callable[[int], None] | None = None,
    metrics: Iterable[str] | None = None,
) -> Sweep:
    """Run a scene for many values of some of its fields. The same arguments give the same bytes.

    An invalid row is refused with its reason, and the others run. All values of a non-numeric field use the same seeds,
    unless `run.seed` varies.

    Args:
        scene: A `Scene`, the name of a shipped scene, or the path of a TOML file.
        grid: Values by dotted path ("safety.window"); None with `samples`. Every combination is run; the last path
            varies fastest. Values are numbers, strings, booleans, lists or tables, as the field allows. The path
            "scene" takes scenes in the form of the first argument. A duplicate value is run twice, because drawn values
            may repeat; the command line refuses duplicates.
        samples: Values by dotted path, all of one length: row i takes value i of each; None with `grid`.
        population: Source of one hand per sample: a `Population`, one of `population_names()`, or the path of a TOML
            file; by default none.
        seed: Seed of these hands, 0 or more.
        ties: Paths that take the value of a varied path in each row; by default none.
        overrides: Fields to change for all rows, `table.key=value` each.
        threads: Number of threads; by default the number of processors.
        lanes: True to advance rows side by side in one thread; the numbers do not change.
        progress: If given, called repeatedly with the number of finished rows, and at the end with the total.
        metrics: Columns to measure in addition to `outcome`, `diverged`, `ticks` and `reason`; by default all, with
            rotation columns for poses only. The selection does not change values.

    Raises:
        SceneError: The scene is invalid, a path does not exist, no row is valid, or a file is not a population.
        ValueError: Neither or both of `grid` and `samples` are given; values are not given by path; samples differ in
            length; a tie refers to a path that does not vary; a population has no samples, or a field that is also
            sampled; too many rows; an unknown metric; an invalid seed, number of threads or `progress`.
    """
    asked = asked_metrics(metrics)
    overrides = override_texts(overrides)
    _, base = named_scene(scene, overrides)
    grid, samples = with_scenes("grid", grid, overrides), with_scenes("samples", samples, overrides)
    check_rows(*counts_of(grid, samples))
    samples = with_population(base.scene, samples, population, seed)
    if (grid is None) == (samples is None):
        message = "give grid or samples: exactly one of the two"
        raise ValueError(message)
    design = design_of(grid, samples, ties)
    varied = design.columns(0, design.rows)
    threads = thread_count(threads)
    settings = SweepSettings(threads=threads, lanes=lanes, progress=progress, metrics=asked)
    reported = 0

    def report(done: int) -> None:
        nonlocal reported
        reported = done
        if progress is not None:
            progress(done)

    found = measured(base, varied, settings if progress is None else replace(settings, progress=report))
    whole = Sweep({**labelled(varied), **found})
    refuse_empty(whole)
    if reported < design.rows:
        # Report refused rows, and rows finished before the first report was due.
        report(design.rows)
    return whole


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """Settings of how rows are run and measured."""

    threads: int
    lanes: bool = True
    """True to advance rows side by side in one thread."""
    progress: Callable[[int], None] | None = None
    """Called repeatedly with the number of finished rows."""
    metrics: tuple[str, ...] | None = None
    """Columns to measure, in table order; None for all."""

    def __post_init__(self) -> None:
        if not isinstance(self.lanes, bool | np.bool_):
            message = f"lanes = {shown(self.lanes)}: must be true or false"
            raise ValueError(message)
        if self.progress is not None and not callable(self.progress):
            message = (
                f"progress = {shown(self.progress)}: must be a function, called with the number of rows that are done"
            )
            raise ValueError(message)


def thread_count(threads: int | None) -> int:
    """Return the given number of threads, or the number of processors.

    Raises:
        ValueError: Not an integer, below 1, or above `MAX_THREADS`.
    """
    if threads is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return whole_number("threads", threads, 1, MAX_THREADS)


def labelled(varied: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return the varied values as columns of numbers or text."""
    return {
        path: np.array([label(value) for value in column.tolist()]) if column.dtype == object else column
        for path, column in varied.items()
    }


def refuse_empty(rows: Sweep) -> None:
    """Refuse a table without a valid row.

    Raises:
        SceneError: Gives the reason for the first row.
    """
    if not (rows.columns["outcome"] == "refused").all():
        return
    texts = {path: column[0] for path, column in rows.columns.items() if column.dtype.kind == "U"}
    kind = ", ".join(f"{path} = {text}" for path, text in texts.items() if path not in {"outcome", "reason"})
    message = f"{kind or 'row 0'}: {texts['reason']}"
    raise SceneError(message)


def asked_metrics(metrics: Iterable[str] | None) -> tuple[str, ...] | None:
    """Return the requested columns in table order; None for all.

    Raises:
        ValueError: An unknown column, no column, or not a list of names.
    """
    if metrics is None:
        return None
    if not isinstance(metrics, Iterable):
        message = f"metrics = {shown(metrics)}: must be a list of names, one or more of {', '.join(METRICS)}"
        raise ValueError(message)
    names = [metrics] if isinstance(metrics, str) else list(metrics)
    if not names:
        message = f"metrics: none given: must be one or more of {', '.join(METRICS)}"
        raise ValueError(message)
    if unknown := [name for name in names if name not in METRICS]:
        message = f"metrics: {unknown[0]!r}: {closest(str(unknown[0]), METRICS)}"
        raise ValueError(message)
    return tuple(name for name in METRICS if name in names or name in ENDING)


def measured(
    base: Checked, varied: Mapping[str, npt.NDArray[Any]], settings: SweepSettings
) -> dict[str, npt.NDArray[Any]]:
    """Return outcome and metrics of each row; only `outcome` and `reason` if no row is valid."""
    categories = {path: column for path, column in varied.items() if column.dtype == object}
    if not categories:
        return in_order(_metrics([_plan(base, varied)], settings)[0])
    numbers = {path: column for path, column in varied.items() if path not in categories}
    labels = [[label(value) for value in column.tolist()] for column in categories.values()]
    codes: dict[tuple[str, ...], int] = {}
    of_row = np.array([codes.setdefault(kind, len(codes)) for kind in zip(*labels, strict=True)])
    rows = [np.flatnonzero(of_row == code) for code in codes.values()]
    plans = []
    for chosen in rows:
        own = {path: column[chosen] for path, column in numbers.items()}
        try:
            changed = _of_kind(base, {path: column[chosen[0]] for path, column in categories.items()})
            # If no number varies, all rows of a combination are equal, and the seed must be given.
            own = own or {"run.seed": np.full(len(chosen), float(changed.scene.run.seed))}
            plans.append(_plan(changed, own))
        except SceneError as error:
            plans.append(_Plan(base=base, rows=len(chosen), refused=dict.fromkeys(range(len(chosen)), str(error))))
    return in_order(joined(list(zip(rows, _metrics(plans, settings), strict=True)), len(of_row)))


def in_order(metrics: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Sort metrics into the order of files, whichever rows were computed first."""
    return {name: metrics[name] for name in [*METRICS, *metrics] if name in metrics}


_KINDS: dict[tuple[bytes, bytes], Checked] = {}
_MOST_KINDS = 256


def _of_kind(base: Checked, values: Mapping[str, "Raw | SceneChoice"]) -> Checked:
    """Return the scene with changed non-numeric fields; files are relative to the working folder.

    The latest scenes without files are cached for the batches of one sweep.

    Raises:
        SceneError: The scene is invalid.
    """
    if isinstance(chosen := values.get(SCENE), SceneChoice):
        base = chosen.checked
    fields = cast("dict[str, Raw]", {path: value for path, value in values.items() if path != SCENE})
    if not fields:
        return base
    # Keyed by the scene as written, not as resolved, because a preset fills in omitted values.
    key = (msgspec.msgpack.encode(base.scene), msgspec.msgpack.encode(fields))
    if (cached := _KINDS.get(key)) is None:
        changed: Raw = cast("dict[str, Raw]", msgspec.to_builtins(base.scene))
        for path, value in fields.items():
            changed = with_value(changed, path_of(path), value)
        written = typed_scene(changed)
        scene = embed_recordings(written, FilePath())
        cached = Checked(scene, checked_spec(scene))
        if scene == written:
            if len(_KINDS) >= _MOST_KINDS:
                _KINDS.clear()
            _KINDS[key] = cached
    return cached


def shifted(progress: Callable[[int], None] | None, done: int) -> Callable[[int], None] | None:
    """Return a `progress` call with an offset of `done` rows."""
    return None if progress is None else lambda now: progress(done + now)


def joined(
    parts: Sequence[tuple["npt.NDArray[np.intp]", Mapping[str, npt.NDArray[Any]]]], rows: int
) -> dict[str, npt.NDArray[Any]]:
    """Join the columns of parts into columns of all rows; a column missing in a part is not measured there."""
    whole: dict[str, npt.NDArray[Any]] = {}
    for name in dict.fromkeys(name for _, of_these in parts for name in of_these):
        columns = [(chosen, of_these[name]) for chosen, of_these in parts if name in of_these]
        kind = np.result_type(*(column for _, column in columns))
        column = unmeasured(kind, rows)
        for chosen, of_these in columns:
            column[chosen] = of_these
        whole[name] = column
    return whole


def unmeasured(kind: "np.dtype[Any]", rows: int) -> npt.NDArray[Any]:
    """Return a column without measurements: NaN, empty text, or 0 if the type has neither; shape `(rows,)`."""
    return np.full(rows, np.nan if kind.kind == "f" else "" if kind.kind == "U" else 0, kind)


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """Rows with numbers of one scene; invalid rows are separate."""

    base: Checked
    rows: int
    columns: list[tuple[str, Array]] = field(default_factory=list)
    """Columns of the valid rows."""
    built: "Array | slice | None" = None
    """Indices of the valid rows, or None without any."""
    refused: dict[int, str]
    research: Research | None = None


def _plan(base: Checked, varied: Mapping[str, Array]) -> _Plan:
    """Return the rows for the extension to run.

    Raises:
        SceneError: A path does not exist in the scene, or a controller cannot be created.
    """
    research = research_of(base.scene)
    columns, refused = _columns(base, varied)
    rows = len(next(iter(varied.values())))
    if len(refused) == rows:
        return _Plan(base=base, rows=rows, refused=refused)
    built = np.array([row for row in range(rows) if row not in refused]) if refused else slice(None)
    columns = [(path, np.ascontiguousarray(column[built])) for path, column in columns]
    return _Plan(base=base, rows=rows, columns=columns, built=built, refused=refused, research=research)


def _metrics(plans: Sequence[_Plan], settings: SweepSettings) -> list[dict[str, npt.NDArray[Any]]]:
    """Return the metrics of each plan; rows with a common beginning run together across plans."""
    metrics = None if settings.metrics is None else [name for name in settings.metrics if name not in ENDING]
    found: dict[int, Mapping[str, Any]] = {}
    together: list[int] = []
    calls: list[tuple[list[int], Research | None]] = [(together, None)]
    for index, plan in enumerate(plans):
        if not plan.columns:
            continue
        # A Python controller needs a separate call.
        if plan.research is None:
            together.append(index)
        else:
            calls.append(([index], plan.research))
    done = sum(len(plan.refused) for plan in plans)
    for indices, research in calls:
        if indices:
            parts = [(plans[index].base.json, plans[index].columns) for index in indices]
            progress = shifted(settings.progress, done)
            rows = sum(plans[index].rows - len(plans[index].refused) for index in indices)
            # Limit the threads to the number of rows.
            threads = min(settings.threads, rows)
            tables = _core.sweep_scenes(parts, threads, settings.lanes, progress, research, metrics)
            found |= dict(zip(indices, tables, strict=True))
            done += rows
    return [_of_plan(plan, found.get(index)) for index, plan in enumerate(plans)]


def _of_plan(plan: _Plan, found: Mapping[str, Any] | None) -> dict[str, npt.NDArray[Any]]:
    """Expand the result of the extension to all rows of the plan."""
    built, rows, refused = plan.built, plan.rows, plan.refused
    if found is None or built is None:
        return _refused(refused)
    of_rows = {name: _of_rows(name, column, built, rows, refused) for name, column in found.items()}
    if (of_rows["outcome"] == "refused").all():
        return _refused(dict(enumerate(of_rows["reason"].tolist())))
    return of_rows


def _refused(reasons: Mapping[int, str]) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of rows that are all invalid."""
    return {
        "outcome": np.full(len(reasons), "refused"),
        "reason": np.array([reasons[row] for row in range(len(reasons))]),
    }


def label(value: object) -> str:
    """Format a non-numeric value for a column: lists joined by "+", an empty list "none", tables as JSON."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "+".join(map(label, value)) or "none"
    if isinstance(value, Mapping):
        return msgspec.json.encode(value).decode()
    return str(value)


def _of_rows(
    name: str, column: npt.NDArray[Any], built: "Array | slice", rows: int, refused: Mapping[int, str]
) -> npt.NDArray[Any]:
    """Expand a column of the valid rows to all rows."""
    if not refused:
        return column
    if column.dtype.kind == "U":
        texts = {"outcome": dict.fromkeys(refused, "refused"), "reason": refused}[name]
        found = dict(zip(np.arange(rows)[built].tolist(), column.tolist(), strict=True))
        return np.array([texts.get(row, found.get(row)) for row in range(rows)])
    whole = unmeasured(column.dtype, rows)
    whole[built] = column
    return whole


# --------------------------------------------------------------------------------------------------- columns


def sweep_columns(base: Checked, varied: Mapping[str, Array]) -> tuple[list[tuple[str, Array]], dict[int, str]]:
    """Return the numbers of the specification that differ between rows, with their value in each row.

    These are the varied numbers on every axis, and defaults derived from them. The second result gives the reason for
    each invalid row; its column values are undefined.

    Raises:
        SceneError: A path does not exist in the scene, or no row is valid.
    """
    columns, refused = _columns(base, varied)
    if refused and len(refused) == len(next(iter(varied.values()))):
        row, why = min(refused.items())
        message = f"row {row}: {why}"
        raise SceneError(message)
    return columns, refused


def _columns(base: Checked, varied: Mapping[str, Array]) -> tuple[list[tuple[str, Array]], dict[int, str]]:
    """Same as `sweep_columns`, but all rows may be invalid."""
    expected = _leaves_of(base.json)
    columns: dict[str, Array] = {}
    together: dict[Path, Array] = {}
    faults: list[dict[int, str]] = []
    for text, values in varied.items():
        path = path_of(text)
        leaves = _of_parameter(path, expected)
        if _ALONE.fullmatch(".".join(map(str, path))):
            faults.append(out_of_range(path, values))
            columns |= dict.fromkeys(leaves, values)
        else:
            together[path] = values
    if together:
        joint, wrong_rows = _joint_columns(base, expected, together)
        # A varied number wins over its default, which another varied number may change.
        columns = joint | columns
        faults.append(wrong_rows)
    refused = {row: why for found in faults for row, why in found.items()}
    several = [row for row, count in Counter(row for found in faults for row in found).items() if count > 1]
    if several:
        # A row with several errors reports the one that a run of that row reports.
        changes = _Changes(base, tuple(map(path_of, varied)))
        rows = np.column_stack(list(varied.values()))
        for row in several:
            if isinstance(why := changes.of(rows[row].tolist()), str):
                refused[row] = why
    return list(columns.items()), refused


def _joint_columns(
    base: Checked, expected: Mapping[str, Leaf], varied: Mapping[Path, Array]
) -> tuple[dict[str, Array], dict[int, str]]:
    """Return the columns of jointly checked parameters, once per combination of values, and the errors by row."""
    changes = _Changes(base, tuple(varied))
    rows = np.column_stack(list(varied.values()))
    combinations, first_rows, of_row = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    own = [leaf for path in varied for leaf in _of_parameter(path, expected)]
    columns = {leaf: np.full(len(combinations), _number(leaf, expected[leaf])) for leaf in own}
    of_row = of_row.reshape(-1)
    refused: dict[int, str] = {}  # by combination
    for number, combination in enumerate(combinations.tolist()):
        try:
            found = changes.of(combination)
            if isinstance(found, str):
                refused[number] = found
                continue
            for leaf in found.keys() - expected.keys():
                message = f"{leaf}: a sweep changes numbers, not what the scene consists of"
                raise SceneError(message)
            for leaf in found.keys() - columns.keys():
                columns[leaf] = np.full(len(combinations), _number(leaf, expected[leaf]))
            for leaf, column in columns.items():
                column[number] = _number(leaf, found.get(leaf, expected[leaf]))
        except SceneError as error:
            message = f"row {int(first_rows[number])}: {error}"
            raise SceneError(message) from None
    wrong_rows = {row: refused[number] for row, number in enumerate(of_row.tolist()) if number in refused}
    return {leaf: np.ascontiguousarray(column[of_row]) for leaf, column in columns.items()}, wrong_rows


_MOST_CHANGES = 4096
_LONGEST_KEPT = 1 << 16
"""Largest scene in bytes whose changes are cached."""
_CHANGES: dict[tuple[bytes, tuple[Path, ...], bytes], "dict[str, Leaf] | str"] = {}


class _Changes:
    """Changes of specification leaves caused by values of some paths.

    The latest results are cached, because rows come in batches.

    Args:
        base: Base scene.
        paths: Paths of the values.
    """

    def __init__(self, base: Checked, paths: tuple[Path, ...]) -> None:
        self._raw = cast("dict[str, Raw]", msgspec.to_builtins(base.scene))
        self._expected, self._paths = _leaves_of(base.json), paths
        key = msgspec.msgpack.encode(base.scene)
        self._key = key if len(key) <= _LONGEST_KEPT else None

    def of(self, values: Sequence[float]) -> "dict[str, Leaf] | str":
        """Return the leaves that differ from the base, or the reason why the scene is invalid.

        Raises:
            SceneError: A leaf of the base is missing.
        """
        if self._key is None:
            return self._found(values)
        # Compare bit patterns: -0 is not 0.
        key = (self._key, self._paths, np.asarray(values, dtype=np.float64).tobytes())
        if (kept := _CHANGES.get(key)) is None:
            kept = self._found(values)
            if len(_CHANGES) >= _MOST_CHANGES:
                _CHANGES.clear()
            _CHANGES[key] = kept
        return kept

    def _found(self, values: Sequence[float]) -> "dict[str, Leaf] | str":
        changed = self._raw
        try:
            for path, value in zip(self._paths, values, strict=True):
                changed = cast("dict[str, Raw]", with_value(changed, path, as_typed(value)))
            leaves = dict(leaf_values(checked_spec(typed_scene(changed))))
        except SceneError as error:
            return str(error)
        if gone := self._expected.keys() - leaves.keys():
            message = f"{min(gone)}: a sweep changes numbers, not what the scene consists of"
            raise SceneError(message)
        return {
            leaf: seen for leaf, seen in leaves.items() if leaf not in self._expected or seen != self._expected[leaf]
        }


@lru_cache(maxsize=8)
def _leaves_of(json: bytes) -> Mapping[str, Leaf]:
    """Return the leaves of a JSON specification."""
    return MappingProxyType(dict(leaf_values(msgspec.json.decode(json))))


def _number(path: str, leaf: Leaf) -> float:
    if leaf is None:
        message = f"{path}: the scene leaves it out; give it a value in the scene's file before varying it"
        raise SceneError(message)
    if isinstance(leaf, bool) or not isinstance(leaf, int | float):
        message = f"{path} = {shown(leaf)}: a sweep of numbers cannot change it: set it for all rows"
        raise SceneError(message)
    if isinstance(leaf, int) and leaf > LARGEST_EXACT:
        message = f"{path} = {leaf}: must be {EXACT}"
        raise SceneError(message)
    return float(leaf)


def _of_parameter(path: Path, leaves: Mapping[str, Leaf]) -> list[str]:
    """Return the specification numbers of a path: itself, or one for every axis."""
    text = ".".join(map(str, path))
    axis = f"{text}."
    found = [leaf for leaf in leaves if leaf == text or (leaf.startswith(axis) and leaf[len(axis) :].isdecimal())]
    if not found:
        message = f"{place(path)}: the scene has no such part; add it to the scene's file before varying it"
        raise SceneError(message)
    for leaf in found:
        _number(leaf, leaves[leaf])
    return found
