"""Arbitrary registers, scripts and streams: the emulated controller goes on, and its outputs are finite."""

import math
import struct
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.ur.raw_rtde import frame
from tests.ur.virtual import START, World

from haptether.slave.ur_emulator.dashboard import Dashboard
from haptether.slave.ur_emulator.rtde.frames import FrameReader, FramingError
from haptether.slave.ur_emulator.script.calls import SIGNATURES
from haptether.slave.ur_emulator.script.port import ScriptReader

WORLD: list[World] = []
"""One controller for all examples: each begins with a reset."""

numbers = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([0.0, 1.0, -1.0, 0.002, 0.1, 300.0, 1e-300, 1e300, 1.7e308, -1.7e308, *START]),
    st.floats(-2.0, 2.0),
)
integers = st.one_of(st.integers(-(2**31), 2**31 - 1), st.integers(-2, 3))
commands = st.one_of(st.integers(0, 75), st.integers(-(2**31), 2**31 - 1))


def world(version: str = "5.26") -> World:
    if not WORLD:
        WORLD.append(World(version, scene="three_axis_box"))
    assert WORLD[0].line.answer("reset", 0.0) == "ok"
    return WORLD[0]


def all_finite(of: World) -> bool:
    def finite(value: object) -> bool:
        return all(map(finite, value)) if isinstance(value, tuple) else math.isfinite(value)  # type: ignore[arg-type]

    return all(map(finite, of.controller.outputs.values()))


def packed(of: World) -> bool:
    """Return true if RTDE can send every output."""
    for names in batched(of.controller.output_types, 60):
        session = of.rtde(protocol=1)
        session.receive(frame("O", ",".join(names).encode()))
        session.receive(frame("S"))
        if not session.package(10):
            return False
    return True


def batched(names: Iterable[str], count: int) -> Iterator[tuple[str, ...]]:
    left = iter(names)
    while part := tuple(islice(left, count)):
        yield part


def whole_frames(answer: bytes) -> list[tuple[int, bytes]]:
    """Return the frames of an answer; assert that nothing is left over."""
    reader = FrameReader()
    found = list(reader.frames(answer))
    assert sum(3 + len(payload) for _, payload in found) == len(answer)
    return found


arguments = st.tuples(commands, st.lists(numbers, min_size=18, max_size=18), st.lists(integers, min_size=7, max_size=7))


@given(st.lists(arguments, min_size=1, max_size=4))
def test_whatever_is_in_the_registers(writes: list[tuple[int, list[float], list[int]]]) -> None:
    of = world()
    of.upload()
    for command, doubles, ints in writes:
        of.write(command, doubles, ints)
        of.cycles(4)
        of.write(0)
        of.cycles(2)
    of.cycles(20)
    assert all_finite(of)
    assert packed(of)


names = st.sampled_from([*SIGNATURES, "os"])
literals = st.one_of(
    numbers.map(repr),
    st.integers(-(10**30), 10**30).map(str),
    st.lists(numbers, min_size=5, max_size=7).map(repr),
    st.lists(numbers, min_size=6, max_size=6).map(lambda values: f"p{values!r}"),
    st.lists(numbers, max_size=4).map(repr),
    st.sampled_from(
        ["True", "'text'", "1e999", "-1e999", "2 + 3", "1 / 0", "[]", "x", "a=1", "t=-1", "(", "None", "[1, 2]", "p[]",
         "[1e999, 0, 0]", "p[1e999, 0, 0, 0, 0, 0]",
         "[[1], 2, 3]", "['a', 'b', 'c']", "[True, 1, 1]", "m=1", "m=[1, 2]",
         "cog=[1, 2]", "cog=[1.7e308, 1.7e308, 1.7e308]", "1.7e308 + 1.7e308", "1.7e308 * 10", "'a' * 9",
         "[1] * 9",
         "**x", "*[1]", "9" * 400, "1" + "+1" * 900,
         "-" * 900 + "1", "[" * 150 + "]" * 150, "{1: 2}", "1j", "b''", "...",
         r"'\ud800'", r"'\udfff' + 1", r"tcp_name='\udc80'", r"'\x1b[31m'"]
    ),
)  # fmt: skip


def lines(calls: Iterable[tuple[str, list[str]]]) -> str:
    return "".join(f"  {name}({', '.join(arguments)})\n" for name, arguments in calls)


@given(st.lists(st.tuples(names, st.lists(literals, max_size=4)), max_size=4), st.sampled_from(["def", "sec"]))
def test_whatever_the_script_says(calls: list[tuple[str, list[str]]], kind: str) -> None:
    of = world()
    for submitted in ScriptReader().receive(f"{kind} fuzz():\n{lines(calls)}end\n".encode()):
        of.controller.submit(submitted)
    of.cycles(30)
    assert all_finite(of)
    assert packed(of)


@given(st.lists(st.binary(max_size=60), max_size=5))
def test_whatever_comes_on_the_other_ports(pieces: list[bytes]) -> None:
    of = world()
    reader, dashboard = ScriptReader(), Dashboard(of.controller)
    for piece in pieces:
        for submitted in reader.receive(piece):
            of.controller.submit(submitted)
        text = piece.decode("utf-8", "replace")
        assert dashboard.answer(text)[0]
        assert "\n" not in of.line.answer(text.replace("quit", ""), 0.0)
        of.cycles(2)
    assert all_finite(of)


WRONG = (
    "1e999",
    "-1e999",
    "'a'",
    "[1, 2]",
    "[1e999, 0, 0]",
    "p[0, 0, 0, 0, 0, 1e999]",
    "True",
    "None",
    "[]",
    "1.7e308",
    r"'\ud800'",
)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", SIGNATURES)
def test_every_function_with_every_number_of_arguments(name: str) -> None:
    of = world()
    for count in range(len(SIGNATURES[name].kinds) + 2):
        for value in (*WRONG, "1", repr(list(START)), f"p{list(START)!r}"):
            for submitted in ScriptReader().receive(f"{name}({', '.join([value] * count)})\n".encode()):
                of.controller.submit(submitted)
            of.cycles(14)
            assert all_finite(of), (name, count, value)
    assert packed(of)


name_lists = st.one_of(
    st.binary(max_size=300),
    st.tuples(
        st.sampled_from([b"x,", b",", b"input_int_register_0,", b"actual_q,", b"\xff,"]), st.integers(0, 20_000)
    ).map(lambda of: (of[0] * of[1])[:65_500]),
)
requests = st.one_of(
    st.tuples(st.sampled_from("VvMUOISP"), st.binary(max_size=40)),
    st.tuples(
        st.sampled_from("O"), st.tuples(st.floats(), name_lists).map(lambda of: struct.pack(">d", of[0]) + of[1])
    ),
    st.tuples(st.sampled_from("IO"), name_lists),
    st.tuples(st.characters(max_codepoint=255), st.binary(max_size=10)),
)


@given(st.lists(requests, max_size=5), st.sampled_from([1, 2]), st.integers(1, 64))
def test_whatever_an_rtde_client_asks(sequence: list[tuple[str, bytes]], protocol: int, piece: int) -> None:
    of = world()
    session = of.rtde(protocol)
    stream = b"".join(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload for kind, payload in sequence)
    for begin in range(0, len(stream), 1009 * piece):
        whole_frames(session.receive(stream[begin : begin + 1009 * piece]))
    of.cycles(2)
    assert all_finite(of)
    session.close()


@given(st.lists(numbers, min_size=6, max_size=6))
def test_whatever_a_clients_sensor_measures(wrench: list[float]) -> None:
    of = world()
    of.upload()
    of.controller.setup.external_sensor = True
    of.controller.inputs.write({"external_force_torque": tuple(wrench)})
    of.cycles(5)
    assert all_finite(of)


@given(st.binary(max_size=200))
def test_what_is_no_frame_ends_the_connection_and_nothing_else(stream: bytes) -> None:
    session = world().rtde()
    try:
        whole_frames(session.receive(stream))
    except FramingError:
        session.close()


def test_a_list_of_names_that_is_too_long_gets_no_types() -> None:
    of = world()
    session = of.rtde()
    names = b",".join([b"x"] * 7000)
    assert session.receive(frame("O", struct.pack(">d", 125.0) + names)) == frame("O", b"\x00")
    assert session.receive(frame("I", names)) == frame("I", b"\x00")
    assert of.rtde(1).receive(frame("O", names)) == frame("O")
    # The longest permitted list has a full answer.
    known: Any = session.receive(frame("O", struct.pack(">d", 125.0) + b",".join([b"actual_q"] * 227)))
    assert known[3:4] == b"\x01"
