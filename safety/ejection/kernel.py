"""Kernels between the motion of a device and its estimate, measured from the estimator itself."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from haptether._core import Estimator, EstimatorKind
from haptether.safety.ejection.push import Array, Rising, best_push, best_rising_push

REST_TICKS = 130
"""Ticks at rest before the impulse; longer than any window (128)."""
LEAST_TICKS = 256
MOST_TICKS = 1 << 17
NEGLIGIBLE = 1e-10
"""Largest share of a kernel in the last quarter of its measured ticks; with more, twice as many ticks are measured."""
DIRECT = 2048
"""Longest kernel that is convolved directly."""
MOST_TURNS = 64
"""Number of ages for which the largest change of V^ since that age is computed; for older ages only the cap counts."""
MOST_TAIL_TICKS = 256
"""Largest number of ticks for which a single push is searched that maximises the energy of the hand still in A.

If A shows the hand for longer, the worst push of each tick is used.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """Linear estimator, by its responses to one tick of unit acceleration and to one wrong reading.

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
    """Response of V^ in 1/s to a reading that is wrong by 1 m for one tick, shape `(n,)`."""
    acceleration_noise: Array
    """Response of A in 1/s² to the same reading."""

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
        """`tail[k] = 1 - sum_(j<k) g[j]`: share of a past force that A still contains k ticks after its end."""
        return 1.0 - np.concatenate(([0.0], np.cumsum(self.acceleration)))

    @property
    def tail_s(self) -> float:
        """`T_t = dT sum |tail|` in s."""
        return float(self.period_s * np.abs(self.tail).sum())

    @property
    def velocity(self) -> Array:
        """Response of V^ in s to one tick of unit acceleration: `dT - h`."""
        return self.period_s - self.lag_s

    @property
    def viscous_lag_s(self) -> float:
        """`L_b = sum |V^ - g * V|` in s, with V the mean over a tick.

        Times b and the acceleration, it bounds the viscous friction that remains in F_h^.
        """
        mean = self.period_s * (np.cumsum(self.acceleration) - self.acceleration / 2.0)
        return float(np.abs(self.velocity - mean).sum())

    def growing_lag_s(self, growth: float) -> float:
        """Return the largest V - V^ in s for a force of at most 1 that grows by at most `growth` per tick.

        Unloading is free, and the force at the release is arbitrary. Without a growth limit the result is at most L_v.

        Source: `docs/ejection_bound.md`, Eq. 6.
        """
        return float(best_push(self.lag_s, growth).max())

    def rising_speed(self, growth: float) -> Rising:
        """Bound the excess of V over V^ of the tick before, in s, for a V that is at its maximum so far.

        The force is that of `growing_lag_s`:

        `max dT f[-1] + sum_j lag_s[j] f[j]`, with dT for the tick in which the speed is reached.

        Source: `docs/ejection_bound.md`, Eq. 6a.
        """
        return best_rising_push(np.concatenate(([self.period_s], self.lag_s)), growth)

    def turned_speeds(self, growth: float) -> tuple[Array, Array]:
        """Return `max V^[n] - V` in s for each age j, with V at either end of the tick that ended j ticks ago.

        The second result is the same without the growth limit.

        Source: `docs/ejection_bound.md`, Eq. 9b.
        """
        size = len(self.acceleration)
        # Beyond the computed ages, the bound is the change by the cap in j + 1 ticks plus the lag.
        passed_s = self.period_s * np.arange(1, size + 1, dtype=np.float64)
        since, free = self.growing_lag_s(growth) + passed_s, self.lag_norm_s + passed_s
        # V at both ends of the tick, j and j + 1 ticks ago.
        ends = np.arange(min(size, MOST_TURNS) + 1)
        change = np.where(np.arange(size) < ends[:, None], self.period_s, 0.0) - self.lag_s
        for bound, found in ((since, best_push(change, growth).max(axis=-1)), (free, np.abs(change).sum(axis=-1))):
            bound[ends[:-1]] = np.minimum(bound[ends[:-1]], np.maximum(found[:-1], found[1:]))
        return since, free

    def rises_since(self, growth: float) -> tuple[Array, Array]:
        """Return `max V^[n] - V^[n-j]` in s for each age j below `MOST_TURNS`, and the same without the growth limit.

        Source: `docs/ejection_bound.md`, Eq. 15.
        """
        velocity = np.append(self.velocity, np.full(MOST_TURNS, self.period_s))
        older = np.arange(len(velocity)) - np.arange(MOST_TURNS)[:, None]
        change = velocity - np.where(older < 0, 0.0, velocity[older])
        return best_push(change, growth).max(axis=-1), np.abs(change).sum(axis=-1)

    def tail_way(self, growth: float, window: int) -> tuple[float, float]:
        """Return the largest `-dT sum_k tail[k] V^[k]` in s² over the ticks of a window.

        V^ results from a force of at most 1 since the release; the force at the release was not negative. The second
        result is the same without the growth limit.

        Source: `docs/ejection_bound.md`, Eq. 9a.
        """
        tail = self.tail[:-1]
        answer = np.abs(self.velocity)
        # Worst case of each tick separately: the force pushes on, or it has reversed and grows.
        forward = np.concatenate(([0.0], np.cumsum(answer)))[:-1]
        grown = np.minimum(1.0, growth * np.arange(1, len(answer) + 1))
        backward = np.concatenate(([0.0], _convolved(answer, grown)[: len(answer)]))[:-1]
        each = np.abs(tail) * np.where(tail > 0.0, backward, forward)
        worst, free = float(each.sum()), float((np.abs(tail) * forward).sum())
        left = np.cumsum(each[::-1])[::-1]
        ticks = int((left > 1e-6 * worst).sum())
        if 0 < ticks <= min(MOST_TAIL_TICKS, len(tail)):
            # Contribution of a force at tick i to the sum from the release to tick k.
            lasting = np.tril(np.ones((ticks, ticks)))
            pushed = np.zeros((ticks, ticks))
            for i in range(ticks - 1):
                pushed[i + 1 :, i] = -tail[i + 1 : ticks] * self.velocity[: ticks - 1 - i]
            until = lasting @ pushed
            # Windows that end at k, and windows that begin after k and end a window later.
            begins = np.minimum(np.arange(ticks) + window, ticks - 1)
            windows = np.concatenate((until[: min(ticks, window)], until[begins] - until))
            rest = float(left[ticks]) if ticks < len(left) else 0.0
            worst = min(worst, max(0.0, float(best_push(windows[:, ::-1], growth, from_zero=True)[:, -1].max())) + rest)
            free = min(free, float(np.abs(windows).sum(axis=-1).max()) + rest)
        return self.period_s * worst, self.period_s * free

    def readings(self, growth: float) -> "Readings":
        """Return the effect of wrong readings (Eq. 9c)."""
        size = len(self.lag_s)
        answer = np.concatenate((np.zeros(size - 1), self.velocity, np.full(size, self.period_s)))
        met = _convolved(answer, self.acceleration_noise[::-1])[size - 1 : len(answer)]
        sizes = np.abs(self.acceleration_noise)
        return Readings(
            period_s=self.period_s,
            bend=float(best_push(met, growth).max()),
            free_bend=float(np.abs(met).sum()),
            change=float(np.abs(np.diff(self.velocity, prepend=0.0)).sum()),
            parts=np.abs(np.cumsum(self.acceleration_noise)),
            sizes=np.cumsum(sizes),
        )


def _convolved(one: Array, other: Array) -> Array:
    """Convolve two kernels; long ones by their spectra."""
    if min(len(one), len(other)) <= DIRECT:
        return np.convolve(one, other)
    size = len(one) + len(other) - 1
    spectrum = np.fft.rfft(one, size) * np.fft.rfft(other, size)
    return np.fft.irfft(spectrum, size)


@dataclass(frozen=True, slots=True, kw_only=True)
class Readings:
    """Effect of wrong readings on A and thus on an energy."""

    period_s: float
    """dT in s."""
    bend: float
    """Largest correlation of V^ with the response of A to a reading, under a unit force of limited growth."""
    free_bend: float
    """The same without the growth limit."""
    change: float
    """Largest change of V^ in one tick under a unit force."""
    parts: Array
    """Size of the summed response of A to a reading after k ticks, shape `(n,)`."""
    sizes: Array
    """Sum of the sizes of that response after k ticks, shape `(n,)`."""

    def power(self, *, ticks: int, force: float, steady: float, speed: float) -> float:
        """Return the largest `dT sum A_noise V^` in m²/s² over a window, for readings each wrong by at most 1 m.

        A does not respond to a steady velocity, so noise of A and a slowly changing velocity add little energy. Summed
        by parts, each reading is multiplied by a smoothed second difference of V^, and by V^ itself only at both ends
        of the window.

        Args:
            ticks: w.
            force: Acceleration in m/s² by the cap, under the growth limit.
            steady: Additional acceleration in m/s² by friction, of any growth.
            speed: Largest |V^| in m/s.

        Source: `docs/ejection_bound.md`, Eq. 9c.
        """
        if not self.sizes[-1]:
            return 0.0
        inside = force * self.bend + steady * self.free_bend
        change = (force + steady) * self.change
        left = np.maximum(self.sizes[-1] - self.sizes, 0.0)
        # Newest readings: only a part of their response has arrived.
        come = np.concatenate(([0.0], np.cumsum(self.sizes)[:-1]))
        newest = np.minimum(speed * self.parts + change * come, inside + speed * left)
        # Readings before the window: a part of their response is still to come.
        coming = np.concatenate((np.cumsum(left[::-1])[::-1][1:], [0.0]))
        before = np.minimum(speed * self.parts + change * coming, speed * left)
        return self.period_s * float(ticks * inside + np.maximum(newest - inside, 0.0).sum() + before.sum())


def exact(period_s: float) -> Kernel:
    """Return the kernel of a measured velocity: no lag, and A is the mean acceleration of the last tick."""
    return Kernel(
        period_s=period_s,
        lag_s=np.zeros(1),
        acceleration=np.ones(1),
        velocity_noise=np.zeros(1),
        acceleration_noise=np.zeros(1),
    )


def kernel(of: EstimatorKind, period_s: float) -> Kernel:
    """Measure the kernels of an estimator by impulses.

    Raises:
        ValueError: The estimator is not linear and has no kernel, or its memory is too long.
    """
    return _kernel(repr(of), _Hashed(of), period_s)


class _Hashed:
    """Hashable wrapper of an estimator kind, for a cache whose key is the kind's text."""

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
    # One tick of 1 m/s²; V = dT from then on.
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
