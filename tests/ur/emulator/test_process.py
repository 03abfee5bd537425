"""The process of an emulated controller: its end, its refusals, its control line."""

import json
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from tests.ur.emulated import emulator, free_host

from haptether.cli import main

pytestmark = pytest.mark.live


@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "end of input"])
def test_it_ends_cleanly(how: str) -> None:
    with emulator() as running:
        assert running.process.stdin is not None
        if how == "end of input":
            running.process.stdin.close()
        else:
            running.process.send_signal(signal.Signals[how])
        assert running.process.wait(5.0) == 0


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["--host", "192.0.2.1"], 2, "add --expose"),
        (["--host", "nowhere"], 2, "must be an IPv4 address"),
        (["--host", "::1"], 2, "must be an IPv4 address"),
        (["--model", "ur6"], 2, "must be one of"),
        (["--version", "4.2"], 2, "must be 3.15"),
        (["--scene", "no_scene"], 2, "no shipped scene"),
        (["--noise", "-1"], 2, "must be finite and 0 or more"),
        (["--start", "9", "0", "0", "0", "0", "0"], 2, "start"),
        (["--control", "192.0.2.1:9000"], 2, "control = "),
        (["--gripper", "2f-85", "--gripper-port", "65536"], 2, "gripper_port = 65536: must be 0 to 65535"),
        (["--gripper", "2f-85", "--gripper-object-mm", "90"], 2, "gripper_object_mm = 90: 90 mm: must be 0 to 85 mm"),
        (["--gripper", "2f-85", "--gripper-object-mm", "nan"], 2, "gripper_object_mm = nan: width nan m"),
        (["--gripper-object-mm", "40"], 2, "--gripper must name a gripper"),
        (["--gripper-active"], 2, "--gripper must name a gripper"),
    ],
)
def test_bad_requests_are_refused(
    arguments: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    host = ["--host", free_host()] if "--host" not in arguments else []
    assert main(["ur-emulator", "--duration-s", "1", *host, *arguments]) == status
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1


def test_a_port_in_use_is_a_failed_run(capsys: pytest.CaptureFixture[str]) -> None:
    with emulator() as running:
        assert main(["ur-emulator", "--host", running.host]) == 1
        assert f"{running.host}:30004" in capsys.readouterr().err


def test_the_control_line_on_a_socket(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    host = free_host()
    command = [sys.executable, "-m", "haptether", "ur-emulator", "--host", host, "--control", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert f"controlled by {path}" in process.stdout.readline()
        assert path.stat().st_mode & 0o077 == 0
        with socket.socket(socket.AF_UNIX) as control:
            control.settimeout(5.0)
            control.connect(str(path))
            control.sendall(b"status\nnonsense\n\n \r\nquit\n")
            answers = b""
            while received := control.recv(1 << 16):
                answers += received
        status, error, empty, blank, end = answers.decode().splitlines()
        assert json.loads(status.removeprefix("ok "))["model"] == "ur5e"
        assert error.startswith("error: 'nonsense': must be one of")
        # A client that waits for an answer to each line must get one.
        assert empty == blank
        assert empty.startswith("error: an empty line: must be one of")
        assert end == "ok"
        assert process.wait(5.0) == 0
        assert not path.exists()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
