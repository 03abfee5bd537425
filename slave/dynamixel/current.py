"""Control of joints in current mode on the host: commanded torques, or a spring and damper about a goal."""

from typing import Final

import numpy as np

from haptether.dynamixel.arm import ArmSettings, JointCompensation, Vector
from haptether.dynamixel.arm.plausible import FASTEST_SHARE
from haptether.dynamixel.description import ArmKinematics
from haptether.slave.dynamixel.observer import ReactionForceObserver
from haptether.slave.dynamixel.options import DynamixelSlaveOptions

FADE: Final = 0.1
"""Share of `max_speed` beyond it, over which a torque that accelerates fades to 0."""
STOPPING: Final = 1.5
"""Limit margin over the distance in which the damper alone stops a joint from `max_speed`."""


class CurrentControl:
    """Currents of the joints, and the torque of the environment on them.

    Commanded torque: tau = s F + compensation, with s from 1 to 0 beyond `max_speed` and before a limit, where a damper
    2 M w rises. Goal: tau = M w^2 (q_goal - q) - 2 M w v + compensation, critically damped. Compensation is
    `JointCompensation`.

    Args:
        options: Options of the driver, with mode `current`.
        settings: Servos of the arm.

    Raises:
        ValueError: The description or the inertia is missing or does not fit.
    """

    def __init__(self, options: DynamixelSlaveOptions, settings: ArmSettings) -> None:
        servos = settings.servos
        count = len(servos)
        nothing = [0.0] * count
        arm = options.described(servos)
        self._kinematics = None if arm is None else ArmKinematics(arm)
        self._own: Vector = np.array(options.inertia if arm is None else arm.motor_inertia(options.inertia or None))
        coulomb, viscous = (list(given or nothing) for given in (options.coulomb, options.viscous))
        if arm is not None and arm.knows_friction and not (options.coulomb or options.viscous):
            coulomb = [joint.coulomb_nm or 0.0 for joint in arm.joints]
            viscous = [joint.viscous_nm_s or 0.0 for joint in arm.joints]
        default = 1.0 if arm is not None and arm.knows_masses else 0.0
        self._compensation = JointCompensation(
            gravity=None if self._kinematics is None else self._kinematics.gravity,
            gravity_gain=default if options.gravity_gain is None else options.gravity_gain,
            coulomb=[options.friction_gain * one for one in coulomb],
            viscous=[options.friction_gain * one for one in viscous],
            friction_speed=options.friction_speed,
        )
        self._observer = ReactionForceObserver(options.observer_bandwidth, coulomb, viscous)
        motors = np.array([1.0 + len(servo.shadows) for servo in servos])
        likely, most = ([getattr(servo, name) for servo in servos] for name in ("nm_per_a", "most_nm_per_a"))
        self._nm_per_a = motors * np.array(options.torque_constant or likely)
        # The largest constant, so that no joint exceeds the torque.
        self._amperes = 1.0 / (motors * np.array(options.torque_constant or most))
        capped = np.array([servo.current_cap_a for servo in servos]) / self._amperes
        self._most = np.minimum(np.array(options.max_torque), capped) if options.max_torque else capped
        self._bandwidth = options.joint_bandwidth
        self._max_speed = options.max_speed
        self._fastest = FASTEST_SHARE * np.array([servo.servo.no_load_rad_s for servo in servos])
        self._low: Vector = np.array([servo.low_rad for servo in servos])
        self._high: Vector = np.array([servo.high_rad for servo in servos])
        self._position: Vector = np.zeros(count)
        self._velocity: Vector = np.zeros(count)
        self._inertia = self._own
        """M of each joint in kg m^2: motors, gears, and the described links in this posture."""
        stopping = STOPPING * options.max_speed / options.joint_bandwidth
        # Overlapping margins would leave no torque between them.
        self._margin = np.minimum(max(options.limit_margin, stopping), 0.5 * (self._high - self._low))

    def take(self, position: Vector, velocity: Vector, current_a: Vector, period_s: float) -> Vector:
        """Take a sample; return the torque of the environment in N m, of `ReactionForceObserver`.

        Args:
            position: q in rad, plausible.
            velocity: v in rad/s.
            current_a: Measured currents in A.
            period_s: Time since the last sample in s.
        """
        # A read beyond what a joint can do would brake with all of the current.
        velocity = np.where(np.abs(velocity) > self._fastest, self._velocity, velocity)
        self._position, self._velocity = position.copy(), velocity
        weight = np.zeros(len(position))
        if self._kinematics is not None:
            self._inertia = self._own + np.array(self._kinematics.link_inertia(position))
            weight = np.array(self._kinematics.gravity(position))
        return self._observer.of(self._nm_per_a * current_a, velocity, self._inertia, weight, period_s)

    @property
    def max_torque(self) -> float:
        """Smallest of the largest commanded torques of the joints in N m."""
        return float(self._most.min())

    def reset(self) -> None:
        """Reset the observer."""
        self._observer.reset()

    def exerting(self, torque: Vector) -> Vector:
        """Return the currents in A that exert torques in N m on the joints."""
        w, speed = self._bandwidth, np.abs(self._velocity)
        wanted = np.minimum(np.maximum(torque, -self._most), self._most)
        slow = np.minimum(np.maximum((1.0 + FADE - speed / self._max_speed) / FADE, 0.0), 1.0)
        wanted = self._room(wanted) * np.where(wanted * self._velocity > 0.0, slow * wanted, wanted)
        # Brake what is too fast, and motion towards a limit that is near.
        braked = np.maximum(speed - self._max_speed, (1.0 - self._room(self._velocity)) * speed)
        wanted -= 2.0 * self._inertia * w * np.copysign(braked, self._velocity)
        beyond = self._position - np.minimum(np.maximum(self._position, self._low), self._high)
        return self._currents(wanted - self._inertia * w**2 * beyond)

    def holding(self, goal: Vector) -> Vector:
        """Return the currents in A that pull the joints to a goal in rad."""
        w = self._bandwidth
        return self._currents(self._inertia * w * (w * (goal - self._position) - 2.0 * self._velocity))

    def rest(self) -> Vector:
        """Return the goal at which moving joints come to rest without turning back by more than 0.07 v / w."""
        goal: Vector = self._position + 0.5 / self._bandwidth * self._velocity
        return goal

    def _room(self, direction: Vector) -> Vector:
        """Return the distance to the limit in a direction over the margin, 0 to 1."""
        ahead = np.where(direction > 0.0, self._high - self._position, self._position - self._low)
        room: Vector = np.minimum(np.maximum(ahead / self._margin, 0.0), 1.0)
        return room

    def _currents(self, torque: Vector) -> Vector:
        own = np.array(self._compensation.torques(self._position, self._velocity))
        bounded = np.minimum(np.maximum(torque, -self._most), self._most)
        currents: Vector = self._amperes * (bounded + own)
        return currents
