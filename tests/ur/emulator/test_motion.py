"""Motion of the emulated arm: against matrix exponentials, closed forms and reported figures of real arms."""

import math

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from haptether.slave.ur.kinematics.pose import matrix_from_rotvec
from haptether.slave.ur_emulator.robot.force_mode import ForceMode
from haptether.slave.ur_emulator.robot.motions import (
    Motion,
    Move,
    PosePath,
    Servo,
    SpeedJoints,
    StopJoints,
    Target,
    Trapezoid,
    transition,
)
from haptether.slave.ur_emulator.robot.robot import JointLoop

STEP_S = 0.002
FAST = (1e9,)
SIX: tuple[float, ...] = (0.0,) * 6

positive = st.floats(1e-3, 1e3)


@given(st.floats(1.0, 1e4), st.floats(0.0, 1e3), st.floats(1e-4, 0.05))
def test_transitions_are_matrix_exponentials(stiffness: float, damping: float, step_s: float) -> None:
    system = np.array(((0.0, 1.0), (-stiffness, -damping)))
    expected = scipy.linalg.expm(system * step_s).ravel()
    # Entries differ in size by up to the stiffness; the tolerance is the rounding of the largest.
    got = transition(stiffness, damping, step_s)
    assert np.abs(got - expected).max() < 1e-11 * np.abs(system).max()


def servo(goal: float, lookahead_s: float, gain: float, steps: int, speed: float = 0.0) -> np.ndarray:
    at = Target((0.0,), (0.0,))
    path = []
    for step in range(steps):
        at = Servo((goal + speed * (step + 1) * STEP_S,), lookahead_s, gain, FAST).step(at, STEP_S, 1.0)
        path.append(at.q[0])
    return np.array(path)


@pytest.mark.parametrize(
    ("gain", "lookahead_s", "rise_s", "overshoot"),
    [(300.0, 0.1, 0.188, None), (1200.0, 0.03, 0.062, 0.15), (2000.0, 0.03, 0.056, None)],
)
def test_steps_of_servoj(gain: float, lookahead_s: float, rise_s: float, overshoot: float | None) -> None:
    path = servo(0.1, lookahead_s, gain, 500) / 0.1
    system = np.array(((0.0, 1.0), (-gain, -gain * lookahead_s)))
    exact = [1.0 - (scipy.linalg.expm(system * STEP_S * (step + 1)) @ (1.0, 0.0))[0] for step in range(0, 500, 25)]
    # The tolerance is the rounding of 500 steps whose transition has entries of up to the gain.
    assert path[::25] == pytest.approx(exact, abs=1e-10)
    # The table of settings has times in whole control cycles.
    assert (np.argmax(path >= 0.9) + 1) * STEP_S == pytest.approx(rise_s, abs=1.01 * STEP_S)
    if overshoot is not None:
        assert path.max() - 1.0 == pytest.approx(overshoot, abs=0.005)


@given(st.sampled_from([(300.0, 0.1), (100.0, 0.2), (2000.0, 0.03)]), st.floats(-1.0, 1.0))
def test_servoj_follows_a_ramp_by_its_lookahead(setting: tuple[float, float], speed: float) -> None:
    gain, lookahead_s = setting
    steps = 800
    lag = speed * steps * STEP_S - servo(0.0, lookahead_s, gain, steps, speed)[-1]
    # The set point of a step is held at its final value: half a step ahead in the mean.
    assert lag == pytest.approx(speed * (lookahead_s - 0.5 * STEP_S), abs=1e-5)


def test_servoj_keeps_to_the_speed_of_a_joint() -> None:
    at, servoj = Target(SIX), Servo((1.0,) * 6, 0.03, 2000.0, (0.5,) * 6)
    for _ in range(200):
        before, at = at, servoj.step(at, STEP_S, 1.0)
        assert max(map(abs, at.qd)) <= 0.5
        assert (at.q[0] - before.q[0]) / STEP_S <= 0.5 + 1e-12


def loop() -> JointLoop:
    return JointLoop((3.0,) * 6, (150.0,) * 6, 2 * math.pi * 30.0)


def test_a_joint_gives_way_to_a_torque_and_comes_back() -> None:
    joints = loop()
    torque = (40.0, -40.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(200):
        joints.step(SIX, torque, STEP_S)
    rest = 40.0 / (3.0 * (2 * math.pi * 30.0) ** 2)
    assert joints.deflection == pytest.approx((rest, -rest, 0.0, 0.0, 0.0, 0.0), abs=1e-12)
    assert not joints.saturated
    for _ in range(200):
        joints.step(SIX, SIX, STEP_S)
    assert max(map(abs, joints.deflection)) < 1e-12


def test_a_motor_that_is_asked_for_too_much_falls_behind() -> None:
    joints = loop()
    # 100 rad/s² are commanded with 150 N m / 3 kg m²: after t the joint is 25 t² behind.
    for _ in range(10):
        joints.step((100.0, *SIX[1:]), SIX, STEP_S)
    assert joints.saturated
    assert joints.deflection[0] == pytest.approx(-25.0 * 0.02**2, rel=1e-9)


def test_a_torque_beyond_the_motor_pushes_the_joint_away() -> None:
    joints = loop()
    for _ in range(500):
        joints.step(SIX, (180.0, *SIX[1:]), STEP_S)
    # The excess of 30 N m beyond the motor accelerates 3 kg m²; the first step falls short of it.
    assert joints.deflection[0] == pytest.approx(0.5 * 10.0 * 1.0**2, rel=0.05)


@given(positive, positive, positive, st.floats(0.0, 1.0))
def test_trapezoids_begin_and_end_at_rest(length: float, speed: float, acceleration: float, share: float) -> None:
    profile = Trapezoid(length, speed, acceleration)
    end = profile.duration_s
    assert profile.at(0.0) == 0.0
    assert profile.at(end) == length
    assert profile.top_speed <= speed
    # The profile is symmetric, and never exceeds the top speed or the acceleration.
    t = share * end
    assert profile.at(t) + profile.at(end - t) == pytest.approx(length, rel=1e-9)
    h = 1e-4 * end
    v = (profile.at(t + h) - profile.at(t)) / h
    assert -1e-9 * speed <= v <= profile.top_speed * (1 + 1e-6)
    a = (profile.at(t + h) - 2 * profile.at(t) + profile.at(t - h)) / h**2
    assert abs(a) <= acceleration * (1 + 1e-4) + 1e-9 * length / h**2


def run(motion: Motion, target: Target, share: float = 1.0) -> tuple[list[Target], Target]:
    path = []
    for _ in range(20_000):
        target = motion.step(target, STEP_S, share)
        path.append(target)
        if motion.done:
            return path, target
    raise AssertionError


def test_movej_leads_every_joint_there_at_the_same_time() -> None:
    goal = (0.5, -0.25, 0.1, 0.0, 0.0, 0.0)
    path, end = run(Move(goal, 1.0, 2.0), Target(SIX))
    assert end == Target(goal)
    # 0.5 rad at 1 rad/s and 2 rad/s²: 0.5 s up, 0 s along, 0.5 s down.
    assert len(path) * STEP_S == pytest.approx(1.0, abs=STEP_S)
    for target in path:
        assert target.q[1] == pytest.approx(-0.5 * target.q[0], abs=1e-12)
        assert abs(target.qd[0]) <= 1.0 + 1e-9


def test_movej_goes_slower_with_the_slider() -> None:
    path, _ = run(Move((0.5, *SIX[1:]), 1.0, 2.0), Target(SIX), share=0.25)
    assert len(path) * STEP_S == pytest.approx(4.0, abs=STEP_S)
    assert max(abs(target.qd[0]) for target in path) == pytest.approx(0.25, rel=0.01)


def test_movej_brakes_before_it_begins() -> None:
    path, end = run(Move(SIX, 1.0, 2.0), Target(SIX, (0.5,) * 6))
    assert end == Target(SIX)
    # 0.5 rad/s at 2 rad/s²: 1/16 rad beyond.
    assert max(target.q[0] for target in path) == pytest.approx(0.0625, rel=0.01)


def test_stopj_brakes_in_step() -> None:
    path, end = run(StopJoints(2.0), Target(SIX, (1.0, -0.5, 0.0, 0.0, 0.0, 0.0)))
    assert len(path) * STEP_S == pytest.approx(0.5, abs=STEP_S)
    assert end.q[:2] == pytest.approx((0.25, -0.125), abs=1e-3)
    assert end.at_rest


def test_speedj_ramps_and_keeps_its_speed() -> None:
    motion = SpeedJoints((0.2, -0.1, 0.0, 0.0, 0.0, 0.0), 0.5)
    path, end = run(motion, Target(SIX))
    assert len(path) * STEP_S == pytest.approx(0.4, abs=STEP_S)
    assert end.q[0] == pytest.approx(0.5 * 0.2 * 0.4, rel=0.01)
    later = motion.step(end, STEP_S, 1.0)
    assert later.q[0] - end.q[0] == pytest.approx(0.2 * STEP_S)
    assert later.qd == (0.2, -0.1, 0.0, 0.0, 0.0, 0.0)


angle = st.tuples(*3 * [st.floats(-1.7, 1.7)])


@given(angle, angle, st.floats(0.0, 1.0))
def test_paths_of_poses_are_straight_and_turn_about_one_axis(
    first: tuple[float, ...], last: tuple[float, ...], share: float
) -> None:
    path = PosePath((0.1, 0.2, 0.3, *first), (0.4, 0.0, 0.3, *last))
    pose = path.at(share)
    assert pose[:3] == pytest.approx((0.1 + 0.3 * share, 0.2 - 0.2 * share, 0.3), abs=1e-12)
    a, b, c = (matrix_from_rotvec(r) for r in (first, pose[3:], last))

    def between(p: np.ndarray, q: np.ndarray) -> float:
        return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(p.T @ q)) - 1.0))))

    whole = between(a, c)
    # acos loses half of its digits near 1.
    assert between(a, b) == pytest.approx(share * whole, abs=1e-7)
    assert between(b, c) == pytest.approx((1.0 - share) * whole, abs=1e-7)
    assert path.length == pytest.approx(max(math.hypot(0.3, 0.2), whole), abs=1e-7)


def test_force_mode_presses_a_wall_with_the_force_that_was_asked_for() -> None:
    mode = ForceMode(gain_scaling=0.5, damping=0.025)
    mode.begin(SIX, (False, False, True, False, False, False), (0.0, 0.0, -10.0, 0.0, 0.0, 0.0), 2, (0.1,) * 6)
    z, forces = 0.01, []
    for _ in range(5000):
        contact = max(0.0, -10_000.0 * z)
        velocity = mode.velocity(np.zeros(6), (0.0, 0.0, contact, 0.0, 0.0, 0.0), np.eye(4), np.zeros(6), STEP_S)
        assert velocity[:2] == pytest.approx((0.0, 0.0))
        z += velocity[2] * STEP_S
        forces.append(contact)
    assert forces[-1] == pytest.approx(10.0, rel=1e-6)
    assert max(forces) < 40.0


def test_force_mode_drifts_in_free_space_within_its_limit() -> None:
    for wrench, limit, speed in [(10.0, 1.0, 0.01), (10.0, 0.005, 0.005), (-100.0, 1.0, -0.1)]:
        mode = ForceMode(gain_scaling=0.5, damping=0.025)
        mode.begin(SIX, (True,) + (False,) * 5, (wrench, *SIX[1:]), 2, (limit,) * 6)
        for _ in range(2000):
            velocity = mode.velocity(np.full(6, 0.3), SIX, np.eye(4), np.zeros(6), STEP_S)
        # w / (M d) with M = 50 kg / 0.5 and d = 400 1/s * 0.025.
        assert velocity[0] == pytest.approx(speed, rel=1e-6)
        assert velocity[1:] == pytest.approx((0.3,) * 5)


def test_the_axes_of_force_mode_are_those_of_its_frame() -> None:
    mode = ForceMode(gain_scaling=0.5, damping=0.025)
    turned = (0.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2)
    mode.begin(turned, (True,) + (False,) * 5, (10.0, *SIX[1:]), 2, (1.0,) * 6)
    for _ in range(2000):
        velocity = mode.velocity(np.zeros(6), SIX, np.eye(4), np.zeros(6), STEP_S)
    assert velocity[:3] == pytest.approx((0.0, 0.01, 0.0), abs=1e-9)
    mode.begin((0.0, 0.0, 0.5, 0.0, 0.0, 0.0), (False, True) + (False,) * 4, (0.0, 10.0, *SIX[2:]), 1, (1.0,) * 6)
    for _ in range(2000):
        velocity = mode.velocity(np.zeros(6), SIX, np.eye(4), np.zeros(6), STEP_S)
    # Type 1: y points from the tool, here at the origin, to the frame.
    assert velocity[:3] == pytest.approx((0.0, 0.0, 0.01), abs=1e-9)
    mode.begin(SIX, (True,) + (False,) * 5, (10.0, *SIX[1:]), 3, (1.0,) * 6)
    moving = np.array((0.0, -0.2, 0.1, 0.0, 0.0, 0.0))
    for _ in range(2000):
        velocity = mode.velocity(np.zeros(6), SIX, np.eye(4), moving, STEP_S)
    # Type 3: x is the tool's velocity in the plane of x and y.
    assert velocity[:3] == pytest.approx((0.0, -0.01, 0.0), abs=1e-9)
