"""Exceedance rates from order statistics of clusters, without an assumed distribution."""

import math

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.studies.intervals import exceedance_interval, gamma_quantile
from haptether.studies.tuning.normal_operation import Scores

SEPARATION_S = 0.3
"""Separation in s below which exceedances are one event: hold-off and release ramp of an intervention."""
GROUPING_EVENTS = 5
"""Smallest number of largest events for an estimate of the grouping D."""


class Boundary(Struct, frozen=True, kw_only=True):
    """k-th largest event of T hours as a threshold, with its exceedance rate.

    Events above a high value form a Poisson process (Leadbetter 1976) whose rate lambda(u) falls with u. At the k-th
    largest event of T hours, `T lambda(u) ~ Gamma(k, 1)` for any distribution, because `T lambda` maps the events,
    largest first, to a process of rate 1. The mean is k / T, and the bound at confidence C is `chi2_(2 k)(C) / (2 T)`:
    for the largest value `-ln(1 - C) / T`, at 95 % the rule of three.

    Events of one hand come in groups of n_i in block i. They count as `k' = (sum n_i)^2 / sum n_i^2` single events,
    each of size `D = sum n_i^2 / sum n_i`: `T lambda / D ~ Gamma(k', 1)`.

    Source: Leadbetter 1976 (events of a stationary series); Smith and Weissman 1994 (clusters by a smallest
    separation); Fay and Feuer 1997 (gamma interval of a count whose variance differs from its mean).
    """

    value: float
    """u in the unit of the threshold without its sign; infinite if an intervention cut the peak."""
    order: int
    """k."""
    grouping: float
    """D: mean events per non-empty block, weighted by their number; 1 if all are single."""
    hours: float
    """T."""

    @property
    def per_hour(self) -> float:
        """Expected rate in 1/h."""
        return self.order / self.hours

    def quantile_per_hour(self, share: float) -> float:
        """Return the quantile of lambda(u) in 1/h for a probability: `D Q(share; k') / T`, Q of Gamma(k', 1)."""
        return self.grouping * gamma_quantile(share, self.order / self.grouping) / self.hours

    def interval_per_hour(self, confidence: float) -> tuple[float, float]:
        """Return the equal-tailed interval of the rate in 1/h; `confidence` between 0 and 1."""
        tail = 0.5 * (1.0 - confidence)
        return self.quantile_per_hour(tail), self.quantile_per_hour(1.0 - tail)

    def expected_count(self, hours: float, confidence: float) -> tuple[int, int]:
        """Return the interval of the number of exceedances in other recordings of the given hours."""
        low, high = exceedance_interval(self.order / self.grouping, hours / self.hours, confidence)
        return math.floor(low * self.grouping), math.ceil(high * self.grouping)


class Exceedances:
    """Events of a score by falling height: exceedances at least `SEPARATION_S` apart.

    Args:
        scores: Score per tick, which rises as safety falls.
        hours: T, coupled time in h.
        period_s: dT of a tick in s.

    Source: Smith and Weissman 1994 (clusters by a smallest separation).
    """

    def __init__(self, scores: Scores, hours: float, period_s: float) -> None:
        self.hours = hours
        self._gap = round(SEPARATION_S / period_s)
        falling = np.argsort(-scores.value, kind="stable")
        self._value = scores.value[falling]
        self._tick, self._block = scores.tick[falling], scores.block[falling]

    def count(self, value: float) -> int:
        """Return the number of events above a value."""
        return len(self._events(self._ticks_above(value)))

    def boundary(self, order: int) -> Boundary | None:
        """Return the `order`-th largest event, or None if there are fewer."""
        ticks, high = len(self._value), min(order, len(self._value))
        while high < ticks and len(self._events(high)) < order:
            high = min(2 * high, ticks)
        if len(self._events(high)) < order:
            return None
        low = 0
        # Two events may merge as ticks between them are added; find the first position with enough events.
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if len(self._events(middle)) >= order else (middle, high)
        grouping = _grouping(self._events(high))
        if order < GROUPING_EVENTS and (more := self.boundary(GROUPING_EVENTS)) is not None:
            grouping = more.grouping
        return Boundary(value=float(self._value[high - 1]), order=order, grouping=grouping, hours=self.hours)

    def rate_of(self, value: float, confidence: float) -> tuple[float, tuple[float, float]]:
        """Return events per hour above an independent value, with an interval (Garwood 1936, grouped)."""
        events = self._events(self._ticks_above(value))
        count, grouping = len(events), _grouping(events) if len(events) else 1.0
        tail = 0.5 * (1.0 - confidence)
        low = gamma_quantile(tail, count / grouping) if count else 0.0
        high = gamma_quantile(1.0 - tail, count / grouping + 1.0)
        return count / self.hours, (grouping * low / self.hours, grouping * high / self.hours)

    def peaks(self, most: int) -> list[float]:
        """Return the largest events in falling order; cut peaks are infinite."""
        order = np.argsort(self._tick)
        tick, value = self._tick[order], self._value[order]
        begins = np.flatnonzero(np.diff(tick, prepend=-self._gap - 1) > self._gap)
        largest = np.maximum.reduceat(value, begins) if len(begins) else value
        falling: list[float] = np.sort(largest)[::-1][:most].tolist()
        return falling

    def at_most(self, per_hour: float, confidence: float) -> Boundary | None:
        """Return the lowest boundary whose exceedance rate is at most `per_hour` with a confidence, or None.

        If all events would be allowed, return the largest one, because lower boundaries are unknown.
        """
        low, high = 0, 1
        while self._keeps(high, per_hour, confidence):
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self._keeps(middle, per_hour, confidence) else (low, middle)
        if low and self.boundary(low + 1) is None:
            low = 1
        return self.boundary(low) if low else None

    def _keeps(self, order: int, per_hour: float, confidence: float) -> bool:
        boundary = self.boundary(order)
        return boundary is not None and boundary.quantile_per_hour(confidence) <= per_hour

    def _ticks_above(self, value: float) -> int:
        """Return the number of ticks above a value."""
        return int(np.searchsorted(-self._value, -value, "left"))

    def _events(self, ticks: int) -> npt.NDArray[np.int64]:
        """Return the blocks of the events formed by the highest ticks."""
        order = np.argsort(self._tick[:ticks])
        tick, block = self._tick[:ticks][order], self._block[:ticks][order]
        begins: npt.NDArray[np.int64] = block[np.diff(tick, prepend=-self._gap - 1) > self._gap]
        return begins


def _grouping(blocks: npt.NDArray[np.int64]) -> float:
    """Return D of events in blocks."""
    counts = np.bincount(blocks)
    return float((counts**2).sum() / counts.sum())


def hours_for(per_hour: float, confidence: float) -> float:
    """Return the time in h without an event that supports a rate: `-ln(1 - C) / rate`.

    Source: Hanley and Lippman-Hand 1983 (the rule of three at 95 %).
    """
    return -math.log(1.0 - confidence) / per_hour
