"""Commands and samples of a gripper: invalid numbers are refused where they enter."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.bridge import GRIPPERS, device_names, load_gripper
from haptether.slave import Gripper, GripperCommand, GripperSample

COMMAND = GripperCommand(position=0.5, speed=1.0, force_n=20.0)
SAMPLE = GripperSample(position=0.5, velocity=0.0, force_n=20.0, holds_object=True)
NEVER = (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize(
    ("key", "wrong", "right", "said"),
    [
        ("position", (-0.001, 1.001, *NEVER), (0.0, 1.0), "must be 0 (open) to 1 (closed)"),
        ("speed", (0.0, -1.0, 150.0, *NEVER), (1e-9, 100.0), "must be above 0 and at most 100 1/s"),
        ("force_n", (-0.1, 1e6, *NEVER), (0.0, 10_000.0), "must be 0 to 10000 N"),
    ],
)
def test_a_command_that_cannot_be_is_refused(
    key: str, wrong: tuple[float, ...], right: tuple[float, ...], said: str
) -> None:
    for value in wrong:
        with pytest.raises(ValueError, match=f"GripperCommand: {key} = ") as refused:
            replace(COMMAND, **{key: value})
        assert said in str(refused.value)
    for value in right:
        assert getattr(replace(COMMAND, **{key: value}), key) == value


@pytest.mark.parametrize(
    ("key", "wrong"),
    [("position", (-0.1, 1.1, *NEVER)), ("velocity", (101.0, -101.0, *NEVER)), ("force_n", (-1.0, 1e5, *NEVER))],
)
def test_a_sample_that_cannot_be_is_refused(key: str, wrong: tuple[float, ...]) -> None:
    for value in wrong:
        with pytest.raises(ValueError, match=f"GripperSample: {key} = "):
            replace(SAMPLE, **{key: value})  # type: ignore[arg-type]  # numbers all


@given(st.floats(), st.floats(), st.floats())
def test_whatever_numbers_come_those_that_stay_are_in_range(position: float, speed: float, force_n: float) -> None:
    try:
        command = GripperCommand(position=position, speed=speed, force_n=force_n)
    except ValueError:
        return
    assert 0.0 <= command.position <= 1.0
    assert 0.0 < command.speed <= 100.0
    assert 0.0 <= command.force_n <= 10_000.0


def test_a_gripper_is_found_by_its_name() -> None:
    assert "robotiq" in device_names(GRIPPERS)
    assert isinstance(load_gripper("robotiq", {"host": "192.168.1.10"}), Gripper)
    with pytest.raises(ValueError, match=r"no such driver \(haptether\.grippers\): did you mean robotiq\?"):
        load_gripper("robotic", {})
