"""Own commands as child processes of a demonstration, which end with it."""

import contextlib
import os
import queue
import secrets
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Protocol

from haptether.child import child_environment, module_command

if TYPE_CHECKING:
    from subprocess import Popen

START_TIMEOUT_S = 20.0
"""Timeout in s for a process to open its socket."""
END_TIMEOUT_S = 5.0
NICE = -10
"""Nice value of a demonstration's processes, until their loops have real time."""


class Interrupted(Exception):  # noqa: N818  # not an error: somebody pressed Ctrl-C
    """A stop of the run was requested."""


class StopRequest(Protocol):
    """Stop request, and a sleep that it interrupts."""

    def __bool__(self) -> bool:
        """True once a stop was requested."""

    def sleep(self, seconds: float) -> None:
        """Sleep for up to `seconds`."""


class Process:
    """Own command as a child process, with its output."""

    def __init__(self, name: str, process: "Popen[str]", says: str) -> None:
        self.name = name
        self._says = says
        self.process = process
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._all: list[str] = []
        # Read the pipe continuously, so that the child never blocks on it.
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        if self.process.stdout is not None:
            for line in self.process.stdout:
                self._all.append(line.strip())
                self._lines.put(line.strip())

    def headline(self, stopped: StopRequest) -> str:
        """Return the line that reports the open socket.

        Raises:
            Interrupted: A stop was requested.
            RuntimeError: The process ended, or printed nothing in time.
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
        """Return its last error line, or its last line."""
        lines = [line for line in self._all if line]
        wrong = [line for line in lines if "fault:" in line or line.startswith(("haptether:", "hold", "stop"))]
        return next(reversed(wrong or lines), f"{self.name} said nothing")

    def said(self) -> str:
        """Return its whole output in one line."""
        return " / ".join(line for line in self._all if line)

    def failure(self, other: "Process") -> str:
        """Return the last output of both sides, and a note if the machine was overloaded."""
        said = f"the {self.name} ended with status {self.process.returncode}: {self.last()}; {other.last()}"
        load, processors = os.getloadavg()[0], os.cpu_count() or 1
        if load <= processors:
            return said
        busy = f"this machine is busy (load {load:.1f} on {processors} processors)"
        return f"{said}; {busy}: run it again with less beside it"

    def end(self) -> None:
        """Terminate the process, by force if needed."""
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
    """Run an own command as a child process inside the context; `says` is the prefix of its first line.

    It also ends if this process is killed, provided that `setpriv` of util-linux exists.
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
    # Loading takes seconds for each process in turn; without permission it takes longer.
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
    child = Process(name, process, says or name)
    try:
        yield child
    finally:
        child.end()


class Network(Protocol):
    """Network of a demonstration, the same each way."""

    @property
    def delay_s(self) -> float:
        """Mean delay in s."""

    @property
    def jitter_s(self) -> float:
        """Standard deviation of the delay in s."""

    @property
    def loss(self) -> float:
        """Probability of loss."""

    @property
    def seed(self) -> int:
        """Seed of the draws."""


def slave_behind(
    network: Network, limit: str, stack: contextlib.ExitStack, stopped: StopRequest, *slave: str
) -> tuple[Process, str]:
    """Start a slave with these options, and netsim before it, each for `limit` s; return the slave and its address."""
    local = ("--listen", "127.0.0.1:0", "--duration-s", limit)
    process = stack.enter_context(child_process("slave", *local, "--patience-s", limit, *slave))
    netsim = stack.enter_context(child_process(
        "netsim", "proxy", *local, "--forward", process.headline(stopped).rsplit(" ", 1)[-1],
        "--delay-s", str(network.delay_s), "--jitter-s", str(network.jitter_s), "--loss", str(network.loss),
        "--seed", str(network.seed),
    ))  # fmt: skip
    return process, netsim.headline(stopped).split(",")[0].rsplit(" ", 1)[-1]


def emulated_ur(limit: str, stack: contextlib.ExitStack, stopped: StopRequest, *arguments: str) -> str:
    """Start an emulated controller for `limit` s; return its address."""
    # The controller's ports are fixed, so use a random address to run several demonstrations.
    host = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
    command = ("ur-emulator", "--host", host, "--duration-s", limit, *arguments)
    stack.enter_context(child_process(*command, says="listening on")).headline(stopped)
    return host


def until_ended(master: Process, lasts_s: float, each: Callable[[float], None], stopped: StopRequest) -> None:
    """Call `each` with the time in s until a master of a demonstration ends.

    Raises:
        Interrupted: A stop was requested.
        RuntimeError: The master did not end in time.
    """
    begun_s = time.monotonic()
    while master.process.poll() is None:
        at_s = time.monotonic() - begun_s
        each(at_s)
        if stopped:
            break
        if at_s > lasts_s + START_TIMEOUT_S:
            message = f"the master did not end within {lasts_s + START_TIMEOUT_S:g} s"
            raise RuntimeError(message)
        stopped.sleep(0.01)
    if stopped:
        # Ctrl-C of a terminal reaches all processes.
        raise Interrupted
