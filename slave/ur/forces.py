"""Forces of a UR tool: joint torques that exert a wrench within the limits of the arm, under direct-torque."""

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from haptether.slave.ur.kinematics.pose import Array, Quaternion, quat_wxyz_from_rotvec, turn_between
from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.set_point import shortened
from haptether.slave.ur.state import UrState

if TYPE_CHECKING:
    from haptether.slave.ur.modes import JointTracking

NOMINAL_ACCELERATION: Final = 50.0
"""Acceleration in rad/s² of a joint at its largest torque: sets the nominal inertia, which no vendor publishes."""
LIMIT_RATE: Final = 10.0
"""Rate w in 1/s of the law before a limit: a loop delay of 8 ms costs its damping of 2 w a phase of 0.16 rad."""
FADE_SHARE: Final = 0.5
"""Largest fraction of a speed limit below the limit over which an accelerating force fades."""
SOFT: Final = 0.05
"""Lever in m, and without unit for a rotation, below which the springs of the held directions soften."""


class ToolForces:
    """Joint torques `tau = J' (W + W_h)` for a wrench W at the tool.

    W_h holds the directions H that the scene does not command, and acts in no other direction. It is the force of the
    joint springs K and dampers D at the tool while the commanded directions are free:

        H W_h = (H J K^-1 J' H' + s)^-1 H (e - (D/K) J q')

    for the deviation e from the held pose. The small s softens it at a singularity, where `J'` itself stays bounded.

    The limits use a nominal inertia M of the joints. Each changes the torque only where it acts:

    - **Speed**: the accelerating part of a force F fades to 0 at the largest speed, over `F / (2 w m)` or half of that
      speed. A faster tool is damped by `2 w m` for the mass m of the tool in that direction.
    - **Distances** h (planes, cone, links of the arm) with gradient g: `tau += g' l` with the smallest `l >= 0` for
      which `g M^-1 tau >= -2 w h' - w² h`. This removes the force through the limit, and is a critically damped spring
      beyond it.
    - **Joints**: the same law for their angles and speeds.
    - **Torques**: all are scaled down together to `torque_share`, which keeps the direction of the wrench.

    Args:
        options: Options of the driver.
        joints: Kinematics of the arm with its tool, and distances of planes and links.
        stiffness: K in N m/rad, (6,).
        max_torque: Largest commanded torques in N m, (6,).
        max_speed: Largest joint speeds in rad/s, (6,).

    Source: O. Khatib, "A Unified Approach for Motion and Force Control of Robot Manipulators", IEEE J. Robotics and
    Automation 3(1), 1987; Q. Nguyen, K. Sreenath, "Exponential Control Barrier Functions for Enforcing High
    Relative-Degree Safety-Critical Constraints", American Control Conference, 2016, for the law before a limit.
    """

    def __init__(
        self,
        options: UrOptions,
        joints: "JointTracking",
        stiffness: Array,
        max_torque: Array,
        max_speed: Array,
    ) -> None:
        model = joints.kinematics.model
        self._options = options
        self._cone, self._axis = options.cone, np.array(options.axis_unit)
        self._joints = joints
        self._max_torque = max_torque
        self._max_speed = max_speed
        self._inertia = np.array(model.max_torque) / NOMINAL_ACCELERATION
        self._position_min, self._position_max = np.array(model.position_min), np.array(model.position_max)
        self._compliance = 1.0 / stiffness
        self._damping_s = options.joint_damping / options.joint_stiffness
        self._soft = SOFT * SOFT / options.joint_stiffness * np.eye(6)
        # Rows of held directions: those across the one axis, then the rotation.
        across = np.zeros((0, 3))
        if options.axes == 1:
            across = np.linalg.svd(self._axis[np.newaxis])[2][1:]
        self._held = np.zeros((len(across) + 3, 6))
        self._held[: len(across), :3] = across
        self._held[len(across) :, 3:] = np.eye(3)
        self._position = np.zeros(3)
        self._orientation: Quaternion | None = None
        """Held orientation; None while torques turn the tool."""
        self._max_tilt = math.pi
        self.away_m = 0.0
        """Distance from the line of the one axis in m at the last call."""
        self.away_rad = 0.0
        """Angle from the held orientation in rad at the last call."""

    def hold(self, position: Three, orientation: Quaternion) -> None:
        """Set the pose whose directions are held unless commanded."""
        self._position = np.array(position)
        self._orientation = orientation
        cone = self._cone
        self._max_tilt = math.pi if cone is None else max(cone.half_angle, cone.tilt(orientation)[0])

    def torque(self, force: Three, moment: Three | None, state: UrState) -> list[float]:
        """Return joint torques in N m for a force in N and a moment in N m about the tool point, in the base frame.

        Without a moment the orientation is held: that at `hold`, or at the first call after one with a moment.
        """
        options = self._options
        orientation = quat_wxyz_from_rotvec(state.pose[3:])
        if moment is not None:
            self._orientation = None
        elif self._orientation is None:
            self._orientation = orientation
        jacobian = self._joints.kinematics.forward_and_jacobian(state.q)[1]
        twist = jacobian @ state.qd
        wrench = np.zeros(6)
        mobility = (jacobian / self._inertia) @ jacobian.T
        velocity = twist[:3]
        if options.axes == 1:
            velocity = self._axis * (self._axis @ velocity)
        wrench[:3] = _governed(shortened(force, options.max_force), velocity, mobility[:3, :3], options.max_speed)
        if moment is not None:
            bounded = shortened(moment, options.max_torque)
            wrench[3:] = _governed(bounded, twist[3:], mobility[3:, 3:], options.max_angular_speed)
        wrench += self._holding(jacobian, twist, state, orientation)
        torque = self._within_distances(jacobian.T @ wrench, jacobian, orientation, state)
        torque /= max(1.0, float((np.abs(torque) / self._max_torque).max()))
        return self._within_joints(torque, state).tolist()  # type: ignore[no-any-return]

    def _holding(self, jacobian: Array, twist: Array, state: UrState, orientation: Quaternion) -> Array:
        """Return W_h, (6,)."""
        held = self._held
        away = np.zeros(6)
        away[:3] = self._position - state.pose[:3]
        if self._orientation is None:
            held = held[:-3]
        else:
            away[3:] = turn_between(orientation, self._orientation)
        across = self._held[:-3, :3] @ away[:3]
        self.away_m, self.away_rad = float(np.linalg.norm(across)), float(np.linalg.norm(away[3:]))
        if not len(held):
            return np.zeros(6)
        compliance = held @ ((jacobian * self._compliance) @ jacobian.T + self._soft) @ held.T
        wanted = held @ (away - self._damping_s * twist)
        return np.linalg.solve(compliance, wanted) @ held

    def _within_distances(self, torque: Array, jacobian: Array, orientation: Quaternion, state: UrState) -> Array:
        """Return the torque with the reactions of the distances that need one."""
        left, gradients = self._joints.distances(state.q)
        cone = self._cone
        if cone is not None:
            tilt, outward = cone.tilt(orientation)
            left = np.append(left, self._max_tilt - tilt)
            gradients = np.vstack((gradients, -(np.array(outward) @ jacobian[3:])))
        if not len(left):
            return torque
        lowest = -2.0 * LIMIT_RATE * (gradients @ state.qd) - LIMIT_RATE * LIMIT_RATE * left
        for _ in range(len(left)):
            lacking = lowest - gradients @ (torque / self._inertia)
            worst = int(lacking.argmax())
            if not lacking[worst] > 0.0:
                break
            gradient = gradients[worst]
            torque = torque + gradient * (lacking[worst] / (gradient @ (gradient / self._inertia)))
        return torque

    def _within_joints(self, torque: Array, state: UrState) -> Array:
        """Return the torque within the bounds of joint angles, speeds and torques."""
        q, qd, w = np.array(state.q), np.array(state.qd), LIMIT_RATE
        lowest = np.maximum(-2.0 * w * qd - w * w * (q - self._position_min), -2.0 * w * (qd + self._max_speed))
        highest = np.minimum(-2.0 * w * qd + w * w * (self._position_max - q), 2.0 * w * (self._max_speed - qd))
        torque = np.clip(torque, self._inertia * lowest, self._inertia * highest)
        return np.clip(torque, -self._max_torque, self._max_torque)


def _governed(force: Three, velocity: Array, mobility: Array, max_speed: float) -> Array:
    """Return a force without the part that accelerates a tool beyond its speed limit, and with damping above it.

    Args:
        force: In N, or N m.
        velocity: In m/s, or rad/s, (3,).
        mobility: Inverse of the inertia at the tool, (3, 3).
        max_speed: In m/s, or rad/s.
    """
    governed = np.array(force)
    speed = float(np.linalg.norm(velocity))
    if speed < FADE_SHARE * max_speed:
        return governed
    direction = velocity / speed
    damping = 2.0 * LIMIT_RATE / float(direction @ mobility @ direction)
    along = float(direction @ governed)
    if along > 0.0:
        fade = min(along / damping, FADE_SHARE * max_speed)
        governed -= direction * along * (1.0 - min(max((max_speed - speed) / fade, 0.0), 1.0))
    governed -= direction * damping * max(0.0, speed - max_speed)
    return governed
