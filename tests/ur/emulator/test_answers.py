"""Requests to the emulated controller, and its settings: poses, tools, forces, contact, the watchdog."""

import math

import numpy as np
import pytest
from tests.ur.virtual import DONE, START, UP, World, lifted, shifted

from haptether.slave.ur.kinematics.pose import pose_trans
from haptether.slave.ur_emulator import SafetyLimits
from haptether.slave.ur_emulator.script.control_script import RUNNING

# --------------------------------------------------------------------------------------------- requests and settings


def test_the_tool_moves_with_its_offset(world: World) -> None:
    flange = world.vector("actual_TCP_pose")
    offset = (0.01, 0.0, 0.1, 0.0, 0.3, 0.0)
    world.call(29, offset)
    world.call(40)
    assert world.six() == offset
    world.cycles(1)
    assert world.vector("tcp_offset") == offset
    assert world.vector("actual_TCP_pose") == pytest.approx(pose_trans(flange, offset), abs=1e-12)
    world.call(43)
    assert world.six() == pytest.approx(pose_trans(flange, offset), abs=1e-12)
    world.call(44, [*START, *(0.0,) * 6])
    assert world.six() == pytest.approx(flange, abs=1e-12)
    world.realtime(58)
    world.cycles(1)
    assert world.six() == pytest.approx(flange, abs=1e-12)


def test_inverse_kinematics_of_the_controller(world: World) -> None:
    pose = lifted(world.vector("actual_TCP_pose"), 0.02)
    world.call(46, pose)
    near = world.six()
    world.call(44, [*near, *(0.0,) * 6])
    assert world.six() == pytest.approx(pose, abs=1e-9)
    world.call(30, [*pose, *near, 1e-10, 1e-10])
    assert world.six() == pytest.approx(near, abs=1e-9)
    for command, where, yes in [(60, pose, 1), (60, (2.0, 2.0, 2.0, 0.0, 0.0, 0.0), 0), (36, pose, 1)]:
        world.call(command, where)
        assert world.integer(1) == yes
    for q, yes in [(START, 1), (shifted(5, 7.0), 0)]:
        world.call(37, q)
        assert world.integer(1) == yes
    assert world.playing


def test_answers_of_simple_questions(world: World) -> None:
    world.realtime(26)
    world.cycles(1)
    assert world.six()[0] == 0.002
    world.call(47)
    assert world.integer(1) == 1
    world.call(39, [0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert world.six() == pytest.approx((0.1, 0.7, 0.3, 0.0, 0.0, math.pi / 2), abs=1e-12)
    world.call(17, [1.5, 0.0, 0.0, 0.05])
    world.call(17, [2.5, 0.0, 0.0, 0.0])
    world.cycles(1)
    # A zero centre of gravity leaves the previous one.
    assert world.number("payload") == 2.5
    assert world.vector("payload_cog") == (0.0, 0.0, 0.05)


def test_joints_of_some_cycles_ago(world: World) -> None:
    world.realtime(9, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 10.0, 0.0])
    world.seconds(0.5)
    world.realtime(27, integers=[50])
    world.cycles(1)
    assert world.vector("actual_q")[0] - world.six()[0] == pytest.approx(0.1 * 0.002 * 50, abs=1e-9)


def test_jacobians_fill_the_registers_column_after_column() -> None:
    world = World("5.23")
    world.realtime(70)
    world.cycles(1)
    columns = [float(world.controller.outputs[f"output_double_register_{n}"]) for n in (*range(24), *range(36, 48))]  # type: ignore[arg-type]
    jacobian = np.array(columns).reshape(6, 6).T
    _, expected = world.controller.robot.arm.transform_and_jacobian(START)
    assert jacobian == pytest.approx(expected, abs=1e-12)
    world.realtime(67)
    world.cycles(1)
    assert not world.playing
    assert "get_mass_matrix" in world.controller.log[-1]


def test_what_a_version_does_not_have_changes_nothing() -> None:
    world = World("5.11")
    world.realtime(70)
    world.cycles(2)
    assert world.six() == (0.0,) * 6
    assert world.playing


@pytest.mark.parametrize(
    ("feature", "frame", "expected"),
    [
        (0, (0.0,) * 6, (0.02, 0.0, 0.0)),
        (2, (0.5, 0.5, 0.5, 0.0, 0.0, math.pi / 2), (0.0, 0.02, 0.0)),
    ],
)
def test_jogging_along_a_feature(
    world: World, feature: int, frame: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    world.call(41, [0.02, 0.0, 0.0, 0.0, 0.0, 0.0, feature, 0.5, *frame])
    world.seconds(0.5)
    assert world.vector("actual_TCP_speed")[:3] == pytest.approx(expected, abs=1e-4)
    world.call(42)
    assert world.vector("target_qd") == pytest.approx((0.0,) * 6)


# ---------------------------------------------------------------------------------------------------------- watchdog


@pytest.mark.parametrize("offset", [0, 24])
def test_a_watchdog_stops_the_program_and_the_arm(offset: int) -> None:
    world = World(offset=offset)
    world.call(35, [20.0])
    world.realtime(10, [*UP, 0.25, 0.0])
    for _ in range(20):
        # Any package with the command register resets the watchdog, whatever its value.
        world.seconds(0.04)
        world.write(10)
        assert world.playing
    world.seconds(0.048)
    assert world.playing
    world.seconds(0.008)
    assert not world.playing
    assert "watchdog" in world.controller.log[-1]
    world.seconds(0.2)
    assert world.vector("target_qd") == (0.0,) * 6
    assert world.controller.safety.mode.name == "NORMAL"
    # The watchdog ends with the program.
    world.upload()
    world.seconds(1.0)
    assert world.playing


# ------------------------------------------------------------------------------------------------- contact and force


def test_zero_ftsensor_takes_away_what_is_there(world: World) -> None:
    world.environment.push((3.0, -4.0, 12.0), 10.0)
    world.cycles(2)
    assert world.vector("actual_TCP_force")[:3] == (3.0, -4.0, 12.0)
    assert world.number("tcp_force_scalar") == pytest.approx(13.0)
    world.call(8)
    world.cycles(1)
    assert world.vector("actual_TCP_force") == (0.0,) * 6
    # At the flange, in its frame and without the offset.
    rotation = world.controller.robot.measured.tool[:3, :3]
    assert world.vector("ft_raw_wrench")[:3] == pytest.approx(rotation.T @ (3.0, -4.0, 12.0))


def test_the_sensor_carries_the_payload_and_the_force_at_the_tool_does_not(world: World) -> None:
    cog = (0.01, -0.02, 0.05)
    world.controller.setup.set_payload(1.5, cog)
    world.cycles(2)
    rotation = world.controller.robot.measured.tool[:3, :3]
    weight = rotation.T @ (0.0, 0.0, -1.5 * 9.82)
    assert world.vector("ft_raw_wrench") == pytest.approx([*weight, *np.cross(cog, weight)])
    assert world.vector("actual_TCP_force")[:3] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("line", "answer"), [("slider 0.5", "ok"), ("slider 1.2", "error: slider: 1.2: must be")])
def test_the_speed_slider_is_reported(world: World, line: str, answer: str) -> None:
    assert world.line.answer(line, 0.0).startswith(answer)
    world.cycles(2)
    assert world.number("target_speed_fraction") == (0.5 if answer == "ok" else 1.0)


def test_force_mode_presses_with_the_force_that_was_asked_for() -> None:
    world = World(scene="three_axis_box", overrides=["environment.objects.0.contact.stiffness=2000"])
    world.environment.engage()
    # The box is 20 mm before the tool along -x; at 2000 N/m a force of 10 N needs 5 mm more.
    world.realtime(
        6,
        [*(0.0,) * 6, -10.0, 0.0, 0.0, 0.0, 0.0, 0.0, *(0.1,) * 6],
        [2, 1, 0, 0, 0, 0, 0],
    )
    begin = world.vector("actual_TCP_pose")
    world.seconds(6.0)
    assert world.vector("actual_TCP_force")[0] == pytest.approx(10.0, abs=0.01)
    end = world.vector("actual_TCP_pose")
    assert end[0] - begin[0] == pytest.approx(-0.025, abs=1e-4)
    assert end[1:3] == pytest.approx(begin[1:3], abs=1e-4)
    world.call(7)
    world.seconds(0.1)
    assert world.vector("target_qd") == pytest.approx((0.0,) * 6)


def test_contact_is_reported_with_how_long_it_lasts(world: World) -> None:
    world.environment.push((0.0, 0.0, 20.0), 10.0)
    world.cycles(30)
    world.realtime(25, [0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    world.cycles(1)
    assert world.integer(1) == pytest.approx(30, abs=2)
    world.realtime(25, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    world.cycles(1)
    assert world.integer(1) == 0


def test_move_until_contact_goes_back_to_where_it_touched() -> None:
    world = World(scene="three_axis_box")
    world.environment.engage()
    begin = world.vector("actual_TCP_pose")
    world.call(51, [-0.05, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    # The face is 20 mm away; contact counts from 1 N on, 7 mm deep at 150 N/m.
    assert world.vector("actual_TCP_pose")[0] - begin[0] == pytest.approx(-0.02 - 1.0 / 150.0, abs=1e-3)


def test_contact_detection_ends_a_move(world: World) -> None:
    world.call(62, [0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    world.call(1, [*shifted(0, 0.5), 0.2, 1.0], [1])
    world.seconds(0.5)
    world.call(64)
    assert world.integer(1) == 0
    world.environment.push((0.0, 0.0, 20.0), 0.05)
    world.seconds(1.0)
    world.call(64)
    assert world.integer(1) > 0
    assert not world.integer(2) & RUNNING
    assert world.vector("target_qd") == (0.0,) * 6


def test_freedrive_lets_a_push_move_the_arm(world: World) -> None:
    world.call(52)
    world.call(54)
    assert world.integer(1) == 1
    begin = world.vector("actual_TCP_pose")[2]
    world.environment.push((0.0, 0.0, 10.0), 10.0)
    world.seconds(1.0)
    assert world.vector("actual_TCP_pose")[2] > begin + 0.005
    world.call(53)
    world.call(54)
    assert world.integer(1) == 0


def test_direct_torque_turns_a_joint_against_its_friction() -> None:
    world = World("5.26", limits=SafetyLimits(deviation=10.0))
    for _ in range(250):
        world.realtime(66, [3.0, 0.0, 0.0, 0.0, 0.0, 0.0, *(0.0,) * 12])
        world.cycles(1)
    inertia, friction = world.controller.robot.loop.inertia[0], world.controller.robot.friction[0]
    assert (inertia, friction) == pytest.approx((150.0 / 50.0, 0.05 * 150.0 / math.pi))
    # I q'' = tau - b q', from rest.
    t = 249 * 0.002
    assert world.vector("actual_qd")[0] == pytest.approx(
        3.0 / friction * (1.0 - math.exp(-friction * t / inertia)), rel=0.01
    )
    # An older version has no such line in its script.
    old = World("5.23")
    old.realtime(66, [3.0, *(0.0,) * 17])
    old.cycles(10)
    assert old.vector("actual_qd") == (0.0,) * 6
    assert old.playing


def test_a_stiff_wall_gives_an_arm_under_direct_torque_no_energy() -> None:
    contact = "contact = { stiffness = 50000, damping = 0 }"
    objects = f"environment.objects=[{{ shape = {{ kind = 'plane' }}, {contact} }}]"
    world = World("5.26", scene="remote_push", overrides=[objects, "environment.pushers=[]", "slave.position=0"])
    _, jacobian = world.controller.robot.arm.transform_and_jacobian(START)
    torque = (-10.0 * jacobian[0]).tolist()
    forces = []
    for _ in range(1000):
        world.realtime(66, [*torque, *(0.0,) * 12])
        world.cycles(1)
        forces.append(world.vector("actual_TCP_force")[0])
    first, last = max(forces[:250]), max(forces[750:])
    # A constant force on an undamped spring swings to twice the force; friction of b/I = 0.8 /s is all that damps it.
    assert 19.0 < first < 20.0
    assert 10.0 + (first - 10.0) * math.exp(-0.5 * 0.8 * 2.0) * 0.9 < last < 17.0


def test_a_sensor_of_the_client_can_take_the_place_of_the_flange(world: World) -> None:
    world.controller.inputs.write({"external_force_torque": (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)})
    world.cycles(2)
    assert world.vector("actual_TCP_force") == (0.0,) * 6
    world.call(56, [0.5, *(0.0,) * 6], [1])
    world.cycles(2)
    assert world.vector("actual_TCP_force") == (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    world.call(56, [0.5, *(0.0,) * 6], [0])
    world.cycles(2)
    assert world.vector("actual_TCP_force") == (0.0,) * 6


def test_servoc_works_once_as_in_the_script(world: World) -> None:
    goal = lifted(world.vector("actual_TCP_pose"), 0.02)
    world.write(12, [*goal, 0.25, 1.2, 0.0])
    world.cycles(2)
    # In the script it is not a real-time command, although the client treats it as one: the answer stays at "done".
    assert world.answer == DONE
    world.seconds(1.0)
    assert world.vector("actual_TCP_pose") == pytest.approx(goal, abs=1e-6)
    assert world.answer == DONE
