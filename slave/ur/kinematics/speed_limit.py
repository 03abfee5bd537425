"""The limit of the tool's speed in a quadratic program: a ball, by the multiplier of a cost."""

import math
from typing import Final

import numpy as np

from haptether.slave.ur.kinematics.pose import Array

CLOSE: Final = 1e-9
"""How far the tool's speed may be from its limit where the limit holds, as a part of it."""


class SpeedLimit:
    """`|J qd| <= max_speed` as a cost `m/2 |J qd|^2`: m is searched for which the speed, which falls with m, is that.

    By 1/speed, which is all but linear in m as long as the same bounds hold; where bounds come and go it has kinks, and
    where they leave nothing to choose it is flat. So: secants from the m before, then within a bracket, which is halved
    where secants do not do that.

    Args:
        max_speed: Of the tool point, in m/s.
        jacobian: Linear velocity of the tool point by those of the joints, (3, 6); read at each call.
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
        """Of 1/speed by m, as it was last seen."""
        self._before: tuple[float, float] | None = None
        """m and 1/speed - 1/max_speed of the try before."""
        self._fast = (0.0, -math.inf)
        """The same of the largest m that was too fast."""
        self._slow = (math.inf, math.inf)
        """The same of the smallest m that was too slow."""
        self._width = math.inf
        """Of the bracket two tries ago."""

    def speed(self, qd: Array) -> float:
        """Of the tool point in m/s."""
        return math.hypot(*(self._jacobian @ qd).tolist())

    def added_to(self, hessian: Array, m: float) -> Array:
        """H + m J'J."""
        np.multiply(self._squared, m, out=self._sum)
        np.add(self._sum, hessian, out=self._sum)
        return self._sum

    def reset(self) -> None:
        """Drops the bracket and keeps the slope, for the next program."""
        self._before, self._fast, self._slow, self._width = None, (0.0, -math.inf), (math.inf, math.inf), math.inf

    def next(self, m: float, speed: float) -> float:
        """The m to try after one that gave that speed; 0 before any other below what is needed."""
        tried = m, 1 / max(speed, 1e-12) - 1 / self.max_speed
        before, self._before = self._before, tried
        if before is not None and m != before[0]:
            slope = (tried[1] - before[1]) / (m - before[0])
            self._slope = slope if slope > 0 else self._slope
        following = m - tried[1] / self._slope
        too_fast = tried[1] < 0
        # Illinois: an end that stays a second time counts half.
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
            # With every joint at a bound the speed does not change at all, until m frees one.
            return min(following, 10 * m + 1) if following > m else 10 * m + 1
        if low_value == -math.inf:
            return max(following, 0.0)
        width, self._width = self._width, high - low
        if high - low > width / 2:
            self._width = math.inf
            return (low + high) / 2
        return (low * high_value - high * low_value) / (high_value - low_value)
