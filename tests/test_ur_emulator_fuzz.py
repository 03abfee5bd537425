"""Whatever is in registers, script or stream: the emulated controller goes on, and what it tells is finite."""

import math
from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st
from tests.ur.plain_rtde import frame
from tests.ur.virtual import START, World

from haptether.slave.ur_emulator.dashboard import Dashboard
from haptether.slave.ur_emulator.rtde_session import RtdeSession
from haptether.slave.ur_emulator.script_port import ScriptReader

WORLD: list[World] = []
"""One controller for all examples: each begins with a reset."""

numbers = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([0.0, 1.0, -1.0, 0.002, 0.1, 300.0, 1e-300, 1e300, *START]),
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

    return all(map(finite, of.of.outputs.values()))


def packed(of: World) -> bytes | None:
    """Every output there is, as RTDE sends it."""
    session = RtdeSession(
        99, 500.0, lambda: of.of.version, of.of.inputs, of.of.outputs, of.of.output_types, of.of.tell, protocol=1
    )
    names: list[str] = []
    for name in of.of.output_types:
        names.append(name)
        if sum(map(len, names)) + len(names) > 1900:
            break
    session.receive(frame("O", ",".join(names).encode()))
    session.receive(frame("S"))
    return session.package(10)


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


names = st.sampled_from(
    ["movej", "movel", "stopj", "stopl", "speedj", "speedl", "servoj", "sleep", "sync", "textmsg", "popup", "set_tcp",
     "set_payload", "zero_ftsensor", "set_digital_out", "set_tool_digital_out", "write_output_integer_register",
     "write_output_float_register", "protective_stop", "end_force_mode", "os"]
)  # fmt: skip
literals = st.one_of(
    numbers.map(repr),
    st.integers(-(10**30), 10**30).map(str),
    st.lists(numbers, min_size=5, max_size=7).map(repr),
    st.lists(numbers, min_size=6, max_size=6).map(lambda values: f"p{values!r}"),
    st.sampled_from(["True", "'text'", "1e999", "-1e999", "2 + 3", "1 / 0", "[]", "x", "a=1", "t=-1", "(", "None"]),
)


def lines(calls: Iterable[tuple[str, list[str]]]) -> str:
    return "".join(f"  {name}({', '.join(arguments)})\n" for name, arguments in calls)


@given(st.lists(st.tuples(names, st.lists(literals, max_size=4)), max_size=4), st.sampled_from(["def", "sec"]))
def test_whatever_the_script_says(calls: list[tuple[str, list[str]]], kind: str) -> None:
    of = world()
    for submitted in ScriptReader().receive(f"{kind} fuzz():\n{lines(calls)}end\n".encode()):
        of.of.submit(submitted)
    of.cycles(30)
    assert all_finite(of)
    assert packed(of)


@given(st.lists(st.binary(max_size=60), max_size=5))
def test_whatever_comes_on_the_other_ports(pieces: list[bytes]) -> None:
    of = world()
    reader, dashboard = ScriptReader(), Dashboard(of.of)
    for piece in pieces:
        for submitted in reader.receive(piece):
            of.of.submit(submitted)
        text = piece.decode("utf-8", "replace")
        assert dashboard.answer(text)[0]
        assert "\n" not in of.line.answer(text.replace("quit", ""), 0.0)
        of.cycles(2)
    assert all_finite(of)
