"""Exceedance rates from the order statistics of clusters, without an assumed distribution."""

import math

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.studies.intervals import exceedance_interval, gamma_quantile
from haptether.studies.tuning.normal_operation import Scores

SEPARATION_S = 0.3
"""Exceedances closer than this in s are one event: hold-off and release ramp of an intervention."""
GROUPING_EVENTS = 5
"""Smallest number of the largest events for an estimate of the grouping D."""


class Boundary(Struct, frozen=True, kw_only=True):
    """The k-th largest event of T hours as a threshold, and its exceedance rate.

    Events beyond a high value are a Poisson process (Leadbetter 1976), whose rate lambda(u) falls with u. At the k-th
    largest of T hours `T lambda(u) ~ Gamma(k, 1)` for any distribution of the values: `T lambda` maps the events, from
    the largest on, to a process of rate 1. The mean is therefore k / T, and the bound with confidence C is
    `chi2_(2 k)(C) / (2 T)`. For the largest value this is `-ln(1 - C) / T`, at 95 % the rule of three.

    Events of one hand are grouped, n_i of them in block i. They are equivalent to `k' = (sum n_i)^2 / sum n_i^2`
    independent events, each for `D = sum n_i^2 / sum n_i`: `T lambda / D ~ Gamma(k', 1)`.

    Source: Leadbetter 1976 (events of a stationary series); Smith and Weissman 1994 (clusters by a least separation);
    Fay and Feuer 1997 (gamma interval of a count whose variance is not its mean).
    """

    value: float
    """u, in the unit of the threshold without its sign; infinite if an intervention cut the peak off."""
    order: int
    """k."""
    grouping: float
    """D: events per block that has any, weighted by their number; 1 if all are single."""
    hours: float
    """T."""

    @property
    def per_hour(self) -> float:
        """Expected rate in 1/h."""
        return self.order / self.hours

    def quantile_per_hour(self, share: float) -> float:
        """Quantile of lambda(u) in 1/h: `D Q(share; k') / T`, Q of Gamma(k', 1)."""
        return self.grouping * gamma_quantile(share, self.order / self.grouping) / self.hours

    def interval_per_hour(self, confidence: float) -> tuple[float, float]:
        """Interval of the rate in 1/h, with equal tails."""
        tail = 0.5 * (1.0 - confidence)
        return self.quantile_per_hour(tail), self.quantile_per_hour(1.0 - tail)

    def expected_count(self, hours: float, confidence: float) -> tuple[int, int]:
        """Range of exceedances expected in other recordings of so many hours."""
        low, high = exceedance_interval(self.order / self.grouping, hours / self.hours, confidence)
        return math.floor(low * self.grouping), math.ceil(high * self.grouping)


class Exceedances:
    """Events of a score in falling order: exceedances at least `SEPARATION_S` apart.

    Args:
        scores: Ticks of a score that rises as safety falls.
        hours: T, coupled time of the hands in h.
        period_s: dT of a tick in s.

    Source: Smith and Weissman 1994 (clusters by a least separation).
    """

    def __init__(self, scores: Scores, hours: float, period_s: float) -> None:
        self.hours = hours
        self._gap = round(SEPARATION_S / period_s)
        falling = np.argsort(-scores.value, kind="stable")
        self._value = scores.value[falling]
        self._tick, self._block = scores.tick[falling], scores.block[falling]

    def count(self, value: float) -> int:
        """Number of events above a value."""
        return len(self._events(self._ticks_above(value)))

    def boundary(self, order: int) -> Boundary | None:
        """`order`-th largest event; None if there are fewer."""
        ticks, high = len(self._value), min(order, len(self._value))
        while high < ticks and len(self._events(high)) < order:
            high = min(2 * high, ticks)
        if len(self._events(high)) < order:
            return None
        low = 0
        # Intermediate ticks may merge two events, so find the first tick count with enough events.
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if len(self._events(middle)) >= order else (middle, high)
        grouping = _grouping(self._events(high))
        if order < GROUPING_EVENTS and (more := self.boundary(GROUPING_EVENTS)) is not None:
            grouping = more.grouping
        return Boundary(value=float(self._value[high - 1]), order=order, grouping=grouping, hours=self.hours)

    def rate_of(self, value: float, confidence: float) -> tuple[float, tuple[float, float]]:
        """Events per hour above an independently chosen value, with an interval (Garwood 1936, grouped)."""
        events = self._events(self._ticks_above(value))
        count, grouping = len(events), _grouping(events) if len(events) else 1.0
        tail = 0.5 * (1.0 - confidence)
        low = gamma_quantile(tail, count / grouping) if count else 0.0
        high = gamma_quantile(1.0 - tail, count / grouping + 1.0)
        return count / self.hours, (grouping * low / self.hours, grouping * high / self.hours)

    def peaks(self, most: int) -> list[float]:
        """Largest events in falling order; a cut-off peak is infinite."""
        order = np.argsort(self._tick)
        tick, value = self._tick[order], self._value[order]
        begins = np.flatnonzero(np.diff(tick, prepend=-self._gap - 1) > self._gap)
        largest = np.maximum.reduceat(value, begins) if len(begins) else value
        falling: list[float] = np.sort(largest)[::-1][:most].tolist()
        return falling

    def at_most(self, per_hour: float, confidence: float) -> Boundary | None:
        """Lowest boundary with at most so many exceedances in 1/h at a confidence; None without one.

        If all events would be allowed, it is the largest one: the data then give no lower limit.
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
        return int(np.searchsorted(-self._value, -value, "left"))

    def _events(self, ticks: int) -> npt.NDArray[np.int64]:
        """Blocks of the events formed by the highest ticks."""
        order = np.argsort(self._tick[:ticks])
        tick, block = self._tick[:ticks][order], self._block[:ticks][order]
        begins: npt.NDArray[np.int64] = block[np.diff(tick, prepend=-self._gap - 1) > self._gap]
        return begins


def _grouping(blocks: npt.NDArray[np.int64]) -> float:
    """D of events in blocks."""
    counts = np.bincount(blocks)
    return float((counts**2).sum() / counts.sum())


def hours_for(per_hour: float, confidence: float) -> float:
    """Event-free time in h that hands must hold to claim a rate: `-ln(1 - C) / rate`.

    Source: Hanley and Lippman-Hand 1983 (the rule of three at 95 %).
    """
    return -math.log(1.0 - confidence) / per_hour
