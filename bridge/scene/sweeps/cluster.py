"""Rows of a sweep computed by the workers of a Dask cluster; a worker that is lost on the way costs its batch again."""

import contextlib
import importlib
import importlib.util
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy.typing as npt

from haptether.bridge.scene.load import Checked
from haptether.bridge.scene.sweep import Threads, measured
from haptether.bridge.scene.sweeps.design import Design

BATCH = 256
"""Rows of a task: seconds of work, so that a lost worker costs no more."""
AHEAD = 4
"""Tasks for each worker that are submitted at once: memory does not grow with the rows."""
RETRIES = 10
"""How often a batch is begun anew whose workers were lost."""
ANSWER_S = "30 s"
"""How long a scheduler may take to answer."""


def computed_by_cluster(
    base: Checked,
    design: Design,
    gaps: Iterable[tuple[int, int]],
    address: str | None,
    *,
    threads: int,
    lanes: bool,
    progress: Callable[[int], None] | None,
) -> Iterator[tuple[int, dict[str, npt.NDArray[Any]]]]:
    """The first row and the metrics of batches that fill the gaps, as they are done: in any order.

    Args:
        base: The scene without what varies.
        design: Which value has which row.
        gaps: Ranges of rows, each first and end.
        address: Of a scheduler, "tcp://host:8786", whose workers have this version of Haptether; none for as many
            processes of this machine as `threads`.
        threads: Threads of each worker's batch; with processes of this machine one each.
        lanes: As of `sweep`.
        progress: Called with the number of rows that are done.

    Raises:
        ImportError: Without dask.distributed.
        OSError: No scheduler answers.
        RuntimeError: Batches whose workers were lost again and again.
    """
    if importlib.util.find_spec("distributed") is None:
        message = "the engine dask needs dask.distributed: install distributed beside haptether"
        raise ImportError(message)
    distributed: Any = importlib.import_module("distributed")
    ranges = ((first, min(first + BATCH, end)) for start, end in gaps for first in range(start, end, BATCH))
    with contextlib.ExitStack() as stack:
        if address is None:
            # Each worker is a process: one that dies takes no other with it.
            local = distributed.LocalCluster(
                n_workers=threads, threads_per_worker=1, processes=True, dashboard_address=None
            )
            cluster, threads = stack.enter_context(local), 1
        else:
            cluster = address
        client: Any = stack.enter_context(distributed.Client(cluster, timeout=ANSWER_S, set_as_default=False))
        shared = client.scatter(base, broadcast=True)
        how = {"count": threads, "lanes": lanes}

        def submit(first: int, end: int) -> Any:  # noqa: ANN401  # of distributed
            columns = design.columns(first, end)
            return client.submit(_batch, shared, first, columns, how, pure=False, retries=RETRIES)

        waiting = distributed.as_completed(loop=client.loop)
        most = AHEAD * max(1, len(client.scheduler_info()["workers"]))
        for _, each in zip(range(most), ranges, strict=False):
            waiting.add(submit(*each))
        done = 0
        for future in waiting:
            try:
                first, metrics = future.result()
            except distributed.KilledWorker as error:
                message = f"workers of the cluster were lost with the same rows again and again: {error}"
                raise RuntimeError(message) from None
            future.release()
            if (following := next(ranges, None)) is not None:
                waiting.add(submit(*following))
            done += len(metrics["outcome"])
            yield first, metrics
            if progress is not None:
                progress(done)


def _batch(
    base: Checked, first: int, columns: Mapping[str, npt.NDArray[Any]], how: Mapping[str, Any]
) -> tuple[int, dict[str, npt.NDArray[Any]]]:
    """On a worker: the metrics of some rows."""
    return first, measured(base, columns, Threads(**how))
