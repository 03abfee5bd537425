"""The driver on local sockets: its checklist, its thread, and misbehaving servers."""

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from tests.gripper.serving import MISBEHAVIOURS, Misbehaviour, Served, served, silent, until
from tests.gripper.virtual import gripper, move

from haptether.checklist import RefusedError
from haptether.slave import GripperSample, RobotiqGripper
from haptether.slave.robotiq.protocol import get
from haptether.slave.robotiq.wire import Wire, WireError

pytestmark = pytest.mark.live

REPLY_S = 0.2
PATIENCE_S = 10.0
CLOSED_S = 3.0
"""`close` takes at most two replies and a connection."""


@pytest.fixture
def server() -> Iterator[Served]:
    with served(gripper(40.0)) as running:
        yield running


def driver(of: Served, **options: Any) -> RobotiqGripper:  # noqa: ANN401  # options of the driver
    return RobotiqGripper(host="127.0.0.1", port=of.port, reply_timeout_s=REPLY_S, **options)


@pytest.fixture
def led(server: Served) -> Iterator[RobotiqGripper]:
    of = driver(server)
    of.open()
    yield of
    of.close()
    assert not running_threads()


def running_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "robotiq"]


def faulty(sample: GripperSample) -> bool:
    return sample.fault is not None


# ------------------------------------------------------------------------------------------------------- checklist


def test_an_active_gripper_is_led_without_moving(
    server: Served, led: RobotiqGripper, capsys: pytest.CaptureFixture[str]
) -> None:
    assert led.read() == GripperSample(position=0.0, velocity=0.0, force_n=0.0, holds_object=False)
    assert server.settings == []
    assert not capsys.readouterr().out


def test_one_that_is_not_active_is_refused_and_not_moved(capsys: pytest.CaptureFixture[str]) -> None:
    with served(gripper(active=False)) as server:
        of = driver(server)
        with pytest.raises(RefusedError, match=r"active: no, STA 0: it would move, and was not allowed to: .*activate"):
            of.open()
        of.close()
        assert server.settings == []
    said = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1].split()[0] for line in said] == ["ok", "REFUSED"]


def test_one_that_is_not_active_is_activated_where_that_is_allowed() -> None:
    with served(gripper(active=False)) as server:
        of = driver(server, activate=True)
        of.open()
        assert server.settings[:2] == ["SET ACT 0", "SET ATR 0"]
        assert server.settings[-1] == "SET ACT 1"
        assert of.read().fault is None
        of.close()


@pytest.mark.parametrize(
    ("flt", "said"),
    [(8, "fault: FLT 8: it is too hot: let it cool down"), (13, "active: no, FLT 13: its activation failed: ")],
)
def test_a_fault_at_the_begin_is_named(server: Served, flt: int, said: str) -> None:
    server.gripper.fail(flt)
    with pytest.raises(RefusedError, match=said):
        driver(server).open()
    assert server.settings == []


def test_a_slave_id_is_chosen_first(server: Served) -> None:
    of = driver(server, slave_id=3)
    of.open()
    of.close()
    assert server.settings == ["SET SID 3"]


def test_a_slave_id_is_chosen_again_by_a_new_connection(server: Served) -> None:
    of = driver(server, slave_id=3)
    of.open()
    server.misbehaves = silent
    until(of, faulty)
    server.misbehaves = None
    of.acknowledge()
    until(of, lambda sample: sample.fault is None)
    of.close()
    assert server.settings == ["SET SID 3"] * 2


def test_a_server_that_is_too_slow_is_refused(server: Served) -> None:
    def slow(_connection: object, line: bytes) -> bytes:
        time.sleep(0.15)
        return line.removeprefix(b"GET ") + b" 3"

    server.misbehaves = slow
    with pytest.raises(RefusedError, match=r"server: answers within 1\d\d.\d ms: must be within 100 ms"):
        driver(server).open()


def test_nobody_there() -> None:
    with served(gripper()) as gone:
        port = gone.port
    with pytest.raises(WireError, match=f"no connection: 127.0.0.1:{port}: Connection refused: is the arm on"):
        RobotiqGripper(host="127.0.0.1", port=port).open()


@pytest.mark.parametrize(("misbehaves", "said"), MISBEHAVIOURS)
def test_whoever_else_is_there_is_named_in_time(server: Served, misbehaves: Misbehaviour, said: str) -> None:
    server.misbehaves = misbehaves
    of = driver(server)
    begun_s = time.monotonic()
    with pytest.raises(WireError, match=said):
        of.open()
    assert time.monotonic() - begun_s < 5 * REPLY_S + 1.0
    of.close()


def test_a_reply_that_comes_twice_is_not_that_to_the_next_request(server: Served) -> None:
    def twice(connection: socket.socket, _line: bytes) -> None:
        connection.sendall(b"STA 3")
        time.sleep(0.02)
        connection.sendall(b"STA 3")

    server.misbehaves = twice
    wire = Wire("127.0.0.1", server.port, REPLY_S)
    assert wire.exchange(get("STA")) == 3
    time.sleep(0.2)
    with pytest.raises(WireError, match=r"malformed reply: b'STA 3': nothing was asked"):
        wire.exchange(get("STA"))


def test_an_end_of_line_that_comes_late_belongs_to_the_reply_before(server: Served) -> None:
    def ends_late(connection: socket.socket, _line: bytes) -> None:
        connection.sendall(b"STA 3")
        time.sleep(0.02)
        connection.sendall(b"\r\n")

    server.misbehaves = ends_late
    wire = Wire("127.0.0.1", server.port, REPLY_S)
    assert [wire.exchange(get("STA")) for _ in range(5)] == [3] * 5
    wire.close()


# ---------------------------------------------------------------------------------------------------------- motion


def test_it_picks_something_up_and_lets_go(server: Served, led: RobotiqGripper) -> None:
    led.write(move(1.0, speed=1.5, force_n=100.0))
    held = until(led, lambda sample: sample.holds_object)
    assert held.position == pytest.approx(1.0 - 40.0 / 85.0, abs=0.01)
    assert held.force_n == pytest.approx(100.0, abs=1.0)
    led.hold()
    led.write(move(0.0, speed=1.5))
    assert not until(led, lambda sample: sample.position == 0.0).holds_object
    assert len(server.settings) == 2


def test_the_newest_command_wins(server: Served, led: RobotiqGripper) -> None:
    for step in range(5000):
        led.write(move(0.0001 * step))
    until(led, lambda sample: sample.position > 0.49)
    # At most 50 a second are sent; the others are dropped.
    assert len(server.settings) < 60
    assert server.settings[-1].startswith(f"SET POS {round(3 + 0.4999 * 227)} ")


def test_close_stops_jaws_that_move(server: Served) -> None:
    of = driver(server)
    of.open()
    of.write(move(1.0, speed=0.3))
    until(of, lambda sample: sample.position > 0.05)
    of.close()
    assert server.settings[-1] == "SET GTO 0"
    assert not running_threads()


def test_close_keeps_the_grip(server: Served) -> None:
    of = driver(server)
    of.open()
    of.write(move(1.0, speed=1.5, force_n=100.0))
    until(of, lambda sample: sample.holds_object)
    of.close()
    assert len(server.settings) == 1
    assert server.gripper.figures()["force_n"] == pytest.approx(100.0, abs=1.0)


# ---------------------------------------------------------------------------------------------------------- faults


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("misbehaves", "said"), MISBEHAVIOURS)
def test_a_lost_connection_is_a_fault_that_moves_nothing(
    server: Served, led: RobotiqGripper, misbehaves: Misbehaviour, said: str
) -> None:
    led.write(move(1.0, speed=1.5, force_n=100.0))
    until(led, lambda sample: sample.holds_object)
    server.misbehaves = misbehaves
    lost = until(led, faulty)
    assert lost.fault is not None
    assert lost.fault.startswith(said)
    # The last values stay, with zero velocity.
    assert (lost.holds_object, lost.velocity) == (True, 0.0)
    before = server.settings.copy()
    # Nothing is sent before the fault is acknowledged, not even for new commands.
    server.misbehaves = None
    led.write(move(0.0))
    time.sleep(0.3)
    assert led.read() == lost
    led.acknowledge()
    assert until(led, lambda sample: sample.fault is None).holds_object
    time.sleep(0.2)
    assert server.settings == before
    led.write(move(0.0, speed=1.5))
    until(led, lambda sample: sample.position == 0.0)


def test_an_acknowledgement_in_vain_says_why(server: Served, led: RobotiqGripper) -> None:
    server.misbehaves = silent
    until(led, faulty)
    server.misbehaves = None
    server.gripper.fail(10)
    led.acknowledge()
    again = until(led, lambda sample: sample.fault is not None and "FLT 10" in sample.fault)
    assert "activate = true" in str(again.fault)
    # An acknowledgement does not activate the gripper, because activation moves the jaws.
    assert server.settings == []


def test_a_fault_that_nobody_was_shown_is_not_acknowledged(server: Served, led: RobotiqGripper) -> None:
    led.read()
    server.gripper.fail(8)
    end_s = time.monotonic() + PATIENCE_S
    while led._sample.fault is None:
        assert time.monotonic() < end_s
        time.sleep(0.005)
    server.gripper.fail(0)
    led.acknowledge()
    time.sleep(0.3)
    assert led.read().fault is not None
    led.acknowledge()
    until(led, lambda sample: sample.fault is None)


def test_a_thread_that_stands_still_is_a_fault(led: RobotiqGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    let = threading.Event()
    due = led._session.due
    monkeypatch.setattr(led._session, "due", lambda *given: due(*given) if let.wait(PATIENCE_S) else None)
    stood = until(led, faulty)
    assert str(stood.fault).startswith("silence: its thread has stood still for ")
    led.write(move(1.0))
    let.set()
    time.sleep(0.3)
    # The fault stays once the server responds again, and earlier commands are not executed.
    assert led.read().fault == stood.fault
    assert led.read().position == 0.0
    led.acknowledge()
    assert until(led, lambda sample: sample.fault is None).position == 0.0


def test_an_error_of_the_driver_itself_is_a_fault(led: RobotiqGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        message = "broken"
        raise RuntimeError(message)

    monkeypatch.setattr(led._session, "replied", fails)
    assert until(led, faulty).fault == "its driver failed: RuntimeError: broken"


# ------------------------------------------------------------------------------------------------------ time limits


def test_no_call_waits_for_the_server(server: Served, led: RobotiqGripper) -> None:
    server.misbehaves = silent
    begun_s = time.monotonic()
    for step in range(2000):
        led.write(move(0.0005 * step))
        led.read()
        led.hold()
    assert time.monotonic() - begun_s < 1.0


@pytest.mark.parametrize("misbehaves", [misbehaves for misbehaves, _ in MISBEHAVIOURS])
def test_close_ends_in_time_whatever_the_server_does(server: Served, misbehaves: Misbehaviour) -> None:
    of = driver(server)
    of.open()
    of.write(move(1.0, speed=0.3))
    until(of, lambda sample: sample.position > 0.05)
    server.misbehaves = misbehaves
    begun_s = time.monotonic()
    of.close()
    assert time.monotonic() - begun_s < CLOSED_S
    assert not running_threads()


@pytest.mark.parametrize("blocked", ["silence", "activation"])
def test_close_ends_an_open_that_blocks(blocked: str) -> None:
    with served(gripper(active=False)) as server:
        server.misbehaves = silent if blocked == "silence" else None
        of = RobotiqGripper(host="127.0.0.1", port=server.port, reply_timeout_s=2.0, activate=True)
        failed: list[Exception] = []

        def opens() -> None:
            try:
                of.open()
            except (WireError, RefusedError) as error:
                failed.append(error)

        opening = threading.Thread(target=opens)
        opening.start()
        time.sleep(0.3)
        of.close()
        opening.join(1.0)
        assert not opening.is_alive()
        assert failed
        assert "SET ACT 1" not in server.settings
        assert not running_threads()


def test_close_without_open() -> None:
    RobotiqGripper(host="127.0.0.1").close()
