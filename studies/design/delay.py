"""Largest delay that a position-force coupling tolerates."""

from collections.abc import Iterable
from typing import TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]


class Follower(msgspec.Struct, frozen=True, kw_only=True):
    """Following arm: `M x'' = K_s (x_set - x) + B_s (rho x_set' - x') + F_e`."""

    mass_kg: float
    damping: float
    """B_s in N s/m."""
    stiffness: float
    """K_s in N/m."""
    follows_velocity: bool = False
    """True for rho = 1: the command includes the velocity of the set position; False for rho = 0."""


class ContactLoop(msgspec.Struct, frozen=True, kw_only=True):
    """Hand and device that press a remote environment through a position-force coupling.

    `m x'' + b x' + k x = -lambda_f (K_e y + B_e y')(t - T)`, where T is the sum of both delays. y is `lambda_p x`
    without a `follower`, otherwise the position of an arm on K_e and B_e that is commanded to it.

    Source: paper Eq. 3 without Coulomb friction, with a hand; Hulin, Albu-Schäffer and Hirzinger 2014 (delayed spring).
    """

    mass_kg: float
    """m of device and hand in kg."""
    damping: float
    """b of device and hand in N s/m."""
    hand_stiffness: float = 0.0
    """k in N/m; 0 if the hand only follows."""
    environment_stiffness: float
    """K_e in N/m."""
    environment_damping: float = 0.0
    """B_e in N s/m."""
    force_scale: float = 1.0
    """lambda_f, without unit."""
    position_scale: float = 1.0
    """lambda_p, without unit."""
    follower: Follower | None = None


def largest_delay_s(loop: ContactLoop) -> float:
    """Return the smallest sum of both delays in s at which contact oscillates.

    Infinite if none; 0 if it oscillates without delay.

    The delay margin `min (pi + arg L(jw)) / w` over all w with `|L(jw)| = 1`, of `L(s) = lambda_f lambda_p (K_e + B_e
    s) G(s) / (m s² + b s + k)`.

    Linear: without Coulomb friction, limiter and safety controllers.

    Source: Without follower and hand, `w tan(w T) = b/m` and `K = b w / sin(w T)`, the delayed spring; sampled form in
    Hulin, Albu-Schäffer and Hirzinger 2014.
    """
    top, bottom = _polynomials(loop)
    if top.size == 0:
        return float("inf")
    if np.roots(np.polyadd(bottom, top)).real.max() >= 0.0:
        return 0.0
    frequencies, phases, _ = _crossings(top, bottom)
    return float((phases / frequencies).min()) if frequencies.size else float("inf")


def stable_delays(loop: ContactLoop, up_to_s: float) -> tuple[tuple[float, float], ...]:
    """Return the intervals of the sum of both delays in s, 0 to `up_to_s`, without oscillation of the contact.

    Roots of `bottom + top e^(-sT)` enter and leave the right half plane in pairs, at the delays `(phase + 2 pi n) / w`
    of all w with `|top| = |bottom|`; they enter where `|bottom|² - |top|²` increases with w. Linear, same as
    `largest_delay_s`.

    Raises:
        ValueError: `up_to_s` is negative or infinite.

    Source: Walton and Marshall 1987, "Direct method for TDS stability analysis".
    """
    if not 0.0 <= up_to_s < float("inf"):
        message = f"up_to_s = {up_to_s}: must be a number of at least 0"
        raise ValueError(message)
    top, bottom = _polynomials(loop)
    if top.size == 0:
        return ((0.0, up_to_s),) if np.roots(bottom).real.max() < 0.0 else ()
    unstable = int((np.roots(np.polyadd(bottom, top)).real >= 0.0).sum())
    changes: list[tuple[float, int]] = []
    for frequency, phase, enters in zip(*_crossings(top, bottom), strict=True):
        delays = np.arange(phase / frequency, up_to_s, 2.0 * np.pi / frequency)
        changes += [(float(delay), 2 if enters else -2) for delay in delays]
    found: list[tuple[float, float]] = []
    begun = 0.0 if unstable == 0 else None
    for delay, change in sorted(changes):
        unstable += change
        if unstable == 0 and begun is None:
            begun = delay
        elif unstable > 0 and begun is not None:
            found.append((begun, delay))
            begun = None
    if begun is not None:
        found.append((begun, up_to_s))
    return tuple(found)


def stable_together(loops: Iterable[ContactLoop], up_to_s: float) -> tuple[tuple[float, float], ...]:
    """Return the intervals of the sum of both delays in s, 0 to `up_to_s`, without oscillation of any loop.

    Raises:
        ValueError: `up_to_s` is negative or infinite.
    """
    common: tuple[tuple[float, float], ...] = ((0.0, up_to_s),)
    for loop in loops:
        own = stable_delays(loop, up_to_s)
        both = ((max(low, begin), min(high, end)) for low, high in common for begin, end in own)
        common = tuple((low, high) for low, high in both if low < high)
    return common


def _polynomials(loop: ContactLoop) -> tuple[Array, Array]:
    """Return the polynomials of `bottom(s) + top(s) e^(-sT) = 0`; `top` is empty without contact."""
    gain = loop.force_scale * loop.position_scale
    contact = [loop.environment_damping, loop.environment_stiffness]
    top = np.trim_zeros(gain * np.array(contact), "f")
    bottom = np.array([loop.mass_kg, loop.damping, loop.hand_stiffness])
    if (arm := loop.follower) is not None:
        command = [arm.damping, arm.stiffness] if arm.follows_velocity else [arm.stiffness]
        top = np.polymul(top, command).astype(np.float64)
        bottom = np.polymul(bottom, np.polyadd([arm.mass_kg, arm.damping, arm.stiffness], contact))
    return top, bottom


def _crossings(top: Array, bottom: Array) -> tuple[Array, Array, "npt.NDArray[np.bool_]"]:
    """Return each w in rad/s with `|top| = |bottom|`, `w T` in rad of its first delay, and True if roots enter."""
    # |top|² = |bottom|² is a polynomial in w².
    excess = np.polysub(_squared(bottom), _squared(top))
    crossings = np.roots(excess)
    squared = crossings[(np.abs(crossings.imag) < 1e-9 * np.abs(crossings)) & (crossings.real > 0.0)].real
    frequencies = np.sqrt(squared)
    at = 1j * frequencies
    phases = np.angle(-np.polyval(top, at) / np.polyval(bottom, at)) % (2.0 * np.pi)
    return frequencies, phases, np.polyval(np.polyder(excess), squared) > 0.0


def _squared(polynomial: Array) -> Array:
    """Return `|p(jw)|²` as a polynomial in w²."""
    mirrored = polynomial * (-1.0) ** np.arange(polynomial.size)[::-1]
    even = np.polymul(polynomial, mirrored)[::-1][::2]
    # s² = -w².
    return (even * (-1.0) ** np.arange(even.size))[::-1]
