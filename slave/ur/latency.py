"""How late an arm follows what it is told, from what it was told and where it was."""

from collections import deque
from typing import Final

import numpy as np

LONGEST_S: Final = 0.4
"""Largest delay that is looked for."""
STEP_S: Final = 0.001
KEPT_S: Final = 8.0
MIN_M: Final = 0.002
"""Standard deviation of the motion below which nothing can be told."""


class Latency:
    """The delay d at which `x(t)` is nearest to `x_set(t - d)`, means taken away: the least sum of squares.

    A constant distance, as in contact, does not count. The arm is taken to be a pure delay; what it is besides smooths
    the minimum and moves it towards the lag that it has for slow motion.

    Args:
        period_s: Between two samples.
    """

    def __init__(self, period_s: float) -> None:
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=int(KEPT_S / period_s))

    def add(self, time_s: float, told: float, measured: float) -> None:
        """A position along one axis in m, as told and as measured."""
        self._rows.append((time_s, told, measured))

    def clear(self) -> None:
        """Forgets all: motion begins anew."""
        self._rows.clear()

    @property
    def seconds(self) -> float | None:
        """The delay in s; none where there was too little motion."""
        rows = np.array(self._rows)
        if len(rows) < 3:
            return None
        time_s, told, measured = rows.T
        late = time_s > time_s[0] + LONGEST_S
        if late.sum() < 3 or float(measured[late].std()) < MIN_M:
            return None
        delays = np.arange(0.0, LONGEST_S, STEP_S)
        squares = np.empty(len(delays))
        for place, delay in enumerate(delays):
            off = measured[late] - np.interp(time_s[late] - delay, time_s, told)
            squares[place] = ((off - off.mean()) ** 2).sum()
        best = int(squares.argmin())
        if not 0 < best < len(delays) - 1:
            return float(delays[best])
        # The parabola through the three lowest.
        before, at, after = squares[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        return float(delays[best] + (0.5 * STEP_S * (before - after) / bend if bend > 0.0 else 0.0))
