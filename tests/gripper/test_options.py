"""Options of the driver `robotiq`, and its counts in SI units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.gripper.virtual import move, scale

from haptether.bridge import load_gripper
from haptether.slave import ROBOTIQ_MODELS, GripperCommand, RobotiqOptions
from haptether.slave.robotiq.models import Scale
from haptether.slave.robotiq.options import robotiq_options

HOST = {"host": "192.168.1.10"}


@pytest.mark.parametrize(
    ("given_", "said"),
    [
        ({}, "host is missing: must be the address of the UR controller"),
        (HOST | {"prot": 1}, "prot = 1: is no option: must be one of host, port, "),
        ({"host": "192.168.1.10:63352"}, "must be an IPv4 address or a name, without a port"),
        ({"host": "0.0.0.0"}, "host = '0.0.0.0': is the address of no peer"),
        ({"host": ""}, "host = '': must be an IPv4 address"),
        (HOST | {"port": 0}, "port = 0: must be 1 to 65535"),
        (HOST | {"model": "3f"}, "model = '3f': must be one of 2f-85, 2f-140, hand-e"),
        (HOST | {"slave_id": 256}, "slave_id = 256: must be 0 to 255"),
        (HOST | {"activate": "perhaps"}, "activate = 'perhaps': must be true or false"),
        (HOST | {"rate_hz": 101}, "rate_hz = 101: must be 1 to 100 Hz"),
        (HOST | {"rate_hz": math.nan}, "rate_hz = nan: must be finite"),
        (HOST | {"reply_timeout_s": 0.01}, "reply_timeout_s = 0.01: must be 0.05 to 2 s"),
        (HOST | {"open_count": 240}, "open_count = 240: the jaws are open at 240 and closed at 230"),
        (HOST | {"closed_count": 3}, "closed_count = 3: the jaws are open at 3 and closed at 3"),
    ],
)
def test_wrong_options_are_refused_by_name(given_: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match="gripper = robotiq: ") as refused:
        load_gripper("robotiq", given_)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_defaults_are_cautious() -> None:
    options = robotiq_options(HOST)
    assert options == RobotiqOptions(host="192.168.1.10")
    assert not options.activate
    assert (options.port, options.rate_hz) == (63352, 50.0)
    assert options.scale.counts == (3, 230)


def test_counts_of_other_fingers_are_options() -> None:
    counted = robotiq_options(HOST | {"open_count": "10", "closed_count": 110}).scale
    assert [counted.position(count) for count in (0, 10, 60, 110, 255)] == [0.0, 0.0, 0.5, 1.0, 1.0]


@pytest.mark.parametrize(
    ("model", "command", "counts"),
    [
        # The end positions are requested beyond those of the jaws, at 3 and 230.
        ("2f-85", move(0.0, 0.150 / 0.085, 235.0), (0, 255, 255)),
        ("2f-85", move(1.0, 0.020 / 0.085, 20.0), (255, 0, 0)),
        ("2f-85", move(0.5, 0.085 / 0.085, 127.5), (116, 127, 128)),
        # Values out of range saturate; the least force is not zero.
        ("2f-85", move(0.5, 100.0, 10_000.0), (116, 255, 255)),
        ("2f-85", move(0.5, 1e-6, 0.0), (116, 0, 0)),
        ("2f-140", move(0.25, 0.250 / 0.140, 67.5), (60, 255, 128)),
        ("hand-e", move(0.75, 0.085 / 0.050, 102.5), (173, 127, 128)),
    ],
)
def test_a_command_in_counts(model: str, command: GripperCommand, counts: tuple[int, int, int]) -> None:
    request = scale(model).request(command)
    assert tuple(request.values()) == pytest.approx(counts, abs=1)
    assert (request["POS"] in {0, 255}) == (counts[0] in {0, 255})


@given(
    st.sampled_from(sorted(ROBOTIQ_MODELS)),
    st.sets(st.integers(0, 255), min_size=2, max_size=2).map(sorted),
    st.builds(move, st.floats(0.0, 1.0), st.floats(1e-3, 100.0), st.floats(0.0, 10_000.0)),
)
def test_counts_go_there_and_back(name: str, counts: list[int], command: GripperCommand) -> None:
    opened, closed = counts
    model = ROBOTIQ_MODELS[name]
    of = Scale(model, (opened, closed))
    request = of.request(command)
    assert all(0 <= value <= 255 for value in request.values())
    # The error is at most half a count, except for end positions, which are requested beyond.
    assert abs(of.position(request["POS"]) - command.position) <= 0.5 / (closed - opened) + 1e-12
    low, high = model.force_n
    assert abs(of.force_n(request["FOR"]) - min(max(command.force_n, low), high)) <= 0.5 * (high - low) / 255 + 1e-9
