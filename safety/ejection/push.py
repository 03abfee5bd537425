"""Worst-case force: the largest value of a linear function over all forces that the limiter passes."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]

MOST_LEVELS = 256
"""Largest number of steps in which a force grows to its cap; slower growth is rounded up to this one."""
MOST_WEIGHTS = 1 << 16
"""Largest number of weights, over all rows, for the exact search. With more, the force may reverse at once.

Over such a long memory the difference is small.
"""
LEVEL_OF_LIMIT = 0.04
"""Largest spacing of the levels if the force has a separate limit at each age."""
FEW_AGES = 64
"""Number of weights that are always searched."""
NEGLIGIBLE = 1e-6
"""Share of the weights beyond `FEW_AGES` that is added without growth limit, so that a decayed kernel costs nothing."""
LIFTS = 16
"""Number of lift heights per round of the search."""
ROUNDS = 2
"""Number of rounds; later rounds refine the search around the best height."""


@dataclass(frozen=True, slots=True)
class _Levels:
    """Levels that contain an optimum, and the transitions between them."""

    growth: float
    force: Array
    """Levels from -1 to 1."""
    zero: int
    """Index of level 0."""
    reach: npt.NDArray[np.intp]
    """For a level of size `force[zero + i]`, the largest index distance from `zero` that its growth allows."""

    @classmethod
    def of(cls, growth: float, spacing: float = 1.0) -> "_Levels":
        growth = max(growth, 1.0 / MOST_LEVELS)
        parts = max(1, int(np.ceil(growth / spacing)))
        steps = growth / parts * np.arange(int(parts / growth) + 1)
        half = np.unique(np.concatenate((steps, 1.0 - steps, [0.0, 1.0])).round(12))
        reach = np.searchsorted(half, half + growth * (1.0 + 1e-6), side="right") - 1
        return cls(growth, np.concatenate((-half[:0:-1], half)), len(half) - 1, reach)

    def best_newer(self, value: Array) -> Array:
        """Return, for each level, the best value among its successors; shape `(..., levels)` as `value`."""
        least, zero = self.reach[0], self.zero
        rising = np.maximum.accumulate(value[..., zero - least :], axis=-1)[..., least:]
        falling = np.maximum.accumulate(value[..., zero + least :: -1], axis=-1)[..., least:]
        return np.concatenate((falling[..., self.reach][..., :0:-1], rising[..., self.reach]), axis=-1)

    def from_zero(self) -> slice:
        """Return the levels that may follow 0 or any force above it."""
        return slice(self.zero - int(self.reach[0]), None)


def best_push(weights: Array, growth: float, *, from_zero: bool = False, highest: Array | None = None) -> Array:
    """Compute `max sum_(j<=k) w[j] f[j]` for each k, over forces |f| <= 1 of limited growth.

    f[0] is the newest force; its size grows by at most `growth` per tick:
    `min(0, f[j]) - growth <= f[j-1] <= max(0, f[j]) + growth`. For given signs, these constraints are differences, so
    an optimum has all |f| at `i growth` or `1 - i growth`. Dynamic programming over those levels is exact.

    Args:
        weights: w, shape `(..., n)`.
        growth: Largest growth per tick, in units of the cap.
        from_zero: If true, the oldest force follows a force that is not negative, so it is at least `-growth`.
        highest: Largest force at each age, 0 to 1, shape as `weights`; rounded up to the next level.

    Source: Bellman 1957; Hoffman and Kruskal 1956 (integral vertices).
    """
    free = np.abs(weights) if highest is None else np.maximum(weights * highest, -weights)
    sizes = np.cumsum(free, axis=-1)
    if growth >= 1.0 or weights.size > MOST_WEIGHTS:
        # Only a reversal beyond the cap is limited in this case; the sum without a limit is an upper bound.
        return np.asarray(sizes)
    levels = _Levels.of(growth, 1.0 if highest is None else LEVEL_OF_LIMIT)
    oldest = levels.from_zero() if from_zero else slice(None)
    spacing = 0.0 if highest is None else float(np.diff(levels.force).max())
    counted = weights.shape[-1]
    if counted > FEW_AGES and not from_zero:
        left = sizes[..., -1:] - sizes > NEGLIGIBLE * sizes[..., -1:]
        counted = min(counted, int(left.reshape(-1, counted).any(axis=0).sum()) + 1)
    best = np.empty(weights.shape)
    newer: Array | float = 0.0
    for age in range(counted):
        value = weights[..., age, None] * levels.force + newer
        if highest is not None:
            value = np.where(levels.force < highest[..., age, None] + spacing, value, -np.inf)
        best[..., age] = value[..., oldest].max(axis=-1)
        newer = levels.best_newer(value)
    rest = slice(counted, None)
    best[..., rest] = best[..., counted - 1, None] + (sizes[..., rest] - sizes[..., counted - 1, None])
    return best


def worst_push(weights: Array, growth: float) -> Array:
    """Return a force that attains the largest `best_push`, newest first, shape `(k,)`, at most as long as `weights`."""
    if growth >= 1.0:
        return np.where(weights < 0.0, -1.0, 1.0)
    levels = _Levels.of(growth)
    values: list[Array] = []
    newer: Array | float = 0.0
    for weight in weights[: MOST_WEIGHTS // LIFTS]:
        values.append(weight * levels.force + newer)
        newer = levels.best_newer(values[-1])
    oldest = int(np.argmax([value.max() for value in values]))
    place = int(np.argmax(values[oldest]))
    push = [levels.force[place]]
    for value in values[oldest - 1 :: -1] if oldest else []:
        size = abs(place - levels.zero)
        low, high = levels.zero - levels.reach[0], levels.zero + levels.reach[0]
        if place >= levels.zero:
            high = levels.zero + levels.reach[size]
        if place <= levels.zero:
            low = levels.zero - levels.reach[size]
        place = int(low + np.argmax(value[low : high + 1]))
        push.append(levels.force[place])
    return np.array(push[::-1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Rising:
    """Bound of a linear function over forces under which V is greatest at the newest tick (Eq. 6)."""

    most: float
    """Bound of `max sum w f`."""
    lift: Array
    """mu that was added to w; at least 0 and not growing with age."""


def best_rising_push(weights: Array, growth: float, *, highest: Array | None = None) -> Rising:
    """Bound `max sum w[j] f[j]` over forces as in `best_push` whose sums `f[0] + ... + f[j]` are all at least 0.

    Any mu that is at least 0 and does not grow with age may be added to w: by summation by parts, `sum mu f` is a
    non-negative combination of those sums. The bound is the least `best_push` of `w + mu`. The search uses mu that are
    constant up to one age and 0 beyond it.

    Args:
        weights: w, shape `(n,)`.
        growth: Largest growth per tick, in units of the cap.
        highest: Largest force at each age, 0 to 1, shape as `weights`.

    Source: `docs/ejection_bound.md`, Eq. 6; weak duality (Boyd and Vandenberghe 2004, section 5.2.2).
    """
    most, lift = float(best_push(weights, growth, highest=highest).max()), np.zeros(len(weights))
    if not (weights < 0.0).any() or LIFTS * len(weights) > MOST_WEIGHTS:
        return Rising(most=most, lift=lift)
    negative = weights < -1e-3 * np.abs(weights).max()
    # Try lifts that end within a negative part, or just after it.
    first = int(np.argmax(negative))
    ends = first + np.flatnonzero(np.diff(negative[first:].astype(int)) == -1)
    ends = np.unique(np.clip(ends[:2, None] + np.arange(-2, 3), 1, len(weights) - 1))
    ages = np.arange(len(weights))
    for end in ends:
        low, high = 0.0, float(-weights.min())
        for _ in range(ROUNDS):
            heights = np.linspace(low, high, LIFTS)
            lifts = heights[:, None] * (ages <= end)
            below = None if highest is None else np.broadcast_to(highest, lifts.shape)
            found = best_push(weights + lifts, growth, highest=below).max(axis=-1)
            place = int(np.argmin(found))
            if found[place] < most:
                most, lift = float(found[place]), lifts[place]
            low, high = heights[max(place - 1, 0)], heights[min(place + 1, LIFTS - 1)]
    return Rising(most=most, lift=lift)
