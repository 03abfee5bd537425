"""`haptether check-device` and `haptether list` as processes: status, questions, and the forces written to a device."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.devices.drivers import WRITTEN, declared
from tests.devices.terminal import QUESTION, Terminal, forces, run

pytestmark = pytest.mark.live


def test_a_driver_that_is_right_is_status_0_and_one_that_is_not_is_status_1_with_its_line(tmp_path: Path) -> None:
    environment = declared(tmp_path, stylus="Stylus", broken="RaisesInRead", closes="RaisesInClose")
    good = run(environment, "check-device", "stylus", "--duration-s", "1", "--json", "-")
    assert good.returncode == 0, good.stderr
    report = json.loads(good.stdout)
    assert (report["side"], report["kind"], report["axes"], report["passed"]) == ("master", "linear", 3, True)
    assert report["timing"]["period_p99_s"] >= report["timing"]["period_p50_s"] > 0.0
    assert {"close after an exception", "velocity"} <= {found["check"] for found in report["findings"]}
    assert "stylus: open, a master of kind linear" in good.stderr
    bad = run(environment, "check-device", "broken", "--duration-s", "1")
    assert bad.returncode == 1
    assert "KeyError: 'encoder'" in bad.stdout
    # Source lines help only the author of the driver.
    assert "drivers.py" not in bad.stdout + bad.stderr
    assert "Traceback" not in bad.stderr
    assert "1 to mend" in bad.stdout
    debug = run(environment, "check-device", "broken", "--duration-s", "1", "--debug")
    assert "Traceback" in debug.stderr
    assert "in read\n    raise KeyError(message)" in debug.stderr
    closes = run(environment, "check-device", "closes", "--duration-s", "0.5", "--options", "held=false")
    assert closes.returncode == 1
    assert "close after an exception" in closes.stdout


@pytest.mark.parametrize(
    ("driver", "message", "verdict"),
    [
        ("Refused", "supply: off: plug it in", "refused: see above"),
        ("RefusedTwice", "supply: off: plug it in", "refused: see above"),
        ("RaisesInOpen", "no such bus", "OSError: no such bus"),
        ("Faulty", "overheated", "the device reports: overheated"),
        ("FaultyAndSaysSo", "overheated", "the device reports: see above"),
        ("Unplugged", "the cable is out", "Unplugged: OSError: see above"),
    ],
)
def test_each_error_is_printed_once_and_without_its_source(
    tmp_path: Path, driver: str, message: str, verdict: str
) -> None:
    environment = declared(tmp_path, device=driver) | {"COLUMNS": "300"}
    command = ("check-device", "device", "--duration-s", "0.5")
    ended = run(environment, *command, "--json", str(tmp_path / "report.json"))
    printed = ended.stdout + ended.stderr
    assert printed.count(message) == 1, printed
    assert verdict in ended.stdout
    assert ended.returncode == 1, "a fault in the run is no pass"
    assert ".py" not in printed
    # The report is complete without the printed text.
    assert message in (tmp_path / "report.json").read_text()
    debug = run(environment, *command, "--debug")
    assert ("drivers.py" in debug.stderr) == (driver not in {"Faulty", "FaultyAndSaysSo"})


def test_a_refusal_is_printed_once_on_a_terminal_that_breaks_its_line(tmp_path: Path) -> None:
    terminal = Terminal(declared(tmp_path, device="RefusedTwice"), "check-device", "device", "--duration-s", "0.5")
    assert terminal.end() == 1, terminal.printed
    printed = "".join(terminal.printed.split())
    assert printed.count("moreandmore:closeit") == 1, terminal.printed
    assert "refused:seeabove" in printed


def test_an_arm_is_opened_read_stopped_and_closed_twice_and_never_written(tmp_path: Path) -> None:
    environment = declared(tmp_path, "haptether.slaves", arm="Arm") | {WRITTEN: str(tmp_path / "written")}
    ended = run(environment, "check-device", "arm", "--duration-s", "0.5", "--options", "axes=3", "--kind", "linear")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert (tmp_path / "written").read_text().split() == ["open", "stop", "close"] * 2


def test_a_driver_that_hangs_in_open_ends_with_status_1_in_bounded_time(tmp_path: Path) -> None:
    begun_s = time.monotonic()
    ended = run(declared(tmp_path, hung="HungInOpen"), "check-device", "hung", "--open-s", "0.5")
    assert ended.returncode == 1
    assert "does not return" in ended.stdout
    assert time.monotonic() - begun_s < 30.0


@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["check-device", "styluss"], "did you mean stylus? there is any, arm, both, "),
        (["check-device", "both"], "--side master or --side slave"),
        (["check-device", "stylus", "--options", "hold=1"], "it takes (*, held: bool = True"),
        (["check-device", "stylus", "--options", "held"], "must be table.key=value"),
        (["check-device", "stylus", "--kind", "pose"], "kind = pose: stylus is a driver of linear"),
        (["check-device", "stylus", "--duration-s", "nan"], "duration-s = nan: must be between"),
        (["check-device", "stylus", "--period-s", "1"], "period-s = 1: must be between 0.0001 and 0.1 s"),
        (["check-device", "stylus", "--push-n", "0.5"], "a person must say yes on the terminal, and there is none"),
        (["check-device", "stylus", "--push-n", "1.5", "--yes"], "push-n = 1.5: must be at most 1 N"),
        (["check-device", "stylus", "--push-n", "-0.5", "--yes"], "push-n = -0.5: must be above 0"),
        (["check-device", "any", "--push-n", "0.1", "--yes"], "is of linear or joints: say which by --kind"),
        (["identify", "any", "--yes"], "is of linear or joints: say which by --kind"),
        (["check-device", "any", "--push-n", "0.2", "--yes", "--kind", "joints"], "must be at most 0.1 N m"),
        (["check-device", "arm", "--push-n", "0.5", "--yes"], "an arm is never moved"),
        (["check-device", "robotiq", "--push-n", "0.5", "--yes"], "jaws are never moved"),
    ],
)
def test_a_bad_request_is_one_line_and_status_2_and_opens_nothing(
    tmp_path: Path, arguments: list[str], said: str
) -> None:
    environment = declared(tmp_path, stylus="Stylus", both="Stylus", any="OfAnyKind") | {
        WRITTEN: str(tmp_path / "written")
    }
    package = tmp_path / "bench_drivers-1.0.dist-info" / "entry_points.txt"
    drivers = "tests.devices.drivers"
    package.write_text(package.read_text() + f"[haptether.slaves]\narm = {drivers}:Arm\nboth = {drivers}:Arm\n")
    ended = run(environment, *arguments)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "written").exists()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("wrong", "status", "said"),
    [
        ("", 0, "0.250 of 0 (open) to 1 (closed)"),
        ("slow", 1, "must be at most 5 ms"),
        ("none", 1, "read() gives NoneType: must be a GripperSample"),
        ("hold", 1, "hold() raises: the jaws may go on as they were sent"),
        ("fault", 1, "the gripper reports: overheating: let it cool"),
    ],
)
def test_jaws_are_held_and_never_sent_anywhere(tmp_path: Path, wrong: str, status: int, said: str) -> None:
    environment = declared(tmp_path, "haptether.grippers", jaws="Jaws") | {
        WRITTEN: str(tmp_path / "written"), "COLUMNS": "200",
    }  # fmt: skip
    ended = run(environment, "check-device", "jaws", "--duration-s", "0.3", "--options", f"wrong='{wrong}'")
    assert ended.returncode == status, ended.stdout + ended.stderr
    assert said in ended.stdout
    calls = (tmp_path / "written").read_text().split()
    assert calls[0] == "open"
    assert calls[-1] == "close"
    assert set(calls[1:-1]) == {"hold"}


def test_jaws_that_an_activation_moves_are_activated_on_a_persons_word_only(tmp_path: Path) -> None:
    command = ("check-device", "robotiq", "--options", "host=127.0.0.1", "activate=true")
    environment = declared(tmp_path)
    ended = run(environment, *command)
    assert ended.returncode == 2
    assert "an activation moves the jaws: a person must say yes on the terminal" in ended.stderr
    terminal = Terminal(environment, *command)
    terminal.until(QUESTION)
    terminal.answer("no\n")
    assert terminal.end() == 1
    assert "robotiq: not opened: nobody said yes" in terminal.printed


@pytest.mark.sampled(2)
@pytest.mark.parametrize("answer", ["no\n", "\n", "y\n", "yes"])
def test_nothing_but_a_yes_on_the_terminal_pushes(tmp_path: Path, answer: str) -> None:
    environment = declared(tmp_path, stylus="Stylus") | {WRITTEN: str(tmp_path / "written")}
    terminal = Terminal(environment, "check-device", "stylus", "--duration-s", "0.5", "--push-n", "0.5")
    # An answer typed before the question does not count.
    terminal.answer("yes\n")
    terminal.until(QUESTION)
    terminal.answer(answer)
    if answer == "yes":
        # The answer has no Enter, so the question waits until Ctrl-C.
        time.sleep(0.5)
        terminal.process.send_signal(signal.SIGINT)
    assert terminal.end() == (130 if answer == "yes" else 0), terminal.printed
    assert set(forces(tmp_path / "written")) == {0.0}
    assert ("nobody said yes" in terminal.printed) == (answer != "yes")


def test_a_push_along_an_axis_that_there_is_not_is_none(tmp_path: Path) -> None:
    environment = declared(tmp_path, stylus="Stylus") | {WRITTEN: str(tmp_path / "written")}
    ended = run(
        environment, "check-device", "stylus", "--duration-s", "0.5", "--push-n", "0.5", "--push-axis", "3", "--yes"
    )
    assert "axis 3: there is 0 to 2" in ended.stdout
    assert set(forces(tmp_path / "written")) == {0.0}


def test_a_yes_pushes_once_and_ends_at_zero(tmp_path: Path) -> None:
    environment = declared(tmp_path, stylus="Stylus") | {WRITTEN: str(tmp_path / "written")}
    arguments = ["--duration-s", "0.5", "--push-n", "0.3", "--options", "held=false"]
    terminal = Terminal(environment, "check-device", "stylus", *arguments)
    terminal.until(QUESTION)
    terminal.answer("yes\n")
    assert terminal.end() == 0, terminal.printed
    told = forces(tmp_path / "written")
    assert max(told) == pytest.approx(0.3, abs=1e-4)
    assert min(told) == told[-1] == 0.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_takes_the_push_away_at_once(tmp_path: Path, number: signal.Signals) -> None:
    written = tmp_path / "written"
    environment = declared(tmp_path, stylus="Stylus") | {WRITTEN: str(written)}
    arguments = ["--duration-s", "0.5", "--push-n", "0.5", "--options", "held=false"]
    terminal = Terminal(environment, "check-device", "stylus", *arguments)
    terminal.until(QUESTION)
    terminal.answer("yes\n")
    while not any(forces(written)[-5:]) or forces(written)[-1] < 0.2:
        terminal.read(0.005)
    at = len(forces(written))
    terminal.process.send_signal(number)
    assert terminal.end() == 130, terminal.printed
    told = forces(written)
    assert written.read_text().split()[-1] == "close"
    assert told[-1] == 0.0
    # At least 1 s of the push was left.
    assert sum(force > 0.0 for force in told[at:]) < 400


def test_a_driver_that_cannot_be_loaded_is_listed_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "broken_vendor.py").write_text("raise KeyError('no licence')\n")
    environment = declared(
        tmp_path, stylus="Stylus", vendor="broken_vendor:Device", gone="no_such_module:Device", number="math:pi"
    )
    ended = run(environment, "list", "--json", str(tmp_path / "list.json"))
    assert ended.returncode == 0, ended.stderr
    report = json.loads((tmp_path / "list.json").read_text())
    assert {"gone", "number", "stylus", "vendor"} <= set(report["[master] driver"])
    assert report["cannot be loaded"] == {
        "[master] driver": {
            "gone": "no_such_module:Device of bench-drivers cannot be loaded: No module named 'no_such_module'",
            "number": "math:pi of bench-drivers is no driver: must be a class or a function",
            "vendor": "broken_vendor:Device of bench-drivers cannot be loaded: KeyError: 'no licence'",
        }
    }
    shown = ended.stdout
    assert re.search(r"^  .*\bstylus\b", shown, re.MULTILINE)
    for name, why in report["cannot be loaded"]["[master] driver"].items():
        assert f"\n  {name}: {why}" in shown
    named = run(environment, "check-device", "vendor", "--debug")
    assert named.returncode == 2
    assert "cannot be loaded: KeyError: 'no licence'" in named.stderr
    assert 'broken_vendor.py", line 1' in named.stderr


OWN_FORCE = "EXERTS FORCE OR TORQUE BY ITSELF"
COMMANDS = [("check-device", "--duration-s", "0.5"), ("identify",)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_a_device_that_exerts_by_itself_is_not_opened_before_a_person_says_yes(
    tmp_path: Path, command: tuple[str, ...]
) -> None:
    written = tmp_path / "written"
    environment = declared(tmp_path, bears="BearsItself") | {WRITTEN: str(written)}
    name, *more = command
    refused = run(environment, name, "bears", *more)
    assert (refused.returncode, refused.stdout) == (2, "")
    if name == "check-device":
        assert "bears exerts a force by itself as soon as it is open: a person must say yes" in refused.stderr
    assert not written.exists()
    terminal = Terminal(environment, name, "bears", *more)
    terminal.until(QUESTION)
    assert OWN_FORCE in terminal.printed
    assert not written.exists()
    terminal.answer("no\n")
    assert terminal.end() == 1
    assert "nobody said yes: it was not opened" in terminal.printed
    assert not written.exists()
    ended = Terminal(environment, name, "bears", *more)
    ended.until(QUESTION)
    ended.process.send_signal(signal.SIGINT)
    assert ended.end() == 130
    assert not written.exists()


def test_each_time_that_a_device_exerts_by_itself_its_begin_and_its_end_are_said(tmp_path: Path) -> None:
    environment = declared(tmp_path, bears="BearsItself", hangs="HangsAndBearsItself")
    terminal = Terminal(environment, "check-device", "bears", "--duration-s", "0.5")
    terminal.until(QUESTION)
    terminal.answer("yes\n")
    # It asks again before it opens again: the yes was for the first opening.
    terminal.until("bears will be opened again.")
    terminal.until(QUESTION, count=2)
    terminal.answer("yes\n")
    assert terminal.end() == 0, terminal.printed
    begun, closed = "bears: is opened: from now on it exerts force by itself", "bears: is closed: its force has ended"
    assert terminal.printed.index(OWN_FORCE) < terminal.printed.index(begun) < terminal.printed.index(closed)
    assert (terminal.printed.count(begun), terminal.printed.count(closed)) == (2, 2)
    assert "zero force beside its own" in terminal.printed
    hung = run(environment, "check-device", "hangs", "--duration-s", "0.5", "--yes")
    assert OWN_FORCE in hung.stderr
    assert "hangs: is NOT known to be closed: it may still exert, switch it off" in hung.stderr
    assert "hangs: is closed" not in hung.stderr


@pytest.mark.parametrize("answer", ["no", "interrupt"])
def test_a_second_opening_has_a_yes_of_its_own(tmp_path: Path, answer: str) -> None:
    written = tmp_path / "written"
    environment = declared(tmp_path, bears="BearsItself") | {WRITTEN: str(written)}
    terminal = Terminal(environment, "check-device", "bears", "--duration-s", "0.5")
    terminal.until(QUESTION)
    terminal.answer("yes\n")
    terminal.until(QUESTION, count=2)
    if answer == "no":
        terminal.answer("no\n")
    else:
        terminal.process.send_signal(signal.SIGINT)
    assert terminal.end() == (0 if answer == "no" else 130)
    assert written.read_text().split().count("open") == 1
    if answer == "no":
        # An unchecked property has not passed.
        assert "close after an exception" in terminal.printed
        assert "nobody said yes: it was not opened" in terminal.printed


PRESSED_AT_FINDINGS = """
import os, signal, sys
from haptether.bridge.devices.check.report import DeviceCheck
from haptether.cli import main
findings = DeviceCheck.findings
def pressed(check):
    os.kill(os.getpid(), signal.SIGINT)
    return findings(check)
DeviceCheck.findings = pressed
raise SystemExit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("driver", ["BearsItself", "Stylus"])
def test_ctrl_c_while_its_samples_are_looked_at_opens_nothing(tmp_path: Path, driver: str) -> None:
    """Evaluating many samples takes time, in which a person may press Ctrl-C."""
    written = tmp_path / "written"
    environment = declared(tmp_path, device=driver) | {WRITTEN: str(written)}
    ended = subprocess.run(
        [sys.executable, "-c", PRESSED_AT_FINDINGS, "check-device", "device", "--duration-s", "0.5", "--yes"],
        env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    assert ended.returncode == 130, ended.stderr
    assert written.read_text().split().count("open") == 1
    assert ended.stderr.count("from now on it exerts force by itself") == (driver == "BearsItself")


def test_an_open_that_hangs_is_not_said_to_have_ended(tmp_path: Path) -> None:
    terminal = Terminal(declared(tmp_path, hangs="HangsInOpenAndBearsItself"), "check-device", "hangs", "--yes")
    terminal.until("from now on it exerts force by itself")
    terminal.until("opening hangs")
    terminal.process.send_signal(signal.SIGINT)
    assert terminal.end() == 130
    assert "hangs: is NOT known to be closed: it may still exert, switch it off" in terminal.printed


def test_identify_asks_to_support_it_and_then_to_let_go(tmp_path: Path) -> None:
    written = tmp_path / "written"
    terminal = Terminal(
        declared(tmp_path, bears="BearsItself") | {WRITTEN: str(written)}, "identify", "bears", "--axes", "0"
    )
    terminal.until(QUESTION)
    terminal.answer("yes\n")
    terminal.until("Nobody may hold or touch it")
    assert written.read_text().startswith("open")
    terminal.answer("no\n")
    assert terminal.end() == 1
    assert "bears: is closed: its force has ended" in terminal.printed
