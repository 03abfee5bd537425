"""Torques that make a leader light: gravity, friction, and springs at its limits.

None of them pushes without motion by the hand. The gravity torque is the gradient of an energy, times a gain of at most
1, so it does no work on a closed path. The friction torque follows the motion, vanishes with it, and is at most 0.9 of
the described friction, so the rest still brakes. Springs and damping oppose the joint. Their sum is bounded, and none
is commanded during a fault.
"""

from collections.abc import Sequence

from haptether.dynamixel.arm import JointCompensation
from haptether.dynamixel.description import ArmDescription, ArmKinematics
from haptether.dynamixel.description.kinematics import Numbers
from haptether.master.dynamixel.options import LeaderOptions


class Compensation(JointCompensation):
    """Joint torques in addition to the reflected force.

    tau = k_g dV/dq + k_f (c tanh(w / w_0) + b w) - d w + limits, within `most` of each joint.

    Args:
        options: Gains, springs and damping.
        arm: Description of the arm.
        kinematics: Kinematics of the same arm.
        most: Bound of the sum for each joint in N m.
    """

    def __init__(
        self, options: LeaderOptions, arm: ArmDescription, kinematics: ArmKinematics, most: Sequence[float]
    ) -> None:
        default = 1.0 if arm.knows_masses else 0.0
        super().__init__(
            gravity=kinematics.gravity,
            gravity_gain=default if options.gravity_gain is None else options.gravity_gain,
            coulomb=[options.friction_gain * (joint.coulomb_nm or 0.0) for joint in arm.joints],
            viscous=[options.friction_gain * (joint.viscous_nm_s or 0.0) - options.damping for joint in arm.joints],
            friction_speed=options.friction_speed,
        )
        self._stiffness = options.limit_stiffness
        self._limit_damping = options.limit_damping
        self._joints = [
            # Overlapping springs would leave a step between them.
            (joint.low_rad, joint.high_rad, bound, min(options.limit_margin, 0.5 * (joint.high_rad - joint.low_rad)))
            for joint, bound in zip(arm.joints, most, strict=True)
        ]

    def torques(self, q: Numbers, w: Numbers) -> list[float]:
        """Return the torque in N m of each joint at its angle and velocity."""
        found = []
        for angle, speed, own, (low, high, most, margin) in zip(q, w, super().torques(q, w), self._joints, strict=True):
            torque = own
            if (deep := angle - high + margin) > 0.0:
                torque -= self._stiffness * deep + self._limit_damping * max(speed, 0.0)
            elif (deep := low + margin - angle) > 0.0:
                torque += self._stiffness * deep - self._limit_damping * min(speed, 0.0)
            found.append(min(max(torque, -most), most))
        return found
