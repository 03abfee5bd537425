"""A flooded console: STOP works, pages are served, and Ctrl-C ends it."""

import contextlib
import gc
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.live.control_client import fill
from tests.view.console.flood import flood, held, send
from tests.view.console.served import Served, http, served, stop_answers, wait_for
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from haptether.view.console.connections import MAX_KNOWN, MAX_UNKNOWN, REQUEST_S, TOKEN_S, Connections
from haptether.view.console.page_server import BACKLOG
from haptether.view.console.recorder import FlightWatch
from haptether.view.console.server import Console

pytestmark = pytest.mark.live

DESCRIPTORS = 256
"""Limit of the console's descriptors: a flood exhausts it fast."""
FLOOD = 300
HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"
WHOLE = HALF + b"\r\n"
MOST = MAX_UNKNOWN + MAX_KNOWN + 4 * BACKLOG
"""Largest number of connections of the console, short-lived ones included."""
UPGRADE = (
    HALF + b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


def command(descriptors: int, *arguments: str) -> list[str]:
    """Return a command that limits the descriptors of itself and of its child processes."""
    limited = f'ulimit -n {descriptors} && exec "$@"'
    return ["sh", "-c", limited, "sh", sys.executable, "-m", "haptether", *arguments]


@contextlib.contextmanager
def console(said: Path) -> Iterator[tuple[subprocess.Popen[str], int, str]]:
    """Start both sides of a scene with a console of few descriptors; yield process, port, token; log errors."""
    console = command(DESCRIPTORS, "console", "--scene", "remote_push")
    with said.open("w") as errors, subprocess.Popen(
        console, stdout=subprocess.PIPE, stderr=errors, text=True
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:(\d+)/([\w-]{32})/", process.stdout.readline())
            assert found is not None
            yield process, int(found[1]), found[2]
        finally:
            process.kill()


def page(port: int, token: str) -> ClientConnection:
    origin = Origin(f"http://127.0.0.1:{port}")
    address = f"ws://127.0.0.1:{port}/{token}/live"
    return connect(address, origin=origin, proxy=None, compression=None, close_timeout=0.1)


def stopped(one: ClientConnection) -> list[bool]:
    """Send STOP; return for each side whether it stopped."""
    one.send('{"do":"stop"}')
    end_s = time.monotonic() + 5.0
    while time.monotonic() < end_s:
        message: dict[str, Any] = json.loads(one.recv(timeout=5.0))
        if message["kind"] == "stopped":
            return [answer.get("is_stopped", False) for answer in message["answers"].values()]
    return []


def test_stop_and_the_end_work_while_requests_without_a_token_are_half_open(tmp_path: Path) -> None:
    said = tmp_path / "said"
    with console(said) as (process, port, token), page(port, token) as one, flood(port, FLOOD, HALF):
        time.sleep(0.3)
        begun_s = time.monotonic()
        assert stopped(one) == [True, True]
        assert time.monotonic() - begun_s < 2.0
        process.send_signal(signal.SIGINT)
        begun_s = time.monotonic()
        assert process.wait(20.0) == 0
        assert time.monotonic() - begun_s < 3.0
    assert "Traceback" not in said.read_text()


def test_too_few_descriptors_are_said_before_anything_is_served(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as side:
        side.bind(str(tmp_path / "side"))
        side.listen()
        console = command(100, "console", "--connect", str(tmp_path / "side"))
        ended = subprocess.run(console, capture_output=True, text=True, check=False, timeout=60.0)
    assert ended.returncode != 0
    assert re.search(r"needs \d+ free descriptors, and \d+ are left: raise `ulimit -n`", ended.stderr)
    assert "Traceback" not in ended.stderr


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("console")) as found:
        yield found


def test_without_a_token_few_connections_stay_and_none_for_long(runs: Served) -> None:
    port = runs.console.port
    kinds = (b"", HALF, WHOLE, UPGRADE, HALF + b"X: " + b"x" * 10_000)
    with page(port, runs.token) as one, contextlib.ExitStack() as stack:
        opened = [other for sent in kinds for other in stack.enter_context(flood(port, FLOOD // len(kinds), sent))]
        begun_s = time.monotonic()
        assert held(port) <= MOST
        # An open page, and a new one.
        assert json.loads(one.recv(timeout=5.0))["kind"] == "rows"
        status, _, body = http(port, "GET", f"/{runs.token}/uplot.js", {"Host": f"127.0.0.1:{port}"})
        assert (status, len(body) > 10_000) == (200, True)
        # Single bytes do not extend the time limit.
        while time.monotonic() < begun_s + TOKEN_S + 0.2:
            send(opened, b"x")
            time.sleep(0.1)
            assert held(port) <= MOST
        # The remaining connection is that of the page.
        wait_for(lambda: held(port) <= 1, 5.0)
        assert json.loads(one.recv(timeout=5.0))["kind"] == "rows"


def test_with_the_token_connections_have_a_bound_and_pages_stay(runs: Served) -> None:
    port = runs.console.port
    request = f"GET /{runs.token}/uplot.js HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
    with page(port, runs.token) as one, flood(port, 3 * MAX_KNOWN, request * 40):
        # None of the connections reads.
        time.sleep(1.0)
        for _ in range(10):
            assert json.loads(one.recv(timeout=5.0))["kind"] == "rows"
        with page(port, runs.token) as another:
            assert json.loads(another.recv(timeout=5.0))["kind"] == "rows"
        assert held(port) <= MOST


def test_a_stop_without_a_page_works_under_a_flood(tmp_path: Path) -> None:
    with served(tmp_path) as runs, flood(runs.console.port, FLOOD, HALF):
        here = f"127.0.0.1:{runs.console.port}"
        headers = {"Host": here, "Origin": f"http://{here}", "Content-Length": "0"}
        status, _, body = http(runs.console.port, "POST", f"/{runs.token}/stop", headers)
        assert status == 200
        assert [answer["is_stopped"] for answer in stop_answers(body).values()] == [True, True]


def test_a_stop_works_while_others_fill_the_control_sockets(tmp_path: Path) -> None:
    """The flood closes every connection of the console."""
    with served(tmp_path) as runs, page(runs.console.port, runs.token) as one, contextlib.ExitStack() as stack:
        for name in ("m.ctl", "s.ctl"):
            fill(runs.folder / name, 80, stack)
        one.send('{"id":1,"side":"master","do":"status"}')
        while (message := json.loads(one.recv(timeout=5.0)))["kind"] != "answer":
            pass
        assert (message["done"], message["side"]) == (True, "master")
        assert stopped(one) == [True, True]


def test_the_end_waits_for_no_disk_and_for_no_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hangs = threading.Event()
    reads = threading.Event()

    def read(_: FlightWatch) -> bool:
        reads.set()
        return hangs.wait(30.0)

    monkeypatch.setattr(FlightWatch, "read", read)
    one = Console([tmp_path / "nobody"], [tmp_path / "nobody"], flight=[tmp_path / "flight"])
    ended = threading.Event()
    thread = threading.Thread(target=one.serve, args=(ended.is_set,))
    thread.start()
    token = one.address.rstrip("/").rpartition("/")[2]
    request = f"GET /{token}/uplot.js HTTP/1.1\r\nHost: 127.0.0.1:{one.port}\r\n\r\n".encode()
    try:
        with flood(one.port, 4, request * 40):
            assert reads.wait(10.0)
            ended.set()
            begun_s = time.monotonic()
            thread.join(20.0)
            assert time.monotonic() - begun_s < 2.5
    finally:
        ended.set()
        hangs.set()
        thread.join(20.0)
    assert not thread.is_alive()


def test_the_end_leaves_no_connection_to_a_side_that_hangs(tmp_path: Path) -> None:
    hangs = tmp_path / "hangs"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(hangs))
        listening.listen()
        one = Console([tmp_path / "nobody"], [hangs])
        ended = threading.Event()
        thread = threading.Thread(target=one.serve, args=(ended.is_set,))
        thread.start()
        try:
            # A request of the console is nearly always in progress.
            time.sleep(2.0)
        finally:
            ended.set()
            thread.join(20.0)
        assert not thread.is_alive()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gc.collect()
    assert [str(one.message) for one in caught if one.category is ResourceWarning] == []


class StandIn:
    """Stand-in of a transport; it records whether it was closed."""

    def __init__(self) -> None:
        self.is_closed = False

    def abort(self) -> None:
        self.is_closed = True

    def get_extra_info(self, _: str) -> "StandIn":
        return self

    def fileno(self) -> int:
        return -1 if self.is_closed else 5


def test_who_is_closed_for_whom_and_when() -> None:
    connections, made = Connections(), [StandIn() for _ in range(200)]

    def open_now(of: list[StandIn]) -> int:
        return sum(not one.is_closed for one in of)

    first, *others = made[: MAX_UNKNOWN + 1]
    # It has the token, in time.
    connections.add(first, 0.0)
    connections.admit(first, 0.1)
    for number, one in enumerate(others):
        connections.add(one, number / 100)
    assert open_now(others) == MAX_UNKNOWN
    connections.add(made[50], 1.0)
    assert [one.is_closed for one in others[:2]] == [True, False]
    connections.close_late(TOKEN_S + 0.015)
    assert [one.is_closed for one in others[:3]] == [True, True, False]
    connections.close_late(TOKEN_S + 1.0)
    assert (open_now(others), made[50].is_closed, first.is_closed) == (0, True, False)
    # A page stays until it ends, whatever other clients with the token do.
    connections.keep(first)
    for number, one in enumerate(made[60:150]):
        connections.add(one, 5.0)
        connections.admit(one, 5.0 + number / 100)
    assert open_now(made[60:150]) == MAX_KNOWN - 1
    assert [first.is_closed, made[149].is_closed] == [False, False]
    connections.close_late(5.0 + REQUEST_S + 1.0)
    assert (open_now(made[60:150]), first.is_closed) == (0, False)
    connections.admit(first, 20.0)
    connections.close_late(20.0 + REQUEST_S)
    assert first.is_closed
