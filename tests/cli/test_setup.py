"""`haptether setup`: answers, files, checks, and an engaged pair on an emulated UR controller."""

import contextlib
import io
import json
import os
import pty
import select
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.live.sides import free_port
from tests.ur.emulated import free_host

from haptether.bridge import load_scene, read_key
from haptether.cli import main
from haptether.cli.setup.questions import QUESTIONS

COMMAND = [sys.executable, "-m", "haptether"]
EMULATED = ["--emulate", "yes"]
CASES: dict[str, tuple[list[str], tuple[str, int, str | None, str], list[str]]] = {
    # Options; kind, axes and driver of the master, device of the slave; emulators.
    "models": ([], ("linear", 3, None, "simulated"), []),
    "a UR arm": (["--arm", "ur", *EMULATED, "--gripper", "robotiq"], ("linear", 3, None, "ur"),
                 ["ur-emulator --host 127.0.0.1 --gripper 2f-85"]),
    "an Inverse3 and a UR arm": (["--master", "inverse3", "--arm", "ur", "--arm-address", "192.0.2.10", "--emulate",
                                  "no", "--address", "192.0.2.7:9000", "--end", "master"],
                                 ("linear", 3, "inverse3", "ur"), []),
    "two arms of servos": (["--master", "dynamixel", "--arm", "dynamixel", *EMULATED],
                           ("joints", 6, "dynamixel", "dynamixel"), ["leader.port", "follower.port"]),
    "a leader of a UR arm": (["--master", "dynamixel", "--arm", "ur", *EMULATED], ("pose", 3, "dynamixel", "ur"),
                             ["ur-emulator", "leader.port"]),
    "a model and a follower": (["--arm", "dynamixel", *EMULATED], ("joints", 6, None, "dynamixel"),
                               ["follower.port"]),
    "options": (["--master", "inverse3", "--arm", "ur", *EMULATED, "--arm-options", "model=ur10e", "--master-options",
                 "max_force_n=2"], ("linear", 3, "inverse3", "ur"), ["inverse3-emulator", "--model ur10e"]),
}  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Iterator[Path]:
    with contextlib.chdir(tmp_path):
        yield tmp_path / "cell"


def setup(*arguments: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any], str]:
    """Run in this process, without a terminal; return status, JSON and standard error."""
    status = main(["setup", "cell", *arguments, "--json", "-"])
    said = capsys.readouterr()
    return status, msgspec.json.decode(said.out) if said.out else {}, " ".join(said.err.split())


@pytest.mark.parametrize(("options", "scene", "emulators"), CASES.values(), ids=CASES)
def test_scene_key_and_scripts_are_written_and_pass_their_checks(
    folder: Path,
    options: list[str],
    scene: tuple[str, int, str | None, str],
    emulators: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    status, report, said = setup(*options, capsys=capsys)
    assert status == 0
    answered = report["answers"]
    for name, answer in answered.items():
        option = f"--{name.replace('_', '-')}"
        assert (f"{option} = {answer}: the default" in said) == (option not in options)
    written = load_scene(folder / "scene.toml")
    assert written.slave is not None
    kind = written.master.kind or "linear"
    assert (kind, written.master.axes, written.master.driver, written.slave.device) == scene
    assert len(read_key(folder / "arm.key")) == 32
    assert report["files"] == sorted(map(str, folder.iterdir()))
    for path in folder.iterdir():
        is_script = path.suffix == ".sh"
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if is_script else 0o600), path
        if is_script:
            subprocess.run(["sh", "-n", str(path)], check=True)
    assert (folder / "start-emulators.sh").exists() == bool(emulators)
    for part in emulators:
        assert part in (folder / "start-emulators.sh").read_text()
    listen = "0.0.0.0:9000" if "--end" in options else "127.0.0.1:9000"
    assert f"--listen {listen} --key arm.key" in (folder / "start-slave.sh").read_text()
    assert "--clutch" not in (folder / "start-master.sh").read_text()
    checks = {check["name"]: check for check in report["checks"]}
    assert {"key", "scene", "master", "link"} <= checks.keys()
    assert ("arm" in checks) == ("--end" not in options)
    assert all(check["remedy"] for check in checks.values() if check["state"] == "missing")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--master", "inverse"], "--master = inverse: did you mean inverse3?: must be simulated, dynamixel,"),
        (["--master", "inverse3", "--arm", "dynamixel"], "--arm = dynamixel: no such choice with the answers before"),
        (["--master", "touch", "--gripper", "dynamixel"], "--gripper = dynamixel: no such choice"),
        (["--gripper", "robotiq"], "--gripper = robotiq: no such choice"),
        (["--arm", "ur", "--emulate", "maybe"], "--emulate = maybe: no such choice"),
        (["--arm", "ur"], "--arm-address: is missing: must be an IPv4 address or a name, without a port"),
        (["--arm", "ur", "--arm-address", "10.0.0.9:30004"], "is no address or name: must be an IPv4 address"),
        (["--arm", "ur", *EMULATED, "--arm-address", "10.0.0.9"], "emulators listen to this machine only"),
        (["--address", "192.0.2.7"], "--address = 192.0.2.7: has no port: must be HOST:PORT, such as 192.0.2.7:9000"),
        (["--address", "192.0.2.7:0"], "0 is no port"),
        (["--address", "0.0.0.0:9000"], "is the address of no peer"),
        (["--address", "[::]:9000"], "is the address of no peer"),
        (["--address", "[::1:9000"], "has no closing bracket: must be HOST:PORT"),
        (["--end", "slave"], "--end: has no use with the answers before it: leave it out"),
        (["--arm", "dynamixel", "--arm-address", "ttyUSB0"], "--arm-address = ttyUSB0: is no absolute path"),
        (["--arm", "dynamixel", "--arm-address", "/dev/ttyUSB0", "--arm-file", "no.toml"],
         "--arm-file = no.toml: no such file (haptether dynamixel calibrate writes it)"),
        (["--arm-options", "model"], "model"),
        (["--arm", "ur", *EMULATED, "--arm-options", "modell=ur10e"], "modell = 'ur10e': is no option: must be one of"),
        (["--arm", "ur", *EMULATED, "--gripper", "robotiq", "--gripper-options", "model=2f"], "model"),
        (["--master", "inverse3", *EMULATED, "--master-options", "max_force=2"], "max_force = 2: is no option"),
        (["--arm", "dynamixel", *EMULATED, "--arm-options", "speed=2"], "speed = 2: is no option"),
        (["--check"], "cell/setup.json: no such file: haptether setup cell writes it"),
        (["--check", "--arm", "ur"], "cell/setup.json: no such file"),
    ],
)  # fmt: skip
def test_a_wrong_answer_says_what_is_allowed_and_writes_nothing(
    folder: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, _, err = setup(*options, capsys=capsys)
    assert status == 2
    assert said in err
    assert not folder.exists()


def test_a_wrong_answer_on_a_terminal_is_asked_again(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Typed(io.StringIO):
        def isatty(self) -> bool:
            return True

    typed = ["joystick", "", "urr", "ur", "none", "yes", "9000", "127.0.0.1:9000", "192.0.2.1", "127.0.0.9"]
    monkeypatch.setattr(sys, "stdin", Typed("\n".join(typed) + "\n"))
    status, report, err = setup(capsys=capsys)
    assert status == 0
    expected = {"master": "simulated", "arm": "ur", "gripper": "none", "emulate": "yes"}
    assert report["answers"] == {**expected, "address": "127.0.0.1:9000", "arm_address": "127.0.0.9"}
    for wrong in ("--master = joystick: ", "--arm = urr: did you mean ur?", "--address = 9000: has no port"):
        assert wrong in err
    assert "host=" not in err
    assert load_scene(folder / "scene.toml").slave.options["host"] == "127.0.0.9"  # type: ignore[union-attr]
    monkeypatch.setattr(sys, "stdin", Typed("simulated\n"))
    assert main(["setup", "other"]) == 2
    assert "standard input has ended" in capsys.readouterr().err


def test_each_question_has_its_option_and_its_files_are_not_replaced(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["setup", "cell"]) == 0
    capsys.readouterr()
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["setup", "cell", "--force"]) == 2
    assert "must be an empty folder, or none" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    with pytest.raises(SystemExit):
        main(["setup", "--help"])
    text = capsys.readouterr().out
    assert all(question.option in text for question in QUESTIONS)


def test_the_checks_find_what_is_wrong(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert setup("--end", "slave", "--address", "192.0.2.7:9000", capsys=capsys)[0] == 0
    (folder / "arm.key").chmod(0o644)
    scene = folder / "scene.toml"
    scene.write_text(scene.read_text().replace('controllers = ["wsc"]', "controllers = []\n[environment]\n"
                     "[[environment.pushers]]\nforce_n = [7.0, 0.0, 0.0]"))  # fmt: skip
    for wrong_option, said in ((("--end", "left"), "must be master, slave or both"), (("--arm", "ur"), "no use with")):
        assert said in setup("--check", *wrong_option, capsys=capsys)[2]
    status, report, _ = setup("--check", "--end", "slave", capsys=capsys)
    assert status == 1
    wrong = {check["name"]: check for check in report["checks"] if check["state"] == "mend"}
    assert wrong.keys() == {"key", "scene, ejection"}
    assert "--force" in wrong["key"]["remedy"]


def test_the_script_of_the_hand_starts_on_a_terminal_only(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    setup(capsys=capsys)
    ended = subprocess.run([str(folder / "start-master.sh")], stdin=subprocess.DEVNULL, capture_output=True, text=True,
                           check=False)  # fmt: skip
    assert ended.returncode == 2
    assert "a person presses the clutch" in ended.stderr


@pytest.mark.alone
@pytest.mark.live
@pytest.mark.timeout(180)
def test_from_nothing_to_an_engaged_pair_with_an_emulated_arm(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    address, host = f"127.0.0.1:{free_port()}", free_host()
    status, *_ = setup("--arm", "ur", *EMULATED, "--arm-address", host, "--address", address, capsys=capsys)
    assert status == 0
    with contextlib.ExitStack() as stack:
        emulator = stack.enter_context(script(folder / "start-emulators.sh"))
        until(emulator, "listening on")
        slave = stack.enter_context(script(folder / "start-slave.sh"))
        until(slave, "listens on")
        status, report, err = setup("--check", capsys=capsys)
        assert status == 0, (report, err)
        checks = {check["name"]: check for check in report["checks"]}
        assert "in use by the slave that runs" in checks["arm"]["text"]
        assert checks["link"]["text"].startswith("good enough")
        # A person at a terminal: nothing engages before Enter.
        terminal, end = pty.openpty()
        stack.callback(os.close, terminal)
        arguments = ["--duration-s", "1", "--json", "run.json"]
        master = subprocess.Popen([str(folder / "start-master.sh"), *arguments], stdin=end, stdout=end, stderr=end)
        os.close(end)
        stack.callback(ended, master)
        shown = read(terminal, "Enter presses the clutch", 30.0)
        assert "engaged" not in shown
        os.write(terminal, b"\n")
        shown += read(terminal, "state at the end", 60.0)
        assert master.wait(30.0) == 0, shown
    result = json.loads((folder / "run.json").read_text())
    assert result["engaged_s"] is not None
    assert result["final_state"] == "engaged"


@contextlib.contextmanager
def script(path: Path) -> Iterator["subprocess.Popen[str]"]:
    process = subprocess.Popen(
        [str(path)], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        yield process
    finally:
        ended(process)
        assert process.stdout is not None
        process.stdout.close()


def ended(process: "subprocess.Popen[str] | subprocess.Popen[bytes]") -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30.0)
        finally:
            process.kill()
            process.wait()


def until(process: "subprocess.Popen[str]", text: str) -> None:
    assert process.stdout is not None
    while text not in (line := process.stdout.readline()):
        assert line, "it ended"


def read(terminal: int, text: str, seconds: float) -> str:
    """Return the output up to a text."""
    shown, end_s = "", time.monotonic() + seconds
    while text not in shown:
        assert time.monotonic() < end_s, shown
        if select.select([terminal], [], [], 0.1)[0]:
            shown += os.read(terminal, 1 << 16).decode(errors="replace")
    return shown
