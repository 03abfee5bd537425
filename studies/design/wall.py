"""Largest wall stiffness that a servo loop renders without oscillation of device and hand."""

from math import pi

import numpy as np
import numpy.typing as npt

Complex = npt.NDArray[np.complex128]

GRID = 20_000
"""Number of frequencies in the search for the stability limit."""
HALVINGS = 60


def largest_wall_stiffness(
    *, mass_kg: float, damping: float, hand_stiffness: float, wall_damping: float, period_s: float, late_ticks: int
) -> float:
    """Return the largest K in N/m of a sampled wall with stable device and hand; 0 if unstable without it.

    `1 + (K + B (1 - 1/z) / T) G(z) / z^d = 0` with G(z) of `1 / (m s² + b s + k)` behind a zero-order hold: the
    smallest K that is real and positive on `z = e^(jwT)`. Linear: without Coulomb friction and quantisation.

    Args:
        mass_kg: m of the device in kg.
        damping: b of device and hand in N s/m.
        hand_stiffness: k in N/m; 0 without a hand.
        wall_damping: B in N s/m, for the difference of two positions.
        period_s: T in s.
        late_ticks: d, delay of the force in ticks.

    Source: Colgate and Schenkel 1994; Gil, Avello, Rubio and Florez 2004; D-decomposition, Neimark 1949.
    """
    if damping <= 0.0:
        return 0.0
    discrete = _Discrete(mass_kg, damping, hand_stiffness, period_s)

    def stiffness(frequency: "npt.NDArray[np.float64]") -> Complex:
        z = np.exp(1j * frequency * period_s)
        found: Complex = -(z**late_ticks) / discrete.response(z) - wall_damping * (1.0 - 1.0 / z) / period_s
        return found

    grid = np.geomspace(1e-6, 1.0, GRID) * pi / period_s
    imaginary = stiffness(grid).imag
    least = np.inf
    for place in np.flatnonzero(np.sign(imaginary[:-1]) != np.sign(imaginary[1:])):
        low, high = grid[place], grid[place + 1]
        rises = imaginary[place] < 0.0
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            if (stiffness(np.array([middle]))[0].imag < 0.0) == rises:
                low = middle
            else:
                high = middle
        gain = float(stiffness(np.array([low]))[0].real)
        if gain > 0.0:
            least = min(least, gain)
    # At half the tick rate all values are real.
    edge = float(stiffness(np.array([pi / period_s]))[0].real)
    return min(least, edge) if edge > 0.0 else float(least)


class _Discrete:
    """`1 / (m s² + b s + k)` behind a zero-order hold, discretised."""

    def __init__(self, mass_kg: float, damping: float, stiffness: float, period_s: float) -> None:
        motion = np.array([[0.0, 1.0, 0.0], [-stiffness / mass_kg, -damping / mass_kg, 1.0 / mass_kg], [0.0] * 3])
        whole = exponential(motion * period_s)
        self.step, self.push = whole[:2, :2], whole[:2, 2]

    def response(self, z: Complex) -> Complex:
        """Return X / F."""
        (a, b), (c, d) = self.step
        first, second = self.push
        found: Complex = ((z - d) * first + b * second) / ((z - a) * (z - d) - b * c)
        return found


def exponential(matrix: "npt.NDArray[np.float64]") -> "npt.NDArray[np.float64]":
    """Matrix exponential by its series, with scaling and squaring (Moler and Van Loan 2003, method 3)."""
    squarings = max(0, int(np.ceil(np.log2(max(np.abs(matrix).sum(axis=1).max(), 1e-300)))) + 4)
    small = matrix / 2.0**squarings
    term = whole = np.eye(len(matrix))
    for order in range(1, 14):
        term = term @ small / order
        whole = whole + term
    for _ in range(squarings):
        whole = whole @ whole
    return whole
