"""Poses in every mode, at an emulated arm in virtual time: turns are followed, and nothing jumps."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.ur.posed import PERIOD_S, Orders, Posed
from tests.ur.virtual import START

from haptether.slave import UrKinematics, ur_model
from haptether.slave.ur.kinematics.pose import quat_product, quat_wxyz_from_rotvec
from haptether.slave.ur.modes import JOINT_ACCELERATION, POSE_SPEED_SHARE, SPRUNG_SPEED_SHARE, ur_mode
from haptether.slave.ur.options import ur_options
from haptether.slave.ur.set_point import Attitude
from ur.figures import Path, Pose, figure, turn

pytestmark = pytest.mark.slow

MODEL = ur_model("ur5e")
AT_REST = (0.0, 0.0, 0.0)
TURN = math.radians(60.0)
LATE_S = {"servoj": 0.05 + 0.006, "servol": 0.05 + 0.006, "speedl": 0.003, "direct-torque": 0.025}
"""Lookahead and three cycles of transport; for direct-torque the lag of its springs, see docs/ur.md."""
SPEED, ANGULAR_SPEED = 0.147, 1.56
"""Largest speeds of the figure, in m/s and rad/s."""


def wrist_figure(arm: Posed) -> Path:
    return figure(arm.home.pose, amplitude_m=0.05, angle=TURN, period_s=8.0)


def across(start: tuple[float, ...], tilted: float = 0.0) -> Path:
    """Return a turn of 1 rad with joint 5 through zero: about its axis, or beside it, where joint 4 must go round."""
    kinematics = UrKinematics(MODEL)
    jacobian = np.array(kinematics.forward_and_jacobian(start)[1])
    axis = -(jacobian[3:, 4] + tilted * jacobian[3:, 3])
    return turn(Posed("servoj", start).home.pose, axis=(axis / np.linalg.norm(axis)).tolist(), angle=1.0, speed=0.8)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("mode", LATE_S)
def test_the_tool_follows_a_figure_that_turns_by_60_degrees(mode: str) -> None:
    arm = Posed(mode)
    path = wrist_figure(arm)
    poses = [path(0.01 * tick) for tick in range(800)]
    assert SPEED * 0.98 < max(math.hypot(*pose.velocity) for pose in poses) < SPEED
    assert ANGULAR_SPEED * 0.98 < max(math.hypot(*pose.angular_velocity) for pose in poses) < ANGULAR_SPEED
    led = arm.lead(path, 6.2)
    assert led.fault == ""
    # It turns that far, and lags at most by its delay at the largest speed; springs also sag.
    assert np.ptp([pose.angular_velocity[2] for pose in poses]) > 1.0
    assert led.metres.max() < SPEED * LATE_S[mode] + (4e-3 if mode == "direct-torque" else 1e-4)
    assert led.radians.max() < ANGULAR_SPEED * LATE_S[mode] + (0.01 if mode == "direct-torque" else 1e-3)
    assert (np.abs(led.qd) < POSE_SPEED_SHARE * np.array(MODEL.max_speed)).all()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("tilted", [0.0, 0.3])
@pytest.mark.parametrize(("mode", "share", "swing"), [
    # The command keeps to a share; servoj swings beyond, the loop of speedl compensates, springs saturate.
    ("servoj", POSE_SPEED_SHARE, 1.03), ("servol", POSE_SPEED_SHARE, 1.03), ("speedl", POSE_SPEED_SHARE, 1.1),
    ("direct-torque", SPRUNG_SPEED_SHARE, 1.5),
])  # fmt: skip
def test_a_wrist_goes_through_its_singularity_and_no_joint_jumps(
    mode: str, share: float, swing: float, tilted: float
) -> None:
    start = (*START[:4], 0.5, 0.0)
    led = Posed(mode, start).lead(across(start, tilted), 2.5)
    assert led.fault == ""
    assert led.q[0, 4] == 0.5
    assert led.q[-1, 4] < -0.4
    fastest = np.abs(led.qd).max(axis=0) / np.array(MODEL.max_speed)
    assert fastest.max() < swing * share < 1.0
    assert fastest[3] > 0.4
    assert np.abs(np.diff(led.q, axis=0)).max() < swing * share * max(MODEL.max_speed) * PERIOD_S
    # The tool's point is kept; its orientation lags, and arrives.
    assert led.metres.max() < 0.006
    assert 0.05 < led.radians.max() < 0.3
    assert led.radians[-1] < 0.02


@pytest.mark.parametrize("q5", [0.5, math.pi - 0.5])
def test_servol_does_not_come_to_a_singularity_that_lies_elsewhere_for_the_controller(q5: float) -> None:
    """The controller's tool is 2 mm from that of the model, like that of an uncalibrated arm."""
    start = (*START[:4], q5, 0.0)
    kinematics = UrKinematics(MODEL)
    jacobian = np.array(kinematics.forward_and_jacobian(start)[1])
    axis = jacobian[3:, 4] * (1.0 if q5 > 1.0 else -1.0)
    arm = Posed("servol", start)
    led = arm.lead(turn(arm.home.pose, axis=axis.tolist(), angle=1.0, speed=0.8), 2.5, (0.002, 0.0, 0.0))
    assert "0.30 rad behind" in led.fault
    assert "beside a singularity: with its calibration, or under servoj, it would pass" in led.fault
    assert 0.1 < abs(math.sin(led.q[-1, 4])) < 0.15
    assert (np.abs(led.qd) < 0.35 * np.array(MODEL.max_speed)).all()


@pytest.mark.parametrize("mode", LATE_S)
def test_the_elbow_is_not_stretched_by_a_turn(mode: str) -> None:
    """Out of reach the tool stays behind and the mode says why; no joint is too fast."""
    start = (0.0, -1.0, 0.3, -0.5, 1.2, 0.0)
    arm = Posed(mode, start)
    x, y, z = arm.home.pose[:3]

    def outwards(t: float) -> Pose:
        pose = turn(arm.home.pose, axis=(0.0, 0.0, 1.0), angle=0.5, speed=0.5)(t)
        return pose._replace(position=(x * (1 + 0.2 * t), y, z), velocity=(0.2 * x, 0.0, 0.0))

    led = arm.lead(outwards, 4.0)
    assert "the tool cannot follow" in led.fault
    assert (np.abs(led.qd) < 1.1 * POSE_SPEED_SHARE * np.array(MODEL.max_speed)).all()


def test_speedl_goes_through_on_joint_velocities_and_comes_back_to_the_tools() -> None:
    start = (*START[:4], 0.5, 0.0)
    arm = Posed("speedl", start)
    sent: list[str] = []
    call = Orders.__getattr__

    def kept(orders: Orders, name: str) -> Callable[..., bool]:
        sent.append(name)
        return call(orders, name)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Orders, "__getattr__", kept)
        led = arm.lead(across(start), 2.5)
    assert led.fault == ""
    switched = [n for n, (before, after) in enumerate(itertools.pairwise(sent)) if before != after]
    assert [sent[n + 1] for n in switched] == ["speedJ", "speedL"]
    # The switches do not show in the joints' motion: velocity changes stay within the bound of a period.
    changes = np.abs(np.diff(led.qd, axis=0)).max(axis=1)
    for n in switched:
        assert changes[n - 5 : n + 6].max() < 1.5 * JOINT_ACCELERATION * PERIOD_S


class Calls:
    """A control interface that records its calls."""

    def __init__(self) -> None:
        self.seen: list[list[float]] = []

    def __getattr__(self, name: str) -> Callable[..., bool]:
        def call(numbers: list[float], *_: float) -> bool:
            self.seen.append(numbers)
            return True

        return call


def test_poses_of_servol_do_not_turn_round_at_half_a_turn() -> None:
    # The tool points down, which is nearly half a turn about y; a turn about y leads past it.
    arm = Posed("servol", max_angular_speed=1.0)
    calls, x = Calls(), arm.home.pose
    assert math.hypot(*x[3:]) > 3.1
    arm.mode.begin(arm.home)
    begin = quat_wxyz_from_rotvec(x[3:])
    for tick in range(400):
        angle = 0.5 * PERIOD_S * tick
        turned = quat_product(quat_wxyz_from_rotvec((0.0, angle, 0.0)), begin)
        attitude = Attitude(turned, (0.0, 0.5, 0.0))
        arm.mode.order(x[:3], AT_REST, arm.home, PERIOD_S, attitude)(calls)  # type: ignore[arg-type]  # three numbers
    rotvecs = np.array(calls.seen)[:, 3:]
    assert np.linalg.norm(rotvecs, axis=1).max() > math.pi + 0.1
    assert np.abs(np.diff(rotvecs, axis=0)).max() < 2e-3
    want = Rotation.from_rotvec((0.0, 0.5 * PERIOD_S * 399, 0.0)) * Rotation.from_rotvec(x[3:])
    assert (Rotation.from_rotvec(rotvecs[-1]) * want.inv()).magnitude() < 1e-4


def test_speedl_closes_its_loop_on_the_rotation() -> None:
    """`w = w_set + k log(R_set R')` for an arm that is turned away from its set point by hand."""
    arm = Posed("speedl", position_gain=8.0)
    calls, home = Calls(), arm.home
    arm.mode.begin(home)
    begin = quat_wxyz_from_rotvec(home.pose[3:])
    away = (0.02, -0.01, 0.03)
    turned = Rotation.from_rotvec(away) * Rotation.from_rotvec(home.pose[3:])
    seen = home._replace(pose=(*home.pose[:3], *turned.as_rotvec().tolist()))
    arm.mode.order(home.pose[:3], AT_REST, seen, PERIOD_S, Attitude(begin, AT_REST))(calls)  # type: ignore[arg-type]
    assert calls.seen[-1][:3] == pytest.approx(AT_REST, abs=1e-9)
    assert calls.seen[-1][3:] == pytest.approx([-8.0 * part for part in away], abs=1e-9)
    # The angular speed saturates at the tool's limit.
    far = Rotation.from_rotvec((1.5, 0.0, 0.0)) * Rotation.from_rotvec(home.pose[3:])
    seen = home._replace(pose=(*home.pose[:3], *far.as_rotvec().tolist()))
    arm.mode.order(home.pose[:3], AT_REST, seen, PERIOD_S, Attitude(begin, AT_REST))(calls)  # type: ignore[arg-type]
    assert math.hypot(*calls.seen[-1][3:]) == pytest.approx(3.0, abs=1e-9)


def test_springs_of_direct_torque_hold_the_orientation() -> None:
    """A small turn of the set point makes torques that turn the tool that way: `J^-T K J^-1` times the turn."""
    arm = Posed("direct-torque", torque_share=0.8)
    calls, home = Calls(), arm.home
    arm.mode.begin(home)
    turned = quat_wxyz_from_rotvec((0.0, 0.0, 1e-3))
    attitude = Attitude(quat_product(turned, quat_wxyz_from_rotvec(home.pose[3:])), AT_REST)
    for _ in range(500):
        arm.mode.order(home.pose[:3], AT_REST, home, PERIOD_S, attitude)(calls)  # type: ignore[arg-type]
    _, jacobian = UrKinematics(MODEL).forward_and_jacobian(START)
    stiffness = 300.0 * np.array((1.0, 1.0, 1.0, 0.2, 0.2, 0.2))
    want = stiffness * np.linalg.solve(jacobian, (0.0, 0.0, 0.0, 0.0, 0.0, 1e-3))
    # To first order in the turn.
    assert calls.seen[-1] == pytest.approx(want.tolist(), abs=2e-3)
    assert np.abs(want).max() > 0.05


@pytest.mark.sampled(2)
@pytest.mark.parametrize("mode", LATE_S)
def test_planes_hold_for_a_tool_that_turns(mode: str) -> None:
    arm = Posed(mode, workspace=[[0.0, 0.0, 1.0, START_Z - 0.02]])
    led = arm.lead(wrist_figure(arm), 3.0)
    assert led.fault == ""
    assert arm.point.position[2] >= START_Z - 0.02 - 1e-12
    kinematics = UrKinematics(MODEL)
    z = np.array([kinematics.forward(q)[2, 3] for q in led.q])
    # Springs overshoot their set point.
    assert z.min() > START_Z - 0.02 - (4e-3 if mode == "direct-torque" else 5e-4)
    assert z.min() < START_Z - 0.018


START_Z = float(UrKinematics(MODEL).forward(START)[2, 3])


def test_a_mode_of_one_axis_needs_no_model() -> None:
    options = {"host": "fake", "axes": 1}
    assert all(
        ur_mode(ur_options(options | {"mode": m}), PERIOD_S, (0.0,) * 6).joints is None for m in ("servol", "speedl")
    )
