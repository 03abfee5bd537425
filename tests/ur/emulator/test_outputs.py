"""RTDE outputs of the emulated controller: every output of the guide is served or documented as missing."""

import math
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from tests.ur.virtual import START, UP, World

from haptether.slave import ur_model
from haptether.slave.ur.kinematics.chain import DhRows, chain_transform, dh_rows
from haptether.slave.ur_emulator import ControllerVersion, SafetyLimits
from haptether.slave.ur_emulator.connections import SCRIPT, PeerFactory
from haptether.slave.ur_emulator.dashboard import Dashboard
from haptether.slave.ur_emulator.robot.kinematics import ArmKinematics
from haptether.slave.ur_emulator.rtde.variables import outputs_of

DOCUMENT = Path(__file__).parents[3] / "docs" / "ur_emulator.md"
GUIDE = """
timestamp target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
actual_current_window actual_current_as_torque joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force
target_TCP_pose target_TCP_speed tcp_offset actual_TCP_acceleration target_TCP_acceleration actual_digital_input_bits
actual_configurable_digital_input_bits joint_temperatures actual_execution_time target_execution_time robot_mode
joint_mode safety_mode safety_status actual_tool_accelerometer speed_scaling target_speed_fraction actual_momentum
actual_main_voltage actual_robot_voltage actual_robot_current actual_joint_voltage actual_digital_output_bits
actual_configurable_digital_output_bits runtime_state elbow_position elbow_velocity robot_status_bits
safety_status_bits analog_io_types standard_analog_input0 standard_analog_input1 standard_analog_output0
standard_analog_output1 io_current output_bit_registers0_to_31 output_bit_registers32_to_63 input_bit_registers0_to_31
input_bit_registers32_to_63 actual_robot_energy_consumed actual_robot_braking_energy_dissipated encoder0_raw
encoder1_raw euromap67_input_bits euromap67_output_bits euromap67_24V_voltage euromap67_24V_current tool_mode
tool_analog_input_types tool_analog_input0 tool_analog_input1 tool_output_voltage tool_output_current tool_temperature
tool_output_mode tool_digital_output0_mode tool_digital_output1_mode tcp_force_scalar joint_position_deviation_ratio
collision_detection_ratio ft_raw_wrench wrench_calc_from_currents payload payload_cog payload_inertia
script_control_line time_scale_source target_gravity target_base_acceleration control_step target_base_wrench
"""
"""Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", robot controller outputs, software 5.23."""
REGISTERS = {
    f"{direction}_{kind}_register_{number}"
    for direction in ("input", "output")
    for kind, numbers in (("bit", range(64, 128)), ("int", range(48)), ("double", range(48)))
    for number in numbers
}
NEWEST = ControllerVersion.parsed("5.26")


def named_in_the_document(begin: str) -> set[str]:
    """Return the names in a sentence of the document."""
    (names,) = re.findall(rf"{begin}: (.*?)\.\n", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    return set(re.findall(r"`(\w+)`", names))


MISSING = named_in_the_document(r"Not served \(`NOT_FOUND`\)")
ZERO = named_in_the_document("Served, and always 0")


def test_every_output_of_the_guide_is_served_or_missing() -> None:
    assert set(outputs_of(NEWEST)) | MISSING == set(GUIDE.split()) | REGISTERS
    assert not set(outputs_of(NEWEST)) & MISSING
    assert set(outputs_of(NEWEST)) > ZERO


def test_what_is_said_to_stay_0_does_and_all_else_does_not() -> None:
    world = World("5.26", scene="three_axis_box", noise_n=0.1, tcp=(0.0, 0.01, 0.1, 0.2, 0.0, 0.0))
    seen: set[str] = set()
    world.controller.setup.set_payload(1.0, (0.0, 0.0, 0.1))
    world.controller.setup.payload_inertia = (0.1,) * 6
    world.controller.inputs.write({
        "speed_slider_mask": 1, "speed_slider_fraction": 0.9, "standard_digital_output_mask": 1,
        "standard_digital_output": 1, "standard_analog_output_mask": 3, "standard_analog_output_0": 0.5,
        "standard_analog_output_1": 0.5, "standard_analog_output_type": 1, "input_bit_registers0_to_31": 5,
        "input_bit_registers32_to_63": 6,
    })  # fmt: skip
    world.realtime(10, [*UP, 0.5, 0.1])
    for _ in range(60):
        world.cycles(1)
        for name, value in world.controller.outputs.items():
            if any(value) if isinstance(value, tuple) else value:
                seen.add(name)
    assert not seen & ZERO
    named = {name for name in outputs_of(NEWEST) if name not in REGISTERS}
    assert named - seen == ZERO


def test_inputs_can_be_read_back() -> None:
    world = World("5.11", upload=False)
    world.controller.inputs.write(
        {"input_int_register_47": -3, "input_double_register_0": 2.5, "input_bit_register_127": True}
    )
    world.cycles(1)
    outputs = world.controller.outputs
    assert outputs["input_int_register_47"] == -3
    assert outputs["input_double_register_0"] == 2.5
    assert outputs["input_bit_register_127"] is True
    world.cycles(5)
    assert outputs["input_int_register_47"] == -3


@pytest.mark.parametrize("name", ["ur3", "ur5e", "ur10e", "ur20"])
def test_the_elbow_is_the_end_of_the_upper_arm(name: str) -> None:
    arm, rows = ArmKinematics(ur_model(name)), dh_rows(ur_model(name))
    two = DhRows(*(tuple(of[:2]) for of in (rows.theta, rows.a, rows.d, rows.alpha)))  # type: ignore[arg-type]  # two of six
    random = np.random.default_rng(7)
    for _ in range(50):
        q, qd = random.uniform(-6.0, 6.0, (2, 6))
        at, velocity = arm.elbow(tuple(q.tolist()), tuple(qd.tolist()))
        assert at == pytest.approx(chain_transform(two, q[:2].tolist())[:3, 3], abs=1e-12)
        # The upper arm keeps its length.
        assert math.dist(at, (0.0, 0.0, rows.d[0])) == pytest.approx(math.hypot(rows.a[1], rows.d[1]))
        step = 1e-6
        ahead, behind = (arm.elbow(tuple((q + sign * step * qd).tolist()), (0.0,) * 6)[0] for sign in (1.0, -1.0))
        assert velocity == pytest.approx([(a - b) / (2.0 * step) for a, b in zip(ahead, behind, strict=True)], abs=1e-7)


def test_the_elbow_in_the_stream_is_that_of_the_arm() -> None:
    world = World()
    world.realtime(10, [*UP, 0.5, 0.1])
    places = []
    for _ in range(200):
        world.cycles(1)
        places.append((world.controller.outputs["elbow_position"], world.controller.outputs["elbow_velocity"]))
    (before, _), (_, velocity), (after, _) = places[-3:]
    rate = (np.array(after) - np.array(before)) / 0.004
    assert np.linalg.norm(rate) > 0.005
    assert velocity == pytest.approx(rate.tolist(), abs=1e-4)


def test_accelerations_of_the_tool_are_those_of_its_velocities() -> None:
    world = World()
    world.realtime(10, [*UP, 0.5, 0.1])
    world.cycles(20)
    # speedl at 0.5 m/s² along z.
    assert world.controller.outputs["target_TCP_acceleration"] == pytest.approx(
        (0.0, 0.0, 0.5, 0.0, 0.0, 0.0), abs=0.02
    )
    assert world.controller.outputs["actual_TCP_acceleration"] == pytest.approx(
        (0.0, 0.0, 0.5, 0.0, 0.0, 0.0), abs=0.02
    )


@pytest.mark.parametrize("slider", [1.0, 0.4, 0.0])
def test_the_slider_is_reported_once(slider: float) -> None:
    world = World()
    world.controller.client_settings.slider = slider
    world.cycles(3)
    # Clients multiply both.
    assert world.controller.outputs["speed_scaling"] == 1.0
    assert world.controller.outputs["target_speed_fraction"] == slider


def test_the_limiter_is_reported_beside_the_slider() -> None:
    world = World(limits=SafetyLimits(tool_speed=0.5))
    world.controller.client_settings.slider = 0.8
    world.cycles(1)
    q = (START[0] + 1.5, *START[1:])
    world.realtime(1, [*q, 3.1, 3.0], [1])
    shares: list[float] = []
    for _ in range(400):
        world.cycles(1)
        scaling, fraction = (world.controller.outputs[name] for name in ("speed_scaling", "target_speed_fraction"))
        assert scaling * fraction == pytest.approx(world.controller.robot.speed_scaling)  # type: ignore[operator]
        assert isinstance(scaling, float)
        shares.append(scaling)
    # 3.1 rad/s at 0.4 m and more from the base exceeds the limit.
    assert min(shares) < 0.95


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("load installation default.installation", "Loading installation: default.installation"),
        ("load installation other.installation", "File not found: other.installation"),
        ("saveLog", "Log saved to disk"),
        ("generate flight report system", r"Flight Report generated with id: \d+"),
        ("generate flight report", "Error: .*"),
        ("generate flight report all", "Error: .*"),
        ("generate support file /tmp", r"Completed successfully: ur_\d+_[-_\d]+\.zip"),
        ("set operational mode manual", "Operational mode manual is set"),
        ("set operational mode AUTOMATIC", "Operational mode AUTOMATIC is set"),
        ("set operational mode other", "Failed setting operational mode: other"),
        (
            "clear operational mode",
            r"No longer controlling the operational mode\. Current operational mode: 'AUTOMATIC'\.",
        ),
        ("version", r"5\.11\.0\.0"),
    ],
)  # fmt: skip
def test_the_dashboard_answers_as_universal_robots_own_client_expects(line: str, answer: str) -> None:
    said, stays = Dashboard(World("5.11", upload=False).controller).answer(line)
    assert re.fullmatch(answer, said), said
    assert stays


def test_the_operational_mode_is_kept_until_it_is_cleared() -> None:
    world = World(upload=False)
    dashboard = Dashboard(world.controller)
    for mode in ("manual", "automatic"):
        dashboard.answer(f"set operational mode {mode}")
        assert dashboard.answer("get operational mode")[0] == mode.upper()
    dashboard.answer("set operational mode manual")
    dashboard.answer("clear operational mode")
    assert dashboard.answer("get operational mode")[0] == "AUTOMATIC"


def test_after_load_the_state_has_the_name_of_the_file() -> None:
    world = World()
    dashboard = Dashboard(world.controller)
    dashboard.answer("stop")
    assert dashboard.answer("load /programs/rtde_control.urp")[0] == "Loading program: /programs/rtde_control.urp"
    assert dashboard.answer("programState")[0] == "STOPPED rtde_control.urp"


def robot_message(packed: bytes) -> tuple[int, int, str]:
    """Return type of the frame, type of the message, and its text."""
    size, kind, _, _, of, _, _ = struct.unpack_from(">iBQbbii", packed)
    assert size == len(packed)
    return kind, of, packed[23:].decode()


@pytest.mark.parametrize("port", [30001, 30002, 30003])
@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("nonsense(1)\n", "knows only calls"),
        ("set_payload(1,[1,2])\n", "set_payload: cog = .*: must be three numbers"),
        ("def late():\n  sleep(0.05)\n  set_payload(1000)\nend\n", "late: set_payload: m = 1000"),
        ("sec slow():\n  sleep(1)\nend\n", "slow: a secondary program must not take time"),
        ("def far():\n  movej(p[9,9,9,0,0,0])\nend\n", "far: .*"),
    ],
)
def test_who_sent_a_script_receives_what_stopped_it(port: int, script: str, said: str) -> None:
    world = World(upload=False)
    reception = PeerFactory(world.controller)
    sender, other = reception.peer(port), reception.peer(port)
    assert sender.kind == SCRIPT
    sender.receive(script.encode())
    world.cycles(80)
    package = sender.package(1)
    assert package is not None
    kind, of, text = robot_message(package)
    assert (kind, of) == (20, 10)
    assert re.search(said, text), text
    assert sender.package(1) is None
    assert other.package(1) is None


def test_a_script_that_is_refused_is_reported() -> None:
    world = World(upload=False)
    world.controller.remote_control = False
    sender = PeerFactory(world.controller).peer(30002)
    sender.receive(b"stopj(2)\n")
    package = sender.package(1)
    assert package is not None
    assert "not in remote control" in robot_message(package)[2]
