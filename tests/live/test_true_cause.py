"""Place of a fault, the driver's own words, and the remedies: on both screens and in every record."""

import json
import os
import queue
import re
import secrets
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.live.sides import Arm, Hand, how, packaged, until

from haptether.bridge import (
    DeviceError,
    LiveMaster,
    LiveSlave,
    MasterLoop,
    MasterRun,
    SlaveLoop,
    SlaveRun,
    load_scene,
    read_recording,
    scene_json,
    write_key,
)
from haptether.slave import SlaveSample

pytestmark = pytest.mark.live

ONE = scene_json(load_scene("remote_push", ["environment.pushers=[]"]))
COMMAND = [sys.executable, "-m", "haptether"]
TIMEOUT_S = 30.0

DRIVER = """
import os
from haptether.slave import SlaveSample

class Arm:
    paces = False
    def __init__(self, words: str, fails: str = "", raises: str = "") -> None:
        self.position, self.words, self.fails, self.raises = 0.02, words, fails, raises
    def open(self): pass
    def read(self):
        fault = self.words if self.fails and os.path.exists(self.fails) else None
        return SlaveSample(self.position, 0.0, max(0.0, -100.0 * self.position), fault)
    def write(self, position, velocity):
        self.position = position[0]
        if self.raises and os.path.exists(self.raises):
            raise OSError(self.words)  # the line
    def stop(self): pass
    def close(self): pass
"""
LINE = next(number for number, line in enumerate(textwrap.dedent(DRIVER).splitlines(), 1) if "# the line" in line)


class Screen:
    """A command with its standard error, line by line."""

    def __init__(self, environment: dict[str, str], *arguments: str) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, *arguments], env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip
        self.lines: list[str] = []
        self._waiting: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        with self.process.stderr as lines:
            for line in lines:
                self._waiting.put(line)
        self._waiting.put("")

    def until(self, said: str, again: signal.Signals | None = None) -> str:
        """Wait for a line that contains `said`, and return it; send the signal `again` if a late loop ignored it."""
        while True:
            try:
                line = self._waiting.get(timeout=TIMEOUT_S if again is None else 2.0)
            except queue.Empty:
                if again is None:
                    pytest.fail(f"{said!r} was not said: {self.lines}")
                self.process.send_signal(again)
                again = None
                continue
            assert line, (said, self.lines)
            self.lines.append(line.rstrip("\n"))
            if said in line:
                return self.lines[-1]

    def join(self) -> None:
        """Wait until all of its output has been read."""
        self._reader.join(timeout=TIMEOUT_S)

    def end(self) -> str:
        """Wait for the end and return all of its output."""
        self.process.wait(timeout=TIMEOUT_S)
        self.join()
        while line := self._waiting.get(timeout=TIMEOUT_S):
            self.lines.append(line.rstrip("\n"))
        return "\n".join(self.lines)


@pytest.fixture
def screens() -> Iterator[list[Screen]]:
    running: list[Screen] = []
    yield running
    for screen in running:
        if screen.process.poll() is None:
            screen.process.kill()
        screen.process.wait()
        screen.join()


def begun(tmp_path: Path, screens: list[Screen], *flags: str, secure: bool, **options: str) -> tuple[Screen, Screen]:
    """Start a slave with the driver, and a master, both recorded."""
    key = ["--insecure"]
    if secure:
        write_key(tmp_path / "key")
        key = ["--key", str(tmp_path / "key")]
    environment = packaged(tmp_path, DRIVER)

    def files(side: str) -> list[str]:
        kinds = {"json": "json", "flight": "flight", "record": "mcap"}
        return [word for name, end in kinds.items() for word in (f"--{name}", str(tmp_path / f"{side}.{end}"))]

    scene = ["--scene", "remote_push", "--set", "environment.pushers=[]"]
    device = [
        word for name, value in options.items() for word in ("--set", f"slave.options.{name}={json.dumps(value)}")
    ]
    slave = Screen(
        environment, "slave", "--listen", "127.0.0.1:0", *key, *scene, "--set", "slave.device=bench", *device,
        "--patience-s", "20", *files("slave"), *filter(None, flags),
    )  # fmt: skip
    screens.append(slave)
    found = re.search(r"listens on ([\d.:]+)", slave.until("listens on"))
    assert found
    master = Screen(environment, "master", "--peer", found[1], *key, *scene, "--clutch", "once", *files("master"))
    screens.append(master)
    master.until("master: engaged")
    return slave, master


WORDS = "joint 4: the brake [/nope] is \x1b[2Jstuck"
SHOWN = "joint 4: the brake [/nope] is \\ufffd[2Jstuck"


# A loop that woke late accepts no press.
@pytest.mark.alone
@pytest.mark.sampled(1)
@pytest.mark.parametrize("secure", [False, True], ids=["insecure", "secure"])
def test_a_fault_of_the_arm_is_shown_at_both_screens_with_what_to_do_in_order(
    tmp_path: Path, screens: list[Screen], secure: bool
) -> None:
    flag = tmp_path / "fails"
    slave, master = begun(tmp_path, screens, secure=secure, words=WORDS, fails=str(flag))
    flag.touch()
    text = "the slave has a fault: joint 4: the brake [/nope] is "
    here, there = master.process.pid, slave.process.pid
    for side, states in ((slave, ("fault",)), (master, ("hold", "stop"))):
        assert side.until(text).startswith(tuple(f"{state}: {text}" for state in states))
        assert "\x1b" not in side.lines[-1]
    slave_acknowledges = "  1. mend the cause, then acknowledge it at the slave "
    presses = "  2. release the clutch at the master and press it again "
    assert master.until("  1.") == f"{slave_acknowledges}(there: kill -USR2 PID)"
    assert master.until("  2.") == f"{presses}(here: kill -USR1 {here})"
    assert slave.until("  1.") == f"{slave_acknowledges}(here: kill -USR2 {there})"
    assert slave.until("  2.") == f"{presses}(there: kill -USR1 PID)"
    if not any(line.startswith("stop") for line in master.lines):
        assert master.until(text).startswith(f"stop: {text}")
        master.until("  2.")

    # A press that nobody could answer is reported at once. A loop that woke late accepts none for a while.
    time.sleep(0.5)
    master.process.send_signal(signal.SIGUSR1)
    begun_s = time.monotonic()
    assert master.until("the clutch", again=signal.SIGUSR1).startswith(f"the clutch does nothing yet: {text}")
    assert time.monotonic() - begun_s < 6.0
    assert master.until("  1.") == f"{slave_acknowledges}(there: kill -USR2 PID)"

    # In this order of remedies it couples again.
    flag.unlink()
    slave.process.send_signal(signal.SIGUSR2)
    assert slave.until("slave: acknowledged") == "slave: acknowledged: what was wrong counts as mended"
    time.sleep(0.5)
    master.process.send_signal(signal.SIGUSR1)
    time.sleep(1.0)
    flag.touch()
    assert re.match(r"(hold|stop): ", master.until(text))
    time.sleep(0.5)
    for side in (master, slave):
        side.process.send_signal(signal.SIGINT)
        side.end()
    for name in ("master", "slave"):
        result = json.loads((tmp_path / f"{name}.json").read_text())
        flight = json.loads((tmp_path / f"{name}.flight").read_text())
        recording = read_recording(tmp_path / f"{name}.mcap")
        causes = [flight["causes"][0], {"at": recording.causes[0].at, "text": recording.causes[0].text}]
        for cause in [result["cause"], *causes] if name == "master" else causes:
            assert cause["at"] == "slave"
            assert cause["text"] == json.loads(f'"the slave has a fault: {SHOWN}"')
        assert [step.remedy for step in recording.causes[0].steps] == ["acknowledge", "press"]
        assert recording.causes[0].time_ns > 0
        assert "fault" in set(recording.signals["state" if name == "slave" else "peer_state"])
    for name in ("master.flight", "master.mcap", "slave.mcap"):
        explained = subprocess.run(
            [*COMMAND, "explain", str(tmp_path / name)],
            env=os.environ | {"COLUMNS": "80"}, capture_output=True, text=True, timeout=TIMEOUT_S, check=True,
        ).stdout  # fmt: skip
        said = " ".join(explained.split())
        # Both files contain the words of the arm.
        assert "the slave has a fault: joint 4: the brake [/nope]" in said
        assert "1. mend the cause, then acknowledge it at the slave" in said
        assert "\x1b" not in explained
        assert max(map(len, explained.splitlines())) <= 80


@pytest.mark.parametrize("debug", [False, True], ids=["plain", "debug"])
def test_a_drivers_exception_shows_file_and_line_at_both_screens_and_its_traceback_with_debug(
    tmp_path: Path, screens: list[Screen], debug: bool
) -> None:
    flag = tmp_path / "raises"
    slave, master = begun(tmp_path, screens, "--debug" * debug, secure=False, words="unplugged", raises=str(flag))
    flag.touch()
    seen = re.compile(rf"Arm: OSError: unplugged \(\S*bench_arm\.py:{LINE}, in write\)")
    assert seen.search(master.until("the slave has a fault"))
    assert master.until("and has ended").endswith("in write)")
    assert "start the slave again" in master.until("  1.")
    said = slave.end()
    assert slave.process.returncode == 1
    # This process is gone: nothing is left to acknowledge there.
    assert "mend the cause, then start the slave again" in said
    assert "acknowledge" not in said
    assert said.splitlines()[-1] == "haptether: failed: see above"
    assert ("Traceback" in said) == debug
    assert ("raise OSError(self.words)" in said) == debug
    master.process.send_signal(signal.SIGINT)
    master.end()


def cause(side: Any) -> dict[str, Any]:  # noqa: ANN401  # any of the four
    said = side.cause()
    return json.loads(said) if said is not None else {}


def test_a_fault_of_the_hands_device_is_shown_at_the_slave() -> None:
    slave = LiveSlave(ONE, listen="127.0.0.1:0", **how())
    hand = Hand()
    master = MasterRun(hand, MasterLoop(ONE, peer=slave.address, **how()))
    until(lambda: slave.state == "engaged")
    assert master.cause() is None
    assert slave.cause() is None
    hand.fault = "the stylus is out of its workspace"
    text = f"the master has a fault: {hand.fault}"
    for side in (master, slave):
        until(lambda side=side: cause(side).get("text") == text)  # type: ignore[misc]
        shown = cause(side)
        assert shown["at"] == "master"
        assert [(step["at"], step["remedy"]) for step in shown["steps"]] == [
            ("master", "acknowledge"), ("master", "press"),
        ]  # fmt: skip
    hand.fault = None
    master.acknowledge()
    until(lambda: master.state == "disengaged")
    master.press_clutch()
    until(lambda: slave.state == "engaged" and slave.cause() is None)
    master.finish()
    slave.finish()


class UnsayableError(Exception):
    """An error whose text cannot be read."""

    def __str__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError("no such joint"), "Hand: OSError: no such joint ("),
        (UnsayableError(), "Hand: UnsayableError ("),
        (ValueError("bad \udcff name"), "Hand: ValueError: bad \\udcff name ("),
        (ValueError("long " * 200), "Hand: ValueError: long long"),
    ],
    ids=["plain", "no words", "no UTF-8", "long"],
)
def test_an_exception_of_any_kind_reaches_the_other_side(error: Exception, said: str) -> None:
    slave = LiveSlave(ONE, listen="127.0.0.1:0", **how())
    hand = Hand()
    master = MasterRun(hand, MasterLoop(ONE, peer=slave.address, **how()))
    until(lambda: slave.state == "engaged")
    hand.raises = error
    until(lambda: cause(slave).get("text", "").startswith(f"the master has a fault, and has ended: {said}"))
    master.finish()
    assert isinstance(master.error, DeviceError)
    slave.finish()
    assert slave.state != "engaged"


def test_a_sample_that_is_none_names_the_line_that_gave_it() -> None:
    class Odd:
        paces = False

        def open(self) -> None:
            pass

        def read(self) -> SlaveSample:
            return SlaveSample("nowhere", 0.0, 0.0)  # type: ignore[arg-type]

        def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
            pass

        def stop(self) -> None:
            pass

        def close(self) -> None:
            pass

    run = SlaveRun(Odd(), SlaveLoop(ONE, listen="127.0.0.1:0", **how()))
    until(lambda: run.finished)
    run.finish()
    first = Odd.read.__code__.co_firstlineno
    assert re.search(rf"position = nowhere: must be .* \(\S*test_true_cause\.py:{first}, in read\)", str(run.error))


@pytest.mark.parametrize("secure", [True, False], ids=["secure", "insecure"])
@pytest.mark.parametrize("first", ["master", "slave"])
def test_an_orderly_end_is_no_hold(secure: bool, first: str) -> None:
    kind: dict[str, Any] = {"key": secrets.token_bytes(32)} if secure else {"insecure": True}
    slave = LiveSlave(ONE, listen="127.0.0.1:0", run_id=1, **kind)
    master = LiveMaster(ONE, peer=slave.address, run_id=2, **kind)
    until(lambda: slave.state == "engaged" == master.state)
    time.sleep(0.5)
    ends, stays = (master, slave) if first == "master" else (slave, master)
    ends.finish()
    until(lambda: cause(stays).get("text") == f"the {first} has ended")
    # This is longer than the time to a stop.
    time.sleep(0.4)
    assert stays.state == "disengaged"
    assert cause(stays)["at"] == first
    _, report = stays.finish()
    assert report.holds == 0
    flight = json.loads(stays.flight() or "{}")
    assert [step["reason"] for step in flight["transitions"]][-1] == "peer has ended"
    assert flight["causes"][-1]["text"] == f"the {first} has ended"


@pytest.mark.parametrize("first", ["master", "slave"])
def test_the_end_of_a_driven_side_comes_before_its_silence(first: str) -> None:
    """Even if the report of a run is fetched late, the other side learns of the end before."""
    driven: Any
    stays: Any
    if first == "slave":
        loop = SlaveLoop(ONE, listen="127.0.0.1:0", **how())
        driven = SlaveRun(Arm(), loop)
        stays = LiveMaster(ONE, peer=loop.address, **how())
    else:
        stays = LiveSlave(ONE, listen="127.0.0.1:0", **how())
        driven = MasterRun(Hand(), MasterLoop(ONE, peer=stays.address, **how()))
    until(lambda: stays.state == "engaged")
    driven.stop()
    until(lambda: cause(stays).get("text") == f"the {first} has ended")
    driven.finish()
    _, report = stays.finish()
    assert report.holds == 0


def test_the_end_of_a_master_is_said_at_the_screen_of_the_slave(tmp_path: Path, screens: list[Screen]) -> None:
    slave, master = begun(tmp_path, screens, secure=True, words="none")
    master.process.send_signal(signal.SIGINT)
    assert slave.until("the master has ended") == "the master has ended"
    assert slave.until("  1.").startswith("  1. start the master again, and press the clutch")
    said = master.end()
    assert master.process.returncode == 0, said
    slave.process.send_signal(signal.SIGINT)
    said = slave.end()
    assert not any(line.startswith(("hold:", "stop:", "fault:")) for line in said.splitlines())
