"""Partly invalid telemetry: valid parts are shown, invalid ones are reported, and the other side continues."""

import contextlib
import io
import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from haptether.bridge import TelemetryReader, telemetry
from haptether.view import SideState, panel
from haptether.view.console.bodies import Bodies
from haptether.view.console.feed import SideFeed

SIGNALS = {
    "position": ("axes", [[0.0, 0.1, 0.05]]),
    "device_force": ("axes", [[-1.0, 2.0, 1.5]]),
    "grasp_force": ("axes", [[0.0, 0.0, 0.0]]),
    "round_trip_s": ("number", [0.01, 0.02, 0.015]),
    "tripped": ("bits", [1, 0]),
    "fault": ("count", 0),
    "state": ("name", "engaged"),
    "clutch": ("flag", True),
}
HELLO = {
    "kind": "hello", "schema": 1, "side": "master", "security": "secure", "version": "0.1.0", "scene": None,
    "signals": [{"name": name, "kind": kind, "size": 1, "meaning": name} for name, (kind, _) in SIGNALS.items()],
}  # fmt: skip
VALUES = {name: value for name, (_, value) in SIGNALS.items()}
SAMPLE = {"kind": "sample", "time_ns": 1_000_000, "ticks": 17, "dropped": 0, "unsent_changes": 0, "signals": VALUES}
CHANGE = {"kind": "change", "time_ns": 1_000_000, "signal": "tripped", "from": 0, "to": 1}


def without(message: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in message.items() if key != name}


def changed(**signals: object) -> dict[str, Any]:
    return SAMPLE | {"signals": VALUES | signals}


ODD: dict[str, tuple[Any, str]] = {
    "no JSON": (b"\xff\x00 none", "no line of telemetry"),
    "an empty line": (b"", "no line of telemetry"),
    "another kind": ({"kind": "pulse", "time_ns": 1}, "pulse"),
    "no list": ([1, 2], "no line of telemetry"),
    **{f"without {key}": (without(SAMPLE, key), key) for key in ("time_ns", "ticks", "dropped", "signals")},
    **{f"without {name}": (SAMPLE | {"signals": without(VALUES, name)}, f"{name} = None") for name in VALUES},
    "a text as force": (changed(device_force="strong"), "device_force = strong"),
    "two numbers": (changed(device_force=[[1.0, 2.0]]), "device_force"),
    "two axes": (changed(position=[[0.0] * 3, [0.0] * 3]), "position"),
    "no axis": (changed(position=[]), "position"),
    "a number beyond all": (changed(round_trip_s=[0, 10**400, 1]), "round_trip_s"),
    "a flag as number": (changed(round_trip_s=[True, True, True]), "round_trip_s"),
    "bits below 0": (changed(tripped=[-1, 0]), "tripped"),
    "a number as name": (changed(state=7), "state = 7"),
    "a name as flag": (changed(clutch="open"), "clutch = open"),
    "a signal of nobody": (changed(torque=[[0.0] * 3]), "torque"),
    "a change to a text": (CHANGE | {"to": "hsc"}, "tripped = hsc"),
    "a change of nobody": (CHANGE | {"signal": "mood"}, "mood"),
}


@contextlib.contextmanager
def sending(path: Path, *lines: object, hello: object = HELLO) -> Iterator[None]:
    """Open a socket that sends these lines to each client, then nothing."""
    ended = threading.Event()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()

        def serve() -> None:
            while not ended.is_set():
                with contextlib.suppress(OSError):
                    client, _ = listening.accept()
                    with client:
                        for line in (hello, *lines):
                            client.sendall((line if isinstance(line, bytes) else json.dumps(line).encode()) + b"\n")
                        ended.wait(30.0)

        server = threading.Thread(target=serve, daemon=True)
        server.start()
        try:
            yield
        finally:
            ended.set()
            with contextlib.suppress(OSError):
                listening.shutdown(socket.SHUT_RDWR)
            server.join(30.0)


@pytest.mark.parametrize("odd", ODD)
def test_what_is_valid_is_shown_and_what_is_not_is_reported(odd: str, tmp_path: Path) -> None:
    line, said = ODD[odd]
    last = changed(position=[[0.0, 0.1, 0.07]])
    with sending(tmp_path / "m.sock", SAMPLE, line, last), sending(tmp_path / "s.sock", SAMPLE):
        feeds = [SideFeed(tmp_path / name, name, Bodies().take) for name in ("m.sock", "s.sock")]
        for feed in feeds:
            feed.start()
        end_s, shown, rows = time.monotonic() + 20.0, [], [dict[str, Any](), dict[str, Any]()]
        try:
            while time.monotonic() < end_s:
                shown = [feed.summary() for feed in feeds]
                rows = [row | feed.take_row() for row, feed in zip(rows, feeds, strict=True)]
                if rows[0].get("position") == [0.07] and rows[1]:
                    break
                time.sleep(0.005)
        finally:
            for feed in feeds:
                feed.close()
    assert rows[0]["position"] == [0.07], shown
    assert rows[1]["position"] == [0.05]
    shown = [feed.summary() for feed in feeds]
    assert said in shown[0]["invalid"], shown[0]
    assert (shown[1]["invalid"], shown[1]["state"]) == ("", "engaged")
    assert shown[0]["state"] == "engaged"
    json.dumps([shown, rows], allow_nan=False)


@pytest.mark.parametrize("odd", ODD)
def test_the_panel_of_a_terminal_reports_it_too(odd: str, tmp_path: Path) -> None:
    line, _ = ODD[odd]
    with sending(tmp_path / "m.sock", line, SAMPLE), TelemetryReader(tmp_path / "m.sock") as reader:
        state = SideState(reader.hello)
        for message in reader:
            state.take(message)
            screen = Console(file=io.StringIO(), width=100)
            screen.print(panel(state, 100))
            if state.last("position") == [0.05] and state.last("state") == "engaged":
                break
    assert state.invalid == 1
    assert "invalid telemetry" in screen.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("scene", [{"safety": [1]}, {"safety": {"grasp_threshold": "high", "controllers": ["hsc"]}}, {
    "master": "none"}])  # fmt: skip
def test_a_scene_of_another_version_leaves_the_page_a_side(scene: object, tmp_path: Path) -> None:
    hello = HELLO | {"scene": scene}
    with sending(tmp_path / "m.sock", SAMPLE, hello=hello):
        feed = SideFeed(tmp_path / "m.sock", "m", Bodies().take)
        feed.start()
        end_s = time.monotonic() + 20.0
        while "not connected" in str(feed.summary()["trouble"]) and time.monotonic() < end_s:
            time.sleep(0.005)
        shown = feed.summary()
        feed.close()
    json.dumps(shown, allow_nan=False)
    assert shown["side"] == "master" or shown["trouble"]


def test_the_socket_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(telemetry, "_OWNERS", frozenset({12_345}))
    with sending(tmp_path / "m.sock", SAMPLE), pytest.raises(PermissionError, match=r"m\.sock: is the socket of user"):
        TelemetryReader(tmp_path / "m.sock")
