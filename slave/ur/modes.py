"""The commands that can move a UR arm: each follows the same set point and keeps the orientation it began with."""

import math
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from haptether.slave.ur.connection import Control, Order
from haptether.slave.ur.kinematics.pose import matrix_from_rotvec, rotvec_from_matrix
from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.state import Numbers, UrState
from haptether.slave.ur.stop import joint_deceleration, tool_deceleration

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.arm import UrKinematics
    from haptether.slave.ur.kinematics.models import UrModel

DIRECT_TORQUE_SINCE: Final = (5, 26)
ROTATION_SPEED: Final = 0.5
"""rad/s at most, to keep the orientation under speedl."""
WRIST_SHARE: Final = 0.2
"""Stiffness and damping of the three wrists, of those of the large joints."""
CORRECTION_PERIODS: Final = 4.0
"""Periods in which the joints make up for what they are beside the set point."""
MAX_BEHIND_M: Final = 0.02
"""How far the joints may stay behind it: what more there is would be made up for at once, somewhere else."""
JOINT_ACCELERATION: Final = 25.0
"""rad/s² at most: what the bounds of the tool need over the shortest lever, not what makes it smooth."""
APPROACH_HZ: Final = 10.0
"""A distance to a plane, or of the arm to itself, shrinks at most at this rate times what is left of it; of a tool that
may be faster than 1 m/s so much slower that it brakes with 10 m/s²."""
JOINT_SPEED_SHARE: Final = 0.9
"""Of the largest speed of a joint: what is commanded stays this far below."""


UNKNOWN_CAUSE: Final = "its joints are at their limits, or the arm is near a singularity"


class UnreachableError(ValueError):
    """The arm cannot go on to where it is sent."""


class Mode(Protocol):
    """A command that moves the arm, and the one that stops it."""

    name: str
    """Of the call of the library."""
    goes_on: bool
    """Whether the arm goes on moving where nothing more is sent: then the driver ends that itself."""

    def begin(self, state: UrState) -> None:
        """Motion begins where the arm is."""

    def order(self, position: Three, velocity: Three, state: UrState, elapsed_s: float) -> Order:
        """What sends the arm to the set point after a time in s, in m and m/s along the axes of the base.

        Raises:
            UnreachableError: It cannot get there.
        """

    def brake(self, state: UrState) -> Order:
        """What has the arm come to rest softly; returns once it is done."""


class _Servo:
    """The controller follows each target with its lookahead and gain, and holds the last."""

    goes_on = False

    def __init__(self, options: UrOptions, period_s: float) -> None:
        # Speed and acceleration, which the controller ignores, then time, lookahead and gain.
        self._rest = (0.0, 0.0, period_s, options.lookahead_time, options.gain)
        self._options = options

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = joint_deceleration(self._options, state)
        return lambda control: bool(control.servoStop(deceleration))


class ServoJ(_Servo):
    """`servoJ` on joint angles that are found here: the least work for the controller."""

    name = "servoJ"

    def __init__(self, options: UrOptions, joints: "JointTracking", period_s: float) -> None:
        super().__init__(options, period_s)
        self.joints = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(self, position: Three, velocity: Three, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        self.joints.follow(position, velocity, elapsed_s)
        q, rest = self.joints.q.tolist(), self._rest
        return lambda control: bool(control.servoJ(q, *rest))


class ServoL(_Servo):
    """`servoL`: the controller finds the joint angles, on its own calibrated chain.

    Where it finds none it ends the program.
    """

    name = "servoL"

    def __init__(self, options: UrOptions, period_s: float) -> None:
        super().__init__(options, period_s)
        self._rotvec: Numbers = (0.0, 0.0, 0.0)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._rotvec = state.pose[3:]

    def order(self, position: Three, velocity: Three, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        pose, rest = [*position, *self._rotvec], self._rest
        return lambda control: bool(control.servoL(pose, *rest))


class SpeedL:
    """`speedL` under a position loop that closes here: `v = v_set + k (x_set - x)`, at most as fast as the tool may be.

    The arm goes on at the last velocity where nothing follows, so the driver ends that, and the watchdog where there is
    no driver any more.
    """

    name = "speedL"
    goes_on = True

    def __init__(self, options: UrOptions, period_s: float) -> None:
        self._gain = options.position_gain
        self._max_speed = options.max_speed
        self._acceleration = options.max_acceleration
        self._options = options
        self._period_s = period_s
        self._rotation = np.eye(3)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._rotation = matrix_from_rotvec(state.pose[3:])

    def order(self, position: Three, velocity: Three, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        wanted = [v + self._gain * (x_set - x) for v, x_set, x in zip(velocity, position, state.pose[:3], strict=True)]
        away = rotvec_from_matrix(self._rotation @ matrix_from_rotvec(state.pose[3:]).T)
        xd = [
            *_limited(wanted, self._max_speed),
            *_limited([self._gain * part for part in away], ROTATION_SPEED),
        ]
        acceleration, time_s = self._acceleration, self._period_s
        return lambda control: bool(control.speedL(xd, acceleration, time_s))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = tool_deceleration(self._options, state)
        return lambda control: bool(control.speedStop(deceleration))


class DirectTorque:
    """`directTorque`: springs and dampers on the joints, `tau = K (q_set - q) + D (q_set' - q')`, each bounded.

    Gravity and friction are the controller's. The arm yields to a force instead of insisting on its position.
    """

    name = "directTorque"
    goes_on = True

    def __init__(self, options: UrOptions, joints: "JointTracking", model: "UrModel") -> None:
        shares = np.array((1.0, 1.0, 1.0, WRIST_SHARE, WRIST_SHARE, WRIST_SHARE))
        self._stiffness = options.joint_stiffness * shares
        self._damping = options.joint_damping * shares
        self._max_torque = options.torque_share * np.array(model.max_torque)
        self._options = options
        self.joints = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(self, position: Three, velocity: Three, state: UrState, elapsed_s: float) -> Order:
        """See `Mode`."""
        joints = self.joints
        joints.follow(position, velocity, elapsed_s)
        spring = self._stiffness * (joints.q - state.q) + self._damping * (joints.qd - state.qd)
        torque = np.clip(spring, -self._max_torque, self._max_torque).tolist()
        return lambda control: bool(control.directTorque(torque))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = joint_deceleration(self._options, state)

        def order(control: Control) -> bool:
            # It has no stop of its own; this one returns nothing. Whether the arm rests is seen in what it does.
            control.stopJ(deceleration, False)
            return True

        return order


class JointTracking:
    """From a set point of the tool to joint angles, orientation kept, within the limits of the joints.

    Each period the joint velocities are those that follow `v_set + (x_set - x)/T` best within the limits
    (`UrStreaming`): near a singularity, or at the end of a joint, the tool stays behind instead of a joint
    going faster than it may. The set point is fed forward, so this smooths nothing: `(x_set - x)/T` takes out what
    joint velocities that are even over a period miss of a straight line, and what the limits have kept the tool from.
    Bounds of speed and acceleration are those of the set point. The planes of the workspace are limits here as well,
    before which the joints brake (the set point stops on them at once), as is a keep-out of the arm from itself, of
    which the set point knows nothing.

    The unit's chain is only nearly that of its model, so motion is counted from where both have the tool at the begin:
    what they differ by stays where it was, and the first command is exactly where the joints are.

    Args:
        kinematics: The arm with its tool.
        options: Of the driver.
        period_s: Between two commands, in s.
    """

    def __init__(self, kinematics: "UrKinematics", options: UrOptions, period_s: float) -> None:
        from haptether.slave.ur.kinematics.constraints import SelfKeepOut, StreamingLimits  # noqa: PLC0415  # with CasADi
        from haptether.slave.ur.kinematics.streaming import BrakedPoint, UrStreaming  # noqa: PLC0415

        model = kinematics.model
        speeds = [JOINT_SPEED_SHARE * speed for speed in model.max_speed]
        limits = StreamingLimits(
            position_min=model.position_min,
            position_max=model.position_max,
            max_speed=(speeds[0], speeds[1], speeds[2], speeds[3], speeds[4], speeds[5]),
            max_acceleration=(JOINT_ACCELERATION,) * 6,
            planes=options.planes,
            self_keep_out=SelfKeepOut(),
            approach_rate_hz=APPROACH_HZ / max(1.0, options.max_speed),
        )
        self._kinematics = kinematics
        self._streaming = UrStreaming(kinematics, limits, period_s=period_s)
        self._period_s = period_s
        self._rate_hz = 1.0 / (CORRECTION_PERIODS * period_s)
        self._max_behind_m = max(options.max_jump, MAX_BEHIND_M)
        self._braked = BrakedPoint(limits, period_s)
        self._rotation = np.eye(3)
        self._twist = np.zeros(6)
        self.offset = np.zeros(3)
        """From the controller's tool to that of the model, in m."""
        self.q = np.zeros(6)
        self.qd = np.zeros(6)

    def begin(self, state: UrState) -> None:
        """Motion begins where the arm is."""
        transform = self._kinematics.forward(state.q)
        self._rotation = np.array(transform[:3, :3])
        self.offset = transform[:3, 3] - np.array(state.pose[:3])
        self.q, self.qd = np.array(state.q), np.zeros(6)
        self._streaming.begin(self.q, self.offset)
        self._braked.begin(np.array(transform[:3, 3]), self.offset)

    def follow(self, position: Three, velocity: Three, elapsed_s: float) -> None:
        """Goes on for a time in s, in whole periods.

        Raises:
            UnreachableError: The tool stays far behind.
        """
        target = np.array(position) + self.offset
        feed_forward = np.array(velocity)
        for _ in range(max(1, round(elapsed_s / self._period_s))):
            transform = self._kinematics.forward(self.q)
            tool = transform[:3, 3]
            # From where the target was a period ago: else the joints would run ahead by v times a period.
            behind = target - tool - feed_forward * self._period_s
            # Before a plane the arm brakes, and the set point stops on it: no fault while it comes on as it brakes.
            behind_braked = self._braked.position - tool
            self._braked.step(target)
            self._twist[:3] = feed_forward + behind * self._rate_hz
            self._twist[3:] = rotvec_from_matrix(self._rotation @ transform[:3, :3].T)
            self._twist[3:] *= self._rate_hz
            self.qd = np.array(self._streaming.velocity(self.q, self.qd, self._twist))
            self.q = self.q + self.qd * self._period_s
        away = min(float(np.linalg.norm(behind)), float(np.linalg.norm(behind_braked)))
        if away > self._max_behind_m:
            held_by = self._streaming.held_by
            why = self._streaming.reason or (f"held back by {held_by}" if held_by else UNKNOWN_CAUSE)
            message = f"the tool cannot follow: {1e3 * away:.0f} mm behind {_text(position)} m: {why}"
            raise UnreachableError(message)


def check_mode(options: UrOptions, version: tuple[int, ...]) -> None:
    """Whether a controller has the mode that the options name.

    Raises:
        ValueError: It does not.
    """
    if options.mode == "direct-torque" and tuple(version[:2]) < DIRECT_TORQUE_SINCE:
        text = ".".join(map(str, version[:3]))
        message = (
            f"device = ur: mode = 'direct-torque': needs software 5.26 or later, the controller has {text}: take servoj"
        )
        raise ValueError(message)


def model_distance(mode: Mode, state: UrState) -> float | None:
    """How far the tool of the model is from where the controller has it, in m; none for a mode without a model."""
    if not isinstance(mode, ServoJ | DirectTorque):
        return None
    mode.joints.begin(state)
    return math.hypot(*mode.joints.offset)


def ur_mode(options: UrOptions, period_s: float, tool: Numbers) -> Mode:
    """The mode that the options name.

    Args:
        options: Of the driver.
        period_s: Between two commands, in s.
        tool: The tool's point in the frame of the flange, as a pose.
    """
    if options.mode == "servol":
        return ServoL(options, period_s)
    if options.mode == "speedl":
        return SpeedL(options, period_s)
    from haptether.slave.ur.kinematics.arm import UrKinematics  # noqa: PLC0415
    from haptether.slave.ur.kinematics.chain import read_calibration  # noqa: PLC0415  # with CasADi
    from haptether.slave.ur.kinematics.models import ur_model  # noqa: PLC0415
    from haptether.slave.ur.kinematics.pose import transform_from_pose  # noqa: PLC0415

    model = ur_model(options.model)
    calibration = read_calibration(options.calibration, model) if options.calibration is not None else None
    flange_from_tool = transform_from_pose(tool)
    joints = JointTracking(UrKinematics(model, calibration, flange_from_tool), options, period_s)
    if options.mode == "servoj":
        return ServoJ(options, joints, period_s)
    return DirectTorque(options, joints, model)


def _limited(vector: list[float], limit: float) -> list[float]:
    length = math.hypot(*vector)
    return [part * limit / length for part in vector] if length > limit else vector


def _text(position: Three) -> str:
    return ", ".join(f"{part:.4f}" for part in position)
