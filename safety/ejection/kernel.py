"""What stands between the motion of a device and its estimate, as kernels read from the estimator itself."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from haptether._core import Estimator, EstimatorKind
from haptether.safety.ejection.push import Array, Rising, best_push, best_rising_push

REST_TICKS = 130
"""At rest before the impulse: longer than any window (128)."""
LEAST_TICKS = 256
MOST_TICKS = 1 << 17
NEGLIGIBLE = 1e-10
"""Share of a kernel that may lie beyond its end."""
DIRECT = 2048
"""Longest kernel that is convolved term by term."""
MOST_TURNS = 64
"""Ages of which the largest change of V^ since is computed; beyond them it is bounded by the cap."""
MOST_TAIL_TICKS = 256
"""Ticks for which the hand may show in A, if its energy is to be that of one push and not of the worst at each tick."""


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

    def rising_speed(self, growth: float) -> Rising:
        """Largest `V - V^` in s one tick later, V nowhere above that before, for a force as in `growing_lag_s`.

        `max dT f[-1] + sum_j lag_s[j] f[j]`, with dT of the tick in which the speed is reached.

        Source: `docs/ejection_bound.md`, Eq. 6.
        """
        return best_rising_push(np.concatenate(([self.period_s], self.lag_s)), growth)

    def turned_speeds(self, growth: float) -> tuple[Array, Array]:
        """`max V^[n] - V` in s, V that of the tick that ends at n-j, for each age j; and for a force of any growth.

        Source: `docs/ejection_bound.md`, Eq. 9b.
        """
        size = len(self.acceleration)
        # Where it is not computed it is what the cap gives in j + 1 ticks, and the lag.
        passed_s = self.period_s * np.arange(1, size + 1, dtype=np.float64)
        since, free = self.growing_lag_s(growth) + passed_s, self.lag_norm_s + passed_s
        # V at both ends of the tick: j and j + 1 ticks ago.
        ends = np.arange(min(size, MOST_TURNS) + 1)
        change = np.where(np.arange(size) < ends[:, None], self.period_s, 0.0) - self.lag_s
        for bound, found in ((since, best_push(change, growth).max(axis=-1)), (free, np.abs(change).sum(axis=-1))):
            bound[ends[:-1]] = np.minimum(bound[ends[:-1]], np.maximum(found[:-1], found[1:]))
        return since, free

    def rises_since(self, growth: float) -> tuple[Array, Array]:
        """`max V^[n] - V^[n-j]` in s for each age j up to `MOST_TURNS`, and the same for a force of any growth.

        Source: `docs/ejection_bound.md`, Eq. 15.
        """
        velocity = np.append(self.velocity, np.full(MOST_TURNS, self.period_s))
        older = np.arange(len(velocity)) - np.arange(MOST_TURNS)[:, None]
        change = velocity - np.where(older < 0, 0.0, velocity[older])
        return best_push(change, growth).max(axis=-1), np.abs(change).sum(axis=-1)

    def tail_way(self, growth: float, window: int) -> tuple[float, float]:
        """Largest `-dT sum_k tail[k] V^[k]` in s² over ticks that a window can hold, and the same for any growth.

        V^ is that of a force of at most 1 since the release, which follows on one that is not negative.

        Source: `docs/ejection_bound.md`, Eq. 9a.
        """
        tail = self.tail[:-1]
        answer = np.abs(self.velocity)
        # At the worst of each tick for itself: the force that pushes on, and the one that has turned round and grows.
        forward = np.concatenate(([0.0], np.cumsum(answer)))[:-1]
        grown = np.minimum(1.0, growth * np.arange(1, len(answer) + 1))
        backward = np.concatenate(([0.0], _convolved(answer, grown)[: len(answer)]))[:-1]
        each = np.abs(tail) * np.where(tail > 0.0, backward, forward)
        worst, free = float(each.sum()), float((np.abs(tail) * forward).sum())
        left = np.cumsum(each[::-1])[::-1]
        ticks = int((left > 1e-6 * worst).sum())
        if 0 < ticks <= min(MOST_TAIL_TICKS, len(tail)):
            # What a force at tick i adds to the sum from the release to tick k.
            lasting = np.tril(np.ones((ticks, ticks)))
            pushed = np.zeros((ticks, ticks))
            for i in range(ticks - 1):
                pushed[i + 1 :, i] = -tail[i + 1 : ticks] * self.velocity[: ticks - 1 - i]
            until = lasting @ pushed
            # A window that ends at k, or begins after k and ends a window later.
            begins = np.minimum(np.arange(ticks) + window, ticks - 1)
            windows = np.concatenate((until[: min(ticks, window)], until[begins] - until))
            rest = float(left[ticks]) if ticks < len(left) else 0.0
            worst = min(worst, max(0.0, float(best_push(windows[:, ::-1], growth, from_zero=True)[:, -1].max())) + rest)
            free = min(free, float(np.abs(windows).sum(axis=-1).max()) + rest)
        return self.period_s * worst, self.period_s * free

    def readings(self, growth: float) -> "Readings":
        """What wrong readings meet (Eq. 9c)."""
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
    """The convolution of two kernels, of long ones by their spectra."""
    if min(len(one), len(other)) <= DIRECT:
        return np.convolve(one, other)
    size = len(one) + len(other) - 1
    spectrum = np.fft.rfft(one, size) * np.fft.rfft(other, size)
    return np.fft.irfft(spectrum, size)


@dataclass(frozen=True, slots=True, kw_only=True)
class Readings:
    """What an estimator makes of wrong readings: in A, and so in an energy."""

    period_s: float
    """dT in s."""
    bend: float
    """Largest answer of A to readings, of V^ under a unit force of limited growth."""
    free_bend: float
    """The same of any growth."""
    change: float
    """Largest change of V^ in a tick under a unit force."""
    parts: Array
    """What A has seen of a reading after so many ticks, shape `(n,)`, and at most, `sizes`."""
    sizes: Array

    def power(self, *, ticks: int, force: float, steady: float, speed: float) -> float:
        """Largest `dT sum A_noise V^` in m²/s² over a window, for readings that are each off by at most 1 m.

        A sees no steady velocity, so that noise of A and a velocity that changes slowly do not add up to an energy:
        summed by parts, each reading meets the second difference of V^, and V^ itself at both ends of the window only.

        Args:
            ticks: w.
            force: Acceleration in m/s² that the cap gives, under the limit on growth.
            steady: What friction adds to it, of any growth.
            speed: Largest |V^| in m/s.

        Source: `docs/ejection_bound.md`, Eq. 9c.
        """
        if not self.sizes[-1]:
            return 0.0
        inside = force * self.bend + steady * self.free_bend
        change = (force + steady) * self.change
        left = np.maximum(self.sizes[-1] - self.sizes, 0.0)
        # The newest readings: what of their answer has come by now.
        come = np.concatenate(([0.0], np.cumsum(self.sizes)[:-1]))
        newest = np.minimum(speed * self.parts + change * come, inside + speed * left)
        # Readings before the window: what of their answer is still to come.
        coming = np.concatenate((np.cumsum(left[::-1])[::-1][1:], [0.0]))
        before = np.minimum(speed * self.parts + change * coming, speed * left)
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
