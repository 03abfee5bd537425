"""Driver `dynamixel`: a leader arm of 1 to 7 joints, and a trigger.

The safety layer decides F_device. `Compensation` is added afterwards and is not part of the F_device in the grasp
estimate. That estimate assumes m A + b V + c sign(V) = F_device + F_h, without gravity and without gravity
compensation. The residual of the two, and the limit springs, are attributed to the hand.
"""

from collections.abc import Sequence
from typing import Any

from haptether.dynamixel.arm import MAX_DOUBTFUL, FaultKind, ServoArm
from haptether.dynamixel.description import ArmKinematics
from haptether.master.device import MasterSample
from haptether.master.dynamixel.compensation import Compensation
from haptether.master.dynamixel.options import arm_settings, leader_options, speed_limits, with_unit


class DynamixelMaster:
    """Leader arm on a bus of Dynamixel servos in current mode; see `LeaderOptions`.

    Raises:
        ValueError: An option is unknown or invalid.
    """

    paces = False
    exerts_by_itself = True
    """Compensation, springs and damping act even while zero is written."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # checked by leader_options
        self.options, self.arm = with_unit(*leader_options(options))
        arm = self.arm
        self.kinds = (self.options.kind,)
        settings = arm_settings(self.options, arm)
        self.servos = ServoArm(settings)
        self._kinematics = ArmKinematics(arm)
        self._poses = self.options.kind == "pose"
        self._joints = len(arm.joints)
        self.axes = 3 if self._poses else self._joints
        """Of its samples."""
        self.max_speed = speed_limits(self.options, arm)
        """Largest speed of each joint in rad/s; beyond it is a fault."""
        if self.options.kind == "joints":
            self.speed_bound = max(self.max_speed)
            """Speed bound in rad/s."""
        # Uses the largest torque constant, so that no joint exceeds its limit in N m.
        self._amperes = [1.0 / servo.most_nm_per_a for servo in settings.servos]
        for index, joint in enumerate(arm.joints):
            self._amperes[index] /= joint.motors
        greatest = [servo.current_cap_a / per_nm for servo, per_nm in zip(settings.servos, self._amperes, strict=True)]
        self.most_nm = tuple(greatest)
        """Largest torque of each joint and of the trigger, from current caps and largest constants."""
        left = 1.0 - self.options.force_share
        bounds = [left * most for most in greatest[: self._joints]]
        self.compensation = Compensation(self.options, arm, self._kinematics, bounds)
        self.compensated_nm = [0.0] * self._joints
        """Compensation and spring torques of the last force."""
        self.cut_ticks = 0
        """Number of ticks in which a joint saturated, so that the force was exerted only in part."""
        trigger = arm.trigger
        self._range = 0.0 if trigger is None else abs(trigger.closed_rad - trigger.open_rad)
        self._lever_m = 0.0 if trigger is None else trigger.lever_m
        self._trigger_nm = 0.0
        self._currents = [0.0] * len(settings.servos)
        self._q: list[float] = []
        self._w: list[float] = []
        self._accepted: list[float] = []
        """Joint angles of the last plausible read."""
        self._fast_reads = 0
        """Reads in a row with a joint beyond its largest speed."""
        self._sample: MasterSample | None = None
        self._shown: str | None = None
        """Fault of the last sample."""
        if trigger is not None:
            self.write_trigger = self._write_trigger

    @property
    def cycle_s(self) -> float | None:
        """Shortest bus cycle in s, once open."""
        return self.servos.cycle_s

    @property
    def close_s(self) -> float:
        """Time in s for which `close` lowers the arm."""
        return self.servos.close_s

    def open(self) -> None:
        """Run the checklist of the bus; torque starts with the first `read`, and rises from 0.

        Raises:
            ArmRefusedError: Lists every problem with its remedy.
        """
        self._sample = self._shown = None
        self._trigger_nm = 0.0
        self.servos.open(give_torque=False)

    def close(self) -> None:
        """Lower the arm with damping and end its torque."""
        self.servos.close()

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault: the checklist runs again."""
        # A fault since the last sample has not been shown yet.
        self.servos.acknowledge(self._shown)

    def read(self) -> MasterSample:
        """Return the latest sample; a value that cannot be measured now is a fault, never an old value.

        Raises:
            RuntimeError: A fault occurred before the first measurement.
        """
        servos = self.servos
        if self._sample is None:
            servos.begin()
        while not servos.read() and servos.fault is None:
            pass
        if servos.fault is None:
            self._sample = self._measured()
            self._check_speed()
        self._shown = servos.fault
        if self._sample is None:
            raise RuntimeError(servos.fault)
        return self._sample._replace(fault=self._shown)

    def write(self, force: Sequence[float], torque: Sequence[float] | None = None) -> None:
        """Exert F_device until the next call, in N m at the joints, or in N and N m at the tool point.

        No effect before the first `read`, because the arm has no torque yet.
        """
        if self._sample is None:
            return
        reflected = force
        if self._poses:
            reflected = self._kinematics.torques(self._accepted, (*force, *(torque or (0.0,) * 3)))
        if len(reflected) != self._joints:
            message = f"force = {tuple(reflected)}: {self.arm.name} has {self._joints} joints: must be as many"
            raise ValueError(message)
        self.compensated_nm = self.compensation.torques(self._accepted, self._w)
        currents, amperes, most = self._currents, self._amperes, self.most_nm
        cut = False
        for index in range(self._joints):
            sum_nm = reflected[index] + self.compensated_nm[index]
            cut = cut or abs(sum_nm) > most[index]
            currents[index] = sum_nm * amperes[index]
        self.cut_ticks += cut
        if self._range:
            currents[-1] = self._trigger_nm * amperes[-1]
        self.servos.write_currents(currents)

    def _write_trigger(self, force_n: float) -> None:
        """Set the finger force in N, positive closing; applied with the next `write`, zero at once."""
        before, self._trigger_nm = self._trigger_nm, force_n * self._lever_m
        if force_n == 0.0 and before != 0.0:
            self._currents[-1] = 0.0
            self.servos.write_currents(self._currents)

    def _check_speed(self) -> None:
        """End all torque if a joint is too fast at four reads in a row: fewer may be wrong."""
        speeds = zip(self.arm.joints, self._w, self.max_speed, strict=True)
        fast = next(((joint, speed, most) for joint, speed, most in speeds if abs(speed) > most), None)
        self._fast_reads = 0 if fast is None else self._fast_reads + 1
        if fast is not None and self._fast_reads > MAX_DOUBTFUL:
            joint, speed, most = fast
            text = (
                f"joint {joint.name} (servo {joint.servo}) moved at {speed:+.2f} rad/s: must be within {most:.2f}:"
                " support the arm, see what threw it, then acknowledge"
            )
            self.servos.stop(FaultKind.OVER_SPEED, text)

    def _measured(self) -> MasterSample:
        position, velocity = self.servos.position.tolist(), self.servos.velocity.tolist()
        trigger = min(max(position[-1] / self._range, 0.0), 1.0) if self._range else None
        self._q, self._w = position[: self._joints], velocity[: self._joints]
        self._accepted = self.servos.plausible.position[: self._joints].tolist()
        if not self._poses:
            return MasterSample(self._q, self._w, trigger=trigger)
        place, quat, twist = self._kinematics.state(self._q, self._w)
        return MasterSample(place, twist[:3], trigger=trigger, orientation=quat, angular_velocity=twist[3:])
