"""A command on its own terminal, as a person runs it."""

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

COMMAND = [sys.executable, "-m", "haptether"]
QUESTION = "Type yes and press Enter"


class Terminal:
    """A command on its own terminal, and its output."""

    def __init__(self, environment: dict[str, str], *arguments: str) -> None:
        self.master, slave = pty.openpty()
        self.process = subprocess.Popen(
            [*COMMAND, *arguments], env=environment, stdin=slave, stdout=slave, stderr=slave
        )
        os.close(slave)
        self.printed = ""

    def until(self, text: str, seconds: float = 30.0, count: int = 1) -> None:
        """Read until the text has appeared `count` times."""
        end_s = time.monotonic() + seconds
        while self.printed.count(text) < count:
            assert time.monotonic() < end_s, self.printed
            if not self.read(0.1):
                assert self.printed.count(text) >= count, self.printed

    def read(self, seconds: float) -> bool:
        """Read the available output; false at its end."""
        if not select.select([self.master], [], [], seconds)[0]:
            return True
        try:
            part = os.read(self.master, 65536)
        except OSError:
            return False
        self.printed += part.decode(errors="replace")
        return bool(part)

    def answer(self, text: str) -> None:
        """Type a text."""
        os.write(self.master, text.encode())

    def end(self) -> int:
        """Wait for the command to end; return its status."""
        end_s = time.monotonic() + 30.0
        try:
            while self.read(0.1) and time.monotonic() < end_s:
                pass
            return self.process.wait(timeout=10.0)
        finally:
            self.process.kill()
            self.process.wait()
            os.close(self.master)


def run(environment: dict[str, str], *arguments: str, timeout: float = 100.0) -> subprocess.CompletedProcess[str]:
    """Run a command without a terminal to its end."""
    return subprocess.run(
        [*COMMAND, *arguments], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        timeout=timeout, check=False,
    )  # fmt: skip


def forces(path: Path) -> list[float]:
    """Return the forces on the first axis that the driver was given."""
    return [float(line.split()[1]) for line in path.read_text().splitlines() if line.startswith("write")]
