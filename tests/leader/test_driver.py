"""Driver of a leader arm on an emulated bus: its measurements, its torques and its faults."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.dynamixel.test_description import TWO_LINKS

from haptether.bridge import load_master, load_slave
from haptether.cli.shared.own_force import exerts_by_itself
from haptether.dynamixel.arm import FaultKind
from haptether.dynamixel.description import ArmKinematics, load_arm
from haptether.master.dynamixel import DynamixelMaster, joint_model, leader_options, pose_model

TICK_S = 0.004


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """Write an arm of two joints and a trigger."""
    path = tmp_path / "two.toml"
    path.write_text(TWO_LINKS)
    return path


@contextmanager
def opened(arm: Path | str, *start: float, **given: object) -> Iterator[tuple[DynamixelMaster, EmulatedBus]]:
    """Open a driver with torque on an emulated arm that a stiff hand holds."""
    known = [joint.servo_model.nominal_nm_per_a for joint in load_arm(arm).joints]
    options: dict[str, Any] = {"ramp_s": 0.1, "timeout_s": 0.02, "watchdog_s": 0.5, "verify_watchdog": False}
    # The constants of the emulated servos.
    options |= {"torque_constant": known, **given}
    with emulated_bus("--arm", str(arm), *(("--start", *map(str, start)) if start else ())) as bus:
        for servo in bus.status()["servos"]:
            bus.do(f"hand {servo['id']} {servo['position_rad']} 40 1")
        # The arm has fallen until the hand held it: wait until it is at rest.
        end_s = time.monotonic() + 10.0
        while any(abs(servo["velocity_rad_s"]) > 0.01 for servo in bus.status()["servos"]):
            assert time.monotonic() < end_s
            time.sleep(0.01)
        leader = DynamixelMaster(port=bus.port, arm=str(arm), **options)
        try:
            leader.open()
            yield leader, bus
        finally:
            leader.close()


def run(
    leader: DynamixelMaster, duration_s: float, *force: tuple[float, ...], each: Callable[[], None] = lambda: None
) -> None:
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        leader.read()
        leader.write(*force)
        each()
        time.sleep(TICK_S)


def motors(bus: EmulatedBus) -> list[float]:
    return [servo["torque_nm"] for servo in bus.status()["servos"]]


@pytest.mark.live
def test_it_is_found_by_its_name(two: Path) -> None:
    leader = load_master("dynamixel", {"port": "/dev/none", "arm": str(two)})
    assert isinstance(leader, DynamixelMaster)
    assert leader.kinds == ("joints",)
    with pytest.raises(RuntimeError, match="port: is not there"):
        leader.open()
    leader.close()


@pytest.mark.live
def test_joints_are_measured_and_feel_force_and_weight(two: Path) -> None:
    with opened(two, 0.2, 0.5) as (leader, bus):
        run(leader, 0.5, (0.0, 0.0))
        sample = leader.read()
        assert sample.fault is None
        assert sample.orientation is None
        assert list(sample.position) == pytest.approx([0.2, 0.5], abs=0.02)  # type: ignore[arg-type]
        assert sample.trigger == pytest.approx(0.0, abs=0.02)
        weight = ArmKinematics(leader.arm).gravity(leader.read().position)  # type: ignore[arg-type]
        held = motors(bus)
        # The second servo has a negative sign.
        assert held[0] == pytest.approx(weight[0], abs=0.01)
        assert held[1] == pytest.approx(-weight[1], abs=0.01)
        run(leader, 0.2, (-0.1, 0.05))
        pushed = motors(bus)
        assert pushed[0] - held[0] == pytest.approx(-0.1, abs=0.02)
        assert pushed[1] - held[1] == pytest.approx(-0.05, abs=0.02)
        assert leader.cut_ticks == 0


@pytest.mark.live
def test_a_pose_is_that_of_the_tool_and_its_wrench_is_transposed(two: Path) -> None:
    with opened(two, 0.2, 0.5, kind="pose", gravity_gain=0.0) as (leader, bus):
        run(leader, 0.3, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        before = motors(bus)
        force, torque = (0.3, 0.0, -0.2), (0.0, 0.04, 0.0)
        run(leader, 0.3, force, torque)
        sample = leader.read()
        q = [0.2, 0.5]
        place, quat, _ = ArmKinematics(leader.arm).state(q, (0.0, 0.0))
        assert list(sample.position) == pytest.approx(place, abs=0.02)  # type: ignore[arg-type]
        assert sample.orientation == pytest.approx(quat, abs=0.03)
        assert sample.angular_velocity is not None
        assert sample.velocity is not None
        expected = ArmKinematics(leader.arm).jacobian(q).T @ (*force, *torque)
        seen = np.array(motors(bus))[:2] - before[:2]
        assert seen[0] == pytest.approx(expected[0], abs=0.02)
        assert seen[1] == pytest.approx(-expected[1], abs=0.02)


@pytest.mark.live
def test_a_stretched_arm_is_singular_and_nothing_is_large(two: Path) -> None:
    with opened(two, 0.2, 0.0, kind="pose") as (leader, bus):
        run(leader, 0.4, (5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        assert leader.read().fault is None
        reach = 0.45
        for torque, weight in zip(motors(bus)[:2], leader.compensated_nm, strict=True):
            assert abs(torque) <= 5.0 * reach + abs(weight) + 0.01


@pytest.mark.live
def test_the_trigger_leads_and_is_felt(two: Path) -> None:
    with opened(two) as (leader, bus):
        bus.do("hand 3 0.2 5 0.05")
        run(leader, 0.4, (0.0, 0.0))
        # Halfway from 0.6 to -0.2.
        assert leader.read().trigger == pytest.approx(0.5, abs=0.03)
        run(leader, 0.2, (0.0, 0.0), each=lambda: leader.write_trigger(-2.0))
        # 2 N at 40 mm open the trigger; closing is negative at this servo.
        assert motors(bus)[2] == pytest.approx(0.08, abs=0.01)
        leader.write_trigger(0.0)
        time.sleep(0.05)
        assert abs(motors(bus)[2]) < 1e-6


@pytest.mark.live
def test_a_force_beyond_the_caps_is_cut(two: Path) -> None:
    with opened(two) as (leader, bus):
        run(leader, 0.4, (50.0, -50.0))
        assert leader.cut_ticks > 10
        assert abs(motors(bus)[0]) <= leader.most_nm[0] + 1e-3
        assert abs(motors(bus)[1]) <= leader.most_nm[1] + 1e-3


@pytest.mark.live
@pytest.mark.parametrize(
    ("line", "said"),
    [("hardware-error 2 overload", "overload"), ("silent 1 on", "no answer"), ("unplug", "unplugged")],
)
def test_a_fault_of_the_bus_ends_all_torque(two: Path, line: str, said: str) -> None:
    with opened(two, 0.2, 0.5) as (leader, bus):
        run(leader, 0.3, (0.05, 0.05))
        before = leader.read().position
        bus.do(line)
        end_s = time.monotonic() + 3.0
        while (sample := leader.read()).fault is None:
            leader.write((0.05, 0.05))
            assert time.monotonic() < end_s
        assert said in sample.fault
        assert np.isfinite(np.asarray(sample.position)).all()
        assert list(sample.position) == pytest.approx(list(before), abs=0.05)  # type: ignore[arg-type]
        leader.write((0.05, 0.05))
        time.sleep(0.6)
        # An unplugged bus gets no command: the watchdogs of its servos end the torque.
        assert all(abs(torque) < 1e-6 for torque in motors(bus))
        assert leader.read().fault is not None


@pytest.mark.live
def test_a_fault_is_acknowledged_by_a_person(two: Path) -> None:
    with opened(two, 0.2, 0.5) as (leader, bus):
        run(leader, 0.2, (0.0, 0.0))
        bus.do("hardware-error 2 overload")
        end_s = time.monotonic() + 15.0
        while leader.read().fault is None:
            assert time.monotonic() < end_s
        time.sleep(0.3)
        assert leader.read().fault is not None
        leader.acknowledge()
        while leader.read().fault is not None:
            assert time.monotonic() < end_s
            time.sleep(0.02)
        run(leader, 0.5, (0.0, 0.0))
        assert motors(bus)[0] == pytest.approx(leader.compensated_nm[0], abs=0.01)


@pytest.mark.live
def test_the_end_is_without_torque(two: Path) -> None:
    with opened(two, 0.2, 0.5) as (leader, bus):
        run(leader, 0.2, (0.0, 0.0))
        leader.close()
        assert not any(servo["torque"] for servo in bus.status()["servos"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"arm": "gello-ur"}, "port is missing: must be the port of the arm's adapter"),
        ({"port": "x"}, "arm is missing"),
        ({"port": "x", "arm": "gelo"}, "must be a file, or one of aloha-wx250s"),
        ({"port": "x", "arm": "gello-ur", "gain": 2}, "is no option"),
        ({"port": "x", "arm": "gello-ur", "gravity_gain": 1.2}, "gravity_gain = 1.2: must be 0 to 1"),
        ({"port": "x", "arm": "koch-v1-1", "gravity_gain": 0.5}, "has joints without a mass: must be 0"),
        ({"port": "x", "arm": "gello-ur", "friction_gain": 0.5}, "has joints without a friction: must be 0"),
        ({"port": "x", "arm": "gello-ur", "offsets": [0.0, 1.0]}, "must be 6 numbers, one of each joint of gello-ur"),
        (
            {"port": "x", "arm": "gello-ur", "offsets": [0.0, 0.0, 700.0, 0.0, 0.0, 0.0], "signs": [1] * 6},
            "offsets = (0.0, 0.0, 700.0, 0.0, 0.0, 0.0): joint elbow (servo 3): `offset_rad` = 700: must be",
        ),
        ({"port": "x", "arm": "gello-ur", "signs": [1, 1, 1, 1, 1, 2]}, "signs"),
        ({"port": "x", "arm": "gello-ur", "kind": "linear"}, "kind = 'linear': must be one of joints, pose"),
        ({"port": "x", "arm": "gello-ur", "baud": 1234}, "baud = 1234: must be one of 9600"),
        ({"port": "x", "arm": "gello-ur", "calibration": "/none.toml"}, "calibration = '/none.toml'"),
    ],
)
def test_options_that_cannot_be_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match="driver = dynamixel") as refused:
        DynamixelMaster(**given)
    assert said in str(refused.value)


def test_a_calibration_has_signs_and_offsets_of_a_unit(tmp_path: Path) -> None:
    file = tmp_path / "unit.toml"
    arm = load_arm("gello-ur")
    servos = "".join(
        f'[[servo]]\nid = {joint.servo}\nmodel = "{joint.model}"\nsign = -1\noffset_rad = {0.1 * joint.servo}\n'
        for joint in reversed(arm.joints)
    )
    file.write_text(servos)
    leader = DynamixelMaster(port="x", arm="gello-ur", calibration=str(file))
    assert [joint.sign for joint in leader.arm.joints] == [-1] * 6
    assert [joint.offset_rad for joint in leader.arm.joints] == pytest.approx([0.1 * n for n in range(1, 7)])
    file.write_text(servos.replace("XM430-W350", "XM430-W210", 1))
    with pytest.raises(ValueError, match="must be a XM430-W350: the file has it as a XM430-W210"):
        DynamixelMaster(port="x", arm="gello-ur", calibration=str(file))
    file.write_text(servos.partition("[[servo]]\nid = 1\n")[0])
    with pytest.raises(ValueError, match="servo 1 must be a XM430-W350: the file lacks it"):
        DynamixelMaster(port="x", arm="gello-ur", calibration=str(file))


def test_an_arm_without_masses_is_not_compensated() -> None:
    unit: dict[str, Any] = {"port": "x", "offsets": [0.0] * 5, "signs": [1] * 5}
    leader = DynamixelMaster(arm="koch-v1-1", **unit)
    assert leader.compensation.gravity_gain == 0.0
    count = len(load_arm("factr").joints)
    unit = {"port": "x", "offsets": [0.0] * count, "signs": [1] * count}
    assert DynamixelMaster(arm="factr", **unit).compensation.gravity_gain == 1.0


@pytest.mark.parametrize("more", [{}, {"offsets": [0.0] * 6}, {"signs": [1] * 6}, {"gravity_gain": 0.0}])
def test_a_shipped_arm_whose_zeros_are_not_known_is_refused(more: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="its zeros are of one build, not of this unit: give calibration"):
        DynamixelMaster(port="x", arm="gello-ur", **more)


def test_a_calibration_holds_beside_the_description(tmp_path: Path) -> None:
    file = tmp_path / "unit.toml"
    arm = load_arm("gello-ur")

    def written(low: float, high: float, more: str = "") -> dict[str, Any]:
        servos = [
            f'[[servo]]\nid = {joint.servo}\nmodel = "{joint.model}"\ncap_a = 0.1\n'
            f"low_rad = {low}\nhigh_rad = {high}\n{more}"
            for joint in arm.joints
        ]
        file.write_text("baud = 57600\n" + "".join(servos))
        return {"port": "x", "arm": "gello-ur", "calibration": str(file)}

    leader = DynamixelMaster(**written(-2.0, 2.0))
    assert leader.servos.settings.baud == 57_600
    for joint, described, servo in zip(leader.arm.joints, arm.joints, leader.servos.settings.servos, strict=False):
        assert joint.low_rad == max(described.low_rad, -2.0)
        assert joint.high_rad == min(described.high_rad, 2.0)
        assert joint.cap_a == servo.cap_a == 0.1
    with pytest.raises(ValueError, match="must not be given where the calibration has them"):
        DynamixelMaster(**written(-2.0, 2.0), offsets=[0.0] * 6)
    with pytest.raises(ValueError, match=r"baud = 1000000: must be 57600"):
        DynamixelMaster(**written(-2.0, 2.0), baud=1_000_000)
    with pytest.raises(ValueError, match="servo 1, with the limits of the description"):
        DynamixelMaster(**written(-20.0, -19.0))
    with pytest.raises(ValueError, match=r"servo 1: shadows \[11\]: the description has"):
        DynamixelMaster(**written(-2.0, 2.0, "shadows = [11]\n"))


def test_the_model_of_the_device_comes_from_the_description(two: Path) -> None:
    arm = load_arm(two)
    with pytest.raises(ValueError, match="the inertia of its servos is not known"):
        joint_model(arm)
    found = joint_model(arm, (0.3, -0.8), inertia=(0.01, 0.002), friction_gain=0.5)
    links = ArmKinematics(arm).link_inertia((0.3, -0.8))
    assert found.mass_kg == pytest.approx((0.01 + links[0], 0.002 + links[1]))
    assert found.coulomb == pytest.approx((0.025, 0.01))
    assert found.viscous == pytest.approx((0.01, 0.005))
    with pytest.raises(ValueError, match="gello-ur: its friction is not known"):
        joint_model(load_arm("gello-ur"), inertia=[0.01] * 6)
    pose = pose_model(arm, (0.0, math.pi / 2), inertia=(0.01, 0.002))
    # The arm is bent by a right angle: only the first joint moves x, at 0.2 m.
    links = ArmKinematics(arm).link_inertia((0.0, math.pi / 2))
    first, second = 0.01 + links[0], 0.002 + links[1]
    assert pose.mass_kg[0] == pytest.approx(1.0 / (0.2**2 / first + 0.2**2 / second))
    assert pose.mass_kg[2] == pytest.approx(1.0 / (0.25**2 / first))
    assert pose.inertia_kg_m2[1] == pytest.approx(1.0 / (1.0 / first + 1.0 / second))
    assert leader_options({"port": "x", "arm": str(two)})[1] == arm


def test_drivers_say_whether_they_exert_by_themselves(two: Path) -> None:
    assert exerts_by_itself(load_master("dynamixel", {"port": "x", "arm": str(two)}))
    follower = two.with_name("follower.toml")
    follower.write_text('baud = 4000000\n[[servo]]\nid = 1\nmodel = "XM430-W350"\n')
    # This driver holds its joints.
    assert exerts_by_itself(load_slave("dynamixel", {"port": "x", "arm": str(follower)}))
    for compensated in (True, False):
        device = load_master("force-dimension", {"gravity_compensation": compensated})
        assert exerts_by_itself(device) == compensated
    assert exerts_by_itself(load_master("inverse3", {}))
    assert not exerts_by_itself(load_master("touch", {}))


@pytest.mark.live
@pytest.mark.parametrize(("servo", "joint", "push_nm"), [(1, "first", 1.0), (1, "first", -1.0), (2, "second", -0.3)])
def test_a_joint_that_is_thrown_is_a_fault_that_ends_all_torque(
    two: Path, servo: int, joint: str, push_nm: float
) -> None:
    with opened(two, 0.2, 0.5, max_speed=[1.5, 1.5], limit_stiffness=0.0) as (leader, bus):
        run(leader, 0.4, (0.0, 0.0))
        assert leader.read().fault is None
        assert any(abs(torque) > 0.1 for torque in motors(bus))
        bus.do("hand off")
        bus.do(f"push {servo} {push_nm}")
        end_s = time.monotonic() + 5.0
        while (sample := leader.read()).fault is None:
            leader.write((0.0, 0.0))
            assert time.monotonic() < end_s
        assert sample.fault.startswith(f"over-speed: joint {joint} (servo {servo}) moved at ")
        assert leader.servos.fault_kind == FaultKind.OVER_SPEED
        # The message gives the direction of the joint, by the sign of its servo.
        forward = push_nm > 0.0 if servo == 1 else push_nm < 0.0
        assert ("moved at +" if forward else "moved at -") in sample.fault
        assert "rad/s: must be within 1.50" in sample.fault
        leader.write((0.5, 0.5))
        # The driver does not wait for the stop.
        time.sleep(0.1)
        assert motors(bus) == [0.0, 0.0, 0.0]
        assert not any(one["torque"] for one in bus.status()["servos"])
        # The fault stays, though the arm is at rest again.
        for servo_id in (1, 2):
            bus.do(f"push {servo_id} 0")
            bus.do(f"hand {servo_id} {bus.servo(servo_id)['position_rad']} 40 1")
        run(leader, 0.3, (0.0, 0.0))
        assert leader.read().fault == sample.fault


def test_the_greatest_speeds_of_the_joints(two: Path) -> None:
    unit: dict[str, Any] = {"port": "x", "arm": str(two)}
    # The vendor's no-load speeds are 46 and 65 rpm.
    assert DynamixelMaster(**unit).max_speed == pytest.approx((0.7 * 46 * math.pi / 30, 0.7 * 65 * math.pi / 30))
    assert DynamixelMaster(**unit, max_speed=[1.0, 2.0]).max_speed == (1.0, 2.0)
    with pytest.raises(ValueError, match=r"max_speed = .*: must be 2 numbers"):
        DynamixelMaster(**unit, max_speed=[1.0])
    with pytest.raises(ValueError, match="max_speed"):
        DynamixelMaster(**unit, max_speed=[1.0, 0.0])
