"""Observer of the environment's torque on joints in current mode."""

import math
from collections.abc import Sequence

import numpy as np

from haptether.dynamixel.arm import Vector
from haptether.slave.dynamixel.torque import STANDING_RAD_S


class ReactionForceObserver:
    """Torque f of the environment on each joint in N m, positive along q.

    M dv/dt = tau - c sign(v) - b v - dV/dq + f. With the filter LPF_g = g / (s + g) of first order

        f_hat = LPF_g(M dv/dt - tau') = g M v - LPF_g(tau' + g M v),    tau' = tau - c sign(v) - b v - dV/dq

    so f_hat = LPF_g(f) if the model is exact. Between two samples tau' and dv/dt count as constant; the filter is exact
    for that. A standing joint hides up to c of f, as in `JointTorque`, and the value nearest to 0 is reported.

    Source: T. Murakami, F. Yu, K. Ohnishi, "Torque sensorless control in multidegree-of-freedom manipulator", IEEE
    Trans. Industrial Electronics 40(2), 1993.

    Args:
        bandwidth: g in rad/s.
        coulomb: c of each joint in N m.
        viscous: b of each joint in N m s/rad.
    """

    def __init__(self, bandwidth: float, coulomb: Sequence[float], viscous: Sequence[float]) -> None:
        self._bandwidth = bandwidth
        self._coulomb, self._viscous = np.array(coulomb), np.array(viscous)
        self._torque: Vector = np.zeros(len(self._coulomb))
        """f_hat with the friction of standing joints."""
        self._hidden: Vector = np.zeros(len(self._coulomb))
        """Friction that standing joints may hide, after the same filter."""
        self._before: Vector | None = None
        """v of the last sample."""

    def of(self, torque: Vector, velocity: Vector, inertia: Vector, weight: Vector, period_s: float) -> Vector:
        """Return f_hat after a sample.

        Args:
            torque: tau of the motors in N m since the last sample.
            velocity: v in rad/s.
            inertia: M in kg m^2.
            weight: dV/dq in N m.
            period_s: Time since the last sample in s; 0 changes nothing.
        """
        before, self._before = self._before, velocity.copy()
        if before is not None and period_s > 0.0:
            mean = 0.5 * (velocity + before)
            moving = np.minimum(np.abs(mean) / STANDING_RAD_S, 1.0)
            known = torque - weight - moving * self._coulomb * np.sign(mean) - self._viscous * mean
            step = -math.expm1(-self._bandwidth * period_s)
            self._torque = self._torque + step * (inertia * (velocity - before) / period_s - known - self._torque)
            self._hidden = self._hidden + step * ((1.0 - moving) * self._coulomb - self._hidden)
        found: Vector = np.sign(self._torque) * np.maximum(np.abs(self._torque) - self._hidden, 0.0)
        return found

    def reset(self) -> None:
        """Forget the motion: f_hat starts from 0."""
        self._before = None
        self._torque, self._hidden = np.zeros(len(self._coulomb)), np.zeros(len(self._coulomb))
