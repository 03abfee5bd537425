"""The control script of ur_rtde as the emulated controller runs it, in virtual time."""

import numpy as np
import pytest
from tests.ur.virtual import DONE, READY, START, UP, World, lifted, shifted

from haptether.slave.ur_emulator import SafetyLimits
from haptether.slave.ur_emulator.script.control_script import RUNNING, PathMove, recognised
from haptether.slave.ur_emulator.script.port import Submitted

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
    assert world.controller.runtime.name == "STOPPED"
    world.upload()
    assert world.controller.now_s == pytest.approx(0.02)


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
    # An upload stops the running program at once.
    world.controller.submit(Submitted("other", "def other():\n  sleep(0.1)\nend"))
    assert not world.playing
    world.cycles(11)
    assert world.playing
    world.cycles(60)
    assert not world.playing


@pytest.mark.parametrize(
    ("body", "answer"),
    [
        ("if True:\n  sleep(1)\nend\nwrite_output_integer_register(0 +0, 2)", DONE),
        ("if True:\n  write_output_integer_register(0, 2)\nend", DONE),
        ("x = 1\nwrite_output_integer_register(0, x)", READY),
        ("x = 1", READY),
    ],
)
def test_the_end_of_a_program_that_cannot_be_read_is_signalled(world: World, body: str, answer: int) -> None:
    assert world.answer == READY
    world.controller.submit(Submitted("custom", f"def custom():\n{body}\nend"))
    world.cycles(30)
    assert not world.playing
    assert world.answer == answer
    assert "knows only calls" in world.controller.log[-1]


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
    # One cycle for the main loop to read it, one for the servo thread to take it, one to move.
    assert moved == 3


def test_servoj_follows_its_law_and_holds_the_last_target(world: World) -> None:
    for step in range(500):
        world.servo(shifted(0, 0.2 * step * 0.002))
        world.cycles(1)
    # Lag on a ramp: the lookahead, the cycle between, and half a cycle of holding.
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
    assert "no solution" in world.controller.log[-1]


@pytest.mark.parametrize(("lookahead_s", "gain"), [(0.02, 300.0), (0.3, 300.0), (0.1, 50.0), (0.1, 3000.0)])
def test_servoj_with_numbers_that_it_does_not_take_stops_the_program(
    world: World, lookahead_s: float, gain: float
) -> None:
    world.servo(START, lookahead_s=lookahead_s, gain=gain)
    world.cycles(3)
    assert not world.playing
    assert "servoj: lookahead_time" in world.controller.log[-1]


def test_speedl_goes_on_until_it_is_stopped(world: World) -> None:
    world.realtime(10, [*UP, 0.25, 0.0])
    world.seconds(1.0)
    assert world.vector("actual_TCP_speed")[:3] == pytest.approx(UP[:3], abs=1e-4)
    rise = world.vector("actual_TCP_pose")[2]
    world.seconds(1.0)
    # The client is silent, and the motion continues: 50 mm in the second.
    assert world.vector("actual_TCP_pose")[2] - rise == pytest.approx(0.05, abs=1e-4)
    world.call(15, [10.0])
    assert world.vector("actual_TCP_speed") == pytest.approx((0.0,) * 6, abs=1e-6)


def test_speedl_keeps_to_its_line(world: World) -> None:
    begin = world.vector("actual_TCP_pose")
    world.realtime(10, [0.05, 0.02, 0.03, 0.0, 0.0, 0.0, 0.5, 0.0])
    world.seconds(2.0)
    end = world.vector("actual_TCP_pose")
    travel = np.array(end[:3]) - begin[:3]
    line = np.array((0.05, 0.02, 0.03))
    across = travel - line * (travel @ line) / (line @ line)
    # The rates of each step are exact at its start: an error of the order of step² per step.
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
    assert "another thread is already controlling the robot" in world.controller.log[-1]


# ------------------------------------------------------------------------------------------------------------ moves


def test_movej_takes_speed_before_acceleration(world: World) -> None:
    # 0.5 rad at 1 rad/s and 2 rad/s² take a second.
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
    world.controller.inputs.write({"speed_slider_mask": 1, "speed_slider_fraction": 0.5})
    took = world.call(1, [*shifted(0, 0.5), 1.0, 2.0], [0])
    assert took * 0.002 == pytest.approx(2.0, abs=0.01)
    assert world.number("target_speed_fraction") == 0.5


def test_the_controller_slows_its_own_moves_to_the_limit_of_tool_speed() -> None:
    world = World(limits=SafetyLimits(tool_speed=0.25))
    world.call(1, [*shifted(0, 1.0), 2.0, 2.0], [0])
    assert world.controller.safety.mode.name == "NORMAL"
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
