"""Requests to a running proxy: their effects and their refusals."""

import json
import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from haptether.netsim import Controlled, ControlSocket, DelayTrace, LinkSettings, Proxy, ProxyStatistics, ask_control

pytestmark = pytest.mark.live

PATIENCE_S = 10.0


class Changes:
    """A stand-in for a proxy that keeps the received changes."""

    def __init__(self) -> None:
        self.received: list[tuple[str, LinkSettings]] = []

    def change(self, direction: str, settings: LinkSettings) -> None:
        self.received.append((direction, settings))

    def statistics(self) -> ProxyStatistics:
        raise AssertionError


def handled(request: object, *, forward: LinkSettings | None = None) -> tuple[dict[str, Any], Changes, bool]:
    changes = Changes()
    controlled = Controlled(changes, forward or LinkSettings(delay_s=0.05, loss=0.01), LinkSettings(), lambda _: {})
    line = request if isinstance(request, bytes) else json.dumps(request).encode()
    answer, goes_on = controlled.answer(line)
    return answer, changes, goes_on


def test_what_is_not_named_stays() -> None:
    answer, changes, _ = handled({"forward": {"delay_s": 0.1}, "backward": {"loss": 0.5, "mean_burst": 4}})
    assert answer == {
        "ok": True,
        "changed": {
            "forward": {"delay_s": {"old": 0.05, "new": 0.1}},
            "backward": {"loss": {"old": None, "new": 0.5}, "mean_burst": {"old": None, "new": 4.0}},
        },
    }
    assert changes.received == [
        ("forward", LinkSettings(delay_s=0.1, loss=0.01)),
        ("backward", LinkSettings(loss=0.5, mean_burst=4.0)),
    ]
    answer, changes, _ = handled({"forward": {"loss": None, "outages": [{"times": {"kind": "once", "at_s": 1.0,
                                                                                 "duration_s": 1.0}}]}})  # fmt: skip
    assert answer["changed"]["forward"]["loss"] == {"old": 0.01, "new": None}
    assert answer["changed"]["forward"]["outages"]["old"] is None
    ((_, settings),) = changes.received
    assert settings.loss is None
    assert settings.outages is not None
    assert handled({"forward": {}})[0] == {"ok": True, "changed": {"forward": {}}}


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({}, "request: must be an object with forward, backward, show"),
        ([1], "request: must be an object with forward, backward, show"),
        ({"forwards": {}}, "forwards: a request has only forward, backward, show"),
        ({"show": 1}, "show: must be true or false"),
        ({"forward": 1}, "forward: must be an object of settings"),
        ({"forward": {"dela_s": 1}}, "forward.dela_s: there is no such setting: did you mean delay_s?"),
        ({"backward": {"delay_s": "a"}}, 'backward.delay_s = "a": must be a number from 0 to 3600'),
        ({"backward": {"loss": 2}}, "backward.loss = 2: must be a number from 0 to 1"),
        ({"forward": {"mean_burst": 1.0, "loss": 0.9}}, "forward.mean_burst"),
        ({"forward": {"slots": {"period_s": 1, "peak": 2}}}, "forward.slots.peak: there is no such setting"),
        ({"forward": {"preset": "starlnk"}}, 'forward.preset = "starlnk": must be one of wired-lan, '),
        ({"forward": {"trace": {"file": "/etc/passwd"}}}, "forward.trace.file: a running proxy reads no files"),
        ({"forward": {"opportunities": {"file": "a.up"}}}, "forward.opportunities.file: a running proxy reads no"),
        ({"forward": {"distribution": "a.dist"}}, 'forward.distribution = "a.dist": must be one of normal, '),
        (b'{"forward": {"delay_s": NaN}}', "no JSON: "),
        (b'{"forward": {"delay_s": 1e999}}', "no JSON: "),
        (b"", "no JSON: "),
        (b"\xff\xfe", "no JSON: "),
        (b"POST / HTTP/1.1\r", "no JSON: "),
        (b"[" * 60_000, "no JSON: "),
    ],
)
def test_a_bad_request_names_the_key_and_changes_nothing(request_: object, said: str) -> None:
    # A valid change beside the bad one.
    if isinstance(request_, dict) and "backward" in request_:
        request_ = {"forward": {"delay_s": 0.2}, **request_}
    answer, changes, goes_on = handled(request_)
    assert answer["ok"] is False
    assert answer["error"].startswith(said)
    assert "\n" not in answer["error"]
    assert not changes.received
    assert goes_on == (not said.startswith("no JSON"))


def test_a_recording_is_shown_by_its_length() -> None:
    trace = DelayTrace(time_s=tuple(map(float, range(5000))), delay_s=(0.1,) * 5000)
    with proxied(LinkSettings(trace=trace)) as (address, _):
        answer = ask_control(address, {"show": True})
    assert answer["forward"]["trace"]["time_s"] == "5000 values"
    assert answer["statistics"] == {"received": 0}


@contextmanager
def proxied(forward: LinkSettings, address: str = "127.0.0.1:0") -> Iterator[tuple[str, Proxy]]:
    proxy = Proxy(listen="127.0.0.1:0", forward="127.0.0.1:9", forward_link=forward, backward_link=LinkSettings(),
                  realtime=False)  # fmt: skip
    with ControlSocket(address) as control:
        control.serve(Controlled(proxy, forward, LinkSettings(), lambda of: {"received": of.forward.received}))
        yield control.address, proxy
    proxy.stop()


@contextmanager
def connected(address: str) -> Iterator[socket.socket]:
    host, port = address.rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as client:
        yield client


def test_requests_may_come_in_pieces_and_together() -> None:
    with proxied(LinkSettings()) as (address, _), connected(address) as client, client.makefile("rb") as answers:
        line = b'{"forward": {"delay_s": 0.1}}\n'
        client.sendall(line[:7])
        client.sendall(line[7:] + line + b'{"forward": {"delay_s": -1}}\n{"show": true}\n')
        assert json.loads(answers.readline())["ok"] is True
        again = {"forward": {"delay_s": {"old": 0.1, "new": 0.1}}}
        assert json.loads(answers.readline()) == {"ok": True, "changed": again}
        assert json.loads(answers.readline())["error"].startswith("forward.delay_s = -1: must be ")
        assert json.loads(answers.readline())["forward"] == {"delay_s": 0.1}


@pytest.mark.parametrize("line", [b"POST / HTTP/1.1\r\n", b" " * 2**16 + b"\n"])
def test_after_a_line_that_is_no_request_nothing_counts(line: bytes) -> None:
    with proxied(LinkSettings()) as (address, _):
        with connected(address) as client, client.makefile("rb") as answers:
            client.sendall(line + b'{"forward": {"delay_s": 0.1}}\n')
            assert json.loads(answers.readline())["ok"] is False
            # Later bytes were never read: the connection may be reset.
            with suppress(ConnectionResetError):
                assert answers.read() == b""
        assert ask_control(address, {"show": True})["forward"] == {}


def test_a_line_without_an_end_is_refused() -> None:
    with proxied(LinkSettings()) as (address, _):
        with connected(address) as client, client.makefile("rb") as answers:
            client.sendall(b" " * 2**16)
            assert json.loads(answers.readline()) == {"ok": False, "error": "request: longer than 65536 bytes"}
        assert ask_control(address, {"show": True})["ok"] is True


def test_a_further_connection_closes_the_idlest_which_is_told_why() -> None:
    with proxied(LinkSettings()) as (address, _), ExitStack() as stack:
        clients = [stack.enter_context(connected(address)) for _ in range(4)]
        for client in clients:
            client.sendall(b'{"show": true}\n')
            assert client.recv(1 << 16).startswith(b'{"ok":true')
        # An incomplete request, or an unread answer, does not make a client active.
        clients[0].sendall(b'{"sh')
        clients[1].sendall(b'{"show": true}\n')
        assert clients[1].recv(1 << 16).startswith(b'{"ok":true')
        begun_s = time.monotonic()
        assert ask_control(address, {"show": True})["ok"] is True
        assert time.monotonic() - begun_s < 1.0
        told = json.loads(clients[0].recv(1 << 16))
        assert (told["ok"], "another program has connected" in told["error"]) == (False, True)
        assert clients[0].recv(1) == b""
        clients[1].sendall(b'{"show": true}\n')
        assert clients[1].recv(1 << 16).startswith(b'{"ok":true')


@pytest.mark.parametrize("idle", [4, 5, 60])
def test_idle_clients_keep_nobody_from_a_setting(idle: int) -> None:
    with proxied(LinkSettings()) as (address, _), ExitStack() as stack:
        # All connect at once: most wait to be accepted when the request comes.
        for _ in range(idle):
            stack.enter_context(connected(address))
        assert ask_control(address, {"forward": {"delay_s": 0.25}})["ok"] is True
        assert ask_control(address, {"show": True})["forward"]["delay_s"] == 0.25


def test_a_client_that_reads_nothing_keeps_no_other_waiting() -> None:
    with proxied(LinkSettings()) as (address, _), ExitStack() as stack:
        for _ in range(3):
            client = stack.enter_context(connected(address))
            client.setblocking(False)
            # The buffer is full, or the connection was closed for that.
            with suppress(OSError):
                while True:
                    client.send(b'{"show": true}\n' * 1000)
        begun_s = time.monotonic()
        assert ask_control(address, {"show": True})["ok"] is True
        assert time.monotonic() - begun_s < 1.0


def test_a_unix_socket_is_its_owners_and_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "control"
    with proxied(LinkSettings(), str(path)):
        assert path.stat().st_mode & 0o777 == 0o600
        assert ask_control(str(path), {"show": True})["ok"] is True
        with pytest.raises(OSError, match="Address already in use"):
            ControlSocket(str(path))
    assert not path.exists()
    path.write_text("precious")
    with pytest.raises(OSError, match="Address already in use"):
        ControlSocket(str(path))
    assert path.read_text() == "precious"


def test_the_socket_of_a_proxy_that_was_killed_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "control"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(path))
    with proxied(LinkSettings(), str(path)):
        assert ask_control(str(path), {"show": True})["ok"] is True
    assert not path.exists()


@pytest.mark.parametrize(
    "address", ["0.0.0.0:1", "192.0.2.7:1", "localhost:1", "127.0.0.1:99999", "[::]:1", "", "a\0b"]
)
def test_only_this_machine_may_control(address: str) -> None:
    for use in (ControlSocket, lambda text: ask_control(text, {"show": True})):
        with pytest.raises(ValueError, match="must be the path of a Unix socket, or 127"):
            use(address)


@pytest.mark.parametrize("place", ["nobody", "left"])
def test_where_no_proxy_listens_it_is_said_how_to_start_one(place: str, tmp_path: Path) -> None:
    if place == "left":
        with socket.socket(socket.AF_UNIX) as left:
            left.bind(str(tmp_path / place))
    path = re.escape(str(tmp_path / place))
    with pytest.raises(OSError, match=f"{path}.*: start one with `haptether netsim proxy --control {path} "):
        ask_control(str(tmp_path / place), {"show": True})


def test_a_request_that_is_too_long_is_not_sent(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="request: 65556 bytes, must be at most 65536"):
        ask_control(str(tmp_path / "nobody"), {"forward": {"a": "x" * 65_535}})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_json_cannot_write_is_refused_and_not_taken_for_a_reset(value: float) -> None:
    with pytest.raises(ValueError, match=r"^forward\.loss = -?(nan|inf): must be a finite number$"):
        ask_control("127.0.0.1:9", {"forward": {"loss": value}})
