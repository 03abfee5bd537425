"""Estimate of environment torques on the joints from motor currents."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from haptether.dynamixel.arm import ServoSettings, Vector

STANDING_RAD_S: Final = 0.05
"""Speed below which a gear may stand: two units of Present Velocity."""


class JointTorque:
    """Torque of the environment on each joint in N m, positive along q.

    Moving: tau_e = -K_t i + c sign(v) + b v. Standing: friction may be anything from -c to c, so the value nearest to 0
    is reported: tau_e = -sign(i) max(K_t |i| - c, 0). In between, the two are blended. The estimate includes weight and
    acceleration of the arm, which are unknown here.

    Args:
        servos: Servos of the arm.
        constant: K_t in N m/A; by default the likely value of each servo.
        coulomb: c in N m; by default 0.
        viscous: b in N m s/rad; by default 0.
        filter_hz: Corner frequency of the first-order low-pass; None for none.
    """

    def __init__(
        self,
        servos: Sequence[ServoSettings],
        *,
        constant: Sequence[float] = (),
        coulomb: Sequence[float] = (),
        viscous: Sequence[float] = (),
        filter_hz: float | None = None,
    ) -> None:
        models = [one.servo for one in servos]
        self._constant = np.array(constant or [one.nm_per_a for one in servos])
        self._coulomb = np.array(coulomb or [0.0] * len(models))
        self._viscous = np.array(viscous or [0.0] * len(models))
        self._blind = np.array([not model.has_current_control for model in models])
        self._filter_hz = filter_hz
        self._felt: Vector = np.zeros(len(models))
        self._begun = False

    def of(self, current_a: Vector, velocity: Vector, period_s: float) -> Vector:
        """Return the torque from currents in A and velocities in rad/s; 0 for a servo without current measurement."""
        motor = self._constant * current_a
        motor[self._blind] = 0.0
        moving = -motor + self._coulomb * np.sign(velocity) + self._viscous * velocity
        standing = -np.sign(motor) * np.maximum(np.abs(motor) - self._coulomb, 0.0)
        share = np.minimum(np.abs(velocity) / STANDING_RAD_S, 1.0)
        torque = share * moving + (1.0 - share) * standing
        torque[self._blind] = 0.0
        if self._filter_hz is None or not self._begun:
            self._felt, self._begun = torque, True
        else:
            self._felt = self._felt + (1.0 - math.exp(-2.0 * math.pi * self._filter_hz * period_s)) * (
                torque - self._felt
            )
        return self._felt

    def reset(self) -> None:
        """Clear the filter."""
        self._begun = False
