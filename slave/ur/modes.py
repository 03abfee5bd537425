"""Motion commands of a UR arm: each follows the same set point, and keeps its orientation if none is given."""

import math
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from msgspec.structs import replace

from haptether.slave.ur.connection import Control, Order
from haptether.slave.ur.forces import ToolForces
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
    from haptether.slave.ur.kinematics.chain import UrCalibration

ROTATION_SPEED: Final = 0.5
"""Largest angular speed in rad/s that keeps the initial orientation under speedl."""
WRIST_SHARE: Final = 0.2
"""Ratio of the wrists' stiffness and damping to those of the large joints."""
CORRECTION_PERIODS: Final = 4.0
"""Periods in which the joints correct their deviation from the set point."""
MAX_BEHIND_M: Final = 0.02
"""Largest lag in m of the joints behind the set point; more would be corrected at once at another position."""
MAX_BEHIND_RAD: Final = 0.3
"""Largest orientation lag in rad; the orientation yields near a singularity."""
CATCH_UP: Final = 1.2
"""Largest factor of `max_angular_speed` for correcting an orientation lag."""
JOINT_ACCELERATION: Final = 25.0
"""Largest joint acceleration in rad/s²: required by the tool's bounds over the shortest lever, not for smoothness."""
APPROACH_HZ: Final = 10.0
"""A plane or self distance shrinks at most at this rate times the remaining distance. For a tool faster than 1 m/s the
rate is lower, so that it brakes with 10 m/s².
"""
JOINT_SPEED_SHARE: Final = 0.9
"""Fraction of a joint's largest speed that commands may use."""
POSE_SPEED_SHARE: Final = 0.7
"""Same for a rotating tool: near a singularity joints reach it, and an arm overshoots."""
SPRUNG_SPEED_SHARE: Final = 0.5
"""Same under direct-torque."""
SPRUNG_ACCELERATION: Final = 12.0
"""Largest joint acceleration in rad/s² under direct-torque with a rotating tool; springs saturate at `torque_share`."""
MIN_MANIPULABILITY: Final = 0.05
"""As a fraction of `|a2 a3| (|a2| + |a3|)`; below it a controller cannot invert poses of another chain."""
MIN_TWIST_MANIPULABILITY: Final = 0.15
"""Same for twists, which refer to joints some ms ahead of the controller's."""
SAME_CHAIN: Final = 1e-4
"""Largest deviation of the model's tool in m and rad at which both chains have equal joint angles."""
POSE_COST: Final[dict[str, Any]] = {"weights": (1.0, 1.0, 1.0, 0.01, 0.01, 0.01), "damping": 1e-3}
"""Cost for a rotating tool: 1 rad/s counts like 0.1 m/s, with proportional damping."""


UNKNOWN_CAUSE: Final = "its joints are at their limits, or the arm is near a singularity"
SINGULAR: Final = "the arm is beside a singularity: with its calibration, or under servoj, it would pass"


class UnreachableError(ValueError):
    """The arm cannot reach its target."""


class Mode(Protocol):
    """Command that moves the arm, and the command that stops it."""

    name: str
    """Name of the library call."""
    goes_on: bool
    """True if the arm continues to move without further commands; the driver then ends the motion."""
    finds_joints: bool
    """True if it computes joint angles for positions too; otherwise only for poses, which the controller then receives.
    """

    @property
    def joints(self) -> "JointTracking | None":
        """Source of joint angles; None if never used."""

    def begin(self, state: UrState) -> None:
        """Start a motion at the arm's pose."""

    def order(
        self, position: Three, velocity: Three, state: UrState, elapsed_s: float, attitude: Attitude | None = None
    ) -> Order:
        """Return the order that moves the arm to the set point after a time in s, in m and m/s in the base frame.

        Without any attitude since the start the initial orientation is kept.

        Raises:
            UnreachableError: The arm cannot reach it.
        """

    def brake(self, state: UrState) -> Order:
        """Return the order that brings the arm softly to rest and returns when done."""


class _Servo:
    """The controller follows each target with its lookahead and gain, and holds the last one."""

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
    """`servoJ` with joint angles computed here: the least work for the controller."""

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
    """`servoL`: the controller computes the joint angles on its calibrated chain.

    If it finds none it ends the program. With an orientation it receives poses of joints tracked here, which are
    reachable within their limits.
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
    """`speedL` with a position loop closed here: `v = v_set + k (x_set - x)`, limited to the tool speed.

    The arm continues at the last velocity without a command. The driver ends that, or the watchdog if the driver is
    gone.

    With an orientation, also `w = w_set + k log(R_set R')`, and the set point comes from joints tracked here, as in
    `ServoL`. Near a singularity, where a controller cannot invert a twist, it switches to `speedJ` with the same law on
    the joints, `q' = q_set' + k (q_set - q)`, with continuous velocity.
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
        # The controller uses one number for m/s² and rad/s².
        acceleration = max(options.max_acceleration, options.max_angular_acceleration)
        return lambda control: bool(control.speedL(xd, acceleration, time_s))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = tool_deceleration(self._options, state)
        return lambda control: bool(control.speedStop(deceleration))


class DirectTorque:
    """`directTorque`: springs and dampers on the joints, `tau = K (q_set - q) + D (q_set' - q')`, each saturated.

    The controller compensates gravity and friction. The arm yields to a force. The joint angles include the set
    orientation, so these springs also act on the rotation, `J^-T K J^-1` at the tool, without a second spring.

    The mode also takes forces, see `ToolForces`.
    """

    name = "directTorque"
    goes_on = True
    finds_joints = True

    def __init__(self, options: UrOptions, joints: "JointTracking") -> None:
        model = joints.kinematics.model
        shares = np.array((1.0, 1.0, 1.0, WRIST_SHARE, WRIST_SHARE, WRIST_SHARE))
        self._stiffness = options.joint_stiffness * shares
        self._damping = options.joint_damping * shares
        self._max_torque = options.torque_share * np.array(model.max_torque)
        self._options = options
        self.joints: JointTracking = joints
        max_speed = SPRUNG_SPEED_SHARE * np.array(model.max_speed)
        self.forces = ToolForces(options, joints, self._stiffness, self._max_torque, max_speed)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def resume(self, state: UrState) -> None:
        """Continue a motion at the arm's pose and velocity."""
        self.joints.resume(state)

    def push(self, force: Three, moment: Three | None, state: UrState) -> Order:
        """Return the order that exerts a force in N and a moment in N m, see `ToolForces.torque`."""
        torque = self.forces.torque(force, moment, state)
        return lambda control: bool(control.directTorque(torque))

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
            # Has no stop of its own; stopJ returns nothing. The arm's motion shows whether it rests.
            control.stopJ(deceleration, False)
            return True

        return order


class JointTracking:
    """Tracking from a tool set point to joint angles within the joint limits.

    Each period the joint velocities best follow `v_set + (x_set - x)/T` within the limits (`UrStreaming`). Near a
    singularity, or at a joint limit, the tool lags; no joint exceeds its speed. The set point is fed forward without
    smoothing: `(x_set - x)/T` removes the deviation of constant joint velocities from a straight line, and the lag
    caused by limits. Speed and acceleration bounds are those of the set point. Workspace planes are also limits here,
    before which the joints brake (the set point stops on them at once). So is the self keep-out, which the set point
    does not know.

    Without an attitude the initial orientation is kept. With one, it is a task of lower weight than the position: if
    both conflict, near a singularity or at limits, the tool point is followed and the orientation lags. Joint
    velocities never leave the arm's branch. A wrist turns over only by passing its singularity within its limits.

    Under servol the controller computes the joint angles of a pose; near a singularity they agree only if its chain
    equals the model. Otherwise the joints avoid singularities: the manipulability w shrinks at most at `APPROACH_HZ`
    times its excess over `MIN_MANIPULABILITY`.

    The unit's chain only approximates its model, so motion is relative to the tool pose of both at the start. Their
    initial difference is kept, and the first command equals the joint angles.

    Args:
        kinematics: Kinematics of the arm with its tool.
        options: Options of the driver.
        period_s: Period of commands in s.
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
        """Largest joint speeds in rad/s."""
        self.q, self.qd = np.zeros(6), np.zeros(6)
        self.kinematics = kinematics
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
            # Compile now, not in the first period that needs it.
            kinematics.manipulability(self.q)
        self._sends_poses = options.mode == "servol"
        self._avoids_singularities = False
        self._slowed = ""
        """Reason why joints were slowed without an active limit."""
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
        """Rotation from the controller's tool orientation to the model's: `R' R_model` at the start."""
        self._twist = np.zeros(6)
        self.offset = np.zeros(3)
        """Offset from the controller's tool to the model's in m."""

    def begin(self, state: UrState) -> None:
        """Start a motion at the arm's pose."""
        self.resume(state)
        self.qd = np.zeros(6)
        self._streaming.begin(self.q, self.offset)
        if self._posed is not self._streaming:
            self._posed.begin(self.q, self.offset)
            apart = max(math.hypot(*self.offset), math.hypot(*rotvec_from_matrix(self._model_turn)))
            self._avoids_singularities = self._sends_poses and apart > SAME_CHAIN

    def resume(self, state: UrState) -> None:
        """Continue at the arm's pose and velocity, with the distances that `begin` allowed."""
        transform = self.kinematics.forward(state.q)
        self._rotation = np.array(transform[:3, :3])
        self._model_turn = matrix_from_rotvec(state.pose[3:]).T @ self._rotation
        self.offset = transform[:3, 3] - np.array(state.pose[:3])
        self.q, self.qd = np.array(state.q), np.array(state.qd)
        self._braked.begin(np.array(transform[:3, 3]), self.offset)

    def tool(self) -> tuple[Three, Quaternion, list[float]]:
        """Return position in m, orientation, and twist in m/s and rad/s of the tool at these angles."""
        transform, jacobian = self.kinematics.forward_and_jacobian(self.q)
        orientation = quat_wxyz_from_matrix(transform[:3, :3] @ self._model_turn.T)
        x, y, z = (transform[:3, 3] - self.offset).tolist()
        return (x, y, z), orientation, (jacobian @ self.qd).tolist()

    def follow(self, position: Three, velocity: Three, elapsed_s: float, attitude: Attitude | None = None) -> None:
        """Advance for a time in s, in whole periods.

        Raises:
            UnreachableError: The tool lags too far.
        """
        target = np.array(position) + self.offset
        feed_forward = np.array(velocity)
        streaming = self._streaming if attitude is None else self._posed
        away_rad = 0.0
        for _ in range(max(1, round(elapsed_s / self._period_s))):
            transform = self.kinematics.forward(self.q)
            tool = transform[:3, 3]
            # Relative to the target one period ago; otherwise the joints would lead by v times a period.
            behind = target - tool - feed_forward * self._period_s
            # Before a plane the arm brakes while the set point stops on it; not a fault while the arm approaches.
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

    def distances(self, q: Numbers) -> tuple[Array, Array]:
        """Return distances of planes and links in m, (n,), and their gradients, (n, 6), see `UrStreaming`."""
        return self._streaming.distances(q)

    @property
    def singular(self) -> bool:
        """True if the arm is too close to a singularity for the controller to invert a twist."""
        return self.kinematics.manipulability(self.q) < MIN_TWIST_MANIPULABILITY * self._manipulability_unit

    def _slow_before_singularity(self) -> None:
        """Reduce joint velocities that would approach a singularity too fast."""
        now, least = self.kinematics.manipulability(self.q), MIN_MANIPULABILITY * self._manipulability_unit
        lost = now - self.kinematics.manipulability(self.q + self.qd * self._period_s)
        allowed = max(0.0, now - least) * APPROACH_HZ * self._period_s
        self._slowed = SINGULAR if lost > allowed else ""
        if lost > allowed:
            self.qd *= allowed / lost

    def _turn(self, attitude: Attitude, rotation: Array) -> float:
        """Set the angular velocity towards an attitude; return the remaining angle beyond one period's turn in rad."""
        target = matrix_from_quat_wxyz(attitude.orientation) @ self._model_turn
        feed_forward = np.array(attitude.angular_velocity)
        behind = rotvec_from_matrix(target @ rotation.T) - feed_forward * self._period_s
        self._twist[3:] = _limited((feed_forward + behind * self._rate_hz).tolist(), self._max_turn_rate)
        return float(np.linalg.norm(behind))


def model_distance(mode: Mode) -> float | None:
    """Return the initial distance in m between the model's and the controller's tool; None without a model."""
    return None if mode.joints is None else math.hypot(*mode.joints.offset)


def ur_mode(options: UrOptions, period_s: float, tool: Numbers, calibration: "UrCalibration | None" = None) -> Mode:
    """Return the mode that the options name.

    Args:
        options: Options of the driver.
        period_s: Period of commands in s.
        tool: Tool point in the flange frame, as a pose.
        calibration: Deltas of this unit; by default the data sheet applies.
    """
    if options.axes == 1 and options.mode == "servol":
        return ServoL(options, period_s)
    if options.axes == 1 and options.mode == "speedl":
        return SpeedL(options, period_s)
    from haptether.slave.ur.kinematics.arm import UrKinematics  # noqa: PLC0415  # with CasADi
    from haptether.slave.ur.kinematics.models import ur_model  # noqa: PLC0415
    from haptether.slave.ur.kinematics.pose import transform_from_pose  # noqa: PLC0415

    model = ur_model(options.model)
    flange_from_tool = transform_from_pose(tool)
    joints = JointTracking(UrKinematics(model, calibration, flange_from_tool), options, period_s)
    if options.mode == "servoj":
        return ServoJ(options, joints, period_s)
    if options.mode == "servol":
        return ServoL(options, period_s, joints)
    if options.mode == "speedl":
        return SpeedL(options, period_s, joints)
    return DirectTorque(options, joints)


def _limited(vector: list[float], limit: float) -> list[float]:
    length = math.hypot(*vector)
    return [part * limit / length for part in vector] if length > limit else vector


def _text(position: Three) -> str:
    return ", ".join(f"{part:.4f}" for part in position)
