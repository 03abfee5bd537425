"""Reader of files that `Run.save` wrote."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from haptether.bridge import Event, Metrics, Run, Signals, ladder_state_name, tripped_names
from haptether.input_file import read_npz


def saved_run(path: Path) -> Run:
    """Read a run from a file of `Run.save` or `export --npz`, which has no scene and no metrics.

    Events are those visible in the signals: ladder transitions, trips, grips.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file has another format.
    """
    try:
        arrays = read_npz(path)
    except ValueError as error:
        message = f"{path}: no file of `Run.save` ({error})"
        raise ValueError(message) from None
    times = [name for name in ("time_s", "slave_time_s") if name in arrays]
    if not times or not {"position", "slave_position"} & arrays.keys():
        message = f"{path}: no file of `Run.save`: must have time_s and position, or those of the slave"
        raise ValueError(message)
    signals = Signals(arrays)
    for name, values in arrays.items():
        time = signals.time_of(name)
        if values.ndim == 0 or len(values) != len(arrays[time]) or len(values) == 0:
            message = f"{path}: {name}: must have one value for each of {time}"
            raise ValueError(message)
    events = sorted(_events(signals), key=lambda event: event.time_s)
    return Run(scene=path.stem, seed=0, version="", signals=signals, events=tuple(events), metrics=Metrics())


def _events(signals: Signals) -> Iterator[Event]:
    for side, name in (("master", "state"), ("slave", "slave_state")):
        for time_s, _, now in _changes(signals, name):
            yield Event(time_s, ladder_state_name(now), side)
    for time_s, before, now in _changes(signals, "tripped"):
        if now and not before:
            yield Event(time_s, "trip", " ".join(tripped_names(now)))
        elif before and not now:
            yield Event(time_s, "recover", "")
    for time_s, _, now in _changes(signals, "holds_object"):
        yield Event(time_s, "grip" if now else "drop", "")


def _changes(signals: Signals, name: str) -> Iterator[tuple[float, int, int]]:
    """Yield the time in s of each change, with the values before and after."""
    if name not in signals:
        return
    values: npt.NDArray[Any] = np.nan_to_num(signals[name]).astype(np.int64)
    times: npt.NDArray[np.float64] = signals[signals.time_of(name)]
    at = np.flatnonzero(np.diff(values)) + 1
    for now in at:
        yield float(times[now]), int(values[now - 1]), int(values[now])
