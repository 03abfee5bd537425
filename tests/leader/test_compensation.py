"""A compensated leader in virtual time: the effort of the hand that moves it, and no active push."""

import itertools
import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from haptether.dynamixel.arm import ServoSettings
from haptether.dynamixel.description import ArmDescription, ArmKinematics, load_arm
from haptether.dynamixel.emulator import ArmLoad, Bus, HeldBy, JointSettings, Servo, servos_of
from haptether.dynamixel.models import OperatingMode
from haptether.master.dynamixel import Compensation, LeaderOptions

Array = npt.NDArray[np.float64]
TICK_S = 0.002
SWING_RAD = 1.0
SWING_S = 6.0
MOVING_RAD_S = 0.05
"""Two units of Present Velocity, in rad/s: below it the direction of friction is unknown."""


def with_friction(name: str) -> ArmDescription:
    """Return a shipped arm with the emulator's friction, as nobody has measured the real one."""
    arm = load_arm(name)
    joints = []
    for joint in arm.joints:
        default = JointSettings.of(joint.servo_model)
        joints.append(
            msgspec.structs.replace(
                joint, coulomb_nm=default.coulomb, viscous_nm_s=default.viscous, friction_source="the emulator's"
            )
        )
    return msgspec.structs.replace(arm, joints=tuple(joints))


class Leader:
    """Emulated arm in mode 0, compensated each tick from the servos' measurements."""

    def __init__(self, arm: ArmDescription, options: LeaderOptions, mass_scale: float = 1.0) -> None:
        self.arm = arm
        self.servos = servos_of(arm, baud=4_000_000, firmware=52)[: len(arm.joints)]
        self.bus = Bus(self.servos, load=ArmLoad(arm, self.servos, mass_scale=mass_scale))
        settings = [
            ServoSettings(servo_id=joint.servo, model=joint.model, cap_a=joint.cap_a) for joint in arm.joints
        ]  # fmt: skip
        self.caps = [setting.current_cap_a for setting in settings]
        self.constants = [
            servo.joint.constant_nm_per_a * joint.motors for joint, servo in zip(arm.joints, self.servos, strict=True)
        ]
        self.kinematics = ArmKinematics(arm)
        most = [0.7 * cap * constant for cap, constant in zip(self.caps, self.constants, strict=True)]
        self.compensation = Compensation(options, arm, self.kinematics, most)
        self.now_s = 5.0
        self.bus.advance(self.now_s)
        for servo in self.servos:
            self.write(servo, "Operating Mode", OperatingMode.CURRENT)
            self.write(servo, "Goal Current", 0)
            self.write(servo, "Torque Enable", 1)

    def write(self, servo: Servo, name: str, value: int) -> None:
        item = servo.model.table[name]
        assert servo.write(item.address, item.encoded(value), self.now_s) == 0

    @property
    def q(self) -> list[float]:
        placed = zip(self.arm.joints, self.servos, strict=True)
        return [j.sign * (s.value("Present Position") - 2048) * math.tau / 4096 for j, s in placed]

    @property
    def w(self) -> list[float]:
        placed = zip(self.arm.joints, self.servos, strict=True)
        return [j.sign * s.value("Present Velocity") * 0.229 * math.tau / 60 for j, s in placed]

    def tick(self) -> None:
        self.now_s += TICK_S
        self.bus.advance(self.now_s)
        for index, torque in enumerate(self.compensation.torques(self.q, self.w)):
            servo, joint = self.servos[index], self.arm.joints[index]
            current_a = min(max(torque / self.constants[index], -self.caps[index]), self.caps[index])
            unit_a = servo.model.current_unit_a
            assert unit_a is not None
            self.write(servo, "Goal Current", int(joint.sign * current_a / unit_a))


class Effort(NamedTuple):
    """Root mean squares over all joints and times, in N m."""

    hand: float
    gravity: float
    moving: float
    """Effort of the hand at joints that move."""


def swing(leader: Leader) -> Effort:
    """Swing all joints slowly about the start with a stiff hand; return the effort of the hand and gravity."""
    start = leader.q
    for joint, servo, at in zip(leader.arm.joints, leader.servos, start, strict=True):
        servo.joint.hand = HeldBy(goal_rad=joint.sign * at, stiffness=200.0, damping=2.0)
    for _ in range(250):
        leader.tick()
    hand, gravity, speed = [], [], []
    for turned in (SWING_RAD, 0.0):
        for joint, servo, at in zip(leader.arm.joints, leader.servos, start, strict=True):
            held = servo.joint.hand
            assert held is not None
            servo.joint.hand = HeldBy(
                goal_rad=joint.sign * (at + turned),
                stiffness=200.0,
                damping=2.0,
                from_rad=held.goal_rad,
                begin_s=leader.now_s,
                duration_s=SWING_S,
            )
        for _ in range(round(SWING_S / TICK_S)):
            leader.tick()
            hand.append([servo.joint.hand_nm for servo in leader.servos])
            gravity.append(leader.kinematics.gravity(leader.q))
            speed.append([servo.joint.velocity_rad_s for servo in leader.servos])
    felt = np.array(hand)
    return Effort(*map(rms, (felt, np.array(gravity), felt[np.abs(np.array(speed)) > MOVING_RAD_S])))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def options(**given: float) -> LeaderOptions:
    return LeaderOptions(port="none", arm="none", **given)  # type: ignore[arg-type]


def without_friction(name: str) -> ArmDescription:
    arm = load_arm(name)
    joints = tuple(
        msgspec.structs.replace(joint, coulomb_nm=0.0, viscous_nm_s=0.0, friction_source="none") for joint in arm.joints
    )
    return msgspec.structs.replace(arm, joints=joints)


@pytest.mark.parametrize("name", ["factr", "gello-ur"])
def test_free_motion_needs_under_5_percent_of_gravity(name: str) -> None:
    """Check the effort: 1.0 %, from whole units of current and the acceleration of the arm."""
    light = swing(Leader(without_friction(name), options()))
    heavy = swing(Leader(without_friction(name), options(gravity_gain=0.0)))
    assert light.hand < 0.05 * light.gravity
    # Without compensation the hand carries the arm.
    assert heavy.hand == pytest.approx(heavy.gravity, rel=0.05)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_masses_wrong_by_5_percent_are_felt_as_5_percent(scale: float) -> None:
    effort = swing(Leader(without_friction("factr"), options(), mass_scale=scale))
    assert 0.03 * effort.gravity < effort.hand < 0.08 * effort.gravity


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["factr", "gello-ur"])
def test_free_motion_with_friction_needs_under_5_percent_of_gravity(name: str) -> None:
    """Check the effort: 3.2 % while joints move, of 28 and 26 %; starts and stops cost the static friction."""
    arm = with_friction(name)
    dry, eased = (swing(Leader(arm, options(friction_gain=gain, friction_speed=0.03))) for gain in (0.0, 0.9))
    assert dry.moving > 0.2 * dry.gravity
    assert eased.moving < 0.05 * eased.gravity
    # At starts and stops the compensation stays below friction, or it would push: 8.2 and 7.1 %.
    assert 0.05 * eased.gravity < eased.hand < 0.1 * eased.gravity


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("told", "low", "high"), [(0.8, 0.05, 0.1), (1.1, 0.0, 0.03)])
def test_friction_is_compensated_as_well_as_it_is_known(told: float, low: float, high: float) -> None:
    """Check the effort: 8.0 % remain at 0.8 of the friction, 1.2 % at 1.1, of which 0.99 are compensated."""
    arm = with_friction("factr")
    leader = Leader(arm, options())
    joints = tuple(
        msgspec.structs.replace(
            joint, coulomb_nm=told * (joint.coulomb_nm or 0.0), viscous_nm_s=told * (joint.viscous_nm_s or 0.0)
        )
        for joint in arm.joints
    )
    most = [0.7 * cap * constant for cap, constant in zip(leader.caps, leader.constants, strict=True)]
    leader.compensation = Compensation(
        options(friction_gain=0.9, friction_speed=0.03), msgspec.structs.replace(arm, joints=joints),
        leader.kinematics, most,
    )  # fmt: skip
    effort = swing(leader)
    assert low < effort.moving / effort.gravity < high


@pytest.mark.parametrize("scale", [0.95, 1.0, 1.05])
def test_an_arm_that_is_let_go_stays(scale: float) -> None:
    """Scale the weight: an error of 5 % is less than the remaining friction."""
    leader = Leader(with_friction("factr"), options(friction_gain=0.9), mass_scale=scale)
    before = leader.q
    for _ in range(1000):
        leader.tick()
    assert np.abs(np.array(leader.q) - before).max() < 0.05


def test_an_arm_that_is_thrown_comes_to_rest() -> None:
    """The largest compensation is less than friction, so that no joint keeps going."""
    leader = Leader(with_friction("factr"), options(friction_gain=0.9, friction_speed=0.01))
    leader.servos[0].joint.velocity_rad_s = leader.servos[4].joint.velocity_rad_s = 1.5
    for _ in range(2000):
        leader.tick()
    assert max(abs(servo.joint.velocity_rad_s) for servo in leader.servos) < 0.03


def test_gravity_does_no_work_on_a_way_around() -> None:
    arm = load_arm("factr")
    compensation = Compensation(
        options(limit_stiffness=0.0, limit_damping=0.0), arm, ArmKinematics(arm), [1e3] * len(arm.joints)
    )
    start = np.array([joint.start_rad for joint in arm.joints])
    work, still = 0.0, [0.0] * len(arm.joints)
    phases = np.linspace(0.0, math.tau, 2001)
    places = [start + 0.3 * np.array([math.sin(k * phase + 0.1 * k) for k in range(1, 8)]) for phase in phases]
    for one, other in itertools.pairwise(places):
        work += float(np.dot(compensation.torques(0.5 * (one + other), still), other - one))
    assert abs(work) < 1e-4


def test_limits_push_back_and_brake_only_on_the_way_in() -> None:
    arm = msgspec.structs.replace(load_arm("koch-v1-1"))
    compensation = Compensation(options(), arm, ArmKinematics(arm), [1e3] * 5)
    high, low = arm.joints[0].high_rad, arm.joints[0].low_rad
    middle = [joint.start_rad for joint in arm.joints]

    def first(angle: float, speed: float) -> float:
        return compensation.torques([angle, *middle[1:]], [speed, 0.0, 0.0, 0.0, 0.0])[0]

    assert first(high - 0.11, 0.0) == 0.0
    assert first(high, 0.0) == pytest.approx(-0.1 * 1.0356)
    assert first(low, 0.0) == pytest.approx(0.1 * 1.0356)
    assert first(high, 1.0) == pytest.approx(-0.1 * 1.0356 - 0.0432)
    # The way out of the spring is not braked: friction would hold the joint there.
    assert first(high, -1.0) == pytest.approx(-0.1 * 1.0356)
    assert first(low, -1.0) == pytest.approx(0.1 * 1.0356 + 0.0432)
    assert first(0.5 * (low + high), 3.0) == 0.0


def test_it_is_bounded() -> None:
    arm = with_friction("gello-ur")
    most = [0.05] * 6
    compensation = Compensation(options(friction_gain=0.9, damping=1.0), arm, ArmKinematics(arm), most)
    random = np.random.default_rng(3)
    for _ in range(200):
        q, w = random.uniform(-6.0, 6.0, 6), random.uniform(-20.0, 20.0, 6)
        assert max(map(abs, compensation.torques(q.tolist(), w.tolist()))) <= 0.05


def test_springs_that_would_meet_leave_no_step_between_them() -> None:
    """Use a margin of more than half of a joint's range."""
    arm = load_arm("factr")
    joint = msgspec.structs.replace(arm.joints[0], low_rad=-0.1, high_rad=0.3, near_rad=None)
    arm = msgspec.structs.replace(arm, joints=(joint, *arm.joints[1:]), gravity_m_s2=(0.0, 0.0, 0.0))
    options = LeaderOptions(port="", arm="", limit_margin=1.0, limit_stiffness=2.0)
    compensation = Compensation(options, arm, ArmKinematics(arm), [5.0] * len(arm.joints))
    rest = [joint.start_rad for joint in arm.joints[1:]]
    places = np.linspace(-0.15, 0.35, 501)
    torques = np.array([compensation.torques([q, *rest], [0.0] * 7)[0] for q in places])
    # -K (q - 0.1): the sum of both springs, which meet between the limits.
    assert torques == pytest.approx(-2.0 * (places - 0.1), abs=1e-9)
