"""A follower that takes forces: its driver in current mode, on emulated servos in virtual time."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.dynamixel.emulated import emulated_bus
from tests.dynamixel.test_follower import PATIENCE_S, led, without_torque
from tests.dynamixel.virtual import MODEL, TICK_S, Follower, World, joint_servo

from haptether.dynamixel.control_table import RAD_PER_TICK, RAD_S_PER_UNIT
from haptether.dynamixel.description import load_arm
from haptether.dynamixel.emulator import ArmLoad, Servo, servos_of, set_stops
from haptether.dynamixel.models import SERVO_MODELS
from haptether.slave import GripperCommand, SlaveSample
from haptether.slave.dynamixel.driver import DynamixelSlave
from haptether.slave.dynamixel.gripper.driver import DynamixelGripper
from haptether.slave.dynamixel.observer import ReactionForceObserver

UNIT_NM = (SERVO_MODELS[MODEL].current_unit_a or 0.0) * SERVO_MODELS[MODEL].nominal_nm_per_a
"""Torque of one unit of current. A command is cut down to whole units. A measurement is rounded to the nearest unit."""
INERTIA = 0.02
BANDWIDTH = 25.0
STIFFNESS, DAMPING = INERTIA * BANDWIDTH**2, 2.0 * INERTIA * BANDWIDTH
LEVER_M = 0.2
WALLS = {"2000 N/m": 2000.0 * LEVER_M**2, "100 N/m": 100.0 * LEVER_M**2}
"""Stiffness of a wall at the lever in N m/rad."""
ARM = f"""
name = "lever"
title = "One joint that lifts a weight"
source = "made up"
[[joints]]
name = "only"
servo = 1
model = "{MODEL}"
sign = 1
xyz_m = [0.0, 0.0, 0.0]
axis = [0.0, -1.0, 0.0]
low_rad = -2.0
high_rad = 2.0
coulomb_nm = 0.0
viscous_nm_s = 0.0
inertia_kg_m2 = 0.0082
friction_source = "made up"
link = {{ mass_kg = 0.5, com_m = [0.15, 0.0, 0.0], source = "made up" }}
[tool]
xyz_m = [{LEVER_M}, 0.0, 0.0]
"""
WEIGHT_NM = 0.5 * 9.81 * 0.15


def one_joint(world: World, folder: Path, **given: Any) -> Follower:  # noqa: ANN401  # of joint and driver
    """Return a follower of one joint. Both the joint and the options have the inertia `INERTIA`."""
    loads: dict[str, float] = {key: given.pop(key) for key in ("coulomb", "viscous", "position_rad") if key in given}
    options: dict[str, Any] = {"inertia": [INERTIA], **given}
    options |= {key: [value] for key, value in loads.items() if key != "position_rad"}
    return Follower(world, folder, [joint_servo(INERTIA, **loads)], **options)


def first(sample: SlaveSample) -> tuple[float, float, float]:
    position, velocity, force = np.ravel(sample.position), np.ravel(sample.velocity), np.ravel(sample.force)
    return float(position[0]), float(velocity[0]), float(force[0])


# ------------------------------------------------------------------------------------------------------- observer


@pytest.mark.parametrize("period_s", [0.0005, 0.002, 0.01])
@pytest.mark.parametrize("applied", [0.3, -0.7])
def test_a_step_of_torque_is_observed_with_a_lag_of_first_order(period_s: float, applied: float) -> None:
    g, weight, viscous = 50.0, 0.4, 0.0
    observer = ReactionForceObserver(g, [0.0], [viscous])
    inertia, motor, speed = np.array([INERTIA]), 0.1, 0.2
    for index in range(100):
        found = observer.of(np.array([motor]), np.array([speed]), inertia, np.array([weight]), period_s)
        # f (1 - exp(-g t)), exact because the torques are constant between two samples.
        assert found[0] == pytest.approx(applied * -math.expm1(-g * index * period_s), abs=1e-12)
        speed += (motor - weight + applied) / INERTIA * period_s


def test_acceleration_by_the_motor_is_no_force_of_the_environment() -> None:
    observer = ReactionForceObserver(50.0, [0.0], [0.0])
    speed = 0.0
    for index in range(500):
        motor = 0.5 * math.sin(0.1 * index)
        found = observer.of(np.array([motor]), np.array([speed]), np.array([INERTIA]), np.zeros(1), 0.002)
        assert abs(found[0]) < 1e-12
        # The motor's torque of the next sample acts until then.
        speed += 0.5 * math.sin(0.1 * (index + 1)) / INERTIA * 0.002


@pytest.mark.parametrize(
    ("speed", "motor", "expected"),
    [
        # c + b v moves the joint at a constant speed.
        (1.0, 0.08 + 0.02, 0.0),
        (-1.0, -0.08 - 0.02, 0.0),
        (1.0, 0.4, 0.08 + 0.02 - 0.4),
        # At rest the torque nearest to 0 of those that friction allows.
        (0.0, 0.05, 0.0),
        (0.0, 0.3, -0.22),
        (0.0, -0.3, 0.22),
    ],
)
def test_friction_is_no_force_of_the_environment(speed: float, motor: float, expected: float) -> None:
    observer = ReactionForceObserver(50.0, [0.08], [0.02])
    for _ in range(500):
        found = observer.of(np.array([motor]), np.array([speed]), np.array([INERTIA]), np.zeros(1), 0.002)
    # 1 s is 50 time constants.
    assert found[0] == pytest.approx(expected, abs=1e-9)


# ----------------------------------------------------------------------------------------------- motion and contact


@pytest.mark.parametrize("torque", [0.2, -0.2])
def test_a_torque_accelerates_the_joint_by_its_inertia(world: World, tmp_path: Path, torque: float) -> None:
    follower = one_joint(world, tmp_path, max_speed=10.0, limit_margin=0.01, joint_bandwidth=60.0)
    assert follower.driver.takes_force
    samples = follower.exert(0.2, torque)
    # The first command acts after the first sample.
    elapsed_s = (len(samples) - 1) * TICK_S
    speed = abs(follower.joint.velocity_rad_s)
    assert (abs(torque) - UNIT_NM) / INERTIA * elapsed_s <= speed <= abs(torque) / INERTIA * elapsed_s
    # A velocity is within half a unit, and a high-pass of the momentum passes twice that.
    tolerance = 50.0 * INERTIA * RAD_S_PER_UNIT + 0.5 * UNIT_NM
    assert max(abs(first(sample)[2]) for sample in samples) < tolerance < 0.2 * abs(torque)


@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("coulomb", [0.0, 0.04])
def test_a_wall_bears_the_commanded_torque(world: World, tmp_path: Path, wall: str, coulomb: float) -> None:
    follower = one_joint(world, tmp_path, coulomb=coulomb)
    set_stops(follower.joint, ["-3", "0.1", str(WALLS[wall])])
    follower.exert(3.0, 0.5)
    _, velocity, force = first(follower.sample)
    assert velocity == 0.0
    pressed = -follower.joint.stop_nm
    # The command is truncated to a unit, and friction holds up to c of it.
    assert 0.5 - UNIT_NM - coulomb - 1e-6 <= pressed <= 0.5 + coulomb + 1e-6
    # The measured current is rounded; friction may hide 2 c of the force, and adds nothing.
    assert pressed - 2.0 * coulomb - 0.5 * UNIT_NM - 1e-6 <= -force <= pressed + 0.5 * UNIT_NM + 1e-6
    assert follower.joint.position_rad == pytest.approx(0.1 + pressed / WALLS[wall], abs=1e-6)


def test_a_push_is_felt_and_moves_what_no_torque_holds(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path)
    follower.joint.pushed_nm = -0.1
    samples = follower.exert(0.15, 0.0)
    # 7.5 time constants of the observer.
    tolerance = 0.1 * math.exp(-7.5) + 50.0 * INERTIA * RAD_S_PER_UNIT + 0.5 * UNIT_NM
    assert first(samples[-1])[2] == pytest.approx(-0.1, abs=tolerance)
    assert follower.joint.velocity_rad_s == pytest.approx(-0.1 / INERTIA * len(samples) * TICK_S, rel=0.02)


def with_weight(world: World, folder: Path, **options: Any) -> Follower:  # noqa: ANN401  # of the driver
    path = folder / "lever-arm.toml"
    path.write_text(ARM)
    arm = load_arm(path)
    servos = servos_of(arm, baud=4_000_000, firmware=52, start=[0.0])
    return Follower(
        world, folder, servos, ArmLoad(arm, servos), **{"description": str(path), **options}
    )  # fmt: skip


def test_a_described_weight_is_carried_and_is_no_force(world: World, tmp_path: Path) -> None:
    follower = with_weight(world, tmp_path)
    before = follower.joint.position_rad
    follower.exert(1.0, 0.0)
    # A unit of current at most is missing: 1/2 (UNIT / M) t^2 of a joint that nothing else holds.
    inertia = 0.0082 + 0.5 * 0.15**2
    assert -0.5 * UNIT_NM / inertia <= follower.joint.position_rad - before <= 1e-6
    follower.driver.stop()
    follower.hold(0.5)
    assert first(follower.sample)[2] == pytest.approx(0.0, abs=1.5 * UNIT_NM)
    assert follower.joint.torque_nm == pytest.approx(WEIGHT_NM, rel=0.02)
    follower.joint.pushed_nm = 0.1
    follower.hold(0.5)
    assert first(follower.sample)[2] == pytest.approx(0.1, abs=1.5 * UNIT_NM)


def test_an_unknown_weight_pulls_the_arm_down(world: World, tmp_path: Path) -> None:
    follower = with_weight(world, tmp_path, gravity_gain=0.0)
    before = follower.joint.position_rad
    follower.exert(0.2, 0.0)
    assert follower.joint.position_rad < before - 0.1


# --------------------------------------------------------------------------------------------------------- bounds


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_is_never_much_faster_than_its_bound(world: World, tmp_path: Path, sign: float) -> None:
    follower = one_joint(world, tmp_path, max_speed=1.0, position_rad=-2.0 * sign)
    torque = 0.5
    samples = follower.exert(2.0, sign * torque)
    speeds = [sign * first(sample)[1] for sample in samples]
    # s F = D (w - 1) with s = (1.1 - w) / 0.1.
    expected = (11.0 * torque + DAMPING) / (10.0 * torque + DAMPING)
    assert 1.0 < expected < 1.1
    assert speeds[-1] == pytest.approx(expected, abs=RAD_S_PER_UNIT)
    assert max(speeds) < 1.1 + RAD_S_PER_UNIT


def test_a_fast_joint_may_be_braked_by_the_whole_torque(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path, max_speed=1.0)
    follower.joint.velocity_rad_s = 1.3
    follower.read()
    speed = first(follower.sample)[1]
    follower.driver.write_force((-0.4,))
    assert follower.exerted() == pytest.approx(-0.4 - DAMPING * (speed - 1.0), abs=UNIT_NM)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_drives_no_joint_beyond_its_limit(world: World, tmp_path: Path, sign: float) -> None:
    follower = one_joint(world, tmp_path, low_rad=-0.5, high_rad=0.5)
    samples = follower.exert(3.0, sign)
    angles = [sign * first(sample)[0] for sample in samples]
    # The driver knows the angle to half a tick, and so does this test.
    assert max(angles) <= 0.5 + RAD_PER_TICK + 1e-4
    # It does reach it, and the torque there is 0.
    assert angles[-1] == pytest.approx(0.5, abs=2.0 * RAD_PER_TICK)
    assert abs(follower.joint.torque_nm) < 0.05
    follower.exert(1.0, -sign)
    assert sign * first(follower.sample)[0] < 0.3


def test_a_pushed_joint_is_pulled_back_from_beyond_its_limit(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path, low_rad=-0.5, high_rad=0.5)
    follower.joint.pushed_nm = 0.5
    follower.exert(2.0, 0.0)
    assert first(follower.sample)[0] == pytest.approx(0.5 + 0.5 / STIFFNESS, abs=2.0 * RAD_PER_TICK)


def test_a_torque_is_at_most_that_of_the_options(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path, max_torque=[0.3])
    set_stops(follower.joint, ["-3", "0.02", "80"])
    follower.exert(2.0, 7.0)
    assert follower.joint.torque_nm == pytest.approx(0.3, abs=UNIT_NM)
    assert follower.joint.torque_nm <= 0.3


def test_a_wrong_velocity_does_not_brake_with_all_of_the_current(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path)
    follower.exert(0.1, 0.0)
    control = follower.driver._control
    assert control is not None
    # 5000 units of Present Velocity are 120 rad/s, and the servo makes 4.8 rad/s without load.
    felt = control.take(np.zeros(1), np.array([5000.0 * RAD_S_PER_UNIT]), np.zeros(1), TICK_S)
    assert np.abs(felt).max() < 2.0 * UNIT_NM
    assert np.abs(control.exerting(np.zeros(1))).max() < 2.0 * UNIT_NM
    # Too fast for `max_speed`, and possible: the damper brakes, with at most the largest torque.
    control.take(np.zeros(1), np.array([8.0]), np.zeros(1), TICK_S)
    braked = np.abs(control.exerting(np.zeros(1)) / control._amperes)
    assert control.max_torque == follower.driver.max_force
    assert 0.9 * min(2.0 * INERTIA * 25.0 * 7.0, control.max_torque) < braked[0] <= control.max_torque + 1e-12


def test_while_answers_are_missing_the_joints_only_carry_themselves(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower = one_joint(world, tmp_path)
    follower.exert(0.02, 0.1)
    servos, answers, sent = follower.driver.servos, iter([False, False, True]), []
    read = servos.read
    monkeypatch.setattr(servos, "read", lambda: next(answers) and read())
    monkeypatch.setattr(servos, "write_currents", lambda currents: sent.append(currents.copy()))
    follower.driver.read()
    # The joint is slower than its bound, and has no weight and no friction.
    assert [np.abs(one).max() for one in sent[:2]] == [0.0, 0.0]


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_torque_that_is_no_number_is_not_obeyed(world: World, tmp_path: Path, wrong: float) -> None:
    follower = one_joint(world, tmp_path)
    follower.exert(0.1, 0.1)
    follower.read()
    follower.driver.write_force((wrong,))
    fault = "a torque was commanded that is no number: see the other side, then acknowledge"
    assert follower.read().fault == fault
    # The arm holds its joint, whatever is commanded.
    follower.exert(1.0, 0.3)
    assert follower.sample.fault == fault
    assert first(follower.sample)[1] == 0.0
    follower.driver.acknowledge()
    follower.exert(0.2, 0.1)
    assert follower.sample.fault is None
    assert first(follower.sample)[1] > 0.3


def test_a_wrong_number_of_torques_and_a_wrong_mode_are_refused(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path)
    with pytest.raises(ValueError, match="2 torques: must be 1, one of each joint"):
        follower.driver.write_force((0.1, 0.2))
    positions = one_joint(world, tmp_path, mode="position", port="other")
    assert not positions.driver.takes_force
    with pytest.raises(ValueError, match="mode = position: must be current"):
        positions.driver.write_force((0.1,))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"inertia": []}, "inertia = ().*: must be given in mode = current, or a description"),
        ({"inertia": [0.1, 0.1]}, "inertia = .*must have 1 numbers"),
        ({"inertia": [0.0]}, "inertia = .*above 0"),
        ({"max_torque": [-1.0]}, "max_torque = .*0 to 20 N m"),
        ({"description": "nowhere"}, "description = 'nowhere'"),
        ({"description": "koch-v1-1", "inertia": [0.1] * 5}, "must have 1 numbers"),
        ({"description": "LEVER", "servo_id": 2}, "must have the servos of"),
        ({"observer_bandwidth": 0.0}, "observer_bandwidth = 0.0: must be 1 to 500 rad/s"),
    ],
)
def test_options_that_cannot_be(tmp_path: Path, options: dict[str, Any], said: str) -> None:
    lever, arm = tmp_path / "lever.toml", tmp_path / "arm.toml"
    lever.write_text(ARM)
    given = {"inertia": [0.1], **options}
    arm.write_text(f'[[servo]]\nid = {given.pop("servo_id", 1)}\nmodel = "{MODEL}"\n')
    if given.get("description") == "LEVER":
        given["description"] = str(lever)
    with pytest.raises(ValueError, match=said):
        DynamixelSlave(port="none", arm=str(arm), mode="current", **given)


# ---------------------------------------------------------------------------------------------- hold, switch, watch


def test_stop_comes_to_rest_softly_and_holds(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path)
    follower.exert(0.1, 0.16)
    position, speed, _ = first(follower.read())
    assert speed > 0.5
    follower.driver.stop()
    # -M w^2 (-v / 2 w) - 2 M w v.
    assert follower.exerted() == pytest.approx(-1.5 * INERTIA * BANDWIDTH * speed, abs=UNIT_NM)
    samples = [follower.read() for _ in range(500)]
    angles = [first(sample)[0] for sample in samples]
    rest = position + 0.5 * speed / BANDWIDTH
    assert angles[-1] == pytest.approx(rest, abs=2.0 * RAD_PER_TICK)
    # A damped joint overshoots by exp(-2) / 2 of v / w, and a sampled one by little more.
    assert max(angles) - rest < 0.1 * speed / BANDWIDTH
    follower.joint.pushed_nm = 0.25
    follower.hold(1.0)
    assert first(follower.sample)[0] == pytest.approx(rest + 0.25 / STIFFNESS, abs=3.0 * RAD_PER_TICK)
    follower.joint.pushed_nm = 0.0
    follower.hold(1.0)
    assert first(follower.sample)[0] == pytest.approx(rest, abs=3.0 * RAD_PER_TICK)


def test_a_hold_yields_to_a_great_push_and_does_not_spring_back(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path, max_lag=0.05)
    follower.joint.pushed_nm = 1.5 * 0.05 * STIFFNESS
    follower.hold(1.0)
    # The damper alone takes a third of the push.
    assert first(follower.sample)[1] == pytest.approx(0.5 * 0.05 * STIFFNESS / DAMPING, rel=0.15)
    follower.joint.pushed_nm = 0.0
    pushed = first(follower.sample)[0]
    follower.hold(1.0)
    assert abs(first(follower.sample)[0] - pushed) < 0.05


def test_a_host_that_only_reads_lets_nothing_go_on_pushing(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path)
    follower.exert(0.1, 0.16)
    for _ in range(500):
        follower.read()
    assert first(follower.sample)[1] == 0.0
    assert abs(follower.joint.torque_nm) <= STIFFNESS * RAD_PER_TICK + UNIT_NM


def test_each_switch_exerts_what_the_new_command_asks(world: World, tmp_path: Path) -> None:
    """Switch between commands at a soft stop, where a torque has moved the joint to another place."""
    follower = one_joint(world, tmp_path)
    set_stops(follower.joint, ["-0.01", "0.01", "40"])
    follower.hold(0.5)
    tolerance = STIFFNESS * RAD_PER_TICK + UNIT_NM

    def at() -> float:
        return first(follower.read())[0]

    at()
    follower.driver.write_force((0.4,))
    assert follower.exerted() == pytest.approx(0.4, abs=UNIT_NM)
    follower.exert(1.0, 0.4)
    at()
    follower.driver.stop()
    assert follower.exerted() == pytest.approx(0.0, abs=tolerance)
    follower.hold(1.0)
    at()
    follower.driver.write_force((0.4,))
    assert follower.exerted() == pytest.approx(0.4, abs=UNIT_NM)
    follower.exert(1.0, 0.4)
    follower.driver.write((at(),), (0.0,))
    assert follower.exerted() == pytest.approx(0.0, abs=tolerance)
    for _ in range(500):
        follower.driver.write((at(),), (0.0,))
    follower.driver.stop()
    assert follower.exerted() == pytest.approx(0.0, abs=tolerance)
    at()
    follower.driver.write_force((-0.4,))
    assert follower.exerted() == pytest.approx(-0.4, abs=UNIT_NM)
    assert follower.read().fault is None


def test_positions_are_followed_in_current_mode_too(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path, max_speed=1.0, start="ramp")
    follower.hold(0.1)
    begin_s, reached_s = world.clock.now_s, None
    while first(follower.read())[0] < 0.5:
        follower.driver.write((0.6,), (0.0,))
        assert world.clock.now_s < begin_s + 3.0
    reached_s = world.clock.now_s - begin_s
    # 0.5 rad at 1 rad/s, with the lag 2 / w of a critically damped joint.
    assert reached_s == pytest.approx(0.5 + 2.0 / BANDWIDTH, abs=0.03)
    for _ in range(500):
        follower.read()
        follower.driver.write((0.6,), (0.0,))
    assert first(follower.sample)[0] == pytest.approx(0.6, abs=2.0 * RAD_PER_TICK)
    follower.exert(0.1, -0.1)
    follower.read()
    follower.driver.write((math.nan,), (0.0,))
    assert "an angle was commanded that is no number" in str(follower.read().fault)


def test_a_gripper_on_the_bus_follows_while_the_arm_takes_forces(world: World, tmp_path: Path) -> None:
    jaws = Servo(SERVO_MODELS["XL330-M288"], 7, baud=4_000_000)
    gripper = DynamixelGripper(id=7, model="XL330-M288", open_rad=0.0, closed_rad=1.0, lever_m=0.05)
    follower = Follower(world, tmp_path, [joint_servo(INERTIA), jaws], gripper=gripper, inertia=[INERTIA])
    set_stops(follower.joint, ["-3", "0.02", "80"])
    for _ in range(1000):
        follower.read()
        gripper.read()
        follower.driver.write_force((0.3,))
        gripper.write(GripperCommand(position=0.8, speed=2.0, force_n=2.0))
    assert gripper.read().position == pytest.approx(0.8, abs=0.02)
    assert follower.joint.torque_nm == pytest.approx(0.3, abs=UNIT_NM)
    assert follower.sample.fault is None


def test_the_servo_ends_its_current_when_its_host_stands_still(world: World, tmp_path: Path) -> None:
    follower = one_joint(world, tmp_path, watchdog_s=0.1)
    set_stops(follower.joint, ["-3", "0.02", "80"])
    follower.exert(2.0, 0.5)
    world.pass_by(0.08)
    assert follower.joint.torque_nm == pytest.approx(0.5, abs=UNIT_NM)
    world.pass_by(0.04)
    assert follower.joint.torque_nm == 0.0
    world.pass_by(1.0)
    assert follower.joint.torque_nm == 0.0
    sample = follower.read()
    assert str(sample.fault).startswith("bus watchdog: servo 1 heard nothing for 100 ms")
    assert first(sample)[2] == 0.0
    follower.driver.write_force((0.5,))
    assert follower.exerted() == 0.0


def forced(driver: DynamixelSlave, torque: float, holds: Callable[[SlaveSample], bool]) -> SlaveSample:
    """Command a torque until a sample meets the condition."""
    end = time.monotonic() + PATIENCE_S
    while not holds(sample := driver.read()):
        driver.write_force((torque,))
        assert time.monotonic() < end, sample
        time.sleep(TICK_S)
    return sample


@pytest.mark.live
def test_a_fault_ends_the_torque_and_an_acknowledged_arm_holds(tmp_path: Path) -> None:
    """On a running bus: the recovery has a thread of its own."""
    arm = tmp_path / "arm.toml"
    arm.write_text(f'[[servo]]\nid = 1\nmodel = "{MODEL}"\n')
    patient = {"timeout_s": 0.1, "watchdog_s": 0.5, "lost_after_s": 0.3, "ramp_s": 0.1, "release_s": 0.0}
    with emulated_bus("--servos", f"1={MODEL}", "--stops", "1=-3:0.1:20") as emulated:
        driver = DynamixelSlave(
            port=emulated.port, arm=str(arm), mode="current", inertia=[0.0082], verify_watchdog=False, **patient
        )
        driver.open()
        try:

            def pressing(sample: SlaveSample) -> bool:
                return first(sample)[2] < -0.2

            forced(driver, 0.5, pressing)
            emulated.do("hardware-error 1 overload")
            sample = forced(driver, 0.5, lambda one: one.fault is not None)
            assert str(sample.fault).startswith("overload: servo 1")
            assert first(sample)[2] == 0.0
            without_torque(emulated)
            driver.acknowledge()
            led(driver, (0.0,), lambda one: one.fault is None)
            driver.stop()
            assert emulated.servo(1)["torque"]
            # Nothing of the earlier force is left.
            assert abs(emulated.servo(1)["torque_nm"]) < 0.2
            forced(driver, 0.5, pressing)
        finally:
            driver.close()
        assert not emulated.servo(1)["torque"]
