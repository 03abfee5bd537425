"""Device, hand and wall on one axis by fixed-step methods, for comparison with the exact engine.

No method handles events: a contact, a slipping grip and a reversal under friction fall inside a step. A fixed-step
method cannot hold a device at rest, so its friction is `c V / V_f` below V_f = 1 mm/s.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from _piecewise import Plant, ticks_of
from haptether.bridge import Scene

Array = npt.NDArray[np.float64]
Method = Literal["rk4", "velocity-verlet", "semi-implicit-euler"]

METHODS: tuple[Method, ...] = ("rk4", "velocity-verlet", "semi-implicit-euler")
FRICTION_SPEED = 1e-3
"""V_f in m/s."""


class Numbers(NamedTuple):
    """Scene in the form that Numba takes; without a release `begins_s` is infinite."""

    period_s: float
    position: float
    velocity: float
    mass: float
    viscous: float
    coulomb: float
    stiffness: float
    damping: float
    strength: float
    begins_s: float
    ends_s: float
    knots_s: Array
    ends: Array
    push: float
    wall_stiffness: float
    wall_damping: float
    is_held: bool
    """True if the wall's force is sampled at each tick and held, else it acts continuously."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stepped:
    """Position in m and velocity in m/s at each tick, and last time in s that the wall was left: accurate to a tick."""

    position: Array
    velocity: Array
    left_s: float | None


@cache
def compiled(*, numba: bool) -> Callable[[Numbers, int, int, Array, Array], None]:
    """Return the loop over ticks and steps, as machine code if `numba`."""
    jit: Any = importlib.import_module("numba").njit if numba else lambda function: function

    @jit  # type: ignore[untyped-decorator]
    def acceleration(p: Numbers, held: float, t: float, x: float, v: float) -> float:
        target: float = p.ends[-1]
        for leg in range(len(p.ends) - 1):
            if t < p.knots_s[leg + 1]:
                s = (t - p.knots_s[leg]) / (p.knots_s[leg + 1] - p.knots_s[leg])
                target = p.ends[leg] + (p.ends[leg + 1] - p.ends[leg]) * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
                break
        strength = p.strength
        if t > p.begins_s:
            strength *= max(0.0, (p.ends_s - t) / (p.ends_s - p.begins_s))
        hand = p.stiffness * (target - x) - p.damping * v
        force = p.push + held + min(max(hand, -strength), strength) - p.viscous * v
        if x < 0.0 and not p.is_held:
            force += max(0.0, -p.wall_stiffness * x - p.wall_damping * v)
        return (force - p.coulomb * min(max(v / FRICTION_SPEED, -1.0), 1.0)) / p.mass

    @jit  # type: ignore[untyped-decorator]
    def loop(p: Numbers, method: int, steps: int, positions: Array, velocities: Array) -> None:
        x, v, h = p.position, p.velocity, p.period_s / steps
        for tick in range(len(positions)):
            positions[tick], velocities[tick] = x, v
            held = p.wall_stiffness * max(-x, 0.0) if p.is_held else 0.0
            for step in range(steps):
                t = (tick * steps + step) * h
                first = acceleration(p, held, t, x, v)
                if method == 0:
                    v2 = v + 0.5 * h * first
                    second = acceleration(p, held, t + 0.5 * h, x + 0.5 * h * v, v2)
                    v3 = v + 0.5 * h * second
                    third = acceleration(p, held, t + 0.5 * h, x + 0.5 * h * v2, v3)
                    v4 = v + h * third
                    fourth = acceleration(p, held, t + h, x + h * v3, v4)
                    x += h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
                    v += h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
                elif method == 1:
                    middle = v + 0.5 * h * first
                    x += h * middle
                    # Damping needs V at the end: with a V half a kick earlier the method would lose an order.
                    v = middle + 0.5 * h * acceleration(p, held, t + h, x, v + h * first)
                else:
                    v += h * first
                    x += h * v

    return loop  # type: ignore[no-any-return]


def step(scene: Scene, method: Method, step_s: float, *, numba: bool = False) -> Stepped:
    """Return the motion at each tick of a scene of `_piecewise.Plant`.

    Args:
        scene: One axis.
        method: One of `METHODS`.
        step_s: A whole fraction of a tick.
        numba: True for machine code; needs `haptether[bench]`.
    """
    plant, ticks = Plant(scene), ticks_of(scene)
    begins_s, ends_s = plant.release or (inf, inf)
    is_held = scene.environment is not None and scene.environment.rendering == "sampled"
    numbers = Numbers(
        scene.run.period_s, plant.position, plant.velocity, plant.mass, plant.viscous, plant.coulomb, plant.stiffness,
        plant.damping, plant.strength, begins_s, ends_s, np.array(plant.knots), np.array(plant.ends), plant.push,
        plant.wall_stiffness, plant.wall_damping, is_held,
    )  # fmt: skip
    x, v = np.empty(len(ticks)), np.empty(len(ticks))
    compiled(numba=numba)(numbers, METHODS.index(method), round(scene.run.period_s / step_s), x, v)
    pushed = np.flatnonzero((x < 0.0) & (plant.wall_stiffness * x + plant.wall_damping * v < 0.0))
    left = ticks[min(pushed[-1] + 1, len(ticks) - 1)] if len(pushed) and not is_held else None
    return Stepped(position=x, velocity=v, left_s=None if left is None else float(left))
