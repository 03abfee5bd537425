"""Emulated Inverse3: a mass with friction on three axes, held by a hand; time is an argument."""

import math
from dataclasses import dataclass
from typing import Final

Vector = tuple[float, float, float]

STEP_S: Final = 1e-4
MAX_GAP_S: Final = 0.1
"""Longest integrated pause in s, so that a suspended process does not jump."""
STILL_M_S: Final = 1e-5
"""Speed in m/s below which friction holds."""


@dataclass(frozen=True, kw_only=True)
class EmulatedSettings:
    """m, b, c of the device and the spring of the hand, in SI units.

    No source gives values of an Inverse3; these are the substitutes of its preset.
    """

    mass_kg: float = 0.157
    viscous: float = 0.0
    coulomb: float = 0.038
    hand_stiffness: float = 200.0
    hand_damping: float = 8.0
    reach_m: float = 0.4
    """Largest distance from the origin."""

    def __post_init__(self) -> None:
        limits = {"mass_kg": (1e-3, 10.0), "viscous": (0.0, 100.0), "coulomb": (0.0, 20.0)}
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            if not least <= value <= most:
                message = f"{name} = {value:g}: must be {least:g} to {most:g}"
                raise ValueError(message)


class EmulatedInverse3:
    """m A = F + F_hand - b V - c V/|V|, semi-implicit Euler at 10 kHz.

    Args:
        settings: Settings of device and hand.
        position: Initial position in m in the device frame.
    """

    def __init__(self, settings: EmulatedSettings, position: Vector = (0.0, -0.12, 0.15)) -> None:
        self.settings = settings
        self.position = position
        self.velocity: Vector = (0.0, 0.0, 0.0)
        self.force: Vector = (0.0, 0.0, 0.0)
        """Motor force in N."""
        self.hand: Vector | None = position
        """Target of the hand; None if nobody holds the device."""
        self._now_s: float | None = None

    def advance(self, now_s: float) -> None:
        """Advance to a time in s."""
        if self._now_s is None:
            self._now_s = now_s
        self._now_s = max(self._now_s, now_s - MAX_GAP_S)
        while self._now_s + STEP_S <= now_s:
            self._step()
            self._now_s += STEP_S

    def _step(self) -> None:
        own = self.settings
        held = self.hand is not None
        target = self.hand or self.position
        spring, damper = (own.hand_stiffness, own.hand_damping) if held else (0.0, 0.0)
        push = tuple(
            f + spring * (h - x) - (damper + own.viscous) * v
            for f, h, x, v in zip(self.force, target, self.position, self.velocity, strict=True)
        )
        pushed = [v + p / own.mass_kg * STEP_S for v, p in zip(self.velocity, push, strict=True)]
        speed = math.hypot(*pushed)
        # Friction removes at most the whole momentum.
        left = max(0.0, speed - own.coulomb / own.mass_kg * STEP_S)
        scale = 0.0 if speed < STILL_M_S or left == 0.0 else left / speed
        vx, vy, vz = (v * scale for v in pushed)
        x, y, z = (p + v * STEP_S for p, v in zip(self.position, (vx, vy, vz), strict=True))
        distance = math.hypot(x, y, z)
        if distance > own.reach_m:
            x, y, z = (part * own.reach_m / distance for part in (x, y, z))
            vx = vy = vz = 0.0
        self.position, self.velocity = (x, y, z), (vx, vy, vz)
