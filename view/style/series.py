"""Reduction of long signals to small lines that keep every spike."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
MOST = 8000
"""Largest number of samples that are drawn directly."""
BINS = 2000


def envelope(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Return times and values of a line; of a long one, the extremes of 2000 sections in order.

    Args:
        time_s: Times, (n,).
        values: Values, (n,); NaN for gaps.
    """
    time_s, values = np.asarray(time_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if len(values) <= MOST:
        return time_s, values
    edges = np.linspace(0, len(values), BINS + 1).astype(int)
    kept = []
    for start, stop in pairwise(edges):
        part = values[start:stop]
        finite = np.flatnonzero(np.isfinite(part))
        if not len(finite):
            kept.append(start)
            continue
        least, largest = finite[np.argmin(part[finite])], finite[np.argmax(part[finite])]
        kept.extend(start + np.unique([0, least, largest, len(part) - 1]))
    places = np.array(kept)
    return time_s[places], values[places]


def chatter(values: Array, ticks: int) -> tuple[Array, Array, Array]:
    """Return mean, least and largest value of a window around each sample, for a signal that switches every few ticks.

    Args:
        values: Values, (n,).
        ticks: Samples of the window, an odd number.
    """
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, ticks // 2, mode="edge"), ticks)
    return windows.mean(axis=1), windows.min(axis=1), windows.max(axis=1)
