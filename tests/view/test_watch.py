"""`haptether watch` beside a live side, on a pipe and on a terminal."""

import os
import pty
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.view.unanswered import master

from haptether.cli.entry import main

pytestmark = pytest.mark.live

TIMEOUT_S = 60.0


def watch(path: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "haptether", "watch", str(path), "--wait-s", "30", *arguments]


def test_it_prints_lines_until_the_run_ends(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    with master(path, "--patience-s", "3") as side:
        seen = subprocess.run(watch(path), capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        side.wait(TIMEOUT_S)
    assert (seen.returncode, seen.stderr) == (0, "")
    assert re.search(r"^\d\.\d s  ALIGNING .* slave: not heard$", seen.stdout, re.MULTILINE)
    assert "\x1b" not in seen.stdout


def test_a_run_that_is_killed_is_no_end(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    with master(path, "--patience-s", "60") as side:
        seen = subprocess.Popen(watch(path), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert seen.stdout is not None
        # A reader may connect before the side's first ticks.
        assert any("ALIGNING" in line for line in seen.stdout)
        side.kill()
        _, error = seen.communicate(timeout=TIMEOUT_S)
    assert seen.returncode == 1
    assert "without a word: the side has failed or was killed" in error


def test_on_a_terminal_it_is_a_panel_that_ctrl_c_ends(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    near, far = pty.openpty()
    with master(path, "--patience-s", "60") as side:
        environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100", "LINES": "40"}
        seen = subprocess.Popen(watch(path), stdout=far, stderr=far, env=environment)
        os.close(far)
        screen = b""
        until_s = time.monotonic() + TIMEOUT_S
        while b"loop late" not in screen:
            assert time.monotonic() < until_s, screen
            screen += os.read(near, 4096)
        seen.send_signal(signal.SIGINT)
        assert seen.wait(TIMEOUT_S) == 130
        os.close(near)
        # The reader has not affected the side.
        assert side.poll() is None
        side.send_signal(signal.SIGINT)
        side.wait(TIMEOUT_S)
    assert b"master, Haptether" in screen
    assert b"ALIGNING" in screen


def test_nobody_there_is_one_line_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("no socket")
    none, file = str(tmp_path / "none.sock"), str(tmp_path / "file")
    begun_s = time.monotonic()
    for arguments, option, said in (
        (["watch", none], "telemetry", "no such file"),
        (["watch", file], "telemetry", "nobody sends there"),
        (["console", "--connect", none], "telemetry", "no such file"),
        (["console", "--connect", file], "telemetry", "nobody sends there"),
        (["view", "--connect", none, "--html", str(tmp_path / "a.html")], "telemetry", "no such file"),
    ):
        path = none if none in arguments else file
        assert main(arguments) == 1, arguments
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert f"{path}: {said}: start master or slave with --{option} {path} first, or give --wait-s" in error
    # The command does not wait for seconds, even on a loaded machine.
    assert time.monotonic() - begun_s < 5.0


def test_a_control_socket_that_is_missing_ends_the_console_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, missing = tmp_path / "m.sock", tmp_path / "m.ctl"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as side:
        side.bind(str(path))
        side.listen()
        assert main(["console", "--connect", str(path), "--control", str(missing)]) == 1
    assert f"{missing}: no such file: start master or slave with --control {missing}" in capsys.readouterr().err


@pytest.mark.parametrize("wait_s", ["-1", "nan"])
def test_a_wait_is_a_time(wait_s: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", str(tmp_path / "none.sock"), "--wait-s", wait_s]) == 2
    assert "wait-s = " in capsys.readouterr().err


def test_a_side_that_comes_later_may_be_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "none.sock"
    begun_s = time.monotonic()
    assert main(["watch", str(path), "--wait-s", "0.4"]) == 1
    assert time.monotonic() - begun_s >= 0.4
    assert "no such file" in capsys.readouterr().err
