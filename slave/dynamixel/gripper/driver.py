"""Driver of a gripper on a servo of the arm's bus: `[slave.gripper] device = "dynamixel"`."""

from typing import Any

from haptether.dynamixel.arm import GripServo
from haptether.slave.dynamixel.driver import DynamixelSlave
from haptether.slave.dynamixel.gripper.options import DynamixelGripperOptions, dynamixel_gripper_options
from haptether.slave.gripper import MAX_FORCE_N, MAX_SPEED, GripperCommand, GripperSample


class DynamixelGripper:
    """Gripper that is read and written with the joints of its arm; see `Gripper` and docs/dynamixel.md.

    Args:
        options: Fields of `DynamixelGripperOptions`.

    Raises:
        ValueError: The options are invalid, or the arm does not support it.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: DynamixelGripperOptions = dynamixel_gripper_options(options)
        self.servo = GripServo(self.options.settings())
        self._arm: DynamixelSlave | None = None
        self._shown: object = None
        """Fault of the last sample."""

    def attach(self, arm: object) -> None:
        """Join the bus of its arm, which is not open yet."""
        if not isinstance(arm, DynamixelSlave):
            message = (
                f"[slave.gripper] device = dynamixel: is on the bus of an arm of servos: [slave] device must be"
                f" dynamixel, not {type(arm).__name__}"
            )
            raise ValueError(message)
        arm.carry(self.servo)
        self._arm = arm

    def open(self) -> None:
        """Do nothing: the arm opens the bus and runs the checklist of both."""
        self._attached()

    def read(self) -> GripperSample:
        """Return the last values read with the joints."""
        servo = self.servo
        self._shown = servo.fault
        return GripperSample(
            position=min(max(servo.position, 0.0), 1.0),
            velocity=min(max(servo.velocity, -MAX_SPEED), MAX_SPEED),
            force_n=min(servo.force_n, MAX_FORCE_N),
            holds_object=servo.holds_object,
            fault=None if servo.fault is None else str(servo.fault),
        )

    def write(self, command: GripperCommand) -> None:
        """Set a goal, to be sent with the next joint goals."""
        if self.servo.is_due:
            # No joint goals have been sent since the previous gripper goal.
            self._attached().servos.send_grip()
        self.servo.write(command.position, command.speed, command.force_n)

    def hold(self) -> None:
        """Stop moving jaws at once; pressing jaws keep their force."""
        self.servo.hold()
        self._attached().servos.send_grip()

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault: torque returns at the current jaw position."""
        if self._shown is not None and self._shown is self.servo.fault:
            # Another fault since the last sample has not been shown yet.
            self.servo.acknowledge()

    def close(self) -> None:
        """Do nothing: the arm has closed the bus, and the servo keeps its grip."""

    def _attached(self) -> DynamixelSlave:
        if self._arm is None:
            message = "gripper = dynamixel: is on the bus of an arm: attach(arm) comes before open()"
            raise ValueError(message)
        return self._arm
