"""Sweep to a file: stored in batches, resumable, with memory independent of the number of rows."""

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from dataclasses import replace as replace_fields
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from haptether._core import __version__
from haptether.bridge.scene.errors import SceneError
from haptether.bridge.scene.load import Checked, leaf_values, override_texts
from haptether.bridge.scene.research import controller_names, source_of
from haptether.bridge.scene.run import named_scene
from haptether.bridge.scene.save import scene_toml
from haptether.bridge.scene.sweep import (
    Sweep,
    SweepSettings,
    asked_metrics,
    in_order,
    labelled,
    measured,
    refuse_empty,
    shifted,
    thread_count,
    unmeasured,
)
from haptether.bridge.scene.sweeps.cluster import computed_by_cluster
from haptether.bridge.scene.sweeps.design import Design, Values, counts_of, design_of
from haptether.bridge.scene.sweeps.journal import Journal
from haptether.bridge.scene.sweeps.limits import check_rows
from haptether.bridge.scene.sweeps.population import Population, with_population
from haptether.bridge.scene.sweeps.reasons import RowReason, RowReasons
from haptether.bridge.scene.sweeps.scenes import SCENE, SceneChoice, with_scenes
from haptether.bridge.scene.sweeps.table_file import REQUEST_KEY, STREAMED, check_suffix, table_file
from haptether.bridge.scene.tables.session import Scene
from haptether.private_file import is_stream, refuse_existing, refuse_link

HEAD_ROWS = 20
"""Number of rows of a stored sweep that remain in memory."""
SMALLEST_BATCH, LARGEST_BATCH = 64, 65_536
BATCH_S = 2.0
"""Target duration of a batch in s: the largest loss on a kill, and long compared with the idle time at its end."""
GROWTH = 4
"""Largest growth factor from one batch to the next."""

Metrics: TypeAlias = "dict[str, npt.NDArray[Any]]"


@dataclass(frozen=True, kw_only=True)
class StoredSweep:
    """Sweep whose rows are in a file."""

    path: Path
    rows: int
    resumed: int
    """Rows that an earlier run stored."""
    outcomes: Mapping[str, int]
    """Number of rows per outcome, most frequent first."""
    measured: frozenset[str]
    """Columns with a value in at least one row."""
    reasons: tuple[RowReason, ...] = field(repr=False)
    """First distinct reasons for refused or diverged rows, in row order."""
    other_reasons: int = field(repr=False)
    """Number of rows with another reason."""
    head: Sweep = field(repr=False)
    """First `HEAD_ROWS` rows."""
    whole: Sweep | None = field(repr=False, default=None)
    """All rows, if collected."""


def sweep_to_file(
    scene: Scene | str | PathLike[str],
    path: str | PathLike[str],
    grid: Mapping[str, Values] | None = None,
    samples: Mapping[str, Values] | None = None,
    *,
    population: Population | str | PathLike[str] | None = None,
    seed: int = 1,
    ties: Mapping[str, str] | None = None,
    overrides: Iterable[str] = (),
    threads: int | None = None,
    lanes: bool = True,
    resume: bool = False,
    replace: bool = False,
    collect: bool = False,
    engine: Literal["local", "dask"] = "local",
    address: str | None = None,
    progress: Callable[[int], None] | None = None,
    metrics: Iterable[str] | None = None,
) -> StoredSweep:
    """Run every combination of `grid` with all `samples`, and write a file that does not depend on resumes.

    Batches of rows are kept in the folder `path`.partial until the file is complete. Ctrl-C, a kill or a power loss
    loses at most the running batch. A .csv or .parquet file is written by row group, with constant memory; a .npz file
    is written from all rows at the end. The Parquet metadata holds the version, the scene as TOML and the varied paths.

    Args:
        scene: A `Scene`, the name of a shipped scene, or the path of a TOML file.
        path: Target file, .csv, .parquet or .npz.
        grid: Values by dotted path, as for `sweep`, by default none; the last path varies fastest.
        samples: Values by dotted path, of equal length, by default none; each combination has them all.
        population: Source of one hand per sample, as for `sweep`, by default none; the same in each combination.
        seed: Seed of these hands, 0 or more.
        ties: Paths that take the value of a varied path in each row; by default none.
        overrides: Fields to change for all rows, `table.key=value` each.
        threads: Number of threads; by default the number of processors.
        lanes: True to advance rows side by side in one thread; the numbers do not change.
        resume: True to continue with the rows of an earlier, incomplete run.
        replace: True to replace an existing file.
        collect: True to also return all rows.
        engine: "local" computes rows in threads of this process, "dask" in the workers of a Dask cluster. The file is
            the same.
        address: Scheduler of a cluster, "tcp://host:8786", whose workers have this version; by default worker processes
            on this machine.
        progress: If given, called repeatedly with the number of finished rows, earlier ones included.
        metrics: Columns to measure, as for `sweep`; by default all.

    Raises:
        SceneError: A scene that cannot be built, a path that it does not have, or no row that can be built.
        ValueError: Another suffix; too many rows; rows of an interrupted sweep and not `resume`; a resume of another
            scene, design, version or other metrics, with what differs; a tie to what does not vary; a metric that there
            is not; a seed, a number of threads or a `progress` that is none.
        ImportError: Parquet without PyArrow, or the engine dask without dask.distributed.
        OSError: A file cannot be written; a symbolic link; as `FileExistsError`, one that is there.
    """
    path = Path(path)
    if engine not in {"local", "dask"} or (address is not None and engine != "dask"):
        message = f"engine = {engine!r}, address = {address!r}: must be local without an address, or dask"
        raise ValueError(message)
    check_suffix(path)
    asked = asked_metrics(metrics)
    refuse_link(path)
    if is_stream(path):
        message = f"{path}: is a pipe or a device, must be a file"
        raise ValueError(message)
    overrides = override_texts(overrides)
    name, base = named_scene(scene, overrides)
    grid, samples = with_scenes("grid", grid, overrides), with_scenes("samples", samples, overrides)
    check_rows(*counts_of(grid, samples), stored=path.suffix in STREAMED and not collect)
    design = design_of(grid, with_population(base.scene, samples, population, seed), ties)
    settings = SweepSettings(threads=thread_count(threads), lanes=lanes, progress=progress, metrics=asked)
    request = {
        "version": __version__,
        "scene": name,
        "rows": design.rows,
        **design.described(),
        "specification": json.loads(base.json),
    }
    if asked is not None:
        request["metrics"] = list(asked)
    if scenes := _scenes(design):
        request["scenes"] = {each.name: json.loads(each.checked.json) for each in scenes}
    if (sources := _controller_sources(base, design)) is not None:
        request["controllers in Python"] = sources
    if not resume and not replace and not Journal.is_begun(path):
        refuse_existing(path)
    journal = Journal(path, request, resume=resume)
    try:
        resumed = journal.done
        gaps, report = journal.missing(design.rows), shifted(progress, resumed)
        if progress is not None:
            progress(resumed)
        if engine == "dask":
            batches = computed_by_cluster(base, design, gaps, address, settings, progress=report)
        else:
            batches = computed(base, design, gaps, settings, report)
        for first, rows in batches:
            journal.add(first, rows)
        stored = _written(journal, base, design, request, resumed=resumed, collect=collect)
        journal.remove()
    finally:
        journal.close()
    return stored


def _scenes(design: Design) -> list[SceneChoice]:
    """Return the distinct scenes of a design."""
    levels = [values.tolist() for values in ({**design.factors, **design.samples}.get(SCENE),) if values is not None]
    return list({choice.name: choice for choice in (levels[0] if levels else ())}.values())


def _controller_sources(base: Checked, design: Design) -> dict[str, str] | None:
    """Return the current digests of the Python controllers of a sweep; rows of a changed controller are other rows."""
    tables = [scene.safety.research for scene in (base.scene, *(each.checked.scene for each in _scenes(design)))]
    names = {table.controller for table in tables if table is not None}
    for path, values in design.factors.items():
        if path.partition(".")[0] == "safety" and values.dtype == object:
            leaves = {leaf for value in values.tolist() for _, leaf in leaf_values(value)}
            names |= {name for name in controller_names() if name in leaves}
    return {name: source_of(name) for name in sorted(names)} or None


def computed(
    base: Checked,
    design: Design,
    gaps: Iterable[tuple[int, int]],
    settings: SweepSettings,
    progress: Callable[[int], None] | None,
) -> Iterator[tuple[int, Metrics]]:
    """Yield first row and metrics of the batches that fill the gaps, in order, computed on this machine."""
    size, done = SMALLEST_BATCH, 0
    for start, stop in gaps:
        first = start
        while first < stop:
            end = min(design.end_of_batch(first, size), stop)
            start_s = time.perf_counter()
            counted = replace_fields(settings, progress=shifted(progress, done))
            metrics = measured(base, design.columns(first, end), counted)
            elapsed_s = max(time.perf_counter() - start_s, 1e-9)
            yield first, metrics
            done += end - first
            if progress is not None:
                progress(done)
            wanted = int(BATCH_S * (end - first) / elapsed_s)
            size = max(SMALLEST_BATCH, min(wanted, GROWTH * size, LARGEST_BATCH))
            first = end


def _written(
    journal: Journal, base: Checked, design: Design, request: Mapping[str, Any], *, resumed: int, collect: bool
) -> StoredSweep:
    """Write the file of all rows from the batches of the journal."""
    suffix = journal.path.suffix
    names = journal.types()
    if "ticks" not in names:
        _, metrics = next(journal.batches())
        try:
            refuse_empty(Sweep({**labelled(design.columns(0, len(metrics["outcome"]))), **metrics}))
        except SceneError:
            # No valid rows exist to resume.
            journal.remove()
            raise
    outcomes: Counter[str] = Counter()
    measured_columns: set[str] = set()
    reasons = RowReasons()
    head: Sweep | None = None
    parts: list[Metrics] = []
    metadata = {
        "haptether.version": str(request["version"]),
        "haptether.scene": scene_toml(base.scene),
        REQUEST_KEY: msgspec.json.encode(dict(request)).decode(),
    }
    with journal.replacing(f"table{suffix}", journal.path) as file:
        table = table_file(suffix, file, metadata) if suffix in STREAMED else None
        for first, metrics in journal.batches():
            rows = len(metrics["outcome"])
            columns = {**labelled(design.columns(first, first + rows)), **_with_all(metrics, names, rows)}
            outcomes.update(metrics["outcome"].tolist())
            reasons.add(first, columns)
            measured_columns |= {
                name for name, column in columns.items() if column.dtype.kind != "f" or not np.isnan(column).all()
            }
            if head is None or len(head) < HEAD_ROWS:
                before = [] if head is None else [head.columns]
                head = Sweep({name: column[:HEAD_ROWS] for name, column in _stacked([*before, columns]).items()})
            if table is not None:
                table.write(columns)
            if collect or table is None:
                parts.append(columns)
        if table is not None:
            table.close()
        whole = Sweep(_stacked(parts)) if parts else None
        if table is None and whole is not None:
            arrays: dict[str, Any] = dict(whole.columns)
            np.savez_compressed(file, **arrays)
    assert head is not None, "a design has at least one row"
    return StoredSweep(
        path=journal.path, rows=design.rows, resumed=resumed, outcomes=dict(outcomes.most_common()),
        measured=frozenset(measured_columns), reasons=reasons.first, other_reasons=reasons.others, head=head,
        whole=whole if collect else None,
    )  # fmt: skip


def _with_all(metrics: Metrics, names: Mapping[str, np.dtype[Any]], rows: int) -> Metrics:
    """Add unmeasured columns to the metrics of a batch for the metrics that it lacks."""
    absent = {name: unmeasured(kind, rows) for name, kind in names.items() if name not in metrics}
    return in_order({**metrics, **absent})


def _stacked(parts: list[Any]) -> Metrics:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
