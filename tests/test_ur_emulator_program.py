"""The control script of ur_rtde as the emulated controller runs it, in virtual time."""

import json
import math

import numpy as np
import pytest
from tests.ur.virtual import DONE, READY, START, World

from haptether.slave.ur_emulator import SafetyLimits
from haptether.slave.ur_emulator.async_progress import RUNNING
from haptether.slave.ur_emulator.control_uploads import PathMove, recognised
from haptether.slave.ur_emulator.dashboard import Dashboard
from haptether.slave.ur_emulator.script_port import ScriptReader, Submitted
from haptether.slave.ur_pose import pose_trans

UP = (0.0, 0.0, 0.05, 0.0, 0.0, 0.0)


@pytest.fixture
def world() -> World:
    return World()


def shifted(joint: int, by: float) -> tuple[float, ...]:
    return tuple(q + by * (n == joint) for n, q in enumerate(START))


def lifted(pose: tuple[float, ...], by: float) -> tuple[float, ...]:
    return (*pose[:2], pose[2] + by, *pose[3:])


# --------------------------------------------------------------------------------------------------- the handshake


@pytest.mark.parametrize("offset", [0, 24])
@pytest.mark.parametrize("version", ["3.15", "5.11", "5.23"])
def test_a_command_is_done_once_and_answered_until_it_is_taken_back(version: str, offset: int) -> None:
    world = World(version, offset=offset)
    world.write(40)
    world.cycles(1)
    assert world.answer == DONE
    world.cycles(10)
    assert world.answer == DONE
    world.write(0)
    world.cycles(1)
    assert world.answer == READY


def test_the_script_starts_a_while_after_its_upload() -> None:
    world = World(upload=False)
    assert world.of.runtime.name == "STOPPED"
    world.upload()
    assert world.of.now_s == pytest.approx(0.02)


def test_commands_of_the_realtime_class_are_answered_by_ready(world: World) -> None:
    for command in (11, 9, 26, 38):
        world.realtime(command, [*START, 1.0, 1.0, 0.002, 0.1, 300.0] if command == 11 else [0.0] * 6 + [1.0, 0.0])
        world.cycles(3)
        assert world.answer == READY, command
        world.call(15 if command == 9 else 16, [10.0])


def test_a_program_ends_by_its_command_and_is_replaced_by_the_next(world: World) -> None:
    world.write(255)
    world.cycles(1)
    assert not world.playing
    assert world.number("runtime_state") == 1
    world.upload()
    assert world.playing
    # An upload stops what runs, at once.
    world.of.submit(Submitted("other", "def other():\n  sleep(0.1)\nend"))
    assert not world.playing
    world.cycles(11)
    assert world.playing
    world.cycles(60)
    assert not world.playing


def test_an_unknown_command_is_answered_and_does_nothing(world: World) -> None:
    world.call(240)
    assert world.playing


# ----------------------------------------------------------------------------------------------------- servo, speed


def test_servoj_shows_three_cycles_after_its_command(world: World) -> None:
    world.cycles(5)
    world.servo(shifted(0, 0.01))
    moved = 0
    while world.vector("target_q")[0] == START[0]:
        world.cycles(1)
        moved += 1
    # One for the main loop to read it, one for the servo thread to take it, one to move.
    assert moved == 3


def test_servoj_follows_its_law_and_holds_the_last_target(world: World) -> None:
    for step in range(500):
        world.servo(shifted(0, 0.2 * step * 0.002))
        world.cycles(1)
    # Ramp lag: the lookahead, the cycle between, and half a cycle of holding.
    lag = 0.2 * 499 * 0.002 - (world.vector("actual_q")[0] - START[0])
    assert lag == pytest.approx(0.2 * (0.1 + 0.002), abs=0.2 * 0.002)
    world.seconds(2.0)
    assert world.vector("actual_q") == pytest.approx(shifted(0, 0.2 * 499 * 0.002), abs=1e-6)
    assert world.playing
    assert world.call(16, [10.0]) <= 3


def test_a_long_blocking_time_only_delays_the_next_target(world: World) -> None:
    world.servo(shifted(0, 0.01), time_s=0.1)
    world.cycles(3)
    world.servo(shifted(0, -0.01), time_s=0.1)
    world.cycles(45)
    assert world.vector("target_q")[0] > START[0]
    world.seconds(1.0)
    assert world.vector("actual_q")[0] == pytest.approx(START[0] - 0.01, abs=1e-5)


def test_servol_solves_the_inverse_kinematics(world: World) -> None:
    pose = lifted(world.vector("actual_TCP_pose"), 0.02)
    world.realtime(24, [*pose, 0.0, 0.0, 0.002, 0.1, 300.0])
    world.seconds(2.0)
    assert world.vector("actual_TCP_pose") == pytest.approx(pose, abs=1e-6)
    world.realtime(24, [2.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.002, 0.1, 300.0])
    world.cycles(2)
    assert not world.playing
    assert "no solution" in world.of.log[-1]


@pytest.mark.parametrize(("lookahead_s", "gain"), [(0.02, 300.0), (0.3, 300.0), (0.1, 50.0), (0.1, 3000.0)])
def test_servoj_with_numbers_that_it_does_not_take_stops_the_program(
    world: World, lookahead_s: float, gain: float
) -> None:
    world.servo(START, lookahead_s=lookahead_s, gain=gain)
    world.cycles(3)
    assert not world.playing
    assert "servoj: lookahead_time" in world.of.log[-1]


def test_speedl_goes_on_until_it_is_stopped(world: World) -> None:
    world.realtime(10, [*UP, 0.25, 0.0])
    world.seconds(1.0)
    assert world.vector("actual_TCP_speed")[:3] == pytest.approx(UP[:3], abs=1e-4)
    rise = world.vector("actual_TCP_pose")[2]
    world.seconds(1.0)
    # Nobody says anything any more, and it goes on: 50 mm in the second.
    assert world.vector("actual_TCP_pose")[2] - rise == pytest.approx(0.05, abs=1e-4)
    world.call(15, [10.0])
    assert world.vector("actual_TCP_speed") == pytest.approx((0.0,) * 6, abs=1e-6)


def test_speedl_keeps_to_its_line(world: World) -> None:
    begin = world.vector("actual_TCP_pose")
    world.realtime(10, [0.05, 0.02, 0.03, 0.0, 0.0, 0.0, 0.5, 0.0])
    world.seconds(2.0)
    end = world.vector("actual_TCP_pose")
    way = np.array(end[:3]) - begin[:3]
    line = np.array((0.05, 0.02, 0.03))
    across = way - line * (way @ line) / (line @ line)
    # The rates of each step are exact at its begin: an error of the order of step² per step.
    assert np.abs(across).max() < 2e-5
    assert end[3:] == pytest.approx(begin[3:], abs=2e-5)


def test_speedj_reaches_its_velocity_at_its_acceleration(world: World) -> None:
    world.realtime(9, [0.1, -0.05, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0])
    world.cycles(2)
    world.seconds(0.1)
    assert world.vector("target_qd")[:2] == pytest.approx((0.05, -0.025), abs=0.0011)
    world.seconds(0.2)
    assert world.vector("target_qd")[:2] == pytest.approx((0.1, -0.05))
    world.call(15, [10.0])
    assert world.vector("target_qd") == (0.0,) * 6


def test_a_move_while_the_servo_thread_runs_is_an_error(world: World) -> None:
    world.servo(START)
    world.cycles(5)
    world.write(1, [*shifted(0, 0.1), 1.0, 1.0], [0])
    world.cycles(2)
    assert not world.playing
    assert "another thread is already controlling the robot" in world.of.log[-1]


# ------------------------------------------------------------------------------------------------------------ moves


def test_movej_takes_speed_before_acceleration(world: World) -> None:
    # 0.5 rad at 1 rad/s and 2 rad/s²: a second.
    took = world.call(1, [*shifted(0, 0.5), 1.0, 2.0], [0])
    assert took * 0.002 == pytest.approx(1.0, abs=0.006)
    assert world.vector("actual_q") == pytest.approx(shifted(0, 0.5), abs=1e-9)


def test_movel_goes_straight(world: World) -> None:
    goal = lifted(world.vector("actual_TCP_pose"), 0.1)
    world.realtime(3, [*goal, 0.1, 0.5], [0])
    heights = []
    while world.answer != DONE:
        world.cycles(1)
        pose = world.vector("target_TCP_pose")
        assert pose[:2] == pytest.approx(goal[:2], abs=1e-9)
        assert pose[3:] == pytest.approx(goal[3:], abs=1e-9)
        heights.append(pose[2])
    assert world.vector("actual_TCP_pose") == pytest.approx(goal, abs=1e-9)
    assert max(np.diff(heights)) == pytest.approx(0.1 * 0.002, rel=1e-3)


def test_movej_of_a_pose_and_movel_of_joints(world: World) -> None:
    pose = lifted(world.vector("actual_TCP_pose"), 0.05)
    world.call(2, [*pose, 0.5, 1.0], [0])
    assert world.vector("actual_TCP_pose") == pytest.approx(pose, abs=1e-9)
    world.call(4, [*START, 0.1, 0.5], [0])
    assert world.vector("actual_q") == pytest.approx(START, abs=1e-9)


def test_an_asynchronous_move_tells_of_its_progress(world: World) -> None:
    before = world.integer(2)
    assert not before & RUNNING
    assert world.call(1, [*shifted(0, 0.3), 1.0, 2.0], [1]) <= 2
    world.cycles(2)
    word = world.integer(2)
    assert word & RUNNING
    assert (word >> 24) - (before >> 24) == 1
    assert (word >> 16 & 127) == (before >> 16 & 127) + 1
    world.seconds(2.0)
    assert not world.integer(2) & RUNNING
    assert world.vector("actual_q") == pytest.approx(shifted(0, 0.3), abs=1e-9)


@pytest.mark.parametrize("command", [33, 34])
def test_a_stop_ends_an_asynchronous_move(world: World, command: int) -> None:
    world.call(1, [*shifted(0, 0.5), 1.0, 2.0], [1])
    world.seconds(0.3)
    world.call(command, [2.0], [0])
    assert not world.integer(2) & RUNNING
    assert world.vector("target_qd") == (0.0,) * 6
    assert START[0] < world.vector("actual_q")[0] < START[0] + 0.4


def test_an_asynchronous_stop_goes_on_by_itself(world: World) -> None:
    world.call(1, [*shifted(0, 0.5), 1.0, 2.0], [1])
    world.seconds(0.3)
    assert world.call(33, [0.5], [1]) <= 2
    assert max(map(abs, world.vector("target_qd"))) > 0.1
    world.seconds(2.0)
    assert world.vector("target_qd") == pytest.approx((0.0,) * 6)
    assert not world.integer(2) & RUNNING


def test_moves_slow_down_with_the_speed_slider(world: World) -> None:
    world.of.inputs.write({"speed_slider_mask": 1, "speed_slider_fraction": 0.5})
    took = world.call(1, [*shifted(0, 0.5), 1.0, 2.0], [0])
    assert took * 0.002 == pytest.approx(2.0, abs=0.01)
    assert world.number("target_speed_fraction") == 0.5


def test_the_controller_slows_its_own_moves_to_the_limit_of_tool_speed() -> None:
    world = World(limits=SafetyLimits(tool_speed=0.25))
    world.call(1, [*shifted(0, 1.0), 2.0, 2.0], [0])
    assert world.of.safety.mode.name == "NORMAL"
    assert world.vector("actual_q") == pytest.approx(shifted(0, 1.0), abs=1e-9)


def test_a_path_is_read_from_the_script() -> None:
    text = (
        "def rtde_control():\n  def process_cmd(cmd):\n  def rtde_cmd():\n  read_input_integer_reg(0)\n"
        "    def exec_move_path():\n"
        '        textmsg("exec_move_path")\n'
        "        # inject move path\n"
        "\tsignal_async_progress(0)\n"
        "\tmovej([-1.55,-1.7,-2.2,-0.8,1.6,0],a=1.4,v=1,r=0.01)\n"
        "\tsignal_async_progress(1)\n"
        "\tmovel(p[0.1,-2e-1,.3,0,0,0],a=0.5,v=0.25,r=0)\n"
        "    end\nend\n"
    )
    upload = recognised(text)
    assert upload is not None
    assert upload.path == (
        0,
        PathMove(straight=False, is_pose=False, target=(-1.55, *START[1:]), acceleration=1.4, speed=1.0),
        1,
        PathMove(straight=True, is_pose=True, target=(0.1, -0.2, 0.3, 0.0, 0.0, 0.0), acceleration=0.5, speed=0.25),
    )  # fmt: skip
    assert recognised("def other():\n  movej([0,0,0,0,0,0])\nend") is None


# -------------------------------------------------------------------------------------------------- asked and set up


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
    # A centre of gravity of zeros leaves the one before.
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
    columns = [float(world.of.outputs[f"output_double_register_{n}"]) for n in (*range(24), *range(36, 48))]  # type: ignore[arg-type]
    jacobian = np.array(columns).reshape(6, 6).T
    _, expected = world.of.robot.arm.transform_and_jacobian(START)
    assert jacobian == pytest.approx(expected, abs=1e-12)
    world.realtime(67)
    world.cycles(1)
    assert not world.playing
    assert "get_mass_matrix" in world.of.log[-1]


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
        # Any package with the command register keeps it quiet, whatever it says.
        world.seconds(0.04)
        world.write(10)
        assert world.playing
    world.seconds(0.048)
    assert world.playing
    world.seconds(0.008)
    assert not world.playing
    assert "watchdog" in world.of.log[-1]
    world.seconds(0.2)
    assert world.vector("target_qd") == (0.0,) * 6
    assert world.of.safety.mode.name == "NORMAL"
    # It does not outlive the program.
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
    turn = world.of.robot.measured.tool[:3, :3]
    assert world.vector("ft_raw_wrench")[:3] == pytest.approx(turn.T @ (3.0, -4.0, 12.0))


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


def test_contact_is_told_with_how_long_it_lasts(world: World) -> None:
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
    # The face is 20 mm away; contact is told from 1 N on, 7 mm deep at 150 N/m.
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
    inertia, friction = world.of.robot.loop.inertia[0], world.of.robot.friction[0]
    assert (inertia, friction) == pytest.approx((150.0 / 50.0, 0.05 * 150.0 / math.pi))
    # I q'' = tau - b q', from rest.
    t = 249 * 0.002
    assert world.vector("actual_qd")[0] == pytest.approx(
        3.0 / friction * (1.0 - math.exp(-friction * t / inertia)), rel=0.01
    )
    # An older one has no such line in its script.
    old = World("5.23")
    old.realtime(66, [3.0, *(0.0,) * 17])
    old.cycles(10)
    assert old.vector("actual_qd") == (0.0,) * 6
    assert old.playing


def test_a_sensor_of_the_client_can_take_the_place_of_the_flange(world: World) -> None:
    world.of.inputs.write({"external_force_torque": (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)})
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
    # It is not of the real-time class there, although the client takes it for that: it stays at "done".
    assert world.answer == DONE
    world.seconds(1.0)
    assert world.vector("actual_TCP_pose") == pytest.approx(goal, abs=1e-6)
    assert world.answer == DONE


# ------------------------------------------------------------------------------------------------------- the safety


def test_a_protective_stop_of_the_program(world: World) -> None:
    world.realtime(10, [*UP, 0.25, 0.0])
    world.seconds(0.5)
    world.write(31)
    world.cycles(1)
    assert not world.playing
    assert world.of.safety.mode.name == "PROTECTIVE_STOP"
    assert world.number("safety_status_bits") == 1 << 2 | 1 << 10
    world.seconds(0.2)
    assert world.vector("target_qd") == (0.0,) * 6
    # Nothing starts until it is unlocked, and that takes its time.
    assert not world.of.submit(Submitted("x", "def x():\nend"))
    assert "Cannot unlock" in world.line.answer("unlock", 0.0)
    world.seconds(5.0)
    assert world.line.answer("unlock", 0.0) == "ok Protective stop releasing"
    world.upload()
    assert world.number("safety_mode") == 1


@pytest.mark.parametrize(
    ("push", "reason"),
    [((160.0, 0.0, 0.0), "tool force 160.0 N"), ((0.0, -100.0, 120.0), "tool force 156.2 N")],
)
def test_a_forceful_push_is_a_protective_stop(world: World, push: tuple[float, float, float], reason: str) -> None:
    world.environment.push(push, 0.1)
    world.cycles(2)
    assert world.of.safety.mode.name == "PROTECTIVE_STOP"
    assert world.of.safety.reason.startswith(reason)


def test_a_target_that_jumps_is_a_protective_stop(world: World) -> None:
    world.servo(START)
    world.cycles(5)
    world.servo(shifted(2, 0.31))
    world.cycles(3)
    assert not world.playing
    assert world.of.safety.reason == "C204 path sanity check: sudden change in target position"
    assert max(abs(a - b) for a, b in zip(world.vector("actual_q"), START, strict=True)) < 1e-3


def test_too_fast_a_tool_is_a_protective_stop() -> None:
    world = World(limits=SafetyLimits(tool_speed=0.1))
    world.realtime(10, [0.0, 0.0, 0.15, 0.0, 0.0, 0.0, 1.0, 0.0])
    world.seconds(0.5)
    assert world.of.safety.reason.startswith("tool speed 0.1")
    assert world.vector("target_qd") == (0.0,) * 6


def test_a_push_beyond_the_motors_is_a_deviation_from_the_path() -> None:
    world = World(limits=SafetyLimits(tool_force_n=1e4, tool_speed=10.0))
    world.environment.push((0.0, 0.0, -600.0), 1.0)
    world.seconds(0.5)
    assert "away from its path" in world.of.safety.reason


def test_the_end_of_a_joint_is_a_protective_stop(world: World) -> None:
    world.call(1, [*shifted(5, 6.2), 3.0, 3.0], [0])
    world.realtime(9, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 5.0, 0.0])
    world.seconds(1.0)
    assert world.of.safety.reason.startswith("position of joint 6")


def test_the_same_seed_gives_the_same_noise() -> None:
    one, other = World(noise_n=1.0), World(noise_n=1.0)
    for world in (one, other):
        world.seconds(0.5)
    assert one.vector("actual_TCP_force") == other.vector("actual_TCP_force")
    assert any(one.vector("actual_TCP_force"))


def test_the_end_of_force_mode_lets_nothing_jump() -> None:
    # A servo target 50 mm away along the compliant axis: meanwhile the law has wound up nothing.
    world = World()
    goal = lifted(world.vector("actual_TCP_pose"), 0.05)
    selection = [2, 0, 0, 1, 0, 0, 0]
    world.realtime(6, [*(0.0,) * 12, *(0.1,) * 6], selection)
    # Nothing of this class is acknowledged: what is written in the same cycle takes its place.
    world.cycles(2)
    world.realtime(24, [*goal, 0.0, 0.0, 0.002, 0.1, 300.0])
    world.seconds(1.0)
    assert world.vector("actual_TCP_pose")[2] == pytest.approx(goal[2] - 0.05, abs=1e-3)
    world.of.robot.end_force_mode()
    world.write(0)
    world.cycles(3)
    assert abs(world.vector("actual_TCP_speed")[2]) < 0.1


# ----------------------------------------------------------------------------------- the dashboard and the control line


@pytest.mark.parametrize(
    ("said", "answer"),
    [
        ("PolyscopeVersion", "URSoftware 5.11.0.0 (Jan 01 2024)"),
        ("robotmode", "Robotmode: RUNNING"),
        ("ROBOTMODE\r", "Robotmode: RUNNING"),
        ("safetystatus", "Safetystatus: NORMAL"),
        ("programState", "PLAYING rtde_control"),
        ("running", "Program running: true"),
        ("is in remote control", "true"),
        ("get serial number", "20240000001"),
        ("get robot model", "UR5"),
        ("stop", "Stopped"),
        ("pause", "Pausing program"),
        ("play", "Failed to execute: play"),
        ("load nothing.urp", "File not found: nothing.urp"),
        ("load rtde_control.urp", "Loading program: rtde_control.urp"),
        ("popup careful", "showing popup"),
        ("unlock protective stop", "Protective stop releasing"),
        ("fly away", "could not understand: 'fly away'"),
        ("", "could not understand: ''"),
    ],
)
def test_the_dashboard_answers(world: World, said: str, answer: str) -> None:
    assert Dashboard(world.of).answer(said) == (answer, True)


def test_the_dashboard_in_local_control_and_of_a_cb3() -> None:
    world = World(upload=False)
    world.of.remote_control = False
    for line in ("play", "power off", "load rtde_control.urp", "unlock protective stop"):
        assert Dashboard(world.of).answer(line)[0] == "Command is not allowed due to safety reasons"
    assert Dashboard(world.of).answer("is in remote control")[0] == "false"
    assert Dashboard(world.of).answer("quit") == ("Disconnected", False)
    cb3 = World("3.15", upload=False)
    assert Dashboard(cb3.of).answer("is in remote control")[0].startswith("could not understand")


def test_a_program_on_the_disk_can_be_played() -> None:
    world = World(upload=False)
    dashboard = Dashboard(world.of)
    dashboard.answer("load rtde_control.urp")
    assert dashboard.answer("play")[0] == "Starting program"
    world.seconds(0.1)
    assert world.playing
    assert world.call(40) >= 1


def test_power_comes_and_goes(world: World) -> None:
    dashboard = Dashboard(world.of)
    dashboard.answer("power off")
    assert not world.playing
    assert world.of.submit(Submitted("", "stopj(2)")) is False
    for line, seconds, mode in [("power on", 0.5, "POWER_ON"), ("", 0.6, "IDLE"), ("brake release", 1.1, "RUNNING")]:
        dashboard.answer(line)
        world.seconds(seconds)
        assert dashboard.answer("robotmode")[0] == f"Robotmode: {mode}"
    assert world.vector("joint_mode") == (253,) * 6


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("push", "must be FX or FX,FY,FZ"),
        ("push x", "must be 1 finite number"),
        ("push 1,2", "must be one or three numbers"),
        ("push nan", "must be 1 finite number"),
        ("push 1e9", "must be one or three numbers of at most"),
        ("push 1 -1", "must be positive"),
        ("freeze 0", "must be positive"),
        ("late", "must be 2 finite numbers"),
        ("late -1", "must be between 0 and 60 s"),
        ("drop all rtde", "must be all or some of"),
        ("refuse maybe", "must be on or off"),
        ("version five", "must be real, or like 5.8"),
        ("power", "must be on"),
        ("release-emergency-stop", "is not pressed"),
        ("log x", "must be 1 finite number"),
        ("log 0", "log: 0: must be a whole number of lines, 1 or more"),
        ("log -1", "log: -1: must be a whole number"),
        ("log 2.5", "log: 2.5: must be a whole number"),
        ("log 1 2", "must be 1 finite number"),
        ("nonsense", "must be one of"),
        ("", "error: an empty line: must be one of anchor "),
    ],
)
def test_lines_that_are_refused_say_why(world: World, line: str, said: str) -> None:
    before = world.of.runtime
    answer = world.line.answer(line, 0.0)
    assert answer.startswith("error: ")
    assert said in answer
    assert world.of.runtime == before


def test_the_log_shows_the_lines_that_are_asked_for(world: World) -> None:
    for number in range(30):
        world.of.tell(f"line {number}")
    for line, count in (("log", 20), ("log 1", 1), ("log 3", 3), ("log 1e3", len(world.of.log))):
        shown = json.loads(world.line.answer(line, 0.0).removeprefix("ok "))
        assert shown == list(world.of.log)[-count:], line


def test_reset_brings_everything_back(world: World) -> None:
    world.call(29, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    world.call(17, [3.0, 0.0, 0.0, 0.1])
    world.call(1, [*shifted(0, 0.2), 2.0, 4.0], [0])
    world.environment.push((0.0, 0.0, 20.0), 100.0)
    world.cycles(2)
    world.call(8)
    for line in ("protective-stop", "remote-control off", "version 1.2", "in-use on", "late 0.5"):
        assert world.line.answer(line, 0.0) == "ok"
    assert world.line.answer("reset", 0.0) == "ok"
    world.cycles(1)
    assert world.vector("actual_q") == START
    assert world.vector("actual_TCP_force") == (0.0,) * 6
    assert world.vector("tcp_offset") == (0.0,) * 6
    assert world.number("payload") == 0.0
    assert world.number("safety_mode") == 1
    world.upload()
    assert world.playing


# --------------------------------------------------------------------------------------------------------- scripts


@pytest.mark.parametrize(
    ("line", "holds"),
    [
        ("stopj(2)", lambda w: not w.of.log),
        ("movej([-1.5, -1.7, -2.2, -0.8, 1.6, 0.0], a=1.4, v=1.05)", lambda w: w.vector("actual_q")[0] == -1.5),
        ("set_tcp(p[0, 0, 0.1, 0, 0, 0])", lambda w: w.vector("tcp_offset")[2] == 0.1),
        ("set_standard_digital_out(2, True)", lambda w: w.number("actual_digital_output_bits") == 4),
        ("write_output_integer_register(0 + 12, 3*4)", lambda w: w.integer(12) == 12),
        ('textmsg("hello ", 5)', lambda w: w.of.log[-1].endswith("hello 5")),
        ("protective_stop()", lambda w: w.of.safety.mode.name == "PROTECTIVE_STOP"),
        ("__import__('os')", lambda w: "knows only calls" in w.of.log[-1]),
        ("movej(", lambda w: "knows only calls" in w.of.log[-1]),
        ("movej([1, 2])", lambda w: "must be six numbers" in w.of.log[-1]),
        ("movej([9, 9, 9, 9, 9, 9])", lambda w: "beyond the limits" in w.of.log[-1]),
        ("movej()", lambda w: "missing" in w.of.log[-1]),
    ],
)
def test_single_lines_are_run_at_once(line: str, holds: object) -> None:
    world = World(upload=False)
    (submitted,) = ScriptReader().receive(f"{line}\n".encode())
    assert world.of.submit(submitted)
    world.seconds(1.0)
    assert callable(holds)
    assert holds(world), world.of.log
    assert not world.playing


def test_a_program_ends_at_the_only_end_in_the_first_column() -> None:
    text = "# a comment\n\ndef one():\n  if True:\n    sync()\n  end\n end\nend\nstopj(2)\nsec two():\n  sync()\nend \n"
    whole = list(ScriptReader().receive(text.encode()))
    assert [(s.name, s.secondary) for s in whole] == [("one", False), ("", False), ("two", True)]
    assert whole[0].text.endswith(" end\nend")
    reader = ScriptReader()
    assert [s for n in range(len(text)) for s in reader.receive(text[n : n + 1].encode())] == whole


def test_a_program_without_an_end_is_refused() -> None:
    reader = ScriptReader()
    assert list(reader.receive(b"def endless():\n" + b"  sync()\n" * 300_000)) == []
    with pytest.raises(ValueError, match="without an end"):
        list(reader.receive(b"  sync()\n"))


def test_scripts_are_refused_in_local_control() -> None:
    world = World(upload=False)
    world.of.remote_control = False
    assert not world.of.submit(Submitted("", "stopj(2)"))
    assert "not in remote control" in world.of.log[-1]
    cb3 = World("3.15", upload=False)
    cb3.of.remote_control = False
    assert cb3.of.submit(Submitted("", "stopj(2)"))
