"""Speed profiles of the controller's own moves."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """The way along a path from rest to rest: speeds up at a, goes at v, slows down at a; in m or rad.

    Where the path is shorter than `v²/a`, the top speed is `sqrt(a length)`.
    """

    length: float
    speed: float
    acceleration: float

    @property
    def top_speed(self) -> float:
        """The largest speed that is reached."""
        return min(self.speed, math.sqrt(self.acceleration * self.length))

    @property
    def rise_s(self) -> float:
        """How long it speeds up, in s."""
        return self.top_speed / self.acceleration

    @property
    def duration_s(self) -> float:
        """How long it takes, in s."""
        return self.rise_s + self.length / self.top_speed if self.length > 0.0 else 0.0

    def at(self, time_s: float) -> float:
        """How far it has come."""
        if self.length <= 0.0:
            return 0.0
        left = self.duration_s - time_s
        if time_s <= 0.0:
            return 0.0
        if left <= 0.0:
            return self.length
        rise = self.rise_s
        if time_s < rise:
            return 0.5 * self.acceleration * time_s * time_s
        if left < rise:
            return self.length - 0.5 * self.acceleration * left * left
        return self.top_speed * (time_s - 0.5 * rise)
