"""What stands between the motion of a device and its estimate, as kernels read from the estimator itself."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from haptether._core import Estimator, EstimatorKind

Array: TypeAlias = npt.NDArray[np.float64]

REST_TICKS = 130
"""At rest before the impulse: longer than any window (128)."""
LEAST_TICKS = 256
MOST_TICKS = 1 << 17
NEGLIGIBLE = 1e-10
"""Share of a kernel that may lie beyond its end."""
MOST_LEVELS = 256
"""Steps in which a force grows to its cap; a slower growth is taken for this one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """A linear estimator by its answers to one tick of unit acceleration, and to one reading that is wrong.

    `V - V^ = sum_j lag_s[j] a[n-j]`, `A = sum_j acceleration[j] a[n-j]`, with a[n] of the tick that ends at n.

    Source: `docs/ejection_bound.md`, Eq. 2 and 3.
    """

    period_s: float
    """dT in s."""
    lag_s: Array
    """h in s, shape `(n,)`."""
    acceleration: Array
    """g, shape `(n,)`."""
    velocity_noise: Array
    """V^ in 1/s after a reading that is off by 1 m for one tick, shape `(n,)`."""
    acceleration_noise: Array
    """The same of A, in 1/s²."""

    @property
    def lag_norm_s(self) -> float:
        """`L_v = sum |h|` in s."""
        return float(np.abs(self.lag_s).sum())

    @property
    def gain(self) -> float:
        """`G = sum |g|`."""
        return float(np.abs(self.acceleration).sum())

    @property
    def tail(self) -> Array:
        """`tail[k] = 1 - sum_(j<k) g[j]`: the share of a force of the past that A still has k ticks after its end."""
        return 1.0 - np.concatenate(([0.0], np.cumsum(self.acceleration)))

    @property
    def tail_s(self) -> float:
        """`T_t = dT sum |tail|` in s."""
        return float(self.period_s * np.abs(self.tail).sum())

    @property
    def velocity(self) -> Array:
        """V^ in s to one tick of unit acceleration: `dT - h`."""
        return self.period_s - self.lag_s

    @property
    def viscous_lag_s(self) -> float:
        """`L_b = sum |V^ - g * V|` in s, V the mean over a tick: what viscous friction leaves in the grasp force."""
        mean = self.period_s * (np.cumsum(self.acceleration) - self.acceleration / 2.0)
        return float(np.abs(self.velocity - mean).sum())

    def growing_lag_s(self, growth: float) -> float:
        """Largest V - V^ in s, for a force of at most 1 whose growth from tick to tick is at most `growth`.

        Unloading is free, and the force at the release is any. Without a bound on growth it is at most L_v.

        Source: `docs/ejection_bound.md`, Eq. 6.
        """
        return float(best_push(self.lag_s, growth).max())

    def noise_power(self, *, ticks: int, growth: float, force: float, steady: float, speed: float) -> float:
        """Largest `dT sum A_noise V^` in m²/s² over a window, for readings that are each off by at most 1 m.

        A sees no steady velocity, so that noise of A and a velocity that changes slowly do not add up to an energy:
        summed by parts, each reading meets the second difference of V^, and V^ itself at both ends of the window only.

        Args:
            ticks: w.
            growth: Largest growth of the force a tick, in units of its cap.
            force: Acceleration in m/s² that the cap gives, under that growth.
            steady: What friction adds to it, of any growth.
            speed: Largest |V^| in m/s.

        Source: `docs/ejection_bound.md`, Eq. 9.
        """
        reading, size = self.acceleration_noise, len(self.lag_s)
        if not reading.any():
            return 0.0
        answer = np.concatenate((np.zeros(size - 1), self.velocity, np.full(size, self.period_s)))
        met = np.correlate(answer, reading, "valid")
        inside = force * float(best_push(met, growth).max()) + steady * float(np.abs(met).sum())
        change = (force + steady) * float(np.abs(np.diff(self.velocity, prepend=0.0)).sum())
        parts, sizes = np.cumsum(reading), np.cumsum(np.abs(reading))
        left = np.maximum(sizes[-1] - sizes, 0.0)
        # The newest readings: what of their answer has come by now.
        come = np.concatenate(([0.0], np.cumsum(sizes)[:-1]))
        newest = np.minimum(speed * np.abs(parts) + change * come, inside + speed * left)
        # Readings before the window: what of their answer is still to come.
        coming = np.concatenate((np.cumsum(left[::-1])[::-1][1:], [0.0]))
        before = np.minimum(speed * np.abs(parts) + change * coming, speed * left)
        return self.period_s * float(ticks * inside + np.maximum(newest - inside, 0.0).sum() + before.sum())


def exact(period_s: float) -> Kernel:
    """The kernel of a velocity that is measured: no lag, and A is the mean acceleration of the last tick."""
    return Kernel(
        period_s=period_s,
        lag_s=np.zeros(1),
        acceleration=np.ones(1),
        velocity_noise=np.zeros(1),
        acceleration_noise=np.zeros(1),
    )


def kernel(of: EstimatorKind, period_s: float) -> Kernel:
    """The kernels of an estimator, by impulses through the estimator itself.

    Raises:
        ValueError: The estimator is not linear, so it has none, or it forgets too slowly.
    """
    return _kernel(repr(of), _Hashed(of), period_s)


class _Hashed:
    """An estimator's kind for a cache whose key is its text."""

    def __init__(self, kind: EstimatorKind) -> None:
        self.kind = kind

    def __eq__(self, _: object) -> bool:
        return True

    def __hash__(self) -> int:
        return 0


@lru_cache(maxsize=64)
def _kernel(text: str, of: _Hashed, period_s: float) -> Kernel:
    if "adaptive" in text.lower():
        message = "the adaptive window is not linear: no kernel bounds its lag"
        raise ValueError(message)
    ticks = LEAST_TICKS
    while True:
        found = _measured(of.kind, period_s, ticks)
        late = slice(3 * ticks // 4, None)
        if all(
            np.abs(each[late]).sum() <= NEGLIGIBLE * np.abs(each).sum() for each in (found.lag_s, found.acceleration)
        ):
            return found
        ticks *= 2
        if ticks > MOST_TICKS:
            message = f"the estimator still remembers after {MOST_TICKS} ticks: its bandwidth must be higher"
            raise ValueError(message)


def _measured(of: EstimatorKind, period_s: float, ticks: int) -> Kernel:
    after = np.arange(ticks)
    rest = np.zeros(REST_TICKS)
    # One tick of 1 m/s²: V = dT from then on.
    pushed = np.concatenate((rest, period_s**2 * (after + 0.5)))
    wrong = np.concatenate((rest, (after == 0).astype(float)))
    velocity, acceleration, _ = Estimator(of, period_s=period_s).run(pushed)
    velocity_noise, acceleration_noise, _ = Estimator(of, period_s=period_s).run(wrong)
    return Kernel(
        period_s=period_s,
        lag_s=period_s - velocity[REST_TICKS:],
        acceleration=acceleration[REST_TICKS:],
        velocity_noise=velocity_noise[REST_TICKS:],
        acceleration_noise=acceleration_noise[REST_TICKS:],
    )


def best_push(weights: Array, growth: float) -> Array:
    """`max sum_(j<=k) w[j] f[j]` for each k, over |f| <= 1 whose size grows by at most `growth` a tick: f[0] is newest.

    `min(0, f[j]) - growth <= f[j-1] <= max(0, f[j]) + growth`. For given signs these are differences, so an optimum has
    all |f| at `i growth` or `1 - i growth`: dynamic programming over those levels is exact.

    Source: Bellman 1957; Hoffman and Kruskal 1956 (integral vertices).
    """
    if growth >= 1.0:
        # Only a reversal of more than the cap is limited then; free is more.
        return np.cumsum(np.abs(weights))
    growth = max(growth, 1.0 / MOST_LEVELS)
    steps = growth * np.arange(int(1.0 / growth) + 1)
    half = np.unique(np.concatenate((steps, 1.0 - steps, [0.0, 1.0])).round(12))
    levels = np.concatenate((-half[:0:-1], half))
    zero = len(half) - 1
    # The highest place that the next force may have after one of size half[i], counted from that of zero.
    reach = np.searchsorted(half, half + growth * (1.0 + 1e-6), side="right") - 1
    least = reach[0]
    best = np.zeros(len(weights))
    value = np.zeros(len(levels))
    newer = np.zeros(len(levels))
    for age, weight in enumerate(weights):
        if age:
            rising = np.maximum.accumulate(value[zero - least :])[least:]
            falling = np.maximum.accumulate(value[zero + least :: -1])[least:]
            newer = np.concatenate((falling[reach][:0:-1], rising[reach]))
        value = weight * levels + newer
        best[age] = value.max()
    return best
