"""Connecting to a controller: a peer that accepts a connection and stays silent must not block the driver."""

import contextlib
import inspect
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple, NoReturn

import pytest
from tests.ur.emulated import free_host

from haptether.slave.ur import services
from haptether.slave.ur.connection import LAST_STOP_S
from haptether.slave.ur.services import DashboardError, ProbeError, probe, resolved
from haptether.slave.ur.stop import PROGRAM_STOP_S

HOST = free_host()
LIMIT_S = 0.3


class Peer:
    """Server whose handler is a function."""

    def __init__(self, port: int, handle: Callable[[socket.socket], None]) -> None:
        self._listening = socket.create_server((HOST, port))
        self._handle = handle
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        try:
            while True:
                connection, _ = self._listening.accept()
                with connection:
                    connection.settimeout(5.0)
                    with contextlib.suppress(OSError):
                        self._handle(connection)
        except OSError:
            return

    def close(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(5.0)


@pytest.fixture
def serve() -> Iterator[Callable[[int, Callable[[socket.socket], None]], None]]:
    peers: list[Peer] = []
    yield lambda port, handle: peers.append(Peer(port, handle))
    for peer in peers:
        peer.close()


Serve = Callable[[int, Callable[[socket.socket], None]], None]


def silent(connection: socket.socket) -> None:
    connection.recv(1)
    time.sleep(3 * LIMIT_S)


def closing(connection: socket.socket) -> None:
    connection.recv(1)


def web(connection: socket.socket) -> None:
    connection.recv(100)
    connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    time.sleep(2 * LIMIT_S)


def nonsense(connection: socket.socket) -> None:
    connection.recv(100)
    connection.sendall(struct.pack(">HB", 1, 86))
    time.sleep(2 * LIMIT_S)


def endless(connection: socket.socket) -> None:
    while True:
        connection.sendall(struct.pack(">HB", 4, 77) + b"x")
        time.sleep(0.01)


@pytest.mark.parametrize("handle", [silent, closing, web, nonsense, endless])
def test_the_probe_ends_in_time_with_whoever_is_there(serve: Serve, handle: Callable[[socket.socket], None]) -> None:
    serve(services.RTDE_PORT, handle)
    begun_s = time.monotonic()
    with pytest.raises(ProbeError, match=f"{HOST}:30004: protocol version 2: "):
        probe(HOST, LIMIT_S)
    assert time.monotonic() - begun_s < LIMIT_S + 1.0


def test_nobody_there(serve: Serve) -> None:
    del serve
    with pytest.raises(ProbeError, match=f"{HOST}:30004: connect: "):
        probe(HOST, LIMIT_S)
    with pytest.raises(DashboardError, match=f"dashboard {HOST}:29999: "):
        services.query_dashboard(HOST, "stop", reply_s=LIMIT_S)


@pytest.mark.parametrize("handle", [silent, closing, endless])
def test_the_dashboard_is_not_waited_for(serve: Serve, handle: Callable[[socket.socket], None]) -> None:
    serve(services.DASHBOARD_PORT, handle)
    begun_s = time.monotonic()
    with pytest.raises(DashboardError):
        services.query_dashboard(HOST, "stop", reply_s=LIMIT_S)
    assert time.monotonic() - begun_s < LIMIT_S + 1.0


def dashboard(answers: dict[str, str]) -> Callable[[socket.socket], None]:
    def handle(connection: socket.socket) -> None:
        # Send in parts, as the network may deliver it.
        connection.sendall(b"Connected: Universal Robots ")
        connection.sendall(b"Dashboard Server\n")
        for line in connection.makefile():
            if line.strip() == "quit":
                return
            connection.sendall(f"{answers[line.strip()]}\n".encode())

    return handle


def test_what_the_dashboard_says(serve: Serve) -> None:
    serve(services.DASHBOARD_PORT, dashboard({
        "is in remote control": "true", "stop": "Stopped", "close safety popup": "closing safety popup",
        "unlock protective stop": "Cannot unlock protective stop until 5s after occurrence.",
    }))  # fmt: skip
    assert services.is_in_remote_control(HOST)
    services.stop_program(HOST)
    with pytest.raises(DashboardError, match="unlock protective stop: Cannot unlock protective stop until 5s"):
        services.unlock_protective_stop(HOST)


class End(NamedTuple):
    """Answers of RTDE, behaviour of the dashboard, the queried services, and the error."""

    rtde: tuple[bool | str, ...]
    dashboard: str
    asked: str
    error: str | None


PLAYS = "a program still plays: stop it on the pendant"
ENDS = [
    End((True,), "gone", "R", None),
    End((False, True), "", "RDR", None),
    End((False, False), "", "RDR", PLAYS),
    End((False, "mute"), "", "RDR", "mute"),
    End((False,), "gone", "RD", "gone"),
    End(("mute",), "", "RD", "mute"),
    End(("mute",), "gone", "RD", "mute; gone"),
]


@pytest.mark.parametrize("row", ENDS)
def test_a_program_is_ended_over_rtde_first(monkeypatch: pytest.MonkeyPatch, row: End) -> None:
    asked: list[str] = []
    answers = iter(row.rtde)

    def over_rtde(_host: str) -> bool:
        asked.append("R")
        answer = next(answers)
        if isinstance(answer, str):
            raise ProbeError(answer)
        return answer

    def over_dashboard(_host: str) -> None:
        asked.append("D")
        if row.dashboard:
            raise DashboardError(row.dashboard)

    monkeypatch.setattr(services, "end_control_script", over_rtde)
    monkeypatch.setattr(services, "stop_program", over_dashboard)
    if row.error is None:
        services.end_program(HOST)
    else:
        with pytest.raises(DashboardError) as raised:
            services.end_program(HOST)
        assert str(raised.value) == row.error
    assert "".join(asked) == row.asked


@pytest.mark.parametrize("limit_s", [LAST_STOP_S, PROGRAM_STOP_S])
def test_the_end_of_a_program_is_waited_for_as_long_as_its_steps_may_take(limit_s: float) -> None:
    rtde_s = inspect.signature(services.end_control_script).parameters["limit_s"].default
    dashboard = inspect.signature(services.query_dashboard).parameters
    # The greeting of the dashboard, and one answer.
    dashboard_s = dashboard["connect_s"].default + 2 * dashboard["reply_s"].default
    assert limit_s > 2 * rtde_s + dashboard_s


@pytest.mark.parametrize(("delay_s", "reply_s", "answers"), [(0.3, 0.5, True), (0.3, 0.1, False)])
def test_each_line_of_the_dashboard_has_a_time_limit_of_its_own(
    serve: Serve, delay_s: float, reply_s: float, answers: bool
) -> None:
    def slow(connection: socket.socket) -> None:
        time.sleep(delay_s)
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for _ in connection.makefile():
            time.sleep(delay_s)
            connection.sendall(b"true\n")

    serve(services.DASHBOARD_PORT, slow)
    if answers:
        assert services.query_dashboard(HOST, "is in remote control", "running", reply_s=reply_s) == ["true"] * 2
    else:
        with pytest.raises(DashboardError, match="timed out"):
            services.query_dashboard(HOST, "is in remote control", reply_s=reply_s)


def test_time_limits_of_the_dashboard_are_those_of_the_library() -> None:
    # ur_rtde 1.6.5: DashboardClient.connect and async_readline.
    assert (services.CONNECT_S, services.REPLY_S) == (2.0, 2.5)


def test_the_script_port_is_looked_at(serve: Serve) -> None:
    with pytest.raises(ProbeError, match=f"{HOST}:30003: Connection refused"):
        services.check_script_port(HOST)
    serve(services.SCRIPT_PORT, closing)
    services.check_script_port(HOST)


@pytest.mark.parametrize(("host", "address"), [("127.0.3.77", "127.0.3.77"), ("localhost", "127.0.0.1")])
def test_a_name_becomes_an_address(host: str, address: str) -> None:
    assert resolved(host) == address


def test_a_name_without_an_address_is_an_error_and_a_slow_name_server_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unknown(*_: object) -> NoReturn:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(ProbeError, match=r"arm\.invalid: Name or service not known"):
        resolved("arm.invalid")
    answers = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: answers.wait(30.0))
    begun_s = time.monotonic()
    with pytest.raises(ProbeError, match=r"look-up: has not returned within 0\.3 s"):
        resolved("arm.invalid", limit_s=0.3)
    assert 0.3 <= time.monotonic() - begun_s < 5.0
    answers.set()
