"""STOP while the bridges restart, and requests that end early, without processes."""

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from typing import Any

import pytest

from haptether.view.console.page_server import MAX_REASON, close_reason
from haptether.view.console.pair import Pair
from haptether.view.trial.server import Choice, Network, Trial

CHOICE = Choice(controllers={"left": "none"})


class Slow:
    """Bridges whose start lasts until it is allowed to end."""

    pairs = (Pair(name="left", telemetry=(), control=()),)
    controllers = ("none", "wsc")

    def __init__(self) -> None:
        self.begun, self.allowed = threading.Event(), threading.Event()
        self.starts = 0

    def start(self, _choice: Choice) -> None:
        self.starts += 1
        self.begun.set()
        assert self.allowed.wait(20.0)

    def change(self, network: Network) -> None:
        """Change nothing."""


@pytest.fixture
def slow() -> Iterator[tuple[Slow, Trial]]:
    found, ended = Slow(), threading.Event()
    trial = Trial(found, CHOICE, Network())
    thread = threading.Thread(target=trial.serve, args=(ended.is_set,))
    thread.start()
    try:
        yield found, trial
    finally:
        found.allowed.set()
        ended.set()
        thread.join(20.0)
    assert not thread.is_alive()


def post(
    trial: Trial, path: str, body: bytes = b"", *, missing: int = 0, sent: threading.Event | None = None
) -> dict[str, Any]:
    """Post a body, note that it is sent, and return the answer; close early if it lacks its last bytes."""
    token = trial.address.rstrip("/").rpartition("/")[2]
    connection = HTTPConnection("127.0.0.1", trial.port, timeout=20.0)
    try:
        connection.putrequest("POST", f"/{token}/{path}")
        connection.putheader("Origin", f"http://127.0.0.1:{trial.port}")
        connection.putheader("Content-Length", str(len(body) + missing))
        connection.endheaders(body)
        if sent is not None:
            sent.set()
        return {} if missing else dict(json.loads(connection.getresponse().read()))
    finally:
        connection.close()


def test_stop_ends_a_restart_and_those_that_wait(slow: tuple[Slow, Trial]) -> None:
    bridges, trial = slow
    body = json.dumps({"wall_stiffness": 100.0, "controllers": {"left": "wsc"}}).encode()
    with ThreadPoolExecutor(2) as requests:
        restarts = [requests.submit(post, trial, "restart", body)]
        assert bridges.begun.wait(20.0)
        sent = threading.Event()
        restarts.append(requests.submit(post, trial, "restart", body, sent=sent))
        # The server reads requests in their order.
        assert sent.wait(20.0)
        assert post(trial, "stop") == {}
        bridges.allowed.set()
        for restart in restarts:
            answer = restart.result(20.0)
            assert not answer["done"]
            assert str(answer["text"]).startswith("STOP was pressed")
    assert bridges.starts == 1
    assert post(trial, "restart", body)["done"]


def test_a_request_that_ends_early_is_no_error_of_the_server(
    capfd: pytest.CaptureFixture[str], slow: tuple[Slow, Trial]
) -> None:
    bridges, trial = slow
    bridges.allowed.set()
    post(trial, "restart", b"{", missing=10)
    assert post(trial, "network", b'{"delay_s":0.1}')["done"]
    assert bridges.starts == 0
    assert "Traceback" not in capfd.readouterr().err


def test_the_reason_of_a_close_is_short_in_bytes() -> None:
    for text in ("x" * 200, "x" + "\u00e9" * 200, "\U0001f9ff" * 50):
        reason = close_reason(text)
        assert MAX_REASON - 4 < len(reason.encode()) <= MAX_REASON
        assert text.startswith(reason)
