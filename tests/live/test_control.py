"""Control socket of a live side: the connections that may stop, press and scale it, and the refused ones."""

import contextlib
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.live.control_client import Control, fill
from tests.scene.two_sides import two_sides

from haptether.bridge import LiveMaster, LiveSlave, override_scene, scene_json

pytestmark = pytest.mark.live

BEAT_S = 0.1
MOST = 32
"""Largest number of connections at once."""


@pytest.fixture
def sides(tmp_path: Path) -> Iterator[tuple[LiveMaster, LiveSlave]]:
    """Start two sides without an automatic press, each with a control socket in the folder."""
    scene = scene_json(override_scene(two_sides(), ["operator.clutch=once"]))
    slave = LiveSlave(scene, listen="127.0.0.1:0", run_id=2, insecure=True, control=tmp_path / "slave")
    old_s = time.monotonic() - 10.0
    master = LiveMaster(
        scene, peer=slave.address, run_id=1, insecure=True, started_s=old_s, control=tmp_path / "master"
    )
    wait_for(lambda: master.is_answered)
    yield master, slave
    master.finish()
    slave.finish()


def wait_for(condition: Callable[[], bool], within_s: float = 5.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def hold(control: Control, *, beats: int = 12, every_s: float = BEAT_S) -> dict[str, Any]:
    """Send beats at even times until an answer has no token; return that answer."""
    begun_s = time.monotonic()
    token: dict[str, Any] = {}
    answer: dict[str, Any] = {}
    for beat in range(beats):
        time.sleep(max(0.0, begun_s + beat * every_s - time.monotonic()))
        held_ms = round((time.monotonic() - begun_s) * 1e3)
        answer = control.ask("hold", held_ms=held_ms, **token)
        if "token" not in answer:
            break
        token = {"token": answer["token"]}
    return answer


def test_a_hold_of_a_second_couples_and_a_release_ends_it(sides: tuple[LiveMaster, LiveSlave], tmp_path: Path) -> None:
    master, _ = sides
    with Control(tmp_path / "master") as control, Control(tmp_path / "master") as other:
        assert master.state == "disengaged"
        begun_s = time.monotonic()
        control.ask("hold", held_ms=0)
        refused = other.ask("hold", held_ms=0)
        assert (refused["done"], "holds the button" in refused["text"]) == (False, True)
        assert hold(control)["pressed"] is True
        assert time.monotonic() - begun_s > 1.0
        wait_for(lambda: master.state == "engaged")
        assert other.ask("release")["done"]
        wait_for(lambda: master.state != "engaged")


def test_what_is_no_hold_presses_nothing(sides: tuple[LiveMaster, LiveSlave], tmp_path: Path) -> None:
    master, _ = sides
    path = tmp_path / "master"
    with Control(path) as control:
        # A stalled queue resumes: a whole hold arrives at once.
        beats = b"".join(b'{"do":"hold","held_ms":%d}\n' % held for held in range(0, 1300, 100))
        control.send(beats)
        answers = [control.answer() for _ in range(13)]
        assert not any(answer["pressed"] for answer in answers)
        assert not answers[-1]["done"]
        # Tokens are in time, but all beats come within a moment.
        assert not hold(control, every_s=0.001)["pressed"]
        # The beats have a gap.
        token = control.ask("hold", held_ms=0)["token"]
        time.sleep(0.45)
        assert "stopped" in control.ask("hold", held_ms=450, token=token)["text"]
        # The hold is too short.
        assert not hold(control, beats=6)["pressed"]
        control.ask("let_go")
    with Control(path) as control:
        assert not hold(control, beats=5)["pressed"]
    with Control(path) as control:
        # A hold does not continue on another connection.
        assert "let go" in control.ask("hold", held_ms=600, token=1)["text"]
    time.sleep(0.3)
    assert master.state == "disengaged"
    assert master.ineffective_presses[0] == 1, "that of the old start"


@pytest.mark.parametrize("side", [0, 1])
def test_a_stop_is_at_rest_at_once_whatever_others_do(
    side: int, sides: tuple[LiveMaster, LiveSlave], tmp_path: Path
) -> None:
    path = tmp_path / ("master", "slave")[side]
    with Control(path) as silent, Control(path) as talks, Control(path) as stops:
        # One client sends without end and reads nothing.
        talks.socket.setblocking(False)
        try:
            while True:
                talks.send(b'{"do":"status"}\n' * 100)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            # The server closes a client that does not read its answers.
            pass
        silent.send(b'{"do":"st')
        begun_s = time.monotonic()
        answer = stops.ask("stop")
        took_s = time.monotonic() - begun_s
        assert (answer["done"], answer["is_at_rest"]) == (True, True)
        assert took_s < 0.1
    wait_for(lambda: sides[side].finished)
    wait_for(lambda: not path.exists())


def test_a_further_connection_closes_the_idlest_which_is_told_why(
    sides: tuple[LiveMaster, LiveSlave], tmp_path: Path
) -> None:
    path = tmp_path / "master"
    with contextlib.ExitStack() as stack:
        idle, *others = [stack.enter_context(Control(path)) for _ in range(MOST)]
        # A new connection counts as busy for 0.1 s.
        time.sleep(0.2)
        for other in others:
            assert other.ask("status")["done"]
        # Half a request does not count.
        idle.send(b'{"do":"st')
        with Control(path) as new:
            assert new.ask("status")["done"]
            told = idle.answer()
            assert (told["to"], told["done"], "another program has connected" in told["text"]) == ("", False, True)
            assert idle.answer() == {}
            # The server closes no other connection.
            for other in others:
                assert other.ask("status")["done"]
    assert not sides[0].finished


@pytest.mark.parametrize("sent", [b"", b'{"do":"st', b'{"do":"status"}\n'])
@pytest.mark.parametrize("many", [MOST, 3 * MOST])
def test_a_stop_from_a_new_connection_works_whoever_is_connected(
    many: int, sent: bytes, sides: tuple[LiveMaster, LiveSlave], tmp_path: Path
) -> None:
    path = tmp_path / "slave"
    with contextlib.ExitStack() as stack:
        fill(path, many, stack, sent)
        with Control(path) as stops:
            begun_s = time.monotonic()
            answer = stops.ask("stop")
            took_s = time.monotonic() - begun_s
        assert (answer["done"], answer["is_at_rest"]) == (True, True)
        assert took_s < 0.3
    wait_for(lambda: sides[1].finished)


def test_a_stop_works_while_others_request_and_connect_without_end(
    sides: tuple[LiveMaster, LiveSlave], tmp_path: Path
) -> None:
    path = tmp_path / "master"
    ended = threading.Event()

    def talk() -> None:
        while not ended.is_set():
            with contextlib.suppress(OSError, ValueError), contextlib.ExitStack() as stack:
                fill(path, 20, stack, b'{"do":"status"}\n' * 5)

    others = [threading.Thread(target=talk) for _ in range(3)]
    for other in others:
        other.start()
    time.sleep(0.3)
    try:
        for _ in range(5):
            with Control(path) as control:
                assert control.ask("status")["done"]
        with Control(path) as stops:
            answer = stops.ask("stop")
        assert (answer["done"], answer["is_at_rest"]) == (True, True)
    finally:
        ended.set()
        for other in others:
            other.join(10.0)
    wait_for(lambda: sides[0].finished)


EXHAUSTED = """
import os, resource, sys
from haptether.bridge import LiveSlave, scene_json
from tests.scene.two_sides import two_sides
resource.setrlimit(resource.RLIMIT_NOFILE, (128, 128))
slave = LiveSlave(
    scene_json(two_sides()), listen="127.0.0.1:0", run_id=2, insecure=True, control=sys.argv[1], telemetry=sys.argv[2]
)
try:
    while True:
        os.open(os.devnull, os.O_RDONLY)
except OSError as error:
    print(error.strerror, flush=True)
sys.stdin.read()
"""


def test_a_stop_acts_while_the_side_has_no_descriptor_left(tmp_path: Path) -> None:
    path = tmp_path / "slave"
    with subprocess.Popen(
        [sys.executable, "-c", EXHAUSTED, str(path), str(tmp_path / "telemetry")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            assert "Too many open files" in process.stdout.readline()
            with contextlib.ExitStack() as stack:
                # Open more than one; each takes the place of the previous one.
                for _ in range(3):
                    control = stack.enter_context(Control(path))
                    assert control.ask("status")["done"]
                begun_s = time.monotonic()
                answer = stack.enter_context(Control(path)).ask("stop")
                assert (answer["is_at_rest"], time.monotonic() - begun_s < 0.3) == (True, True)
        finally:
            process.kill()


def test_programs_at_the_telemetry_keep_no_stop_out(tmp_path: Path) -> None:
    """Telemetry accepts 16 clients at most, whether they read or not."""
    path, telemetry = tmp_path / "slave", tmp_path / "telemetry"
    before = len(list(Path("/proc/self/fd").iterdir()))
    slave = LiveSlave(
        scene_json(two_sides()), listen="127.0.0.1:0", run_id=2, insecure=True, control=path, telemetry=telemetry
    )
    with contextlib.ExitStack() as stack:
        for _ in range(60):
            one = stack.enter_context(socket.socket(socket.AF_UNIX))
            one.connect(str(telemetry))
        time.sleep(0.3)
        # Both ends are in this process.
        assert len(list(Path("/proc/self/fd").iterdir())) < before + 60 + 16 + 20
        with Control(path) as stops:
            answer = stops.ask("stop")
        assert (answer["done"], answer["is_at_rest"]) == (True, True)
    slave.finish()


BUSY = """
import sys
from haptether.bridge import LiveSlave, scene_json
from tests.scene.two_sides import two_sides
slave = LiveSlave(scene_json(two_sides()), listen="127.0.0.1:0", run_id=2, insecure=True, control=sys.argv[1])
print("runs", flush=True)
# One call in C: nobody else has the interpreter.
sum(range(10**11))
"""


def test_a_stop_acts_while_the_interpreter_hangs(tmp_path: Path) -> None:
    path = tmp_path / "slave"
    with subprocess.Popen([sys.executable, "-c", BUSY, str(path)], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "runs\n"
            time.sleep(0.2)
            with Control(path) as control:
                begun_s = time.monotonic()
                answer = control.ask("stop")
                assert (answer["is_at_rest"], time.monotonic() - begun_s < 0.1) == (True, True)
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "must be"),
        (b"\0\xff\xfe\n", "must be"),
        (b'{"do":"press"}\n', "must be"),
        (b"x" * 513, "more than 512 bytes"),
        (b'{"do":"stop","x":"' + b"x" * 600 + b'"}\n', "more than 512 bytes"),
    ],
)
def test_what_is_no_request_is_one_line_and_the_end(
    sent: bytes, said: str, sides: tuple[LiveMaster, LiveSlave], tmp_path: Path
) -> None:
    with Control(tmp_path / "master") as control:
        control.send(sent)
        answer = control.answer()
        assert answer["done"] is False
        assert said in answer["text"]
        # The server resets the connection if it has not read all bytes.
        with contextlib.suppress(ConnectionResetError):
            assert control.answer() == {}
    with Control(tmp_path / "master") as control:
        assert control.ask("status")["is_stopped"] is False
    assert not sides[0].finished


def test_scales_are_set_at_the_side_that_has_them(sides: tuple[LiveMaster, LiveSlave], tmp_path: Path) -> None:
    assert not sides[0].finished
    with Control(tmp_path / "master") as master, Control(tmp_path / "slave") as slave:
        assert master.set("force_scale", scale=0.5)["done"]
        assert slave.set("position_scale", scale=0.5)["done"]
        for at, do, scale, said in (
            (master, "position_scale", 0.5, "at the slave"),
            (slave, "force_scale", 0.5, "at the master"),
            (master, "force_scale", -1.0, "force_scale"),
            (master, "force_scale", 1e308, "must be between 0.5 and 2, with an open clutch between 0.01 and 100"),
            (slave, "position_scale", 200.0, "set coupling.position_scale in the scene"),
            (master, "torque_scale", 1.0, 'only a side of kind "pose" has it'),
            (slave, "rotation_scale", 1.0, 'only a side of kind "pose" has it'),
            (slave, "hold", 0.0, "at the master"),
        ):
            answer = at.ask(do, held_ms=0) if do == "hold" else at.set(do, scale=scale)
            assert (answer["done"], said in answer["text"]) == (False, True), answer
        assert master.set("acknowledge")["done"]
        assert master.ask("status")["side"] == "master"


def test_a_coupled_side_keeps_its_scales_within_their_bounds(
    sides: tuple[LiveMaster, LiveSlave], tmp_path: Path
) -> None:
    with Control(tmp_path / "master") as master, Control(tmp_path / "slave") as slave:
        assert master.set("force_scale", scale=5.0)["done"], "the clutch is open"
        assert master.set("force_scale", scale=1.0)["done"]
        assert hold(master)["pressed"] is True
        wait_for(lambda: sides[0].state == "engaged")
        for side, do in ((master, "force_scale"), (slave, "position_scale")):
            for scale in (2.0, 4.0, 8.0, 0.5, 0.25):
                answer = side.set(do, scale=scale)
                assert answer["done"] == (scale in {2.0, 0.5}), answer
                assert ("release the clutch first" in answer["text"]) != answer["done"], answer
        time.sleep(0.3)
        assert sides[0].state == "engaged"


def test_what_waited_in_a_queue_changes_nothing(sides: tuple[LiveMaster, LiveSlave], tmp_path: Path) -> None:
    assert not sides[0].finished
    with Control(tmp_path / "master") as control:
        token = control.ask("status")["token"]
        for late in (token - 1_000_000, token + 60_000_000, 0):
            for do, given in (("acknowledge", {}), ("force_scale", {"scale": 0.5}), ("torque_scale", {"scale": 0.5})):
                answer = control.ask(do, token=late, **given)
                assert (answer["done"], "came too late" in answer["text"]) == (False, True), (do, late, answer)
        time.sleep(0.5)
        assert control.ask("acknowledge", token=token)["done"] is False


def test_the_socket_is_its_owners_and_replaces_only_one_that_is_left(tmp_path: Path) -> None:
    scene = scene_json(two_sides())

    def slave(path: Path) -> LiveSlave:
        return LiveSlave(scene, listen="127.0.0.1:0", run_id=2, insecure=True, control=path)

    path = tmp_path / "slave"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    running = slave(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(OSError, match="another run is controlled there"):
        slave(path)
    link = tmp_path / "link"
    link.symlink_to(path)
    with pytest.raises(OSError, match="is no socket"):
        slave(link)
    running.finish()
    wait_for(lambda: not path.exists())
