"""How much delay a position-force coupling bears."""

import msgspec
import numpy as np


class Follower(msgspec.Struct, frozen=True, kw_only=True):
    """An arm that follows: `M x'' = K_s (x_set - x) + B_s (rho x_set' - x') + F_e`."""

    mass_kg: float
    damping: float
    """B_s in N s/m."""
    stiffness: float
    """K_s in N/m."""
    follows_velocity: bool = False
    """rho = 1, else 0: whether the velocity of the set position is part of the command."""


class ContactLoop(msgspec.Struct, frozen=True, kw_only=True):
    """A hand and a device that press a remote environment through a position-force coupling.

    `m x'' + b x' + k x = -lambda_f (K_e y + B_e y')(t - T)`, where y is what the slave makes of `lambda_p x` and T the
    sum of both delays: that itself without a `follower`, else the position of an arm on K_e and B_e.
    """

    mass_kg: float
    """m, of device and hand."""
    damping: float
    """b in N s/m, of device and hand."""
    hand_stiffness: float = 0.0
    """k in N/m: 0 where the hand only follows."""
    environment_stiffness: float
    """K_e in N/m."""
    environment_damping: float = 0.0
    """B_e in N s/m."""
    force_scale: float = 1.0
    """lambda_f."""
    position_scale: float = 1.0
    """lambda_p."""
    follower: Follower | None = None


def largest_delay_s(loop: ContactLoop) -> float:
    """Smallest sum of both delays in s at which contact begins to oscillate: infinite if at none, 0 if it does anyway.

    The delay margin `min (pi + arg L(jw)) / w` over all w with `|L(jw)| = 1`, of
    `L(s) = lambda_f lambda_p (K_e + B_e s) G(s) / (m s² + b s + k)`.

    Linear: Coulomb friction is left out, and so are limiter and safety controllers.

    Source: without a follower and a hand, `w tan(w T) = b/m` and `K = b w / sin(w T)`, the delayed spring; Hulin,
    Albu-Schäffer and Hirzinger 2014 have its sampled form.
    """
    gain = loop.force_scale * loop.position_scale
    contact = [loop.environment_damping, loop.environment_stiffness]
    top = np.trim_zeros(gain * np.array(contact), "f")
    bottom = np.array([loop.mass_kg, loop.damping, loop.hand_stiffness])
    if (arm := loop.follower) is not None:
        command = [arm.damping, arm.stiffness] if arm.follows_velocity else [arm.stiffness]
        top = np.polymul(top, command).astype(np.float64)
        bottom = np.polymul(bottom, np.polyadd([arm.mass_kg, arm.damping, arm.stiffness], contact))
    if top.size == 0:
        return float("inf")
    if np.roots(np.polyadd(bottom, top)).real.max() >= 0.0:
        return 0.0
    # |top|² = |bottom|² is a polynomial in w².
    crossings = np.roots(np.polysub(_squared(bottom), _squared(top)))
    real = crossings[(np.abs(crossings.imag) < 1e-9 * np.abs(crossings)) & (crossings.real > 0.0)].real
    frequencies = np.sqrt(real)
    if frequencies.size == 0:
        return float("inf")
    at = 1j * frequencies
    phase = np.angle(-np.polyval(top, at) / np.polyval(bottom, at)) % (2.0 * np.pi)
    return float((phase / frequencies).min())


def _squared(
    polynomial: "np.ndarray[tuple[int], np.dtype[np.float64]]",
) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    """`|p(jw)|²` as a polynomial in w²."""
    mirrored = polynomial * (-1.0) ** np.arange(polynomial.size)[::-1]
    even = np.polymul(polynomial, mirrored)[::-1][::2]
    # s² = -w².
    return (even * (-1.0) ** np.arange(even.size))[::-1]
