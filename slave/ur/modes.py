"""The commands that can move a UR arm: each follows the same set point, and without an orientation keeps its own."""

import math
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from msgspec.structs import replace

from haptether.slave.ur.connection import Control, Order
from haptether.slave.ur.kinematics.pose import (
    Array,
    Quaternion,
    matrix_from_quat_wxyz,
    matrix_from_rotvec,
    quat_wxyz_from_matrix,
    quat_wxyz_from_rotvec,
    rotvec_from_matrix,
    rotvec_near,
    turn_between,
)
from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.set_point import Attitude
from haptether.slave.ur.state import Numbers, UrState
from haptether.slave.ur.stop import joint_deceleration, tool_deceleration

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.arm import UrKinematics
    from haptether.slave.ur.kinematics.models import UrModel

DIRECT_TORQUE_SINCE: Final = (5, 26)
ROTATION_SPEED: Final = 0.5
"""rad/s at most, to keep the orientation of the begin under speedl."""
WRIST_SHARE: Final = 0.2
"""Stiffness and damping of the three wrists, of those of the large joints."""
CORRECTION_PERIODS: Final = 4.0
"""Periods in which the joints make up for what they are beside the set point."""
MAX_BEHIND_M: Final = 0.02
"""How far the joints may stay behind it: what more there is would be made up for at once, somewhere else."""
MAX_BEHIND_RAD: Final = 0.3
"""The same of their orientation, which gives way near a singularity."""
CATCH_UP: Final = 1.2
"""Times `max_angular_speed` at most, to make up for what the orientation stayed behind."""
JOINT_ACCELERATION: Final = 25.0
"""rad/s² at most: what the bounds of the tool need over the shortest lever, not what makes it smooth."""
APPROACH_HZ: Final = 10.0
"""A distance to a plane, or of the arm to itself, shrinks at most at this rate times what is left of it; of a tool that
may be faster than 1 m/s so much slower that it brakes with 10 m/s²."""
JOINT_SPEED_SHARE: Final = 0.9
"""Of the largest speed of a joint: what is commanded stays this far below."""
POSE_SPEED_SHARE: Final = 0.7
"""The same where the tool is turned: near a singularity joints go that fast, and an arm overshoots."""
SPRUNG_SPEED_SHARE: Final = 0.5
"""The same under direct-torque."""
SPRUNG_ACCELERATION: Final = 12.0
"""rad/s² at most under direct-torque where the tool is turned: springs saturate at `torque_share`."""
MIN_MANIPULABILITY: Final = 0.05
"""As a part of `|a2 a3| (|a2| + |a3|)`: below it a controller inverts no poses of a chain that is not its own."""
MIN_TWIST_MANIPULABILITY: Final = 0.15
"""Below it no twists: those are of joints some ms ahead of its own."""
SAME_CHAIN: Final = 1e-4
"""How far the model's tool may be from the controller's, in m and rad, for both to have the same joint angles there."""
POSE_COST: Final[dict[str, Any]] = {"weights": (1.0, 1.0, 1.0, 0.01, 0.01, 0.01), "damping": 1e-3}
"""Of a tool that is turned: 1 rad/s weighs as much as 0.1 m/s, and damping in proportion."""


UNKNOWN_CAUSE: Final = "its joints are at their limits, or the arm is near a singularity"
SINGULAR: Final = "the arm is beside a singularity: with its calibration, or under servoj, it would pass"


class UnreachableError(ValueError):
    """The arm cannot go on to where it is sent."""


class Mode(Protocol):
    """A command that moves the arm, and the one that stops it."""

    name: str
    """Of the call of the library."""
    goes_on: bool
    """Whether the arm goes on moving where nothing more is sent: then the driver ends that itself."""
    finds_joints: bool
    """Whether it finds joint angles of positions too; else of poses alone, which the controller is led by."""

    @property
    def joints(self) -> "JointTracking | None":
        """What finds joint angles; none where it never does."""

    def begin(self, state: UrState) -> None:
        """Motion begins where the arm is."""

    def order(
        self, position: Three, velocity: Three, state: UrState, elapsed_s: float, attitude: Attitude | None = None
    ) -> Order:
        """What sends the arm to the set point after a time in s, in m and m/s along the axes of the base.

        Without an attitude in all orders since the begin the orientation is that of the begin.

        Raises:
            UnreachableError: It cannot get there.
        """

    def brake(self, state: UrState) -> Order:
        """What has the arm come to rest softly; returns once it is done."""


class _Servo:
    """The controller follows each target with its lookahead and gain, and holds the last."""

    goes_on = False

    def __init__(self, options: UrOptions, period_s: float, joints: "JointTracking | None" = None) -> None:
        self.joints = joints
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
    finds_joints = True

    def __init__(self, options: UrOptions, joints: "JointTracking", period_s: float) -> None:
        super().__init__(options, period_s)
        self.joints: JointTracking = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(
        self,
        position: Three,
        velocity: Three,
        state: UrState,  # noqa: ARG002
        elapsed_s: float,
        attitude: Attitude | None = None,
    ) -> Order:
        """See `Mode`."""
        self.joints.follow(position, velocity, elapsed_s, attitude)
        q, rest = self.joints.q.tolist(), self._rest
        return lambda control: bool(control.servoJ(q, *rest))


class ServoL(_Servo):
    """`servoL`: the controller finds the joint angles, on its own calibrated chain.

    Where it finds none it ends the program. With an orientation it is sent the poses of joints that are tracked here:
    those it can reach within their limits.
    """

    name = "servoL"
    finds_joints = False

    def __init__(self, options: UrOptions, period_s: float, joints: "JointTracking | None" = None) -> None:
        super().__init__(options, period_s, joints)
        self._rotvec: Numbers = (0.0, 0.0, 0.0)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._rotvec = state.pose[3:]
        if self.joints is not None:
            self.joints.begin(state)

    def order(
        self,
        position: Three,
        velocity: Three,
        state: UrState,  # noqa: ARG002
        elapsed_s: float,
        attitude: Attitude | None = None,
    ) -> Order:
        """See `Mode`."""
        if attitude is not None and self.joints is not None:
            self.joints.follow(position, velocity, elapsed_s, attitude)
            position, orientation, _ = self.joints.tool()
            self._rotvec = rotvec_near(orientation, self._rotvec)
        pose, rest = [*position, *self._rotvec], self._rest
        return lambda control: bool(control.servoL(pose, *rest))


class SpeedL:
    """`speedL` under a position loop that closes here: `v = v_set + k (x_set - x)`, at most as fast as the tool may be.

    The arm goes on at the last velocity where nothing follows, so the driver ends that, and the watchdog where there is
    no driver any more.

    With an orientation `w = w_set + k log(R_set R')` as well, and the set point is that of joints that are tracked
    here, as in `ServoL`. Beside a singularity, where no controller can invert a twist, it is `speedJ` with the same
    law on the joints, `q' = q_set' + k (q_set - q)`: one velocity goes over into the other.
    """

    name = "speedL"
    goes_on = True
    finds_joints = False

    def __init__(self, options: UrOptions, period_s: float, joints: "JointTracking | None" = None) -> None:
        self.joints = joints
        self._gain = options.position_gain
        self._max_speed = options.max_speed
        self._acceleration = options.max_acceleration
        self._options = options
        self._period_s = period_s
        self._rotation = np.eye(3)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._rotation = matrix_from_rotvec(state.pose[3:])
        if self.joints is not None:
            self.joints.begin(state)

    def order(
        self, position: Three, velocity: Three, state: UrState, elapsed_s: float, attitude: Attitude | None = None
    ) -> Order:
        """See `Mode`."""
        if attitude is not None and self.joints is not None:
            self.joints.follow(position, velocity, elapsed_s, attitude)
            return self._order_of_tracked(self.joints, state)
        wanted = [v + self._gain * (x_set - x) for v, x_set, x in zip(velocity, position, state.pose[:3], strict=True)]
        away = rotvec_from_matrix(self._rotation @ matrix_from_rotvec(state.pose[3:]).T)
        xd = [
            *_limited(wanted, self._max_speed),
            *_limited([self._gain * part for part in away], ROTATION_SPEED),
        ]
        acceleration, time_s = self._acceleration, self._period_s
        return lambda control: bool(control.speedL(xd, acceleration, time_s))

    def _order_of_tracked(self, joints: "JointTracking", state: UrState) -> Order:
        gain, options, time_s = self._gain, self._options, self._period_s
        if joints.singular:
            wanted = joints.qd + gain * (joints.q - state.q)
            qd = np.clip(wanted, -joints.max_speed, joints.max_speed).tolist()
            return lambda control: bool(control.speedJ(qd, JOINT_ACCELERATION, time_s))
        position, orientation, twist = joints.tool()
        away = turn_between(quat_wxyz_from_rotvec(state.pose[3:]), orientation)
        xd = [
            *_limited(
                [v + gain * (x_set - x) for v, x_set, x in zip(twist[:3], position, state.pose[:3], strict=True)],
                options.max_speed,
            ),
            *_limited([w + gain * a for w, a in zip(twist[3:], away, strict=True)], options.max_angular_speed),
        ]
        # The controller takes one number for m/s² and rad/s².
        acceleration = max(options.max_acceleration, options.max_angular_acceleration)
        return lambda control: bool(control.speedL(xd, acceleration, time_s))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = tool_deceleration(self._options, state)
        return lambda control: bool(control.speedStop(deceleration))


class DirectTorque:
    """`directTorque`: springs and dampers on the joints, `tau = K (q_set - q) + D (q_set' - q')`, each bounded.

    Gravity and friction are the controller's. The arm yields to a force instead of insisting on its position. The joint
    angles are those of the set orientation as well: so these springs are the spring of its rotation, `J^-T K J^-1` at
    the tool, and no second one acts on the same joints.
    """

    name = "directTorque"
    goes_on = True
    finds_joints = True

    def __init__(self, options: UrOptions, joints: "JointTracking", model: "UrModel") -> None:
        shares = np.array((1.0, 1.0, 1.0, WRIST_SHARE, WRIST_SHARE, WRIST_SHARE))
        self._stiffness = options.joint_stiffness * shares
        self._damping = options.joint_damping * shares
        self._max_torque = options.torque_share * np.array(model.max_torque)
        self._options = options
        self.joints: JointTracking = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(
        self, position: Three, velocity: Three, state: UrState, elapsed_s: float, attitude: Attitude | None = None
    ) -> Order:
        """See `Mode`."""
        joints = self.joints
        joints.follow(position, velocity, elapsed_s, attitude)
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
    """From a set point of the tool to joint angles, within the limits of the joints.

    Each period the joint velocities are those that follow `v_set + (x_set - x)/T` best within the limits
    (`UrStreaming`): near a singularity, or at the end of a joint, the tool stays behind instead of a joint
    going faster than it may. The set point is fed forward, so this smooths nothing: `(x_set - x)/T` takes out what
    joint velocities that are even over a period miss of a straight line, and what the limits have kept the tool from.
    Bounds of speed and acceleration are those of the set point. The planes of the workspace are limits here as well,
    before which the joints brake (the set point stops on them at once), as is a keep-out of the arm from itself, of
    which the set point knows nothing.

    Without an attitude the orientation is that of the begin. With one it is a task as the position is, of less weight:
    where both do not go together, near a singularity or at limits, the tool's point is followed and its orientation
    stays behind. Joint velocities never leave the branch that the arm is in, and a wrist turns over by passing its
    singularity within its limits, or not at all.

    Under servol the controller finds the joint angles of a pose by itself, beside a singularity the same ones only
    where its chain is that of the model. Else the joints do not come to one: the manipulability w shrinks at most at
    `APPROACH_HZ` times what is left of it above `MIN_MANIPULABILITY`.

    The unit's chain is only nearly that of its model, so motion is counted from where both have the tool at the begin:
    what they differ by stays where it was, and the first command is exactly where the joints are.

    Args:
        kinematics: The arm with its tool.
        options: Of the driver.
        period_s: Between two commands, in s.
    """

    def __init__(self, kinematics: "UrKinematics", options: UrOptions, period_s: float) -> None:
        from haptether.slave.ur.kinematics.constraints import (  # noqa: PLC0415  # with CasADi
            SelfKeepOut,
            StreamingCost,
            StreamingLimits,
        )
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
        self.max_speed = np.array(speeds)
        """Of the joints, in rad/s."""
        self.q, self.qd = np.zeros(6), np.zeros(6)
        self._kinematics = kinematics
        self._streaming = UrStreaming(kinematics, limits, period_s=period_s)
        self._posed = self._streaming
        if options.axes == 3:
            sprung = options.mode == "direct-torque"
            share = SPRUNG_SPEED_SHARE if sprung else POSE_SPEED_SHARE
            slower = replace(
                limits,
                max_speed=tuple(share * speed for speed in model.max_speed),
                max_acceleration=(SPRUNG_ACCELERATION if sprung else JOINT_ACCELERATION,) * 6,
            )
            self._posed = UrStreaming(kinematics, slower, period_s=period_s, cost=StreamingCost(**POSE_COST))
            # Compiled now, and not in the first period that needs it.
            kinematics.manipulability(self.q)
        self._sends_poses = options.mode == "servol"
        self._avoids_singularities = False
        self._slowed = ""
        """Why joints were slowed down that nothing else held back."""
        a2, a3 = abs(model.a[1]), abs(model.a[2])
        self._manipulability_unit = a2 * a3 * (a2 + a3)
        self._max_turn_rate = CATCH_UP * options.max_angular_speed
        self._max_behind_rad = max(options.max_turn, MAX_BEHIND_RAD)
        self._period_s = period_s
        self._rate_hz = 1.0 / (CORRECTION_PERIODS * period_s)
        self._max_behind_m = max(options.max_jump, MAX_BEHIND_M)
        self._braked = BrakedPoint(limits, period_s)
        self._rotation = np.eye(3)
        self._model_turn = np.eye(3)
        """From the controller's orientation of the tool to that of the model: `R' R_model` at the begin."""
        self._twist = np.zeros(6)
        self.offset = np.zeros(3)
        """From the controller's tool to that of the model, in m."""

    def begin(self, state: UrState) -> None:
        """Motion begins where the arm is."""
        transform = self._kinematics.forward(state.q)
        self._rotation = np.array(transform[:3, :3])
        self._model_turn = matrix_from_rotvec(state.pose[3:]).T @ self._rotation
        self.offset = transform[:3, 3] - np.array(state.pose[:3])
        self.q, self.qd = np.array(state.q), np.zeros(6)
        self._streaming.begin(self.q, self.offset)
        if self._posed is not self._streaming:
            self._posed.begin(self.q, self.offset)
            apart = max(math.hypot(*self.offset), math.hypot(*rotvec_from_matrix(self._model_turn)))
            self._avoids_singularities = self._sends_poses and apart > SAME_CHAIN
        self._braked.begin(np.array(transform[:3, 3]), self.offset)

    def tool(self) -> tuple[Three, Quaternion, list[float]]:
        """Position in m, orientation, and twist in m/s and rad/s of the tool at these angles, for the controller."""
        transform, jacobian = self._kinematics.forward_and_jacobian(self.q)
        orientation = quat_wxyz_from_matrix(transform[:3, :3] @ self._model_turn.T)
        x, y, z = (transform[:3, 3] - self.offset).tolist()
        return (x, y, z), orientation, (jacobian @ self.qd).tolist()

    def follow(self, position: Three, velocity: Three, elapsed_s: float, attitude: Attitude | None = None) -> None:
        """Goes on for a time in s, in whole periods.

        Raises:
            UnreachableError: The tool stays far behind.
        """
        target = np.array(position) + self.offset
        feed_forward = np.array(velocity)
        streaming = self._streaming if attitude is None else self._posed
        away_rad = 0.0
        for _ in range(max(1, round(elapsed_s / self._period_s))):
            transform = self._kinematics.forward(self.q)
            tool = transform[:3, 3]
            # From where the target was a period ago: else the joints would run ahead by v times a period.
            behind = target - tool - feed_forward * self._period_s
            # Before a plane the arm brakes, and the set point stops on it: no fault while it comes on as it brakes.
            behind_braked = self._braked.position - tool
            self._braked.step(target)
            self._twist[:3] = feed_forward + behind * self._rate_hz
            if attitude is None:
                self._twist[3:] = rotvec_from_matrix(self._rotation @ transform[:3, :3].T)
                self._twist[3:] *= self._rate_hz
            else:
                away_rad = self._turn(attitude, transform[:3, :3])
            self.qd = np.array(streaming.velocity(self.q, self.qd, self._twist))
            if attitude is not None and self._avoids_singularities:
                self._slow_before_singularity()
            self.q = self.q + self.qd * self._period_s
        away = min(float(np.linalg.norm(behind)), float(np.linalg.norm(behind_braked)))
        if away > self._max_behind_m or away_rad > self._max_behind_rad:
            held_by = streaming.held_by
            why = streaming.reason or (f"held back by {held_by}" if held_by else self._slowed or UNKNOWN_CAUSE)
            behind_text = f"{1e3 * away:.0f} mm" if away > self._max_behind_m else f"{away_rad:.2f} rad"
            message = f"the tool cannot follow: {behind_text} behind {_text(position)} m: {why}"
            raise UnreachableError(message)

    @property
    def singular(self) -> bool:
        """Whether the arm is so close to a singularity that the controller is to invert no twist."""
        return self._kinematics.manipulability(self.q) < MIN_TWIST_MANIPULABILITY * self._manipulability_unit

    def _slow_before_singularity(self) -> None:
        """Takes of the joint velocities what would bring the arm closer to a singularity than it may."""
        now, least = self._kinematics.manipulability(self.q), MIN_MANIPULABILITY * self._manipulability_unit
        lost = now - self._kinematics.manipulability(self.q + self.qd * self._period_s)
        allowed = max(0.0, now - least) * APPROACH_HZ * self._period_s
        self._slowed = SINGULAR if lost > allowed else ""
        if lost > allowed:
            self.qd *= allowed / lost

    def _turn(self, attitude: Attitude, rotation: Array) -> float:
        """Sets the angular velocity towards an attitude; how far that is away beside what a period turns, in rad."""
        target = matrix_from_quat_wxyz(attitude.orientation) @ self._model_turn
        feed_forward = np.array(attitude.angular_velocity)
        behind = rotvec_from_matrix(target @ rotation.T) - feed_forward * self._period_s
        self._twist[3:] = _limited((feed_forward + behind * self._rate_hz).tolist(), self._max_turn_rate)
        return float(np.linalg.norm(behind))


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


def model_distance(mode: Mode) -> float | None:
    """How far the tool of the model was at the begin from where the controller has it, in m; none without a model."""
    return None if mode.joints is None else math.hypot(*mode.joints.offset)


def ur_mode(options: UrOptions, period_s: float, tool: Numbers) -> Mode:
    """The mode that the options name.

    Args:
        options: Of the driver.
        period_s: Between two commands, in s.
        tool: The tool's point in the frame of the flange, as a pose.
    """
    if options.axes == 1 and options.mode == "servol":
        return ServoL(options, period_s)
    if options.axes == 1 and options.mode == "speedl":
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
    if options.mode == "servol":
        return ServoL(options, period_s, joints)
    if options.mode == "speedl":
        return SpeedL(options, period_s, joints)
    return DirectTorque(options, joints, model)


def _limited(vector: list[float], limit: float) -> list[float]:
    length = math.hypot(*vector)
    return [part * limit / length for part in vector] if length > limit else vector


def _text(position: Three) -> str:
    return ", ".join(f"{part:.4f}" for part in position)
