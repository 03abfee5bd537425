"""The hand of a page on real pairs: it grips and opens, and couples nothing."""

import contextlib
import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from tests.view.console.served import http, wait_for
from tests.view.trial.tried import NAMES, Tried, tried
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

pytestmark = pytest.mark.live

GRIP = {"stiffness": 300.0, "damping": 8.0, "strength_n": 12.0}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tried]:
    with tried(tmp_path_factory.mktemp("try")) as found:
        yield found


class Pointer:
    """WebSocket of a page's hand, without a page."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.token = json.loads(socket.recv(timeout=5.0))["token"]

    def ask(self, **request: object) -> dict[str, Any]:
        self.socket.send(json.dumps({"token": self.token, **request}))
        answer: dict[str, Any] = json.loads(self.socket.recv(timeout=5.0))
        self.token = answer["token"]
        return answer

    def aim(self, target: float, **changed: float) -> dict[str, Any]:
        return self.ask(do="aim", target=[target], **{**GRIP, **changed})

    def hold(self, target: float, seconds: float) -> None:
        # The page opens first, too; it connects to the sides.
        assert self.aim(target, strength_n=0.0)["done"]
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            answer = self.aim(target)
            assert answer["done"], answer["text"]
            time.sleep(0.02)


@contextlib.contextmanager
def pointer(runs: Tried, origin: str | None = None) -> Iterator[Pointer]:
    with connect(
        f"ws://127.0.0.1:{runs.trial.port}/{runs.token}/hand",
        origin=Origin(origin or f"http://127.0.0.1:{runs.trial.port}"), proxy=None, compression=None,
    ) as socket:  # fmt: skip
        yield Pointer(socket)


def test_the_same_hand_moves_both_styluses_and_couples_neither(runs: Tried) -> None:
    with pointer(runs) as hand:
        hand.hold(0.05, 0.8)
        assert all(abs(at - 0.05) < 0.01 for at in runs.positions().values())
        hand.hold(-0.03, 0.8)
        # Nobody has engaged: no wall is felt, however long and firmly the hand grips.
        assert all(abs(at + 0.03) < 0.01 for at in runs.positions().values())
        assert runs.states() == {"disengaged"}
        assert hand.aim(0.02, strength_n=0.0)["done"]


def test_a_second_pointer_is_refused_until_the_first_has_gone(runs: Tried) -> None:
    with pointer(runs) as second:
        with pointer(runs) as first:
            first.hold(0.02, 0.1)
            assert second.aim(0.06)["text"] == "another page holds the stylus"
        wait_for(lambda: bool(second.aim(0.02)["done"]), 5.0)


def test_late_and_stopped_aims_open_the_hand(runs: Tried) -> None:
    with pointer(runs) as hand:
        hand.hold(0.02, 0.1)
        old = hand.token
        time.sleep(0.5)
        assert "the page was late" in hand.aim(0.02)["text"]
        # With a fresh token, the lapsed grip still counts as open.
        assert "let go, and grip again" in hand.aim(0.02)["text"]
        assert hand.ask(do="aim", target=[0.02], **{**GRIP, "token": old})["text"].startswith("the page was late")
        assert "the page was late" in hand.ask(do="push", force=[1.0], duration_s=0.1, token=old)["text"]
        assert hand.aim(0.02, strength_n=0.0)["done"]
        assert hand.aim(0.02)["done"]


def test_values_out_of_bounds_reach_no_hand(runs: Tried) -> None:
    with pointer(runs) as hand:
        for changed in ({"stiffness": 2001.0}, {"damping": 51.0}, {"strength_n": 51.0}):
            answer = hand.aim(0.02, **changed)
            assert not answer["done"]
            assert all(f"{name}: " in answer["text"] for name in NAMES)
            assert hand.aim(0.02, strength_n=0.0)["done"]
    for text in ("", "aim", '{"do":"hold","token":1}', '{"do":"aim","token":1}', "x" * 5000):
        with pointer(runs) as hand:
            hand.socket.send(text)
            with pytest.raises(ConnectionClosed):
                hand.socket.recv(timeout=5.0)
    assert runs.states() == {"disengaged"}


@pytest.mark.parametrize("origin", ["http://127.0.0.1:1", "http://haptether.example", "null"])
def test_another_origin_has_no_hand_and_no_settings(runs: Tried, origin: str) -> None:
    with pytest.raises(InvalidStatus), pointer(runs, origin):
        pass
    for path in ("restart", "network", "stop"):
        status, _, _ = http(
            runs.trial.port, "POST", f"/{runs.token}/{path}",
            {"Host": f"127.0.0.1:{runs.trial.port}", "Origin": origin, "Content-Length": "0"},
        )  # fmt: skip
        assert status == 403
    assert runs.states() == {"disengaged"}
