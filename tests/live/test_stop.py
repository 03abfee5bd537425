"""Stops with stalled readers of the output, with hanging drivers, and with no memory left."""

import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.devices.drivers import declared
from tests.faults import stopping
from tests.faults.processes import Limits
from tests.faults.rows import Row
from tests.faults.running import HAPTETHER
from tests.scene.two_sides import two_sides
from tests.soak.memory import anonymous_bytes

from haptether.bridge import LiveSlave, read_recording, scene_json
from haptether.cli.live.run import FlightFile, print_kept

pytestmark = pytest.mark.live

BESIDE_OTHERS = {
    stopping.stop_name("master", "pipe", signal.SIGTERM),
    stopping.stop_name("master", "pty", signal.SIGHUP),
    stopping.stop_name("slave", "pipe", signal.SIGHUP),
    stopping.stop_name("slave", "pty", signal.SIGTERM),
}
"""Rows of `make faults` that differ from others only by the signal."""
ROWS = {
    name: measure
    for name, measure in stopping.rows(Limits(hold_s=0.15, fade_s=0.2)).items()
    if name not in BESIDE_OTHERS
}


@pytest.mark.sampled(5)
@pytest.mark.parametrize("measure", ROWS.values(), ids=list(ROWS))
def test_stop(measure: Callable[[], Row]) -> None:
    row = measure()
    assert row.verdict == "ok", f"{row.fault}: {'; '.join(row.complaints)}"


LIVE = (
    ("slave", "--insecure", "--listen", "127.0.0.1:0"),
    ("master", "--insecure", "--peer", "127.0.0.1:9"),
    ("check-link", "--insecure", "--peer", "127.0.0.1:9"),
    ("netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9"),
    ("netsim", "echo", "--listen", "127.0.0.1:0"),
    ("ur-emulator", "--host", "127.77.3.9"),
    ("demo",),
)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("arguments", "kind"),
    list(zip(LIVE, itertools.cycle(["pipe", "pty"]))),
    ids=lambda value: value if isinstance(value, str) else " ".join(value[:2]),
)
def test_commands_end_that_nobody_reads(arguments: tuple[str, ...], kind: str, tmp_path: Path) -> None:
    with stopping.blocked_sink(kind) as sink:
        process = subprocess.Popen(
            [*HAPTETHER, *arguments], stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, cwd=tmp_path
        )
        try:
            time.sleep(2.5)
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            assert process.wait(8.0) in {0, 130}
        finally:
            process.kill()
            process.wait()


@pytest.mark.parametrize("closed", ["2>&-", ">&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_taken_by_nothing_else(closed: str, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    command = " ".join([*HAPTETHER, "slave", "--insecure", "--listen", "127.0.0.1:0", "--patience-s", "0.5",
                        "--record", str(record), "--min-free-bytes", "0"])  # fmt: skip
    ended = subprocess.run(["sh", "-c", f"exec {command} {closed}"], timeout=30, check=False)
    assert ended.returncode == 1, "no master connected"
    assert read_recording(record).whole


OWN_TERMINAL = (
    "import fcntl, os, sys, termios; fcntl.ioctl(1, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
)


def test_a_hung_up_terminal_ends_a_side_in_good_order(tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    reader, writer = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", OWN_TERMINAL, *HAPTETHER, "slave", "--insecure", "--listen", "127.0.0.1:0", "--record",
         str(record), "--min-free-bytes", "0"],
        stdin=writer, stdout=writer, stderr=writer, start_new_session=True,
    )  # fmt: skip
    os.close(writer)
    try:
        while b"real time" not in os.read(reader, 4096):
            pass
        os.close(reader)
        assert process.wait(8.0) in {0, 1}
        assert read_recording(record).whole
    finally:
        process.kill()
        process.wait()


# ------------------------------------------------------------------------------------------- Ctrl-C while it loads

LONG = (
    ("simulate", "remote_push", "--set", "run.duration_s=20000", "record.every=1000000"), ("demo", "--slave", "ur"),
    ("sweep", "remote_push", "--vary", "run.seed=0:999999:1000000"),
)  # fmt: skip
SHORT = (("--help",), ("paper",), ("raven",), ("list",), ("netsim", "list"), ("explain", "none"))
COMMANDS = (*LIVE, *LONG, *SHORT)
DELAYS_S = (0.005, 0.05, 0.1, 0.2, 0.35)


@pytest.mark.parametrize(
    ("arguments", "delay_s"),
    [*zip(COMMANDS, itertools.cycle(DELAYS_S)), *((LIVE[0], delay_s) for delay_s in DELAYS_S[1:])],
    ids=lambda value: f"{value}" if isinstance(value, float) else " ".join(value[:2]),
)
def test_ctrl_c_while_a_command_loads(arguments: tuple[str, ...], delay_s: float, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "haptether", *arguments], stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=tmp_path, bufsize=0,
    )  # fmt: skip
    try:
        stderr = process.stderr
        assert stderr is not None
        # The first import after that of the package comes from the command, which has taken the signal over by then.
        # Before it, Python's own start answers Ctrl-C.
        for line in stderr:
            if line.rstrip().endswith("haptether.cli"):
                break
        stderr.readline()
        reading = threading.Thread(target=lambda: said.append(stderr.read()))
        said: list[str] = []
        reading.start()
        time.sleep(delay_s)
        had_ended = process.poll() is not None
        process.send_signal(signal.SIGINT)
        status = process.wait(30.0)
        reading.join()
    finally:
        process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()
    assert "Traceback" not in said[0]
    assert "KeyboardInterrupt" not in said[0]
    # A process whose Python has begun to end may end by the signal itself: 130 for a shell, too.
    ended = status in {130, -signal.SIGINT}
    # A side that already runs ends in good order; a command that has done its work ends with its own status.
    own = {0} if arguments in LIVE and arguments[0] != "demo" else {0, 1} if arguments in SHORT else set()
    assert had_ended or ended or status in own


@pytest.mark.parametrize("button", [signal.SIGUSR1, signal.SIGUSR2])
@pytest.mark.parametrize("ignored", [True, False])
def test_a_button_pressed_while_a_side_loads_does_not_end_it(button: int, ignored: bool) -> None:
    # A script starts background jobs with SIGINT ignored.
    process = subprocess.Popen(
        ["sh", "-c", 'test "$0" && trap "" INT; exec "$@"', "yes" if ignored else "",
         sys.executable, "-X", "importtime", "-m", "haptether", *LIVE[0], "--realtime", "off"],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, bufsize=1,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        for line in process.stderr:
            if line.rstrip().endswith("haptether.cli.interrupts"):
                break
        time.sleep(0.05)
        process.send_signal(button)
        assert any("slave listens" in line for line in process.stderr)
        reading = threading.Thread(target=process.stderr.read, daemon=True)
        reading.start()
        assert process.poll() is None
        # SIGINT stops a running side even if it was ignored before.
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        assert process.wait(8.0) == 0
        reading.join(8.0)
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


LEAVES_A_THREAD = """
import os, threading, time

class Interpreter:
    def __del__(self, write=os.write):
        write(2, b"the interpreter has ended")

interpreter = Interpreter()

class Arm:
    paces = True
    def __init__(self, fails):
        self.fails = fails
    def open(self):
        threading.Thread(target=time.sleep, args=(60.0,), daemon=True).start()
        print("opening", flush=True)
        if self.fails:
            raise RuntimeError("no such arm")
        time.sleep(60.0)
    def read(self): pass
    def write(self, position, velocity): pass
    def stop(self): pass
    def close(self): pass
"""
LEFT = (*LIVE[0], "--scene", "remote_push", "--set", "slave.device=left", "--set")


@pytest.mark.parametrize(
    ("arguments", "fails", "status"),
    [
        ((*LEFT, "slave.options.fails=false"), False, 130),
        ((*LEFT, "slave.options.fails=true"), True, 1),
        (("check-device", "left", "--options", "fails=true"), True, 1),
    ],
    ids=["interrupted", "failed", "checked"],
)
def test_the_interpreter_does_not_end_under_a_thread_of_a_driver(
    arguments: tuple[str, ...], fails: bool, status: int, tmp_path: Path
) -> None:
    # Python ends such a thread as soon as it asks for the interpreter: C++ code of a library then aborts the process.
    (tmp_path / "left_arm.py").write_text(LEAVES_A_THREAD)
    with subprocess.Popen(
        [*HAPTETHER, *arguments], env=declared(tmp_path, "haptether.slaves", left="left_arm:Arm"), text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "opening\n"
            if not fails:
                process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=20.0)[1]
        finally:
            process.kill()
    assert process.returncode == status, said
    assert "the interpreter has ended" not in said


# ------------------------------------------------------------------------------------------------------- memory


@pytest.mark.thorough
def test_a_side_that_idles_and_records_takes_no_more_memory(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*HAPTETHER, "slave", "--insecure", "--listen", "127.0.0.1:0", "--record", str(tmp_path / "run.mcap"),
         "--min-free-bytes", "0"],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        time.sleep(5.0)
        before = anonymous_bytes(process.pid)
        time.sleep(10.0)
        grown = anonymous_bytes(process.pid) - before
        process.send_signal(signal.SIGTERM)
        assert process.wait(10.0) == 0
    finally:
        process.kill()
        process.wait()
    # An earlier leak per tick was 150 KB per second; this bound allows 900 MB less in a day.
    assert grown < 10 * 5_000, f"{grown / 10.0:.0f} bytes a second"


def test_what_is_kept_of_a_run_is_bounded_and_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    slave = LiveSlave(
        scene_json(two_sides()), listen="127.0.0.1:0", run_id=1, insecure=True, keep_s=0.25, patience_s=1.0
    )
    while not slave.finished:
        assert slave.poll() <= 250
        time.sleep(0.01)
    trace, report = slave.finish()
    assert report.ticks > 500
    assert len(trace) == 250
    assert report.dropped_records == report.ticks - 250
    print_kept(trace, report)
    # A skipped tick makes it longer.
    assert re.search(r"the figures cover the last 0\.2\d* s: --keep-s keeps more", capsys.readouterr().err)
    assert (np.diff(trace.time_s) > 0.0).all()
    assert trace.time_s[-1] > 0.9


# -------------------------------------------------------------------------------------------------------- files


def test_a_flight_file_is_for_its_owner_alone_and_follows_no_link(tmp_path: Path) -> None:
    path, victim = tmp_path / "a.flight", tmp_path / "victim"
    victim.write_text("before")
    (tmp_path / ".a.flight.part").symlink_to(victim)
    flight = FlightFile(path)
    flight.write("one")
    assert path.read_text() == "one"
    assert path.stat().st_mode & 0o777 == 0o600
    # A link that is planted later is replaced.
    path.unlink()
    path.symlink_to(victim)
    flight.write("two")
    assert (path.read_text(), path.is_symlink(), victim.read_text()) == ("two", False, "before")
    assert sorted(each.name for each in tmp_path.iterdir()) == [".a.flight.part", "a.flight", "victim"]
    for name, to in (("planted", victim), ("dangling", tmp_path / "nowhere")):
        (tmp_path / name).symlink_to(to)
        with pytest.raises(OSError, match="is a symbolic link"):
            FlightFile(tmp_path / name)


def test_a_flight_file_that_nobody_reads_is_not_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe")
    FlightFile(tmp_path / "pipe").write("one")
    assert "not written" in capsys.readouterr().err


def test_a_flight_file_that_is_read_slowly_is_whole(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    flight = "x" * 300_000
    read: list[str] = []

    def take() -> None:
        with (tmp_path / "pipe").open() as pipe:
            while taken := pipe.read(10_000):
                read.append(taken)
                time.sleep(0.01)

    reader = threading.Thread(target=take)
    reader.start()
    while not read and reader.is_alive():
        # Repeat until the reader has opened the pipe.
        FlightFile(tmp_path / "pipe").write(flight)
        time.sleep(0.05)
    reader.join(20.0)
    assert "".join(read)[: len(flight)] == flight
