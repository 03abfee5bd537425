"""From a set-point to joint angles: the tool reaches it, its orientation stays, and joint speeds stay within limits."""

import math
from typing import Any

import numpy as np
import pytest
from tests.ur.fake_rtde import START_Q

from haptether.slave import UrKinematics, ur_model
from haptether.slave.ur.kinematics.pose import matrix_from_rotvec, pose_from_transform
from haptether.slave.ur.modes import JOINT_SPEED_SHARE, JointTracking, UnreachableError, ur_mode
from haptether.slave.ur.options import UrOptions, ur_options
from haptether.slave.ur.set_point import SetPoint
from haptether.slave.ur.state import UrState

PERIOD_S = 0.002
MODEL = ur_model("ur5e")


def options(**given: Any) -> UrOptions:  # noqa: ANN401
    return ur_options({"host": "fake"} | given)


def state_at(q: tuple[float, ...], off: tuple[float, ...] = (0.0, 0.0, 0.0)) -> UrState:
    """Return a state whose tool is `off` away from the model's."""
    pose = pose_from_transform(np.array(UrKinematics(MODEL).forward(q)))
    pose[:3] += off
    return UrState(1.0, q, q, (0.0,) * 6, tuple(pose), (0.0,) * 6, (0.0,) * 6, 7, 1, 1, 2, 1.0)


def test_the_tool_follows_and_keeps_its_orientation() -> None:
    off = (0.002, -0.001, 0.0005)
    state = state_at(START_Q, off)
    joints, point = JointTracking(UrKinematics(MODEL), options(), PERIOD_S), SetPoint(0.25, 5.0, PERIOD_S)
    joints.begin(state)
    # The first command is the current joint position.
    assert joints.q.tolist() == list(START_Q)
    home = (state.pose[0], state.pose[1], state.pose[2])
    point.begin(home)
    kinematics = UrKinematics(MODEL)
    rotation = matrix_from_rotvec(state.pose[3:])
    worst_m = worst_rad = 0.0
    for tick in range(1, 1500):
        t = tick * PERIOD_S
        away = 0.04 * (1 - math.cos(2.0 * t))
        rate = 0.08 * math.sin(2.0 * t)
        point.step((home[0] + away, home[1] - away, home[2] + away), (rate, -rate, rate), PERIOD_S)
        joints.follow(point.position, point.velocity, PERIOD_S)
        transform = np.array(kinematics.forward(joints.q))
        there = transform[:3, 3] + off
        worst_m = max(worst_m, float(np.abs(there - point.position).max()))
        worst_rad = max(worst_rad, float(np.abs(transform[:3, :3] @ rotation.T - np.eye(3)).max()))
    # With feed-forward the error is the acceleration within the closing time of 4 periods, a T^2 = 0.32 * 64e-6 m,
    # twice.
    assert worst_m < 4e-5
    # Curvature of the chain within a period, (v T)^2 over a lever of 0.1 m, four periods of it.
    assert worst_rad < 1e-4


def test_near_a_singularity_the_tool_stays_behind_and_no_joint_runs_away() -> None:
    # The elbow is almost straight: no motion outwards remains.
    q = (0.0, -1.0, 0.15, -0.5, 1.2, 0.0)
    state = state_at(q)
    joints, point = JointTracking(UrKinematics(MODEL), options(), PERIOD_S), SetPoint(0.25, 5.0, PERIOD_S)
    joints.begin(state)
    home = (state.pose[0], state.pose[1], state.pose[2])
    point.begin(home)
    outward = np.array(home) / np.linalg.norm(home)
    max_speed = JOINT_SPEED_SHARE * np.array(MODEL.max_speed)
    fastest = np.zeros(6)
    message = ""
    for tick in range(1, 2000):
        x, y, z = (np.array(home) + outward * 0.2 * tick * PERIOD_S).tolist()
        point.step((x, y, z), tuple((0.2 * outward).tolist()), PERIOD_S)
        try:
            joints.follow(point.position, point.velocity, PERIOD_S)
        except UnreachableError as error:
            message = str(error)
            break
        fastest = np.maximum(fastest, np.abs(joints.qd))
    assert "the tool cannot follow" in message
    assert (fastest <= max_speed * (1 + 1e-9)).all()


class Said:
    """A control interface that records its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        def call(*arguments: Any) -> bool:  # noqa: ANN401
            self.calls.append((name, *arguments))
            return True

        return call


@pytest.mark.parametrize(
    ("mode", "call"),
    [("servoj", "servoJ"), ("servol", "servoL"), ("speedl", "speedL"), ("direct-torque", "directTorque")],
)
def test_each_mode_begins_at_rest_where_the_arm_is(mode: str, call: str) -> None:
    state = state_at(START_Q)
    motion = ur_mode(options(mode=mode, gain=700, lookahead_time=0.04), PERIOD_S, (0.0,) * 6)
    point = SetPoint(0.25, 5.0, PERIOD_S)
    home = (state.pose[0], state.pose[1], state.pose[2])
    point.begin(home)
    motion.begin(state)
    point.step(home, (0.0, 0.0, 0.0), PERIOD_S)
    said = Said()
    assert motion.order(point.position, point.velocity, state, PERIOD_S)(said)
    name, numbers, *rest = said.calls[0]
    assert name == motion.name == call
    nowhere = {"servoj": START_Q, "servol": state.pose}.get(mode, (0.0,) * 6)
    assert numbers == pytest.approx(nowhere, abs=1e-9)
    if mode in {"servoj", "servol"}:
        assert rest == [0.0, 0.0, PERIOD_S, 0.04, 700.0]


def test_torques_are_bounded() -> None:
    state = state_at(START_Q)
    motion = ur_mode(options(mode="direct-torque", torque_share=0.1), PERIOD_S, (0.0,) * 6)
    point = SetPoint(3.0, 20.0, PERIOD_S)
    point.begin((state.pose[0], state.pose[1], state.pose[2]))
    motion.begin(state)
    said = Said()
    for _ in range(40):
        point.step((state.pose[0], state.pose[1], state.pose[2] + 0.1), (0.0, 0.0, 0.0), PERIOD_S)
        motion.order(point.position, point.velocity, state, PERIOD_S)(said)
    torques = np.array([call[1] for call in said.calls])
    assert (np.abs(torques) <= 0.1 * np.array(MODEL.max_torque) + 1e-12).all()
    assert np.abs(torques).max() > 1.0
