"""The commands that can move a UR arm: each is given the same set-point and keeps the orientation it began with."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from haptether.slave.ur_options import Three, UrOptions
from haptether.slave.ur_pose import matrix_from_rotvec, rotvec_from_matrix
from haptether.slave.ur_setpoint import SetPoint
from haptether.slave.ur_state import Numbers, UrState

if TYPE_CHECKING:
    from haptether.slave.ur_inverse import UrInverse
    from haptether.slave.ur_kinematics import UrKinematics
    from haptether.slave.ur_models import UrModel

Control = Any
"""An `rtde_control.RTDEControlInterface`; the library has no types."""
Order = Callable[[Control], bool]

DIRECT_TORQUE_SINCE: Final = (5, 26)
JOINT_SPEED_SHARE: Final = 0.9
"""Of the largest speed of a joint: what is commanded stays this far below."""
TURN_SPEED: Final = 0.5
"""rad/s at most, to keep the orientation under speedl."""
WRIST_SHARE: Final = 0.2
"""Stiffness and damping of the three wrists, of those of the large joints."""


class UnreachableError(ValueError):
    """The arm cannot go on to where it is sent."""


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

    def stop(self, control: Control) -> bool:
        """Comes to rest softly; returns once it is done."""


class Joints:
    """From a set-point of the tool to joint angles: nearest posture, orientation kept.

    The unit's chain is only nearly that of its model, so motion is counted from where both have the tool at the begin:
    what they differ by stays where it was, and the first command is exactly where the joints are.
    """

    def __init__(self, model: "UrModel", kinematics: "UrKinematics", inverse: "UrInverse") -> None:
        self._model = model
        self._kinematics = kinematics
        self._inverse = inverse
        self._base_from_tool = np.eye(4)
        self.offset: Three = (0.0, 0.0, 0.0)
        self.q: Numbers = (0.0,) * 6
        self.qd: Numbers = (0.0,) * 6

    def begin(self, state: UrState) -> None:
        self._base_from_tool = np.array(self._kinematics.forward(state.q))
        x, y, z = self._base_from_tool[:3, 3] - np.array(state.pose[:3])
        self.offset = (float(x), float(y), float(z))
        self.q, self.qd = state.q, (0.0,) * 6

    def follow(self, position: Three, elapsed_s: float) -> None:
        for row in range(3):
            self._base_from_tool[row, 3] = position[row] + self.offset[row]
        found = self._inverse.nearest(self._base_from_tool, self.q)
        if found is None:
            message = f"no joint angles for the tool at {_text(position)} m: {self._inverse.reason}"
            raise UnreachableError(message)
        q = tuple(found.tolist())
        qd = tuple((new - old) / elapsed_s for new, old in zip(q, self.q, strict=True))
        for joint, (speed, most) in enumerate(zip(qd, self._model.max_speed, strict=True)):
            if abs(speed) > JOINT_SPEED_SHARE * most:
                message = (
                    f"joint {joint + 1} would have to move at {abs(speed):.2f} rad/s, at most"
                    f" {JOINT_SPEED_SHARE * most:.2f}: the arm is near a singularity"
                )
                raise UnreachableError(message)
        self.q, self.qd = q, qd


class ServoJ:
    """`servoJ` on joint angles that are found here: the least work for the controller."""

    name = "servoJ"
    goes_on = False

    def __init__(self, options: UrOptions, joints: Joints, period_s: float) -> None:
        self._rest = (0.0, 0.0, period_s, options.lookahead_time, options.gain)
        self._deceleration = options.stop_deceleration
        self.joints = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        self.joints.follow(point.position, elapsed_s)
        q, rest = list(self.joints.q), self._rest
        return lambda control: bool(control.servoJ(q, *rest))

    def stop(self, control: Control) -> bool:
        """See `Mode`."""
        return bool(control.servoStop(self._deceleration))


class ServoL:
    """`servoL`: the controller finds the joint angles, on its own calibrated chain; where it finds none it ends the
    program.
    """

    name = "servoL"
    goes_on = False

    def __init__(self, options: UrOptions, period_s: float) -> None:
        self._rest = (0.0, 0.0, period_s, options.lookahead_time, options.gain)
        self._deceleration = options.stop_deceleration
        self._turn: Numbers = (0.0, 0.0, 0.0)

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self._turn = state.pose[3:]

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:  # noqa: ARG002
        """See `Mode`."""
        pose, rest = [*point.position, *self._turn], self._rest
        return lambda control: bool(control.servoL(pose, *rest))

    def stop(self, control: Control) -> bool:
        """See `Mode`."""
        return bool(control.servoStop(self._deceleration))


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
        self._deceleration = options.stop_deceleration
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

    def stop(self, control: Control) -> bool:
        """See `Mode`."""
        return bool(control.speedStop(self._deceleration))


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
        self._deceleration = options.stop_deceleration
        self.joints = joints

    def begin(self, state: UrState) -> None:
        """See `Mode`."""
        self.joints.begin(state)

    def order(self, point: SetPoint, state: UrState, elapsed_s: float) -> Order:
        """See `Mode`."""
        joints = self.joints
        joints.follow(point.position, elapsed_s)
        torque = [
            min(max(k * (q_set - q) + d * (qd_set - qd), -most), most)
            for k, d, most, q_set, q, qd_set, qd in zip(
                self._stiffness, self._damping, self._most, joints.q, state.q, joints.qd, state.qd, strict=True
            )
        ]
        return lambda control: bool(control.directTorque(torque))

    def stop(self, control: Control) -> bool:
        """See `Mode`."""
        # It has no stop of its own; this one returns nothing.
        control.stopJ(self._deceleration, False)
        return True


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
    from haptether.slave.ur_inverse import UrInverse  # noqa: PLC0415
    from haptether.slave.ur_kinematics import UrKinematics  # noqa: PLC0415
    from haptether.slave.ur_models import ur_model  # noqa: PLC0415
    from haptether.slave.ur_pose import transform_from_pose  # noqa: PLC0415

    model = ur_model(options.model)
    calibration = read_calibration(options.calibration) if options.calibration is not None else None
    flange_from_tool = transform_from_pose(tool)
    joints = Joints(
        model, UrKinematics(model, calibration, flange_from_tool), UrInverse(model, calibration, flange_from_tool)
    )
    if options.mode == "servoj":
        return ServoJ(options, joints, period_s)
    return DirectTorque(options, joints, model)


def _at_most(vector: list[float], most: float) -> list[float]:
    length = math.hypot(*vector)
    return [part * most / length for part in vector] if length > most else vector


def _text(position: Three) -> str:
    return ", ".join(f"{part:.4f}" for part in position)
