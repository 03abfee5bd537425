"""Haptether commands as child processes of a demonstration, which end with it."""

import contextlib
import os
import queue
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from haptether.child import child_environment, module_command

if TYPE_CHECKING:
    from subprocess import Popen

START_TIMEOUT_S = 20.0
"""Longest wait for a process to open its socket; then it counts as failed."""
END_TIMEOUT_S = 5.0
NICE = -10
"""Priority of the processes, above others of the machine, until their loops have real time."""


class Interrupted(Exception):  # noqa: N818  # not an error: the user pressed Ctrl-C
    """A stop of the run was requested."""


class StopRequest(Protocol):
    """A stop request, with a sleep that it ends."""

    def __bool__(self) -> bool:
        """True once a stop was requested."""

    def sleep(self, seconds: float) -> None:
        """Wait up to `seconds`, or until a stop is requested."""


class Process:
    """A Haptether command as a child process, and its output."""

    def __init__(self, name: str, process: "Popen[str]", says: str) -> None:
        self.name = name
        self._says = says
        self.process = process
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._all: list[str] = []
        # Read the pipe at all times: a child must never block on a full one.
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        if self.process.stdout is not None:
            for line in self.process.stdout:
                self._all.append(line.strip())
                self._lines.put(line.strip())

    def headline(self, stopped: StopRequest) -> str:
        """Line that reports the open socket.

        Raises:
            Interrupted: A stop was requested.
            RuntimeError: The process ended, or reported nothing in time.
        """
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            if stopped:
                raise Interrupted
            try:
                line = self._lines.get(timeout=0.05)
            except queue.Empty:
                if self.process.poll() is not None and self._lines.empty():
                    break
                continue
            if line.startswith(self._says):
                return line
        if stopped:
            raise Interrupted
        message = f"{self.name} did not start: {self.said() or 'it said nothing'}"
        raise RuntimeError(message)

    def last(self) -> str:
        """Last line about a failure, or else the last line."""
        lines = [line for line in self._all if line]
        wrong = [line for line in lines if "fault:" in line or line.startswith(("haptether:", "hold", "stop"))]
        return next(reversed(wrong or lines), f"{self.name} said nothing")

    def said(self) -> str:
        """Output so far in one line."""
        return " / ".join(line for line in self._all if line)

    def failure(self, other: "Process") -> str:
        """Describe a failure: last lines of both sides, and whether the machine was overloaded."""
        said = f"the {self.name} ended with status {self.process.returncode}: {self.last()}; {other.last()}"
        load, processors = os.getloadavg()[0], os.cpu_count() or 1
        if load <= processors:
            return said
        busy = f"this machine is busy (load {load:.1f} on {processors} processors)"
        return f"{said}; {busy}: run it again with less beside it"

    def end(self) -> None:
        """Terminate the process; kill it if it does not end."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join(END_TIMEOUT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()


@contextlib.contextmanager
def child_process(name: str, *arguments: str, says: str | None = None) -> Iterator[Process]:
    """Run a Haptether command as a child process within the block; `says` begins its first line.

    If `setpriv` of util-linux is present, the child also ends when this process is killed.
    """
    ends_with_this = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []
    process = subprocess.Popen(
        [*ends_with_this, *module_command("haptether", name, *arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=child_environment(),
    )
    # Each process loads for seconds before the next begins; without the permission they load at normal priority.
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
    child = Process(name, process, says or name)
    try:
        yield child
    finally:
        child.end()
