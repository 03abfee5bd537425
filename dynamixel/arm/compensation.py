"""Torques that a joint in current mode needs for itself: gravity and friction."""

import math
from collections.abc import Callable, Sequence

from haptether.dynamixel.description.kinematics import Numbers


class JointCompensation:
    """Torques of gravity and friction.

    tau = k_g dV/dq + k_f (c tanh(w / w_0) + b w). The friction torque follows the motion, and vanishes with it.

    Args:
        gravity: dV/dq in N m of the joint angles; None if the masses are unknown.
        gravity_gain: k_g, compensated fraction of gravity.
        coulomb: k_f c of each joint in N m.
        viscous: k_f b of each joint in N m s/rad.
        friction_speed: w_0 in rad/s.
    """

    def __init__(
        self,
        *,
        gravity: Callable[[Numbers], Sequence[float]] | None,
        gravity_gain: float,
        coulomb: Sequence[float],
        viscous: Sequence[float],
        friction_speed: float,
    ) -> None:
        self.gravity_gain = gravity_gain
        self._gravity = gravity
        self._speed = friction_speed
        self._friction = list(zip(coulomb, viscous, strict=True))

    def torques(self, q: Numbers, w: Numbers) -> list[float]:
        """Return the torque in N m of each joint at its angle and velocity."""
        weights = [0.0] * len(self._friction) if self._gravity is None else self._gravity(q)
        return [
            self.gravity_gain * weight + coulomb * math.tanh(speed / self._speed) + viscous * speed
            for speed, weight, (coulomb, viscous) in zip(w, weights, self._friction, strict=True)
        ]
