"""Contact that swings without settling."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

WINDOW_S = 1.0
"""Time in s before the release, or the end of the run, in which a swing counts."""
LEAST_N = 0.5
"""Smallest swing in N peak to peak that counts; sensors and tremor stay below."""
CROSSINGS = 4
"""Fewest crossings of the mean within the window; a motion of the hand has fewer."""
KEPT = 0.7
"""Smallest ratio of the swings in the second and the first half of the window. A force that settles is below it."""


def contact_swing_n(signals: Mapping[str, npt.NDArray[Any]], release_s: Iterable[float] = ()) -> float | None:
    """Return the swing of the device force in N, peak to peak, if it does not settle; else None.

    It is the largest over the axes, in the last second before the first release or the end. A force that crosses its
    mean at least four times there, and keeps 70 % of its swing from the first half to the second, does not settle.
    """
    force, time_s = signals.get("device_force"), signals.get("time_s")
    if force is None or time_s is None or len(time_s) < 2:
        return None
    end_s = min([*release_s, float(time_s[-1])])
    within = (time_s >= end_s - WINDOW_S) & (time_s < end_s)
    swings = [_swing_n(axis) for axis in force[within].reshape(int(within.sum()), -1).T]
    largest = max(swings, default=0.0)
    return largest if largest >= LEAST_N else None


def _swing_n(force: npt.NDArray[np.float64]) -> float:
    """Return the swing of one axis in N. A force that settles has 0."""
    if len(force) < 2 * CROSSINGS:
        return 0.0
    swing = float(np.ptp(force))
    first, second = (float(np.ptp(half)) for half in np.array_split(force, 2))
    # A crossing counts from a quarter of the swing on one side to a quarter on the other, so that noise adds none.
    middle = force - (force.max() + force.min()) / 2.0
    sides = np.sign(middle[np.abs(middle) > swing / 4.0])
    crossings = int(np.count_nonzero(np.diff(sides)))
    return swing if crossings >= CROSSINGS and second >= KEPT * first else 0.0
