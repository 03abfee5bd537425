"""Weak-form least-squares fit of `m A + b V + c sign(V) = F(t - delay) + F_0` along one axis.

The equation is multiplied by a smooth function phi that is zero outside a window, and integrated by parts. No
derivative of the measured position remains:
`m int x phi'' - b int x phi' + c int sign(V) phi - F_0 int phi = int F(t - delay) phi`.
Noise and quantisation of the position then average out instead of being amplified.

Source: Shinbrot 1957 (method of moment functionals); Preisig and Rippin 1993 (modulating functions); intervals: the
jackknife over blocks, Künsch 1989.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WINDOW_S = 0.12
"""Length of phi; its spectrum covers the highest frequency of the motions."""
WINDOWS = 8
"""Windows that begin within the length of one."""
DELAYS_S = np.arange(-0.004, 0.0301, 0.0005)
"""Candidate delays from force to position."""
BLOCKS = 12
"""Blocks of the jackknife."""
STUDENT_95 = 2.201
"""97.5 % quantile of Student's t with 11 degrees of freedom."""
SMOOTH_S = 0.016
"""Length over which the velocity is computed; only its sign is used."""
STUCK_S = 0.025
"""A device slower than `slow` for longer than this may stick; friction is then anything up to c, not c sign(V)."""
TURN_S, MARGIN = 0.01, 1.2
"""Within this time of a turn, the force must exceed c by this factor; otherwise the device rests there."""
FEWEST = 100
DETERMINED = 0.1
"""Ratio of half interval to value above which a number is not determined."""
MEANS_NOTHING = 0.3
"""Unexplained fraction of the squared force above which the fit is rejected."""
EXPLAINED = 0.02
"""Unexplained fraction of the squared force above which a warning is given."""


@dataclass(frozen=True)
class Estimate:
    """A number with the half width of its 95 % confidence interval."""

    value: float
    half: float

    @property
    def is_determined(self) -> bool:
        """True if the half interval is within a tenth of the value."""
        return self.half <= DETERMINED * abs(self.value)


@dataclass(frozen=True)
class IdentifiedAxis:
    """Identified model of one axis."""

    mass_kg: Estimate
    """m in kg (kg m²)."""
    viscous: Estimate
    """b in N s/m (N m s/rad)."""
    coulomb: Estimate
    """c in N (N m)."""
    offset_n: Estimate
    """F_0 in N (N m): a weight, or an offset of the motor."""
    delay_s: Estimate
    """Delay from force to position in s."""
    unexplained: float
    """Unexplained fraction of the squared force."""
    peak_speed: float
    """Largest speed in m/s (rad/s)."""


class NotDeterminedError(RuntimeError):
    """The data do not determine the model of an axis; the text says why and what to do."""


def fit_axis(time_s: Array, position: Array, written_s: Array, force: Array) -> IdentifiedAxis:
    """Fit the model of one axis to a recorded motion.

    Args:
        time_s: Times of the samples, increasing, shape `(n,)`.
        position: x in m (rad), shape `(n,)`.
        written_s: Times of the writes, shape `(k,)`; a force lasts until the next.
        force: F_device in N (N m), shape `(k,)`.

    Raises:
        NotDeterminedError: The motion is too short or absent, or no valid mass fits.
    """
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 2 else math.nan
    if not (len(time_s) > 2 and time_s[-1] - time_s[0] > 10.0 * WINDOW_S):
        message = "too few samples: the motion was ended early"
        raise NotDeterminedError(message)
    grid = np.arange(time_s[0], time_s[-1], period_s)
    x = np.interp(grid, time_s, position)
    x -= x.mean()
    held = _Held(written_s, force)
    turns, is_stuck, speed = _turns(grid, x)
    rows, targets, is_used = _moving(_weak(grid, x, turns.signs(grid), is_stuck, held), speed)
    first, _ = _solved(rows[is_used], targets[is_used])
    # Repeat with turns corrected for the friction found.
    turns, is_weak = turns.refined(grid, held, first)
    rows, targets, is_used = _moving(_weak(grid, x, turns.signs(grid), is_stuck | is_weak, held), speed)
    rows, targets = rows[is_used], targets[is_used]
    values, left = _solved(rows, targets)
    blocks = np.array_split(np.arange(len(rows)), BLOCKS)
    others = [np.delete(np.arange(len(rows)), block) for block in blocks]
    tries = np.array([_solved(rows[kept], targets[kept])[0] for kept in others])
    deviation = np.sqrt((BLOCKS - 1) / BLOCKS * ((tries - tries.mean(axis=0)) ** 2).sum(axis=0))
    mass, viscous, coulomb, offset, delay = (
        Estimate(float(value), float(STUDENT_95 * sigma)) for value, sigma in zip(values, deviation, strict=True)
    )
    if left > MEANS_NOTHING:
        message = (
            f"m, b and c explain only {100.0 * (1.0 - left):.0f} % of the squared force: is the device held, at a"
            " stop, or at rest? Nobody may hold it"
        )
        raise NotDeterminedError(message)
    if not mass.value > mass.half:
        message = f"a mass of {mass.value:.3g} +- {mass.half:.2g}: is the device held, or its force of the other sign?"
        raise NotDeterminedError(message)
    return IdentifiedAxis(mass, viscous, coulomb, offset, delay, left, speed)


@dataclass(frozen=True)
class _Turns:
    """Times at which the velocity changes its sign."""

    time_s: Array
    before: float
    """Sign before the first turn."""
    half_s: float
    """Half the length over which the velocity was computed."""

    def signs(self, grid: Array) -> Array:
        """Mean sign of the velocity over each step of a grid."""
        step_s = float(grid[1] - grid[0])
        knots = np.concatenate([[grid[0] - step_s], self.time_s, [grid[-1] + step_s]])
        slopes = self.before * (-1.0) ** np.arange(len(knots) - 1)
        total = np.concatenate([[0.0], np.cumsum(slopes * np.diff(knots))])
        after, before = (np.interp(grid + side * step_s, knots, total) for side in (0.5, -0.5))
        return np.asarray((after - before) / step_s)

    def refined(self, grid: Array, held: "_Held", values: Array) -> "tuple[_Turns, NDArray[np.bool_]]":
        """Turns corrected for friction, and a mask of grid points at rest, even for a millisecond.

        At a turn friction changes its sign, and the acceleration changes from `(F + c) / m` to `(F - c) / m`. The slope
        of the line through x over 2 h is then zero later than V. The delay is s with `s - 3 r s^2 / (4 h) = 3 r h / 8`,
        `r = c / |F|`, to second order in s / h. If |F| is not well above c, the device rests.
        """
        _, _, coulomb, offset, delay_s = values
        pushes = np.abs(held.at(self.time_s[:, None] - delay_s + np.linspace(-TURN_S, TURN_S, 9)) + offset)
        is_weak = pushes.min(axis=1, initial=math.inf) < MARGIN * max(0.0, coulomb)
        share = np.clip(max(0.0, coulomb) / np.maximum(pushes.mean(axis=1), 1e-12), 1e-9, 1.0 / MARGIN)
        late_s = self.half_s * 2.0 / (3.0 * share) * (1.0 - np.sqrt(1.0 - 9.0 / 8.0 * share**2))
        rests = np.zeros(len(grid), dtype=bool)
        rests[np.clip(np.searchsorted(grid, self.time_s[is_weak]), 0, len(grid) - 1)] = True
        return _Turns(np.maximum.accumulate(self.time_s - late_s), self.before, self.half_s), rests


def _turns(grid: Array, x: Array) -> tuple[_Turns, NDArray[np.bool_], float]:
    """Turns, a mask of possible sticking, and the largest speed."""
    period_s = float(grid[1] - grid[0])
    half = max(2, round(0.5 * SMOOTH_S / period_s))
    at = np.arange(-half, half + 1)
    # Slope of the least-squares line, Savitzky and Golay 1964.
    slope = at / float((at**2).sum()) / period_s
    velocity = np.correlate(np.pad(x, half, mode="edge"), slope, mode="valid")
    fastest = float(np.abs(velocity).max())
    steps = np.abs(np.diff(x))
    quantum = float(steps[steps > 1e-12].min(initial=math.inf))
    slow = max(0.02 * fastest, min(quantum / SMOOTH_S, 0.1 * fastest))
    is_slow = np.abs(velocity) < slow
    is_stuck = np.zeros(len(x), dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_slow.astype(int), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if (end - begin) * period_s > STUCK_S:
            is_stuck[begin:end] = True
    moving = np.flatnonzero(velocity)
    signs = np.sign(velocity[moving])
    changes = np.flatnonzero(np.diff(signs))
    low, high = moving[changes], moving[changes + 1]
    share = velocity[low] / (velocity[low] - velocity[high])
    turns = _Turns(
        grid[low] + share * (grid[high] - grid[low]), float(signs[0]) if len(signs) else 1.0, half * period_s
    )
    return turns, is_stuck, fastest


class _Held:
    """A force held from one write to the next."""

    def __init__(self, written_s: Array, force: Array) -> None:
        self.written_s, self.force = written_s, force
        self._impulse = np.concatenate([[0.0], np.cumsum(force[:-1] * np.diff(written_s))])

    def at(self, time_s: Array) -> Array:
        """Force in N."""
        return np.asarray(self.force[np.clip(np.searchsorted(self.written_s, time_s, "right") - 1, 0, None)])

    def impulse(self, time_s: Array) -> Array:
        """Integral of the force in N s, piecewise linear between writes."""
        return np.asarray(np.interp(time_s, self.written_s, self._impulse))


_Windows = tuple[Array, Array, NDArray[np.bool_]]
"""Rows of m, b, c and F_0, right side per delay, and mask of usable windows."""


def _moving(windows: _Windows, speed: float) -> _Windows:
    """Check that the device moved; return the windows.

    Raises:
        NotDeterminedError: It hardly moved.
    """
    count = int(windows[2].sum())
    if count < FEWEST:
        message = (
            f"it moved freely in {count} of {len(windows[2])} windows, at most at {speed:.2g} per s: its force hardly"
            " overcomes its friction: allow more speed, force or travel"
        )
        raise NotDeterminedError(message)
    return windows


def _weak(grid: Array, x: Array, sign: Array, is_stuck: NDArray[np.bool_], held: _Held) -> _Windows:
    """Weak form of each window."""
    period_s = float(grid[1] - grid[0])
    count = max(16, round(WINDOW_S / period_s))
    length_s = count * period_s
    s = np.arange(count + 1) / count
    wave = 2.0 * math.pi / length_s
    # phi = sin^4(pi s) = 3/8 - cos(2 pi s)/2 + cos(4 pi s)/8, with its derivatives.
    phi = 0.375 - 0.5 * np.cos(2.0 * math.pi * s) + 0.125 * np.cos(4.0 * math.pi * s)
    first = wave * (0.5 * np.sin(2.0 * math.pi * s) - 0.25 * np.sin(4.0 * math.pi * s))
    second = wave**2 * (0.5 * np.cos(2.0 * math.pi * s) - 0.5 * np.cos(4.0 * math.pi * s))
    stride = max(1, count // WINDOWS)

    def integral(signal: Array, kernel: Array) -> Array:
        # phi and its derivatives up to phi'' vanish at both ends, so this sum is the trapezoid rule.
        return np.asarray(period_s * np.correlate(signal, kernel, mode="valid")[::stride])

    rows = np.stack(
        [integral(x, second), -integral(x, first), integral(sign, phi), -integral(np.ones_like(x), phi)], axis=1
    )
    targets = np.stack([-integral(held.impulse(grid - delay_s), first) for delay_s in DELAYS_S], axis=1)
    stuck = np.correlate(is_stuck.astype(float), np.ones(count + 1), mode="valid")[::stride]
    begins = np.arange(len(stuck)) * stride
    inside = (grid[begins] - DELAYS_S[-1] >= held.written_s[0]) & (
        grid[begins + count] - DELAYS_S[0] <= held.written_s[-1]
    )
    return rows, targets, (stuck == 0.0) & inside


def _solved(rows: Array, targets: Array) -> tuple[Array, float]:
    """m, b, c, F_0 and the delay by least squares, and the unexplained fraction of the squared force."""
    solutions = np.linalg.lstsq(rows, targets, rcond=None)[0]
    left = ((targets - rows @ solutions) ** 2).sum(axis=0) / np.maximum((targets**2).sum(axis=0), 1e-300)
    best = int(np.argmin(left))
    if 0 < best < len(DELAYS_S) - 1:
        # Minimum of the parabola through three points.
        low, mid, high = left[best - 1 : best + 2]
        share = 0.5 * (low - high) / max(low - 2.0 * mid + high, 1e-300)
    else:
        share = 0.0
    share = float(np.clip(share, -0.5, 0.5))
    # The solution is smooth in the delay: interpolate quadratically between three.
    middle = min(max(best, 1), len(DELAYS_S) - 2)
    u = best + share - middle
    weights = np.array([0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)])
    values = solutions[:, middle - 1 : middle + 2] @ weights
    delay_s = float(DELAYS_S[middle] + u * (DELAYS_S[1] - DELAYS_S[0]))
    return np.concatenate([values, [delay_s]]), float(left[best])
