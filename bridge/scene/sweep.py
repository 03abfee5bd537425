"""One scene, run for many values of some of its numbers."""

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

# Numbers on which neither a check nor a default of another number depends: each value is checked once, by itself.
# All others are checked together, row by row.
_ALONE = re.compile(
    r"run\.seed|operator\.(stiffness|damping|grip_strength_n|legs\.\d+\..*|release\..*|regrasp\..*|tremor\..*)"
    r"|environment\.objects\.\d+\.(contact\.(stiffness|damping)|body\..*)|environment\.pushers\.\d+\.(at_s|force_n.*)"
    r"|coupling\.(position_scale|force_scale|command_.*|changes\.\d+\..*_scale)|slave\.(bandwidth_hz|max_.*|force_sensor\..*)"
    r"|safety\.(velocity_.*|vfc_.*|grasp_.*|hsc_.*|wsc_.*|energy_threshold_j|window|hold_off_s|release_ramp_s)"
)
METRICS = ("outcome", *_core.METRICS, "diverged", "ticks", "reason")
"""Columns of what is measured, in their order; a scene of poses has those of rotation."""
ENDING = frozenset(METRICS) - frozenset(_core.METRICS)
"""Those of how a row ended, which every table has."""
OUTCOMES = (
    "complete", "settled", "diverged", "not-released", "never-engaged", "refused",
    *(state for state in LADDER_STATES if state not in {"engaged", "stale"}),
)  # fmt: skip
"""How a row may have ended: of the ladder, the states in which the two are coupled no more."""
MAX_THREADS = 1024
"""Of a sweep: more take longer to be made than the rows that they run."""


class Sweep:
    """Scenarios, one a row: the parameters that were varied, then how each ended and the metrics, as columns.

    `outcome` is complete, settled, diverged, not-released (the run ended before the release), never-engaged, the state
    of the ladder where the two were coupled no more at the end, or refused for a scenario that cannot be built. What
    was not measured is NaN in a column and none in `rows()`, in files and in Polars: never 0. `reason` says why a row
    was refused or diverged.
    """

    def __init__(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        self.columns: Mapping[str, npt.NDArray[Any]] = MappingProxyType(dict(columns))
        """Columns by name, all of one length."""

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
        """The rows, each a value per column."""
        for values in zip(*map(self.values_of, self.columns), strict=True):
            yield dict(zip(self.columns, values, strict=True))

    def values_of(self, name: str) -> list[Any]:
        """A column as raw values, none for what was not measured."""
        return values_of(self.columns, name)

    def save(self, path: str | PathLike[str]) -> None:
        """Writes all columns to a `.csv`, `.parquet` or `.npz` file, for its owner alone.

        Parquet has no metadata; `sweep_to_file` leaves scene, design and version there.

        Raises:
            ValueError: Another suffix.
            ImportError: Parquet without PyArrow (`haptether[parquet]`).
            OSError: The file cannot be written; a symbolic link.
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
        """The columns as a `polars.DataFrame`.

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
    """Runs a scene for many values of some of its fields. The same arguments yield the same bytes.

    A row that cannot be built is refused, with its reason, and the others are run. Of a field that is no number all
    values have the same seeds, unless `run.seed` varies.

    Args:
        scene: A `Scene`, the name of one that comes with Haptether, or the path of a TOML file.
        grid: Values by dotted path ("safety.window"): every combination is run, the last path varies fastest. Values
            are numbers, or whatever else the field takes: strings, booleans, lists, tables. Of the path "scene" they
            are scenes, given as the first is. A value that is there twice is run twice, as what was drawn may be; the
            command line, where values are typed, refuses it.
        samples: Values by dotted path, all of one length: row i takes the value i of each.
        population: As many hands as there are samples, drawn of a `Population`, of one of `population_names()` or of
            the path of a TOML file.
        seed: Of these hands, 0 or more.
        ties: Paths that take, in each row, the value of a path that varies.
        overrides: Fields to change for all rows, `table.key=value` each.
        threads: How many threads; by default as many as there are processors.
        lanes: Whether rows may be advanced side by side in one thread; the numbers are the same.
        progress: Called from time to time with the number of rows that are done, and at the end with that of all.
        metrics: Columns to measure, beside how each row ended (`outcome`, `diverged`, `ticks`, `reason`); by default
            all, those of rotation for poses only. Each has the values that it has beside all others.

    Raises:
        SceneError: A scene that cannot be built, a path that it does not have, no row that can be built, or a file that
            is no population.
        ValueError: Neither or both of `grid` and `samples`, no values by path, samples of different lengths, a tie to
            what does not vary, a population without samples, or one whose field is sampled, too; too many rows; a
            metric that there is not; a seed, a number of threads or a `progress` that is none.
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
        # What is over before a report is due, and rows that were refused.
        report(design.rows)
    return whole


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """How rows are run, and what is measured of them."""

    threads: int
    """How many threads."""
    lanes: bool = True
    """Whether rows may be advanced side by side in one thread."""
    progress: Callable[[int], None] | None = None
    """Called from time to time with the number of rows that are done."""
    metrics: tuple[str, ...] | None = None
    """Columns to measure, in the order of tables; none for all."""

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
    """So many threads, or as many as there are processors.

    Raises:
        ValueError: No whole number, fewer than 1, or more than `MAX_THREADS`.
    """
    if threads is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return whole_number("threads", threads, 1, MAX_THREADS)


def labelled(varied: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """What varies as columns of numbers and of text."""
    return {
        path: np.array([label(value) for value in column.tolist()]) if column.dtype == object else column
        for path, column in varied.items()
    }


def refuse_empty(rows: Sweep) -> None:
    """Refuses a table without a row that can be built.

    Raises:
        SceneError: Why the first cannot.
    """
    if not (rows.columns["outcome"] == "refused").all():
        return
    texts = {path: column[0] for path, column in rows.columns.items() if column.dtype.kind == "U"}
    kind = ", ".join(f"{path} = {text}" for path, text in texts.items() if path not in {"outcome", "reason"})
    message = f"{kind or 'row 0'}: {texts['reason']}"
    raise SceneError(message)


def asked_metrics(metrics: Iterable[str] | None) -> tuple[str, ...] | None:
    """The columns that are asked for, in the order of tables; none for all.

    Raises:
        ValueError: A column that there is not, none at all, or what is no list of names.
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
    """The outcome and the metrics of each row; of rows of which none can be built only `outcome` and `reason`."""
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
            # Where no number varies all rows of a combination are alike, and the seed has to be given.
            own = own or {"run.seed": np.full(len(chosen), float(changed.scene.run.seed))}
            plans.append(_plan(changed, own))
        except SceneError as error:
            plans.append(_Plan(base=base, rows=len(chosen), refused=dict.fromkeys(range(len(chosen)), str(error))))
    return in_order(joined(list(zip(rows, _metrics(plans, settings), strict=True)), len(of_row)))


def in_order(metrics: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Metrics in the one order that files have, whichever rows were computed first."""
    return {name: metrics[name] for name in [*METRICS, *metrics] if name in metrics}


_KINDS: dict[tuple[bytes, bytes], Checked] = {}
_MOST_KINDS = 256


def _of_kind(base: Checked, values: Mapping[str, "Raw | SceneChoice"]) -> Checked:
    """The scene with what is no number changed; files are relative to the working folder.

    The last ones that name no file are cached, for the batches of one sweep.

    Raises:
        SceneError: A scene that cannot be built.
    """
    if isinstance(chosen := values.get(SCENE), SceneChoice):
        base = chosen.checked
    fields = cast("dict[str, Raw]", {path: value for path, value in values.items() if path != SCENE})
    if not fields:
        return base
    # By the scene as it was written, and not as it is resolved: a preset fills in what was left out.
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
    """A call of `progress` that counts what is done from `done` rows on."""
    return None if progress is None else lambda now: progress(done + now)


def joined(
    parts: Sequence[tuple["npt.NDArray[np.intp]", Mapping[str, npt.NDArray[Any]]]], rows: int
) -> dict[str, npt.NDArray[Any]]:
    """Columns of all rows from those of some of them; what a part does not have is not measured."""
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
    """A column in which nothing was measured: NaN, empty text, or 0 where a type has neither; shape `(rows,)`."""
    return np.full(rows, np.nan if kind.kind == "f" else "" if kind.kind == "U" else 0, kind)


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """Rows of numbers of one scene, those that cannot be built set apart."""

    base: Checked
    rows: int
    columns: list[tuple[str, Array]] = field(default_factory=list)
    """Of the rows that can be built."""
    built: "Array | slice | None" = None
    """Which rows these are; none where none can."""
    refused: dict[int, str]
    research: Research | None = None


def _plan(base: Checked, varied: Mapping[str, Array]) -> _Plan:
    """What the extension is to run.

    Raises:
        SceneError: A path that the scene does not have, or a controller that cannot be made.
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
    """What is measured of the rows of each plan; rows that begin alike are run together, whichever plan they are of."""
    metrics = None if settings.metrics is None else [name for name in settings.metrics if name not in ENDING]
    found: dict[int, Mapping[str, Any]] = {}
    together: list[int] = []
    calls: list[tuple[list[int], Research | None]] = [(together, None)]
    for index, plan in enumerate(plans):
        if not plan.columns:
            continue
        # A controller in Python has a call of its own.
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
            # No more threads than rows.
            threads = min(settings.threads, rows)
            tables = _core.sweep_scenes(parts, threads, settings.lanes, progress, research, metrics)
            found |= dict(zip(indices, tables, strict=True))
            done += rows
    return [_of_plan(plan, found.get(index)) for index, plan in enumerate(plans)]


def _of_plan(plan: _Plan, found: Mapping[str, Any] | None) -> dict[str, npt.NDArray[Any]]:
    """Its rows in full, from what the extension has found."""
    built, rows, refused = plan.built, plan.rows, plan.refused
    if found is None or built is None:
        return _refused(refused)
    of_rows = {name: _of_rows(name, column, built, rows, refused) for name, column in found.items()}
    if (of_rows["outcome"] == "refused").all():
        return _refused(dict(enumerate(of_rows["reason"].tolist())))
    return of_rows


def _refused(reasons: Mapping[int, str]) -> dict[str, npt.NDArray[Any]]:
    """The columns of rows none of which can be built."""
    return {
        "outcome": np.full(len(reasons), "refused"),
        "reason": np.array([reasons[row] for row in range(len(reasons))]),
    }


def label(value: object) -> str:
    """What a column says of a value that is no number: lists joined by "+", an empty one "none", tables as JSON."""
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
    """A column of the rows that were built as one of all rows."""
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
    """The numbers of the specification that differ between rows, with their value in each row.

    These are the varied ones, on every axis, and the defaults that follow from them. With them, why rows cannot be
    built, by their number; what stands in their columns counts for nothing.

    Raises:
        SceneError: A path that the scene does not have, or no row that can be built.
    """
    columns, refused = _columns(base, varied)
    if refused and len(refused) == len(next(iter(varied.values()))):
        row, why = min(refused.items())
        message = f"row {row}: {why}"
        raise SceneError(message)
    return columns, refused


def _columns(base: Checked, varied: Mapping[str, Array]) -> tuple[list[tuple[str, Array]], dict[int, str]]:
    """As `sweep_columns`, also of rows none of which can be built."""
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
        columns |= joint
        faults.append(wrong_rows)
    refused = {row: why for found in faults for row, why in found.items()}
    several = [row for row, count in Counter(row for found in faults for row in found).items() if count > 1]
    if several:
        # A row with several faults names the one that a run of that row names.
        changes = _Changes(base, tuple(map(path_of, varied)))
        rows = np.column_stack(list(varied.values()))
        for row in several:
            if isinstance(why := changes.of(rows[row].tolist()), str):
                refused[row] = why
    return list(columns.items()), refused


def _joint_columns(
    base: Checked, expected: Mapping[str, Leaf], varied: Mapping[Path, Array]
) -> tuple[dict[str, Array], dict[int, str]]:
    """Columns of parameters that are checked together, once per combination of their values; what is wrong by row."""
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
"""Bytes of a scene whose changes are kept."""
_CHANGES: dict[tuple[bytes, tuple[Path, ...], bytes], "dict[str, Leaf] | str"] = {}


class _Changes:
    """What values of some paths change in the leaves of a specification; the last are kept, for rows come by batch.

    Args:
        base: The scene that is changed.
        paths: Of the values.
    """

    def __init__(self, base: Checked, paths: tuple[Path, ...]) -> None:
        self._raw = cast("dict[str, Raw]", msgspec.to_builtins(base.scene))
        self._expected, self._paths = _leaves_of(base.json), paths
        key = msgspec.msgpack.encode(base.scene)
        self._key = key if len(key) <= _LONGEST_KEPT else None

    def of(self, values: Sequence[float]) -> "dict[str, Leaf] | str":
        """The leaves that are not those of the base; or why there is no such scene.

        Raises:
            SceneError: A leaf of the base is gone.
        """
        if self._key is None:
            return self._found(values)
        # By their bits: -0 is not 0.
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
    """The leaves of a specification as JSON."""
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
    """The numbers of the specification that a path means: itself, or one for every axis."""
    text = ".".join(map(str, path))
    axis = f"{text}."
    found = [leaf for leaf in leaves if leaf == text or (leaf.startswith(axis) and leaf[len(axis) :].isdecimal())]
    if not found:
        message = f"{place(path)}: the scene has no such part; add it to the scene's file before varying it"
        raise SceneError(message)
    for leaf in found:
        _number(leaf, leaves[leaf])
    return found
