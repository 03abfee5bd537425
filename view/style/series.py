"""Lines of long signals that show every spike and stay small."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
MOST = 8000
"""Samples of the longest line drawn in full."""
BINS = 2000


def envelope(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Times and values of a line; if long, minimum and maximum of each of 2000 pieces, in order.

    Args:
        time_s: (n,).
        values: (n,); NaN where unknown.
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
