"""`haptether view --connect` beside live sides."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageGrab
from tests.view.unanswered import master

from haptether.view.window.playback import KEYS

# The views draw on all processors: real-time loops beside them would be late.
pytestmark = pytest.mark.alone

TIMEOUT_S = 60.0
SMALL = ("--size", "420x300")


def view(path: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "haptether", "view", "--connect", str(path), "--wait-s", "30", *SMALL, *arguments]


def test_a_live_run_as_picture_film_and_page_without_a_display(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    files = {"--screenshot": "a.png", "--movie": "a.gif", "--html": "a.html"}
    written = [word for option, name in files.items() for word in (option, str(tmp_path / name))]
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    with master(path, "--patience-s", "30") as side:
        seen = subprocess.run(
            view(path, *written, "--fps", "5", "--from-s", "0.5", "--until-s", "1.5", "--at-s", "1"),
            capture_output=True, text=True, timeout=TIMEOUT_S, check=False, env=environment,
        )  # fmt: skip
        # The view has not affected the side.
        assert side.poll() is None
        side.send_signal(signal.SIGINT)
        side.wait(TIMEOUT_S)
    assert (seen.returncode, seen.stderr.strip()) == (0, "")
    assert "the robot is not drawn: nothing of the slave was given" in seen.stdout
    with Image.open(tmp_path / "a.png") as picture:
        assert np.std(np.asarray(picture)) > 10.0
    with Image.open(tmp_path / "a.gif") as film:
        assert 1 <= film.n_frames <= 6  # type: ignore[attr-defined]
    assert "const CONTENT" in (tmp_path / "a.html").read_text()


def test_a_side_that_is_killed_is_no_end(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    with master(path, "--patience-s", "30") as side:
        command = view(path, "--at-s", "3600", "--screenshot", str(tmp_path / "a.png"))
        seen = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert seen.stdout is not None
        assert "following" in seen.stdout.readline()
        side.kill()
        _, error = seen.communicate(timeout=TIMEOUT_S)
    assert seen.returncode == 1
    assert "without a word: the side has failed or was killed" in error
    assert not (tmp_path / "a.png").exists()


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Yield a virtual screen that nobody sees."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb")
    readable, writable = os.pipe()
    command = ["Xvfb", "-displayfd", str(writable), "-screen", "0", "640x480x24", "-nolisten", "tcp", "-noreset"]
    with subprocess.Popen(command, pass_fds=[writable], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        os.close(writable)
        # The number comes in pieces; closing the pipe too early ends the server.
        with os.fdopen(readable) as number:
            name = f":{number.readline().strip()}"
        monkeypatch.setenv("DISPLAY", name)
        yield name
        server.terminate()
        server.wait(TIMEOUT_S)


def test_a_window_shows_a_live_run_and_ends_with_it(display: str, tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    with master(path, "--patience-s", "30") as side:
        seen = subprocess.Popen(view(path), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        until_s = time.monotonic() + TIMEOUT_S
        # The screen is black, then a white window, then has hundreds of colours.
        while len(np.unique(np.asarray(ImageGrab.grab(xdisplay=display)).reshape(-1, 3), axis=0)) < 100:
            assert seen.poll() is None, seen.communicate()[1]
            assert time.monotonic() < until_s
            time.sleep(0.1)
        side.send_signal(signal.SIGINT)
        side.wait(TIMEOUT_S)
        _, error = seen.communicate(timeout=TIMEOUT_S)
    assert (seen.returncode, error) == (0, "")


def test_every_key_steers_a_window_through_the_events_of_its_toolkit(display: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "VTK_DEFAULT_OPENGL_WINDOW"}
    ended = subprocess.run(
        [sys.executable, "-m", "tests.view.steered"], capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
        env=environment | {"DISPLAY": display},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    rows = json.loads(ended.stdout)
    (opened, space, timer, pause, home, right, left, up, down, slower, end, trip, *looks, keys, gone, unknown, closed,
     click) = rows  # fmt: skip
    assert (opened["time_s"], opened["playing"]) == (2.0, False)
    assert space["playing"]
    assert timer["time_s"] > 2.0
    assert not pause["playing"]
    assert [home["time_s"], right["time_s"], left["time_s"]] == pytest.approx([0.0, 0.01, 0.0])
    assert [up["speed"], down["speed"], slower["speed"]] == [2.0, 1.0, 0.5]
    assert end["time_s"] == pytest.approx(3.999)
    assert 2.6 < trip["time_s"] < 2.8, "after the last trip comes the first"
    assert [look["camera"] for look in looks] == ["front", "side", "top", "corner"]
    for key, does in KEYS:
        assert key in keys["keys"]
        assert does in keys["keys"]
    assert gone["keys"] == ""
    assert unknown | {"event": ""} == gone | {"event": ""}
    assert closed["closed"]
    assert click["time_s"] == pytest.approx(1.0, abs=0.05)
