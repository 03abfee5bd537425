"""Panel of a live side on its terminal, and its telemetry socket without an option."""

import contextlib
import os
import re
import select
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from tests.live.sides import packaged
from tests.live.test_device_loop import HANGING

pytestmark = pytest.mark.live

TIMEOUT_S = 60.0


class Terminal:
    """A terminal of 100 columns that runs a command."""

    def __init__(self, folder: Path, *arguments: str, environment: Mapping[str, str] = os.environ) -> None:
        self.master, slave = os.openpty()
        environment = {**environment, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "haptether", *arguments],
            stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
            env=environment | {"XDG_RUNTIME_DIR": str(folder), "TMPDIR": str(folder)},
        )  # fmt: skip
        os.close(slave)
        self.text = ""

    def until(self, pattern: str) -> None:
        """Read until text matches this pattern."""
        end = time.monotonic() + TIMEOUT_S
        while not re.search(pattern, self.text):
            assert time.monotonic() < end, self.text[-3000:]
            self.read()

    def read(self) -> None:
        if select.select([self.master], [], [], 0.1)[0]:
            with contextlib.suppress(OSError):
                shown = os.read(self.master, 1 << 16).decode(errors="replace")
                self.text += re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)

    def end(self, number: int) -> int:
        """Send a signal; return the exit status, with all output read."""
        self.process.send_signal(number)
        end = time.monotonic() + TIMEOUT_S
        while self.process.poll() is None:
            assert time.monotonic() < end
            self.read()
        self.read()
        return self.process.wait()


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    tmp_path.chmod(0o700)
    yield tmp_path
    # No drawing process may be left, even after a failed test.
    found = subprocess.run(["pgrep", "-f", f"panel_process {tmp_path}"], capture_output=True, text=True, check=False)
    assert not found.stdout


def slave(*more: str) -> tuple[str, ...]:
    return ("slave", "--insecure", "--listen", "127.0.0.1:0", *more)


def test_a_side_shows_its_panel_and_what_it_says_above_it(folder: Path) -> None:
    side = Terminal(folder, *slave("--telemetry", str(folder / "slave.sock")))
    side.until(r"slave, Haptether \S+ ─+╮")
    side.until(r"loop late \[ms\]")
    assert "DISENGAGED" in side.text
    side.process.send_signal(signal.SIGUSR2)
    side.until("slave: there was nothing to acknowledge here")
    shown = side.text.rpartition("there was nothing to acknowledge here")
    side.until(r"there was nothing to acknowledge here\s*\n?╭─ slave")
    assert "╭─ slave" in shown[0]
    assert side.end(signal.SIGINT) == 0
    # The result replaces the panel.
    assert "slave disengaged: " in side.text.rpartition("╯")[2]


def test_quiet_shows_no_panel(folder: Path) -> None:
    side = Terminal(folder, *slave("--quiet"))
    side.until("real time:")
    side.read()
    assert side.end(signal.SIGTERM) == 0
    assert "╭" not in side.text
    assert "Ctrl-C ends" not in side.text


def test_a_panel_that_is_killed_leaves_a_line(folder: Path) -> None:
    side = Terminal(folder, *slave("--telemetry", str(folder / "slave.sock")))
    side.until("loop late")
    found = subprocess.run(["pgrep", "-f", f"panel_process {folder}"], capture_output=True, text=True, check=True)
    os.kill(int(found.stdout), signal.SIGKILL)
    side.until(r"slave disengaged, \d+ ticks")
    assert side.end(signal.SIGINT) == 0


def test_a_terminal_that_takes_nothing_holds_no_end_up(folder: Path) -> None:
    side = Terminal(folder, *slave("--telemetry", str(folder / "slave.sock")))
    side.until("loop late")
    # Nobody reads: a terminal holds a few KiB, which the panel fills within a second.
    time.sleep(1.5)
    side.process.send_signal(signal.SIGTERM)
    assert side.process.wait(10.0) in {0, 1, -signal.SIGTERM, 143}


def test_a_driver_that_blocks_is_said_above_the_panel_while_it_does(folder: Path) -> None:
    arguments = slave("--scene", "remote_push", "--set", "slave.device=bench")
    environment = packaged(folder, HANGING.replace("SECONDS", "5.0"))
    side = Terminal(folder, *arguments, environment=environment)
    side.until("loop late")
    # No sample comes while the driver blocks.
    begun_s = time.monotonic()
    side.until("has not returned for 0.5 s")
    assert time.monotonic() - begun_s < 4.0
    assert side.end(signal.SIGTERM) in {0, 1}


def test_telemetry_without_an_option_is_private_and_found(folder: Path) -> None:
    side = Terminal(folder, *slave())
    side.until("loop late")
    (path,) = (folder / "haptether").iterdir()
    assert path.name == f"slave-{side.process.pid}.sock"
    assert stat.S_IMODE(path.parent.lstat().st_mode) == 0o700
    stale = path.with_name("master-4194304.sock")
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(stale))
    hour_ago = time.time() - 3600.0
    os.utime(stale, (hour_ago, hour_ago))
    watch = [sys.executable, "-m", "haptether", "watch", "--duration-s", "0.2"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
    seen = subprocess.run(watch, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert (seen.returncode, seen.stderr) == (0, "")
    assert "DISENGAGED" in seen.stdout
    assert not stale.exists()
    assert side.end(signal.SIGINT) == 0
    assert not path.exists()
    seen = subprocess.run(watch, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert seen.returncode == 2
    assert "no side of this user runs here" in seen.stderr


def test_a_folder_of_somebody_else_is_not_used(folder: Path) -> None:
    (folder / "haptether").mkdir(mode=0o777)
    (folder / "haptether").chmod(0o777)
    side = Terminal(folder, *slave())
    side.until("loop late")
    assert not list((folder / "haptether").iterdir())
    assert list((folder / f"haptether-{os.getuid()}").glob("slave-*.sock"))
    assert side.end(signal.SIGINT) == 0
