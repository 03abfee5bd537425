"""Options of the UR driver: what is refused names its key."""

import math

import pytest

from haptether.bridge import load_slave
from haptether.slave.ur_options import UrOptions, ur_options

HOST = {"host": "192.168.1.10"}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "host is missing"),
        (HOST | {"gian": 300}, "gian = 300: is no option: must be one of host, "),
        (HOST | {"gain": 99.9}, "gain = 99.9: expected float >= 100.0"),
        (HOST | {"gain": 2001}, "gain = 2001: expected float <= 2000.0"),
        (HOST | {"lookahead_time": 0.02}, "lookahead_time = 0.02: expected float >= 0.03"),
        (HOST | {"frequency": 250}, "frequency = 250: "),
        (HOST | {"mode": "movej"}, "mode = 'movej': invalid enum value"),
        (HOST | {"model": "ur6"}, "model = 'ur6': "),
        (HOST | {"max_speed": math.nan}, "max_speed = nan: must be finite"),
        (HOST | {"max_speed": "nan"}, "max_speed = 'nan': must be finite"),
        (HOST | {"axis": [1, 0, math.inf]}, "axis = [1, 0, inf]: must be finite"),
        (HOST | {"axis": [0, 0, 0]}, "axis = (0.0, 0.0, 0.0): must have a length"),
        (HOST | {"axis": [1, 0]}, "axis = [1, 0]: "),
        (HOST | {"axes": 2}, "axes = 2: must be 1 (along axis) or 3"),
        (HOST | {"axes": "one"}, "axes = 'one': "),
        (HOST | {"tool": [0, 0, 150, 0, 0, 0]}, "must be in m"),
        (HOST | {"payload_cog": [0, 0, 0.05]}, "payload_cog = (0.0, 0.0, 0.05): needs payload_kg"),
        (HOST | {"workspace": [[0, 0, 0, 1]]}, "workspace = (0.0, 0.0, 0.0, 1.0): must have a normal"),
        (HOST | {"model": "ur5", "force_source": "raw"}, "a ur5 has no sensor in its flange: must be tcp"),
        ({"host": "192.168.1.10:30004"}, "host = '192.168.1.10:30004': must be an IPv4 address or a name"),
        ({"host": ""}, "host = '': must be"),
        ({"host": 5}, "host = 5: "),
    ],
)
def test_wrong_options_are_refused_by_name(given: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match="device = ur") as refused:
        load_slave("ur", given)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_numbers_come_as_a_scene_or_a_command_line_has_them() -> None:
    plain = ur_options(HOST | {"axes": 3, "gain": 300, "frequency": 125, "workspace": [[0, 0, 2, 0.2]]})
    text = ur_options(HOST | {"axes": "3", "gain": "300", "frequency": "125", "workspace": [["0", 0, "2", 0.2]]})
    assert plain == text
    assert (plain.gain, plain.frequency, plain.workspace) == (300.0, 125, ((0.0, 0.0, 2.0, 0.2),))


def test_defaults_are_cautious() -> None:
    options = ur_options(HOST)
    assert options == UrOptions(host="192.168.1.10")
    # 250 mm/s: the speed of manual operation in ISO 10218-1.
    assert options.max_speed == 0.25
    assert options.zero_ft_sensor
    assert options.verify_watchdog
    assert ur_options(HOST | {"axis": [0, 3, 4]}).axis_unit == pytest.approx((0.0, 0.6, 0.8))
