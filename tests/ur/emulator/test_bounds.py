"""Costs of a client for the emulated controller: time of its control cycle, and memory."""

import contextlib
import socket
import struct
import time
import warnings
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from tests.ur.emulated import Emulated, emulator
from tests.ur.raw_rtde import frame
from tests.ur.stalls import anew_after_stalls
from tests.ur.virtual import World

from haptether.slave.ur_emulator.connections import PeerFactory
from haptether.slave.ur_emulator.controller import LOG_LINES, MAX_LOG_LINE
from haptether.slave.ur_emulator.rtde.session import MAX_INPUT_FIELDS
from haptether.slave.ur_emulator.script.calls import CALLS_PER_CYCLE, MAX_CALLS
from haptether.slave.ur_emulator.script.control_script import CONTROL_SCRIPT, MAX_WAYPOINTS, recognised
from haptether.slave.ur_emulator.script.port import (
    HEAD,
    MAX_TEXT,
    ScriptBudget,
    ScriptReader,
    Submitted,
    runtime_exception,
)
from haptether.slave.ur_emulator.script.program import ScriptError

pytestmark = pytest.mark.live


FLOOD_S = 1.0
CLIENTS = 8
LATE_S = 0.05
"""Largest lateness in s of a control cycle under a flood; answering all requests at once made it 0.14 to 4.5 s."""
MORE_MB = 40.0
"""Memory in MB that no client may make the controller allocate."""
DASHBOARD, RTDE, SCRIPT, GRIPPER = 29999, 30004, 30002, 63352


@pytest.fixture
def running() -> Iterator[Emulated]:
    with emulator() as emulated:
        yield emulated


def memory_mb(emulated: Emulated, key: str = "VmHWM") -> float:
    """Return the peak resident memory of the process in MB."""
    status = Path(f"/proc/{emulated.process.pid}/status").read_text(encoding="ascii")
    (line,) = [line for line in status.splitlines() if line.startswith(f"{key}:")]
    return int(line.split()[1]) / 1024.0


def flood(host: str, port: int, content: bytes, *, reads: bool) -> None:
    """Send as much as the server accepts."""
    connections = [socket.create_connection((host, port), 5.0) for _ in range(CLIENTS)]
    try:
        for connection in connections:
            connection.setblocking(False)
        end_s = time.monotonic() + FLOOD_S
        while time.monotonic() < end_s:
            for connection in connections:
                try:
                    # A message may be cut anywhere: a client may also send nonsense.
                    connection.send(content)
                    if reads:
                        connection.recv(1 << 16)
                except BlockingIOError:
                    time.sleep(1e-4)
                except OSError:
                    return
    finally:
        for connection in connections:
            connection.close()


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("port", "request_", "reads"),
    [
        (DASHBOARD, b"x\n", True), (DASHBOARD, b"get loaded program\n", True), (DASHBOARD, b"x\n", False),
        (RTDE, frame("v"), True), (RTDE, frame("v"), False), (RTDE, frame("O", bytes(8) + b"x," * 1000), True),
        (SCRIPT, b"x\n", True), (SCRIPT, b"sec x():\nend\n", True),
        (GRIPPER, b"GET POS\n", True), (GRIPPER, b"SET POS 9\n", False), (GRIPPER, b"x", True), (GRIPPER, b"\n", True),
    ],
)  # fmt: skip
def test_no_flood_of_requests_holds_the_control_cycle_up(port: int, request_: bytes, reads: bool) -> None:
    content = request_ * (65536 // len(request_))

    @anew_after_stalls
    def flooded() -> None:
        with emulator("--gripper", "2f-85") as running:
            before_mb = memory_mb(running)
            running.do("forget-lateness")
            flood(running.host, port, content, reads=reads)
            status = running.status()
            assert status["worst_late_s"] < LATE_S
            assert status["lost_s"] == 0.0
            assert memory_mb(running) < before_mb + MORE_MB

    flooded()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "line",
    ["set_payload(1,[1,2])", "set_payload(1,[1e999,0,0])", 'textmsg("a"*700000000)', "set_tcp(p[1e999,0,0,0,0,0])",
     f"textmsg({'+'.join(['1'] * 400_000)})", "def x():\n" + "  sync()\n" * 150_000 + "end"],
    ids=["three numbers", "finite", "long text", "finite pose", "long sum", "many calls"],
)  # fmt: skip
def test_no_script_costs_memory_or_the_process(running: Emulated, line: str) -> None:
    before_mb = memory_mb(running)
    with socket.create_connection((running.host, SCRIPT), 5.0) as client:
        client.sendall(f"{line}\n".encode())
        end_s = time.monotonic() + 20.0
        while not any("must be" in said or "knows only" in said or "more than" in said or "characters" in said
                      for said in running.do("log 5").split('", "')):  # fmt: skip
            assert time.monotonic() < end_s, running.do("log 5")
            time.sleep(0.05)
    assert memory_mb(running) < before_mb + MORE_MB


UNENCODABLE = r'set_payload("\ud800")', r'set_tcp("\udfff")', r'textmsg("\udc80")', r'set_payload(1, x="\ud800")'


@pytest.mark.parametrize("line", UNENCODABLE)
def test_text_that_utf8_has_not_is_refused(line: str) -> None:
    world = World(upload=False)
    peer = PeerFactory(world.controller).peer(SCRIPT)
    for form in (line, f"def x():\n  {line}\nend"):
        peer.receive(f"{form}\n".encode())
        message = None
        for _ in range(30):
            world.cycles(1)
            message = message or peer.package(1)
        assert message is not None
        assert b"literal, finite arguments" in message
        assert struct.unpack_from(">i", message)[0] == len(message)
    assert not any(character in "".join(world.controller.log) for character in "\ud800\udfff\udc80")


def test_no_text_script_ends_the_process(running: Emulated) -> None:
    with socket.create_connection((running.host, SCRIPT), 5.0) as client:
        client.sendall("".join(f"{line}\n" for line in UNENCODABLE).encode())
        client.settimeout(10.0)
        assert b"literal, finite arguments" in client.recv(4096)
    assert running.status()["runtime_state"] == "STOPPED"


@pytest.mark.parametrize("text", ["\ud800" * 2000, "\u20ac" * 2000, "a" * 5000, "", "a\udfff\x1b"])
def test_messages_hold_whole_characters_of_any_text(text: str) -> None:
    escaped = text.encode("utf-8", "backslashreplace").decode()
    message = runtime_exception(text, 1.0)
    assert struct.unpack_from(">i", message)[0] == len(message) <= HEAD.size + MAX_TEXT
    assert escaped.startswith(message[HEAD.size :].decode())
    assert len(message) > HEAD.size + min(MAX_TEXT, len(escaped.encode())) - 4


def test_what_a_client_writes_is_no_command_to_the_screen() -> None:
    world = World(upload=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Python warns about the unknown escape, and repeats it in the warning.
        world.controller.submit(Submitted("", 'textmsg("\\\x1b[31m")'))
        world.cycles(30)
    assert "textmsg: " in world.controller.log[-1]


def test_a_version_that_no_client_could_be_sent_is_refused() -> None:
    world = World(upload=False)
    for text in ("5.99999999999", "5.\u00b2", f"5.{'9' * 5000}"):
        assert world.line.answer(f"version {text}", 0.0).startswith("error: version: must be")
    assert world.line.answer("version 5.9.999999999", 0.0) == "ok"
    assert world.rtde().receive(frame("v")) == frame("v", struct.pack(">4I", 5, 9, 999_999_999, 0))


def test_scripts_without_an_end_share_what_they_may_hold(running: Emulated) -> None:
    before_mb = memory_mb(running)
    clients = []
    for number in range(30):
        client = socket.create_connection((running.host, SCRIPT), 10.0)
        clients.append(client)
        try:
            client.sendall(f"def x{number}():\n".encode() + b"  sync()\n" * 200_000)
        except OSError:
            # It is cut off: the other connections hold all the memory.
            continue
    running.wait_for("runtime_state", "STOPPED")
    assert memory_mb(running) < before_mb + MORE_MB
    for client in clients:
        client.close()


def test_what_a_connection_held_is_free_with_its_end() -> None:
    held = ScriptBudget(100)
    first, second = ScriptReader(held), ScriptReader(held)
    assert list(first.receive(b"def a():\n" + b"  sync()\n" * 5)) == []
    assert held.bytes == 54
    with pytest.raises(ValueError, match="at most 100 together"):
        list(second.receive(b"def b():\n" + b"  sync()\n" * 10))
    second.clear()
    assert held.bytes == 54
    (program,) = first.receive(b"end\n")
    assert program.name == "a"
    assert held.bytes == 0


def test_the_log_keeps_no_long_texts() -> None:
    world = World(upload=False)
    for _ in range(LOG_LINES + 10):
        world.controller.write_log("a" * 1_000_000)
    assert sum(map(len, world.controller.log)) < LOG_LINES * (MAX_LOG_LINE + 20)


def test_a_connection_keeps_no_more_fields_than_it_may() -> None:
    world = World(upload=False)
    session = world.rtde()
    numbers = [session.receive(frame("I", b",".join([b"input_int_register_1"] * 97)))[3] for _ in range(255)]
    taken = sum(number > 0 for number in numbers)
    assert 97 * taken <= MAX_INPUT_FIELDS < 97 * (taken + 1)
    assert all(new > old for old, new in pairwise(numbers[:taken]))


def test_a_long_program_is_read_a_few_calls_in_each_cycle() -> None:
    world = World(upload=False)
    calls = 20 * CALLS_PER_CYCLE
    assert world.controller.submit(Submitted("long", "def long():\n" + "  sync()\n" * calls + "end"))
    begun = world.controller.cycles
    world.until(lambda: world.controller.program_name == "long")
    # A start takes 10 cycles after the last line, for any length.
    assert world.controller.cycles - begun >= 10 + calls // CALLS_PER_CYCLE
    assert world.controller.submit(Submitted("longer", "def longer():\n" + "  sync()\n" * (MAX_CALLS + 1) + "end"))
    world.cycles(MAX_CALLS // CALLS_PER_CYCLE + 20)
    assert f"more than {MAX_CALLS} calls" in world.controller.log[-1]


@pytest.mark.parametrize(
    "inside",
    ["\n" * 500_000, "def exec_move_path():\n" * 40_000, "  # int register offset\n" * 40_000,
     "# int register offset" + " " * 500_000, "movej([" + "1," * 300_000],
    ids=["blank lines", "begins", "offsets", "spaces", "a long move"],
)  # fmt: skip
def test_a_control_script_is_looked_through_in_one_go(inside: str) -> None:
    text = CONTROL_SCRIPT.removesuffix("end") + "def exec_move_path():\n" + inside + "\n"
    begun_s = time.process_time()
    with contextlib.suppress(ScriptError):
        recognised(text)
    # Each takes about 2 ms; a backtracking search took minutes.
    assert time.process_time() - begun_s < 1.0


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("movej([0,0,0,0,0,1e999], a=1, v=1, r=0)", "cannot be read"),
        ("movej([0,0,0,0,0,x], a=1, v=1, r=0)", "cannot be read"),
        ("movej([0,0,0,0,0,0], a=1, v=1, r=0)\n" * (MAX_WAYPOINTS + 1), "waypoints"),
    ],
)
def test_a_path_that_cannot_be_is_refused(path: str, said: str) -> None:
    text = CONTROL_SCRIPT.removesuffix("end") + f"def exec_move_path():\n{path}\nend\nend"
    with pytest.raises(ScriptError, match=said):
        recognised(text)


@pytest.mark.parametrize("offset", ["12", "9" * 5000])
def test_registers_begin_where_the_client_may_have_them(offset: str) -> None:
    world = World(upload=False)
    text = CONTROL_SCRIPT.removesuffix("end") + f"# int register offset\n{offset}\nend"
    world.controller.submit(Submitted("rtde_control", text))
    world.cycles(15)
    assert len(offset) > 2 or "0 or 24" in world.controller.log[-1]
