"""Torques that make a leader light: gravity, friction, and springs before its limits.

None of them is a push that the hand does not lead. Gravity's is the gradient of an energy, times a gain of at most 1:
on a way that returns to where it began it does no work. Friction's has the direction of the motion, falls to 0 with it,
and is at most 0.9 of what friction is said to take: what is left brakes. Springs and damping oppose the joint. Their
sum is bounded, and while the arm has a fault none of it is commanded.
"""

import math
from collections.abc import Sequence

from haptether.dynamixel.description import ArmDescription, ArmKinematics
from haptether.dynamixel.description.kinematics import Numbers
from haptether.master.dynamixel.options import LeaderOptions


class Compensation:
    """What the joints exert besides the reflected force.

    tau = k_g dV/dq + k_f (c tanh(w / w_0) + b w) - d w + limits, within `most` of each joint.

    Args:
        options: Gains, springs and damping.
        arm: The description.
        kinematics: Of the same arm.
        most: N m of each joint, that the sum never exceeds.
    """

    def __init__(
        self, options: LeaderOptions, arm: ArmDescription, kinematics: ArmKinematics, most: Sequence[float]
    ) -> None:
        default = 1.0 if arm.knows_masses else 0.0
        self.gravity_gain = default if options.gravity_gain is None else options.gravity_gain
        self._gravity = kinematics.gravity
        self._speed = options.friction_speed
        self._stiffness = options.limit_stiffness
        self._limit_damping = options.limit_damping
        self._joints = [
            (
                options.friction_gain * (joint.coulomb_nm or 0.0),
                options.friction_gain * (joint.viscous_nm_s or 0.0) - options.damping,
                joint.low_rad, joint.high_rad, bound,
                # Two that met would leave a step between them.
                min(options.limit_margin, 0.5 * (joint.high_rad - joint.low_rad)),
            )
            for joint, bound in zip(arm.joints, most, strict=True)
        ]  # fmt: skip

    def torques(self, q: Numbers, w: Numbers) -> list[float]:
        """N m of each joint, at its angle and velocity."""
        found = []
        for angle, speed, weight, (coulomb, viscous, low, high, most, margin) in zip(
            q, w, self._gravity(q), self._joints, strict=True
        ):
            torque = self.gravity_gain * weight + coulomb * math.tanh(speed / self._speed) + viscous * speed
            if (deep := angle - high + margin) > 0.0:
                torque -= self._stiffness * deep + self._limit_damping * max(speed, 0.0)
            elif (deep := low + margin - angle) > 0.0:
                torque += self._stiffness * deep - self._limit_damping * min(speed, 0.0)
            found.append(min(max(torque, -most), most))
        return found
