"""Hand model from a recording: impedance by least squares, and ticks at which the hand holds the device."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Struct

Array = npt.NDArray[np.float64]

SMOOTHED_S = 0.021
"""Length in s of the smoothing kernel for all signals; derivatives of a quantised position need it."""
WINDOW_S = 0.2
"""Length in s of a window within which the intended path of the hand is taken as a parabola."""
LAGS_S = (0.0, 0.01, 0.025, 0.05)
"""Lags in s of the force that moves the hand."""
MIN_FORCE_N = 0.5
"""Smallest |F_device| in N at which the holding state is decided."""
STOP_M = 5e-4
"""Distance in m to a mechanical stop within which the device may rest on it."""
LET_GO, HOLDS_AGAIN = 0.3, 0.6
"""Fractions of |F_device| borne by the hand: released below the first, holding again above the second."""
MAX_ERROR = 0.5
"""Largest relative standard error of a stiffness that counts as identified."""
MIN_WINDOWS = 4
LEAST_N = 1e-2
"""Smallest force change in N within a window that counts as moving the hand."""


class HandFit(Struct, frozen=True, kw_only=True):
    """Hand that holds a device: `F_hand = K (x_wanted - x) - B V - M A`.

    Source: Hogan 1989 (impedance).
    """

    stiffness: float
    """K in N/m."""
    damping: float
    """B in N s/m."""
    mass_kg: float
    """M in kg."""
    stiffness_error: float
    """Standard error of K in N/m (jackknife over windows)."""
    damping_error: float
    """Standard error of B in N s/m."""
    explained: float
    """Fraction, 0 to 1, that the model explains of the change of hand force caused by the remote force."""
    windows: int
    """Number of windows in the fit."""
    held_s: float
    """Time in s for which the hand held the device."""


class HandError(ValueError):
    """Recording that does not determine the hand well enough."""


def hand_of(
    position: Array, device_force: Array, device: dict[str, Any], period_s: float
) -> tuple[HandFit, npt.NDArray[np.bool_]]:
    """Identify the impedance of the hand that holds a device, and the ticks at which it holds.

    The equation of motion of the device, `m A + b V + c sign(V) = F_device + F_hand`, gives the hand force. Least
    squares fits its response to motion, with the device force as the instrument: voluntary motion alone would look like
    a hand without stiffness.

    Args:
        position: x in m, shape `(n_ticks, axes)`.
        device_force: F_device in N at each tick, held until the next.
        device: `mass_kg`, `viscous`, `coulomb` and optional `stops` of the device, one value per axis.
        period_s: dT in s.

    Raises:
        HandError: The device force moves the hand too little.
    """
    motion = _motion_of(position, device_force, device, period_s)
    x, velocity, acceleration, force, hand_force, stopped, half = motion
    holds = _holds_of(motion)
    answers = np.stack([x, velocity, acceleration], axis=2)
    windows = _windows((answers, hand_force, force), holds & ~stopped, period_s, half)
    return _fit(windows, float(holds.sum() * period_s)), holds


def held_ticks(position: Array, device_force: Array, device: dict[str, Any], period_s: float) -> npt.NDArray[np.bool_]:
    """Return the ticks at which a hand holds a device by the equation of motion (paper Eq. 3), shape `(n_ticks,)`.

    The hand releases when it bears less than `LET_GO` of F_device, until it bears more than `HOLDS_AGAIN`. Below
    `MIN_FORCE_N` and at a mechanical stop the state does not change.

    Args:
        position: As for `hand_of`.
        device_force: As for `hand_of`.
        device: As for `hand_of`.
        period_s: As for `hand_of`.

    Raises:
        HandError: The recording has too few ticks.
    """
    return _holds_of(_motion_of(position, device_force, device, period_s))


class _Motion(NamedTuple):
    """Smoothed signals of a recorded device and its hand, each of shape `(n_ticks, axes)`."""

    x: Array
    velocity: Array
    acceleration: Array
    force: Array
    hand_force: Array
    stopped: npt.NDArray[np.bool_]
    half: int


def _motion_of(position: Array, device_force: Array, device: dict[str, Any], period_s: float) -> _Motion:
    half = max(2, round(SMOOTHED_S / period_s / 2))
    if len(position) < 8 * half:
        message = f"{len(position)} ticks are too few"
        raise HandError(message)
    mass, viscous, coulomb = (np.asarray(device[name]) for name in ("mass_kg", "viscous", "coulomb"))
    x = _smoothed(position, half)
    # The force is held between ticks, so its average around a tick is the mean of both.
    force = _smoothed((device_force + np.vstack([device_force[:1], device_force[:-1]])) / 2, half)
    velocity = np.gradient(x, period_s, axis=0)
    acceleration = np.zeros_like(x)
    acceleration[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) / period_s**2
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    friction = coulomb * velocity / np.maximum(speed, 1e-3)
    hand_force = mass * acceleration + viscous * velocity + friction - force
    stopped = _at_a_stop(position, device.get("stops"), half)
    return _Motion(x, velocity, acceleration, force, hand_force, stopped, half)


def _holds_of(motion: _Motion) -> npt.NDArray[np.bool_]:
    hand, force = np.linalg.norm(motion.hand_force, axis=1), np.linalg.norm(motion.force, axis=1)
    return _holds(hand, force, (force >= MIN_FORCE_N) & ~motion.stopped)


def _smoothed(values: Array, half: int) -> Array:
    """Smooth by a symmetric kernel without delay; the ends are held."""
    kernel = np.hanning(2 * half + 3)[1:-1]
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    columns = [np.convolve(padded[:, axis], kernel / kernel.sum(), "valid") for axis in range(values.shape[1])]
    return np.stack(columns, axis=1)


def _at_a_stop(position: Array, stops: Sequence[Sequence[float] | None] | None, half: int) -> npt.NDArray[np.bool_]:
    """Mask of ticks at which a mechanical stop may bear the device force, which would look like a hand."""
    stopped = np.zeros(len(position), dtype=bool)
    for axis, pair in enumerate(stops or ()):
        if pair is not None:
            low, high = pair
            stopped |= (position[:, axis] <= low + STOP_M) | (position[:, axis] >= high - STOP_M)
    # Widen by the kernel length.
    return np.convolve(stopped, np.ones(2 * half + 1), "same") > 0.5


def _holds(hand: Array, device: Array, decided: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Mask of ticks at which a hand holds against the force; undecided ticks keep the last state."""
    holds = np.ones(len(hand), dtype=bool)
    held = True
    for tick in np.flatnonzero(decided):
        share = hand[tick] / device[tick]
        if held and share < LET_GO:
            held = False
            holds[tick:] = False
        elif not held and share > HOLDS_AGAIN:
            held = True
            holds[tick:] = True
    return holds


def _windows(
    signals: tuple[Array, Array, Array], usable: npt.NDArray[np.bool_], period_s: float, half: int
) -> list[tuple[Array, Array, Array]]:
    """Return instruments, x, V, A and resisting force of each window and axis, with a parabola removed."""
    answers, hand_force, force = signals
    length = round(WINDOW_S / period_s)
    lags = [round(lag / period_s) for lag in LAGS_S]
    time = np.linspace(-1.0, 1.0, length)
    parabola, _ = np.linalg.qr(np.stack([np.ones(length), time, time**2], axis=1))
    windows = []
    for begin in range(max(half, lags[-1]), len(force) - length - half, length // 2):
        part = slice(begin, begin + length)
        if not usable[part].all():
            continue
        for axis in range(force.shape[1]):
            moved_by = np.stack([force[begin - lag : begin - lag + length, axis] for lag in lags], axis=1)
            of_window = (moved_by, answers[part, axis], -hand_force[part, axis])
            rest = [values - parabola @ (parabola.T @ values) for values in of_window]
            if np.abs(rest[0]).max() > LEAST_N:
                windows.append((rest[0], rest[1], rest[2]))
    return windows


def _fit(windows: list[tuple[Array, Array, Array]], held_s: float) -> HandFit:
    if len(windows) < MIN_WINDOWS:
        message = f"a force moves the hand in {len(windows)} windows of {WINDOW_S:g} s, {MIN_WINDOWS} are needed"
        raise HandError(message)
    # Products per window, so that one can be left out.
    parts = [(z.T @ z, z.T @ a, z.T @ t) for z, a, t in windows]
    totals = tuple(np.sum([part[index] for part in parts], axis=0) for index in range(3))
    used = 3
    solution = _solved(totals, used)
    if solution[2] < 0.0:
        used = 2
        solution = _solved(totals, used)
    without = np.array([_solved(tuple(t - p for t, p in zip(totals, part, strict=True)), used) for part in parts])
    count = len(parts)
    errors = np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    explained = _explained(totals, solution)
    stiffness, damping, mass = solution
    if not stiffness > 0.0 or errors[0] > MAX_ERROR * stiffness or damping < -2.0 * errors[1]:
        found = f"K = {stiffness:.4g} ± {errors[0]:.2g} N/m, B = {damping:.3g} ± {errors[1]:.2g} N s/m"
        message = f"{found}: no hand is like that"
        raise HandError(message)
    return HandFit(
        stiffness=float(stiffness),
        damping=float(max(damping, 0.0)),
        mass_kg=float(mass),
        stiffness_error=float(errors[0]),
        damping_error=float(errors[1]),
        explained=explained,
        windows=count,
        held_s=held_s,
    )


def _solved(totals: tuple[Array, ...], used: int) -> Array:
    """Return K, B and M by two-stage least squares, limited to the first `used`."""
    zz, za, zt = totals
    pseudo = np.linalg.pinv(zz, rcond=1e-10)
    answers = za[:, :used]
    found = np.linalg.lstsq(answers.T @ pseudo @ answers, answers.T @ pseudo @ zt, rcond=None)[0]
    return np.concatenate([found, np.zeros(3 - used)])


def _explained(totals: tuple[Array, ...], solution: Array) -> float:
    """Return the explained fraction of the variation caused by the instruments."""
    zz, za, zt = totals
    pseudo = np.linalg.pinv(zz, rcond=1e-10)
    rest = zt - za @ solution
    whole = float(zt @ pseudo @ zt)
    return max(0.0, 1.0 - float(rest @ pseudo @ rest) / whole) if whole > 0.0 and math.isfinite(whole) else 0.0
