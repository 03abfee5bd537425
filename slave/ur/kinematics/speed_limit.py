"""Tool speed limit in a quadratic program: a ball, by the multiplier of a cost."""

import math
from typing import Final

import numpy as np

from haptether.slave.ur.kinematics.pose import Array

CLOSE: Final = 1e-9
"""Relative tolerance of the tool speed at an active limit."""


class SpeedLimit:
    """`|J qd| <= max_speed` as a cost `m/2 |J qd|^2`, with a search for the m that reaches the limit.

    The speed falls with m. Searches on 1/speed, which is nearly linear in m for a fixed set of active bounds. It has
    kinks where the set changes, and is flat where bounds leave no freedom. Therefore: secants from the previous m, then
    within a bracket, with bisection if secants do not halve it.

    Args:
        max_speed: Limit of the tool point's speed in m/s.
        jacobian: Linear Jacobian of the tool point, (3, 6); read at each call.
        squared: J'J, (6, 6); read at each call.

    Source: J. J. More, D. C. Sorensen, "Computing a Trust Region Step", SIAM J. Sci. Stat. Comput. 4(3), 1983, section
    3 (1/speed); M. Dowell, P. Jarratt, "A modified regula falsi method", BIT 11, 1971 (Illinois).
    """

    def __init__(self, max_speed: float, jacobian: Array, squared: Array) -> None:
        self.max_speed = max_speed
        self._jacobian = jacobian
        self._squared = squared
        self._sum = np.zeros((6, 6))
        self._slope = 1.0
        """Last slope of 1/speed over m."""
        self._before: tuple[float, float] | None = None
        """m and 1/speed - 1/max_speed of the previous try."""
        self._fast = (0.0, -math.inf)
        """Same for the largest m that was too fast."""
        self._slow = (math.inf, math.inf)
        """Same for the smallest m that was too slow."""
        self._width = math.inf
        """Width of the bracket two tries ago."""

    def speed(self, qd: Array) -> float:
        """Return the tool point's speed in m/s."""
        return math.hypot(*(self._jacobian @ qd).tolist())

    def added_to(self, hessian: Array, m: float) -> Array:
        """Return H + m J'J."""
        np.multiply(self._squared, m, out=self._sum)
        np.add(self._sum, hessian, out=self._sum)
        return self._sum

    def reset(self) -> None:
        """Drop the bracket and keep the slope for the next program."""
        self._before, self._fast, self._slow, self._width = None, (0.0, -math.inf), (math.inf, math.inf), math.inf

    def next(self, m: float, speed: float) -> float:
        """Return the next m to try after one that gave a speed; 0 first if below the required value."""
        tried = m, 1 / max(speed, 1e-12) - 1 / self.max_speed
        before, self._before = self._before, tried
        if before is not None and m != before[0]:
            slope = (tried[1] - before[1]) / (m - before[0])
            self._slope = slope if slope > 0 else self._slope
        following = m - tried[1] / self._slope
        too_fast = tried[1] < 0
        # Illinois: an end that stays twice counts half.
        if too_fast:
            if before is not None and before[1] < 0:
                self._slow = self._slow[0], self._slow[1] / 2
            self._fast = tried
        else:
            if before is not None and before[1] > 0:
                self._fast = self._fast[0], self._fast[1] / 2
            self._slow = tried
        (low, low_value), (high, high_value) = self._fast, self._slow
        if high == math.inf:
            # With every joint at a bound the speed is constant until m frees one.
            return min(following, 10 * m + 1) if following > m else 10 * m + 1
        if low_value == -math.inf:
            return max(following, 0.0)
        width, self._width = self._width, high - low
        if high - low > width / 2:
            self._width = math.inf
            return (low + high) / 2
        return (low * high_value - high * low_value) / (high_value - low_value)
