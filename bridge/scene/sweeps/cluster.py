"""Engine that computes the rows of a sweep on a Dask cluster; a batch is retried if its worker is lost."""

import contextlib
import importlib
import importlib.util
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

import numpy.typing as npt

from haptether.bridge.scene.load import Checked
from haptether.bridge.scene.research import ControllerTime, count_controller_time, thread_controller_time
from haptether.bridge.scene.sweep import SweepSettings, measured
from haptether.bridge.scene.sweeps.design import Design
from haptether.child import safe_children
from haptether.extras import require

Metrics: TypeAlias = "dict[str, npt.NDArray[Any]]"

BATCH = 256
"""Rows per task: seconds of work, which limits the loss of a worker."""
AHEAD = 4
"""Tasks submitted per worker at a time, so that memory does not grow with the rows."""
RETRIES = 10
"""Number of retries of a batch whose worker was lost."""
ANSWER_S = "30 s"
"""Timeout of the scheduler."""


class _Future(Protocol):
    """Used part of a `distributed.Future`; Haptether does not depend on dask.distributed."""

    def result(self) -> tuple[int, Metrics, ControllerTime]:
        """Wait for the rows of a batch."""

    def release(self) -> None:
        """Free the rows on the cluster."""


def computed_by_cluster(
    base: Checked,
    design: Design,
    gaps: Iterable[tuple[int, int]],
    address: str | None,
    settings: SweepSettings,
    *,
    progress: Callable[[int], None] | None,
) -> Iterator[tuple[int, Metrics]]:
    """Yield first row and metrics of the batches that fill the gaps, in order of completion.

    Args:
        base: Scene without the varied values.
        design: Values of each row.
        gaps: Row ranges, first and end.
        address: Scheduler address, "tcp://host:8786", whose workers have this Haptether version; None starts one
            process on this machine per thread in `settings`.
        settings: Settings of each worker; processes on this machine use one thread each.
        progress: Called with the number of finished rows.

    Raises:
        ImportError: dask.distributed is not installed.
        OSError: The scheduler does not answer.
        RuntimeError: The retries of a batch are exhausted.
    """
    require("the engine dask", "distributed")
    distributed = importlib.import_module("distributed")
    settings = replace(settings, progress=None)
    ranges = _ranges(design, gaps)
    with contextlib.ExitStack() as stack:
        if address is None:
            stack.enter_context(safe_children())
            # Each worker is a process, so that a crash affects no other.
            local = distributed.LocalCluster(
                n_workers=settings.threads, threads_per_worker=1, processes=True, dashboard_address=None
            )
            cluster, settings = stack.enter_context(local), replace(settings, threads=1)
        else:
            cluster = address
        client = stack.enter_context(distributed.Client(cluster, timeout=ANSWER_S, set_as_default=False))
        shared = client.scatter(base, broadcast=True)

        def submit(first: int, end: int) -> _Future:
            columns = design.columns(first, end)
            future: _Future = client.submit(_batch, shared, first, columns, settings, pure=False, retries=RETRIES)
            return future

        waiting = distributed.as_completed(loop=client.loop)
        submitted = AHEAD * max(1, len(client.scheduler_info()["workers"]))
        for _, rows in zip(range(submitted), ranges, strict=False):
            waiting.add(submit(*rows))
        done = 0
        future: _Future
        for future in waiting:
            try:
                first, metrics, taken = future.result()
            except distributed.KilledWorker as error:
                message = f"workers of the cluster were lost with the same rows again and again: {error}"
                raise RuntimeError(message) from None
            future.release()
            count_controller_time(taken.ticks, taken.seconds)
            if (following := next(ranges, None)) is not None:
                waiting.add(submit(*following))
            done += len(metrics["outcome"])
            yield first, metrics
            if progress is not None:
                progress(done)


def _ranges(design: Design, gaps: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Yield first row and end of each batch."""
    for start, end in gaps:
        first = start
        while first < end:
            after = min(design.end_of_batch(first, BATCH), end)
            yield first, after
            first = after


def _batch(
    base: Checked, first: int, columns: Mapping[str, npt.NDArray[Any]], settings: SweepSettings
) -> tuple[int, Metrics, ControllerTime]:
    """Compute on a worker the metrics of some rows, and the time of their Python controllers."""
    before = thread_controller_time()
    metrics = measured(base, columns, settings)
    after = thread_controller_time()
    return first, metrics, ControllerTime(after.ticks - before.ticks, after.seconds - before.seconds)
