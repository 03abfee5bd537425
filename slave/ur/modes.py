"""The commands that can move a UR arm: each is given the same set-point and keeps the orientation it began with."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from haptether.slave.ur.braking import of_joints, of_tool
from haptether.slave.ur.joints import Joints
from haptether.slave.ur.options import UrOptions
from haptether.slave.ur.setpoint import SetPoint
from haptether.slave.ur.state import Numbers, UrState
from haptether.slave.ur_pose import matrix_from_rotvec, rotvec_from_matrix

if TYPE_CHECKING:
    from haptether.slave.ur_models import UrModel

Control = Any
"""An `rtde_control.RTDEControlInterface`; the library has no types."""
Order = Callable[[Control], bool]

DIRECT_TORQUE_SINCE: Final = (5, 26)
TURN_SPEED: Final = 0.5
"""rad/s at most, to keep the orientation under speedl."""
WRIST_SHARE: Final = 0.2
"""Stiffness and damping of the three wrists, of those of the large joints."""


class Mode(Protocol):
    """One way to move the arm."""

    name: str
    """Of the call of the library."""
    goes_on: bool
    """Whether the arm goes on moving where nothing more is sent: then the driver ends that itself."""

    def begin(self, state: UrState) -> None:
        """Motion begins where the arm is."""

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:
        """What sends the arm to the set-point, to be called on the thread of the library.

        Raises:
            UnreachableError: It cannot get there.
        """

    def brake(self, state: UrState) -> Order:
        """What has the arm come to rest softly; returns once it is done."""


class ServoJ:
    """`servoJ` on joint angles that are found here: the least work for the controller."""

    name = "servoJ"
    goes_on = False

    def __init__(self, options: UrOptions, joints: Joints, period_s: float) -> None:
        self._rest = (0.0, 0.0, period_s, options.lookahead_time, options.gain)
        self._options = options
        self.joints = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        self.joints.follow(point, elapsed_s)
        q, rest = self.joints.q.tolist(), self._rest
        return lambda control: bool(control.servoJ(q, *rest))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = of_joints(self._options, state)
        return lambda control: bool(control.servoStop(deceleration))


class ServoL:
    """`servoL`: the controller finds the joint angles, on its own calibrated chain.

    Where it finds none it ends the program.
    """

    name = "servoL"
    goes_on = False

    def __init__(self, options: UrOptions, period_s: float) -> None:
        self._rest = (0.0, 0.0, period_s, options.lookahead_time, options.gain)
        self._options = options
        self._turn: Numbers = (0.0, 0.0, 0.0)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._turn = state.pose[3:]

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        pose, rest = [*point.position, *self._turn], self._rest
        return lambda control: bool(control.servoL(pose, *rest))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = of_joints(self._options, state)
        return lambda control: bool(control.servoStop(deceleration))


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
        self._turn = np.eye(3)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._turn = matrix_from_rotvec(state.pose[3:])

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        wanted = [
            v + self._gain * (x_set - x)
            for v, x_set, x in zip(point.velocity, point.position, state.pose[:3], strict=True)
        ]
        away = rotvec_from_matrix(self._turn @ matrix_from_rotvec(state.pose[3:]).T)
        xd = [
            *_at_most(wanted, self._max_speed),
            *_at_most([self._gain * part for part in away], TURN_SPEED),
        ]
        acceleration, time_s = self._acceleration, self._period_s
        return lambda control: bool(control.speedL(xd, acceleration, time_s))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = of_tool(self._options, state)
        return lambda control: bool(control.speedStop(deceleration))


class DirectTorque:
    """`directTorque`: springs and dampers on the joints, `tau = K (q_set - q) + D (q_set' - q')`, each bounded.

    Gravity and friction are the controller's. The arm gives way to a force instead of insisting on its position.
    """

    name = "directTorque"
    goes_on = True

    def __init__(self, options: UrOptions, joints: Joints, model: "UrModel") -> None:
        shares = (1.0, 1.0, 1.0, WRIST_SHARE, WRIST_SHARE, WRIST_SHARE)
        self._stiffness = [options.joint_stiffness * share for share in shares]
        self._damping = [options.joint_damping * share for share in shares]
        self._most = [options.torque_share * torque for torque in model.max_torque]
        self._options = options
        self.joints = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:
        """See `Mode`."""
        joints = self.joints
        joints.follow(point, elapsed_s)
        torque = [
            min(max(k * (q_set - q) + d * (qd_set - qd), -most), most)
            for k, d, most, q_set, q, qd_set, qd in zip(
                self._stiffness,
                self._damping,
                self._most,
                joints.q.tolist(),
                state.q,
                joints.qd.tolist(),
                state.qd,
                strict=True,
            )
        ]
        return lambda control: bool(control.directTorque(torque))

    def brake(self, state: UrState) -> Order:
        """See `Mode`."""
        deceleration = of_joints(self._options, state)

        def order(control: Control) -> bool:
            # It has no stop of its own; this one returns nothing. Whether the arm rests is seen in what it does.
            control.stopJ(deceleration, False)
            return True

        return order


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
    joints = getattr(mode, "joints", None)
    if joints is None:
        return None
    joints.begin(state)
    return math.hypot(*joints.offset)


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
    from haptether.slave.ur_calibration import read_calibration  # noqa: PLC0415  # with CasADi
    from haptether.slave.ur_kinematics import UrKinematics  # noqa: PLC0415
    from haptether.slave.ur_models import ur_model  # noqa: PLC0415
    from haptether.slave.ur_pose import transform_from_pose  # noqa: PLC0415

    model = ur_model(options.model)
    calibration = read_calibration(options.calibration, model) if options.calibration is not None else None
    flange_from_tool = transform_from_pose(tool)
    joints = Joints(UrKinematics(model, calibration, flange_from_tool), options, period_s)
    if options.mode == "servoj":
        return ServoJ(options, joints, period_s)
    return DirectTorque(options, joints, model)


def _at_most(vector: list[float], most: float) -> list[float]:
    length = math.hypot(*vector)
    return [part * most / length for part in vector] if length > most else vector
