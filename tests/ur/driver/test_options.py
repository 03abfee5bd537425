"""Options of the UR driver: a refusal names its key."""

import math
from pathlib import Path

import pytest

from haptether.bridge import load_slave
from haptether.slave import WorkspacePlane
from haptether.slave.ur.kinematics.constraints import ToolCone
from haptether.slave.ur.kinematics.models import MAX_PAYLOAD_KG, UR_MODELS
from haptether.slave.ur.options import UrOptions, ur_options

HOST = {"host": "192.168.1.10"}


def test_every_arm_has_a_most_payload() -> None:
    assert MAX_PAYLOAD_KG.keys() == UR_MODELS.keys()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "host is missing"),
        (HOST | {"gian": 300}, "gian = 300: is no option: must be one of host, "),
        (HOST | {"gain": 99.9}, "gain = 99.9: must be 100 to 2000 1/s²"),
        (HOST | {"gain": 2001}, "gain = 2001: must be 100 to 2000 1/s²"),
        (HOST | {"lookahead_time": 0.02}, "lookahead_time = 0.02: must be 0.03 to 0.2 s"),
        (HOST | {"payload_kg": 40}, "payload_kg = 40.0: must be 0 to 5 kg: a ur5e carries no more"),
        (HOST | {"payload_kg": 500}, "payload_kg = 500: must be 0 to 50 kg"),
        (HOST | {"max_jump": 0}, "max_jump = 0: must be above 0 and at most 0.1 m"),
        (HOST | {"torque_share": 1}, "torque_share = 1: must be above 0 and at most 0.8"),
        (HOST | {"frequency": 300}, "frequency = 300: must be 125 or 500 Hz"),
        (HOST | {"mode": "movej"}, "mode = 'movej': must be one of servoj, servol, speedl, direct-torque"),
        (HOST | {"zero_ft_sensor": "maybe"}, "zero_ft_sensor = 'maybe': must be true or false"),
        (HOST | {"model": "ur6"}, "ur: model = 'ur6': must be one of ur3, ur5, ur10, ur3e, "),
        (HOST | {"max_speed": math.nan}, "max_speed = nan: must be finite"),
        (HOST | {"max_speed": "nan"}, "max_speed = 'nan': must be finite"),
        (HOST | {"axis": [1, 0, math.inf]}, "axis = [1, 0, inf]: must be finite"),
        (HOST | {"axis": [0, 0, 0]}, "axis = (0.0, 0.0, 0.0): must have a length"),
        (HOST | {"axis": [1, 0]}, "axis = [1, 0]: must be 3 numbers"),
        (HOST | {"axes": 2}, "axes = 2: must be 1 or 3"),
        (HOST | {"axes": "one"}, "axes = 'one': must be 1 or 3"),
        (HOST | {"tool": [0, 0, 150, 0, 0, 0]}, "tool = (0.0, 0.0, 150.0, 0.0, 0.0, 0.0): must be in m"),
        (HOST | {"payload_cog": [0, 0, 0.05]}, "payload_cog = (0.0, 0.0, 0.05): needs payload_kg"),
        (HOST | {"workspace": [[0, 0, 1]]}, "workspace = [[0, 0, 1]]: must be a list of 4 numbers each"),
        (HOST | {"workspace": [[0, 0, 0, 1]]}, "workspace = (0.0, 0.0, 0.0, 1.0): must have a normal"),
        (HOST | {"max_turn": 0}, "max_turn = 0: must be above 0 and at most 0.5 rad"),
        (HOST | {"max_angular_speed": 7}, "max_angular_speed = 7: must be above 0 and at most 6 rad/s"),
        (HOST | {"max_angular_acceleration": -1}, "must be above 0 and at most 50 rad/s²"),
        (HOST | {"tool_cone": [0, 0, -1]}, "tool_cone = [0, 0, -1]: must be 4 numbers"),
        (HOST | {"tool_cone": [0, 0, 0, 1]}, "tool_cone = (0.0, 0.0, 0.0, 1.0): must be an axis of some length and"),
        (HOST | {"tool_cone": [0, 0, -1, 3.2]}, "must be an axis of some length and 0.1 to below pi rad"),
        (HOST | {"tool_cone": [0, 0, -1, math.nan]}, "must be finite"),
        (HOST | {"model": "ur5", "force_source": "raw"}, "a ur5 has no sensor in its flange: must be tcp"),
        ({"host": "192.168.1.10:30004"}, "host = '192.168.1.10:30004': must be an IPv4 address or a name"),
        ({"host": ""}, "host = '': must be"),
        ({"host": "fe80::1"}, "host = 'fe80::1': must be an IPv4 address or a name, without a port"),
        *(
            ({"host": host}, f"host = '{host}': is the address of no peer")
            for host in (
                "0.0.0.0",
                "0",
                "0.0.0.7",
                "224.0.0.1",
                "255.255.255.255",
            )
        ),
        ({"host": 5}, "host = 5: must be a string"),
    ],
)
def test_wrong_options_are_refused_by_name(given: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match="device = ur") as refused:
        load_slave("ur", given)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "No such file or directory: must be a calibration.toml"),
        ("delta_theta = [0, 0", "device = ur: calibration = "),
        ("delta_alpha = [0.1, 0, 0, 0, 0, 0]", "delta_alpha"),
        ("", "is empty: must have one or more of delta_theta"),
    ],
)
def test_a_calibration_is_read_before_anything_is_connected(content: str | None, said: str, tmp_path: Path) -> None:
    file = tmp_path / "unit.toml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ValueError, match="device = ur: calibration = ") as refused:
        load_slave("ur", HOST | {"calibration": str(file)})
    assert said in str(refused.value)
    assert str(refused.value).count(str(file)) == 1


@pytest.mark.parametrize("key", UrOptions.__struct_fields__)
def test_each_option_says_what_it_may_be(key: str) -> None:
    # This value fits no option's type, not even as text.
    wrong = "" if key in {"host", "model"} else {"no": "such"}
    with pytest.raises(ValueError, match=rf"device = ur: {key} = .*: must be \w") as refused:
        ur_options(HOST | {key: wrong})
    assert "expected" not in str(refused.value).lower()


def test_numbers_come_as_a_scene_or_a_command_line_has_them() -> None:
    numbers = ur_options(HOST | {"axes": 3, "gain": 300, "frequency": 125, "workspace": [[0, 0, 2, 0.2]]})
    text = ur_options(HOST | {"axes": "3", "gain": "300", "frequency": "125", "workspace": [["0", 0, "2", 0.2]]})
    assert numbers == text
    assert (numbers.gain, numbers.frequency, numbers.workspace) == (300.0, 125, ((0.0, 0.0, 2.0, 0.2),))


def test_defaults_are_cautious() -> None:
    options = ur_options(HOST)
    assert options == UrOptions(host="192.168.1.10")
    # 250 mm/s: the speed of manual operation in ISO 10218-1.
    assert options.max_speed == 0.25
    assert options.zero_ft_sensor
    assert options.verify_watchdog
    assert ur_options(HOST | {"axis": [0, 3, 4]}).axis_unit == pytest.approx((0.0, 0.6, 0.8))


def test_the_planes_of_the_workspace_have_normals_of_length_1() -> None:
    (plane,) = ur_options(HOST | {"workspace": [[0, 0, 2, 0.2]]}).planes
    assert plane == WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=0.1)


def test_the_cone_of_the_tool_has_an_axis_of_length_1() -> None:
    assert ur_options(HOST).cone is None
    cone = ur_options(HOST | {"tool_cone": [0, 0, -2, 0.8]}).cone
    assert cone == ToolCone(axis=(0.0, 0.0, -1.0), half_angle=0.8)
