"""Stops of the emulated controller, other scripts, the dashboard and the control line, in virtual time."""

import json

import pytest
from tests.ur.virtual import START, UP, World, lifted, shifted

from haptether.slave.ur_emulator import SafetyLimits
from haptether.slave.ur_emulator.dashboard import Dashboard
from haptether.slave.ur_emulator.script.port import ScriptReader, Submitted

# ------------------------------------------------------------------------------------------------------- the safety


def test_a_protective_stop_of_the_program(world: World) -> None:
    world.realtime(10, [*UP, 0.25, 0.0])
    world.seconds(0.5)
    world.write(31)
    world.cycles(1)
    assert not world.playing
    assert world.controller.safety.mode.name == "PROTECTIVE_STOP"
    assert world.number("safety_status_bits") == 1 << 2 | 1 << 10
    world.seconds(0.2)
    assert world.vector("target_qd") == (0.0,) * 6
    # Nothing starts before the unlock, which takes some time.
    assert not world.controller.submit(Submitted("x", "def x():\nend"))
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
    assert world.controller.safety.mode.name == "PROTECTIVE_STOP"
    assert world.controller.safety.reason.startswith(reason)


def test_a_target_that_jumps_is_a_protective_stop(world: World) -> None:
    world.servo(START)
    world.cycles(5)
    world.servo(shifted(2, 0.31))
    world.cycles(3)
    assert not world.playing
    assert world.controller.safety.reason == "C204 path sanity check: sudden change in target position"
    assert max(abs(a - b) for a, b in zip(world.vector("actual_q"), START, strict=True)) < 1e-3


def test_too_fast_a_tool_is_a_protective_stop() -> None:
    world = World(limits=SafetyLimits(tool_speed=0.1))
    world.realtime(10, [0.0, 0.0, 0.15, 0.0, 0.0, 0.0, 1.0, 0.0])
    world.seconds(0.5)
    assert world.controller.safety.reason.startswith("tool speed 0.1")
    assert world.vector("target_qd") == (0.0,) * 6


def test_a_push_beyond_the_motors_is_a_deviation_from_the_path() -> None:
    world = World(limits=SafetyLimits(tool_force_n=1e4, tool_speed=10.0))
    world.environment.push((0.0, 0.0, -600.0), 1.0)
    world.seconds(0.5)
    assert "away from its path" in world.controller.safety.reason


def test_the_end_of_a_joint_is_a_protective_stop(world: World) -> None:
    world.call(1, [*shifted(5, 6.2), 3.0, 3.0], [0])
    world.realtime(9, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 5.0, 0.0])
    world.seconds(1.0)
    assert world.controller.safety.reason.startswith("position of joint 6")


def test_the_same_seed_gives_the_same_noise() -> None:
    one, other = World(noise_n=1.0), World(noise_n=1.0)
    for world in (one, other):
        world.seconds(0.5)
    assert one.vector("actual_TCP_force") == other.vector("actual_TCP_force")
    assert any(one.vector("actual_TCP_force"))


def test_the_end_of_force_mode_lets_nothing_jump() -> None:
    # The servo target is 50 mm away along the compliant axis: the law must not wind up meanwhile.
    world = World()
    goal = lifted(world.vector("actual_TCP_pose"), 0.05)
    selection = [2, 0, 0, 1, 0, 0, 0]
    world.realtime(6, [*(0.0,) * 12, *(0.1,) * 6], selection)
    # Commands of this class get no acknowledgement: a write in the same cycle replaces the previous one.
    world.cycles(2)
    world.realtime(24, [*goal, 0.0, 0.0, 0.002, 0.1, 300.0])
    world.seconds(1.0)
    assert world.vector("actual_TCP_pose")[2] == pytest.approx(goal[2] - 0.05, abs=1e-3)
    world.controller.robot.end_force_mode()
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
    assert Dashboard(world.controller).answer(said) == (answer, True)


def test_the_dashboard_in_local_control_and_of_a_cb3() -> None:
    world = World(upload=False)
    world.controller.remote_control = False
    for line in ("play", "power off", "load rtde_control.urp", "unlock protective stop"):
        assert Dashboard(world.controller).answer(line)[0] == "Command is not allowed due to safety reasons"
    assert Dashboard(world.controller).answer("is in remote control")[0] == "false"
    assert Dashboard(world.controller).answer("quit") == ("Disconnected", False)
    cb3 = World("3.15", upload=False)
    assert Dashboard(cb3.controller).answer("is in remote control")[0].startswith("could not understand")


def test_a_program_on_the_disk_can_be_played() -> None:
    world = World(upload=False)
    dashboard = Dashboard(world.controller)
    dashboard.answer("load rtde_control.urp")
    assert dashboard.answer("play")[0] == "Starting program"
    world.seconds(0.1)
    assert world.playing
    assert world.call(40) >= 1


def test_power_comes_and_goes(world: World) -> None:
    dashboard = Dashboard(world.controller)
    dashboard.answer("power off")
    assert not world.playing
    assert world.controller.submit(Submitted("", "stopj(2)")) is False
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
        ("clamp", "must be a stiffness in N m/rad, and a damping"),
        ("clamp 1e4", "clamp: 1e4: must be between 0 and 1000"),
        ("clamp 10 -1", "must be between 0 and 1000"),
        ("freeze 0", "must be positive"),
        ("late", "must be 2 finite numbers"),
        ("late -1", "must be between 0 and 60 s"),
        ("drop all rtde", "must be all or some of"),
        ("refuse maybe", "must be on or off"),
        ("version five", "must be real, or like 5.8"),
        ("power", "must be on"),
        ("unlock", "unlock: is in no protective stop but in NORMAL"),
        ("release-emergency-stop", "is not pressed"),
        ("log x", "must be 1 finite number"),
        ("log 0", "log: 0: must be a whole number, 1 to 1000000"),
        ("log -1", "log: -1: must be a whole number"),
        ("log 2.5", "log: 2.5: must be a whole number"),
        ("log 1 2", "must be 1 finite number"),
        ("nonsense", "must be one of"),
        ("", "error: an empty line: must be one of anchor "),
    ],
)
def test_lines_that_are_refused_say_why(world: World, line: str, said: str) -> None:
    before = world.controller.runtime
    answer = world.line.answer(line, 0.0)
    assert answer.startswith("error: ")
    assert said in answer
    assert world.controller.runtime == before


def test_power_stays_off_in_an_emergency_stop(world: World) -> None:
    assert world.line.answer("emergency-stop", 0.0) == "ok"
    assert world.line.answer("power on", 0.0).startswith("error: power: is in ")
    assert world.line.answer("unlock", 0.0).startswith("error: unlock: is in no protective stop")
    assert world.line.answer("release-emergency-stop", 0.0) == "ok"
    assert world.line.answer("power on", 0.0) == "ok"


def test_the_log_shows_the_lines_that_are_asked_for(world: World) -> None:
    for number in range(30):
        world.controller.write_log(f"line {number}")
    for line, count in (("log", 20), ("log 1", 1), ("log 3", 3), ("log 1e3", len(world.controller.log))):
        shown = json.loads(world.line.answer(line, 0.0).removeprefix("ok "))
        assert shown == list(world.controller.log)[-count:], line


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
        ("stopj(2)", lambda w: not w.controller.log),
        ("movej([-1.5, -1.7, -2.2, -0.8, 1.6, 0.0], a=1.4, v=1.05)", lambda w: w.vector("actual_q")[0] == -1.5),
        ("set_tcp(p[0, 0, 0.1, 0, 0, 0])", lambda w: w.vector("tcp_offset")[2] == 0.1),
        ("set_standard_digital_out(2, True)", lambda w: w.number("actual_digital_output_bits") == 4),
        ("write_output_integer_register(0 + 12, 3*4)", lambda w: w.integer(12) == 12),
        ('textmsg("hello ", 5)', lambda w: w.controller.log[-1].endswith("hello 5")),
        ("protective_stop()", lambda w: w.controller.safety.mode.name == "PROTECTIVE_STOP"),
        ("__import__('os')", lambda w: "knows only calls" in w.controller.log[-1]),
        ("movej(", lambda w: "knows only calls" in w.controller.log[-1]),
        ("movej([1, 2])", lambda w: "must be six numbers" in w.controller.log[-1]),
        ("movej([9, 9, 9, 9, 9, 9])", lambda w: "beyond the limits" in w.controller.log[-1]),
        ("movej()", lambda w: "missing" in w.controller.log[-1]),
    ],
)
def test_single_lines_are_run_at_once(line: str, holds: object) -> None:
    world = World(upload=False)
    (submitted,) = ScriptReader().receive(f"{line}\n".encode())
    assert world.controller.submit(submitted)
    world.seconds(1.0)
    assert callable(holds)
    assert holds(world), world.controller.log
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
    assert list(reader.receive(b"def endless():\n" + b"  sync()\n" * 200_000)) == []
    with pytest.raises(ValueError, match="without an end"):
        list(reader.receive(b"  sync()\n" * 100_000))


def test_scripts_are_refused_in_local_control() -> None:
    world = World(upload=False)
    world.controller.remote_control = False
    assert not world.controller.submit(Submitted("", "stopj(2)"))
    assert "not in remote control" in world.controller.log[-1]
    cb3 = World("3.15", upload=False)
    cb3.controller.remote_control = False
    assert cb3.controller.submit(Submitted("", "stopj(2)"))


def test_a_secondary_program_runs_beside_the_one_that_runs(world: World) -> None:
    assert world.controller.submit(
        Submitted("beside", "sec beside():\n  set_digital_out(1, True)\nend", secondary=True)
    )
    world.cycles(1)
    assert world.playing
    assert world.number("actual_digital_output_bits") == 2
    assert world.controller.submit(Submitted("slow", "sec slow():\n  sleep(1)\nend", secondary=True))
    assert "must not take time" in world.controller.log[-1]
    assert world.playing
