"""A device in virtual time: `m A + b V + c sign(V) = F + F_0`, with a quantised position, noise and delay."""

import math
from collections import deque

import numpy as np

from haptether.master import MasterSample


class Plant:
    """One axis, advanced exactly between two changes of force; at rest, friction resists up to c.

    Source: paper Eq. 3, solved under a constant force: `V = V_inf + (V_0 - V_inf) exp(-b t / m)`.
    """

    def __init__(self, mass_kg: float, viscous: float, coulomb: float, offset_n: float = 0.0) -> None:
        self.m, self.b, self.c, self.offset_n = mass_kg, viscous, coulomb, offset_n
        self.x = self.v = 0.0

    def _free(self, force: float, t: float) -> tuple[float, float]:
        """Return displacement and velocity after t under a constant force that includes friction."""
        if abs(self.b) * t / self.m < 1e-9:
            a = force / self.m
            return self.v * t + 0.5 * a * t * t, self.v + a * t
        rate, steady = self.b / self.m, force / self.b
        decay = math.exp(-rate * t)
        return steady * t + (self.v - steady) * (1.0 - decay) / rate, steady + (self.v - steady) * decay

    def advance(self, force: float, t: float) -> None:
        """Advance by a time in s under a force in N."""
        force += self.offset_n
        while t > 0.0:
            if self.v == 0.0:
                if abs(force) <= self.c:
                    return
                side = math.copysign(1.0, force)
            else:
                side = math.copysign(1.0, self.v)
            net = force - self.c * side
            dx, v = self._free(net, t)
            if v * side >= 0.0:
                self.x, self.v = self.x + dx, v
                return
            low, high = 0.0, t
            for _ in range(60):
                middle = 0.5 * (low + high)
                if self._free(net, middle)[1] * side > 0.0:
                    low = middle
                else:
                    high = middle
            self.x += self._free(net, high)[0]
            self.v, t = 0.0, t - high


class VirtualDevice:
    """Several axes, as a driver sees them.

    Args:
        plants: One an axis.
        delay_s: From a write until the force acts, in s.
        quantum: Resolution of the position.
        noise: Standard deviation of the position.
        seed: Of the noise.
    """

    def __init__(
        self, plants: list[Plant], *, delay_s: float = 0.0, quantum: float = 0.0, noise: float = 0.0, seed: int = 1
    ) -> None:
        self.plants, self.delay_s, self.quantum, self.noise = plants, delay_s, quantum, noise
        self.random = np.random.default_rng(seed)
        self.now_s = 0.0
        self.written: deque[tuple[float, tuple[float, ...]]] = deque()
        self.acting: tuple[float, ...] = (0.0,) * len(plants)

    def write(self, force: tuple[float, ...], at_s: float) -> None:
        self.written.append((at_s + self.delay_s, force))

    def read(self, at_s: float) -> MasterSample:
        """Return the position at a time that is not before the previous one."""
        while self.written and self.written[0][0] <= at_s:
            acts_s, force = self.written.popleft()
            self._advance(acts_s)
            self.acting = force
        self._advance(at_s)
        x = np.array([plant.x for plant in self.plants]) + self.noise * self.random.standard_normal(len(self.plants))
        if self.quantum:
            x = self.quantum * np.round(x / self.quantum)
        return MasterSample(x.tolist())

    def _advance(self, to_s: float) -> None:
        if to_s > self.now_s:
            for plant, force in zip(self.plants, self.acting, strict=True):
                plant.advance(force, to_s - self.now_s)
            self.now_s = to_s
