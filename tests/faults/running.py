"""Real master and slave processes under test, and their recordings."""

import contextlib
import json
import math
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from tests.faults.signals import Ticks

from haptether.bridge import read_recording, write_key

HAPTETHER = (sys.executable, "-m", "haptether")
DEFAULT_SCENE = "remote_push"
"""Scene of both commands without --scene; changes need its name."""
END_S = 30.0
"""Time in s in which any process has to end, or to print its first line."""
PRESSED_S = 1.8
"""Time in s from a master's first line: handshake, engagement, 1.2 s of path; the hand presses the wall with about 3
N."""
AGAIN_S = 1.2
"""Time in s from a press: 0.1 s released, realignment, 0.2 s of fade-in."""

APART_S = 0.2
"""Time in s between the ends of two processes that receive SIGTERM at once: each checks for it every 50 ms."""


class Process:
    """A command with its first line, which says that its socket is open; output to a `sink` is not read here."""

    def __init__(
        self, *arguments: str, record: Path | None = None, within: Sequence[str] = (),
        environment: Mapping[str, str] | None = None, sink: int | None = None,
    ) -> None:  # fmt: skip
        recorded = () if record is None else ("--record", str(record), "--min-free-bytes", "0")
        self.record = record
        self.begun_s = time.monotonic()
        self.process = subprocess.Popen(
            [*within, *HAPTETHER, *arguments, *recorded], stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL if sink is None else sink, stderr=subprocess.PIPE if sink is None else sink,
            text=True, env=None if environment is None else dict(environment),
        )  # fmt: skip
        self.headline = "" if self.process.stderr is None else self.process.stderr.readline()
        self.said = ""

    @property
    def address(self) -> str:
        """Address at which it listens.

        Raises:
            RuntimeError: The first line has no address.
        """
        found = re.search(r"(?:listens on|master on) (\S+:\d+)", self.headline)
        if found is None:
            raise RuntimeError(f"{self.headline.strip()!r}: must say where it listens")
        return found[1].rstrip(",")

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self.process.send_signal(number)

    def end(self, number: signal.Signals | None = signal.SIGTERM) -> str:
        """Send a signal, or None, wait for the end, and return its output."""
        if number is not None and self.process.poll() is None:
            self.process.send_signal(number)
        try:
            _, said = self.process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            _, said = self.process.communicate()
        self.said += said or ""
        return self.said

    def frozen(self, length_s: float) -> None:
        """Stop it for a time, like a machine that swaps or a debugger."""
        self.send(signal.SIGSTOP)
        time.sleep(length_s)
        self.send(signal.SIGCONT)

    def kill(self) -> None:
        """Kill it if it runs, and close its pipe, even if it has ended by itself."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        if self.process.stderr is not None:
            self.process.stderr.close()


@dataclass
class Stage:
    """A folder, a key, and the processes of one row; all are removed when it ends."""

    overrides: ClassVar[tuple[str, ...]] = ()
    """Changes of the scene at both sides."""
    folder: Path
    processes: list[Process] = field(default_factory=list)

    @classmethod
    @contextlib.contextmanager
    def set(cls) -> Iterator[Self]:
        """Set up a stage and take it down."""
        with tempfile.TemporaryDirectory() as folder:
            stage = cls(Path(folder))
            write_key(stage.key)
            try:
                yield stage
            finally:
                for process in stage.processes:
                    process.kill()

    @property
    def key(self) -> Path:
        """Path of the key of both sides."""
        return self.folder / "session.key"

    def end_together(self, *processes: Process) -> None:
        """End sides at nearly the same time, so that the end of one is not a fault of the other."""
        for process in processes:
            process.process.terminate()
        for process in processes:
            process.end(None)

    def path(self, name: str) -> Path:
        """Return the path of a file of this row."""
        return self.folder / name

    def slave(self, name: str = "slave", *arguments: str, listen: str = "127.0.0.1:0", **more: Any) -> Process:  # noqa: ANN401  # those of Process
        """Start the side of the robot."""
        record = more.pop("record", self.path(f"{name}.mcap"))
        return self._begun(Process(
            "slave", "--key", str(self.key), "--listen", listen, "--json", str(self.path(f"{name}.json")),
            "--force", *self.scene_options(), *arguments, record=record, **more,
        ))  # fmt: skip

    def master(self, peer: str, name: str = "master", *arguments: str, key: Path | None = None, **more: Any) -> Process:  # noqa: ANN401  # those of Process
        """Start the side of the hand."""
        record = more.pop("record", self.path(f"{name}.mcap"))
        return self._begun(Process(
            "master", "--key", str(key or self.key), "--peer", peer, "--json", str(self.path(f"{name}.json")),
            "--force", *self.scene_options(), *arguments, record=record, **more,
        ))  # fmt: skip

    @classmethod
    def scene_options(cls) -> list[str]:
        """Return the options of both commands for the changes."""
        changes = [part for one in cls.overrides for part in ("--set", one)]
        return ["--scene", DEFAULT_SCENE, *changes] if changes else []

    def _begun(self, process: Process) -> Process:
        self.processes.append(process)
        return process

    def report(self, name: str) -> dict[str, Any]:
        """Return the report of a process that has ended."""
        content: dict[str, Any] = json.loads(self.path(f"{name}.json").read_text())
        return content

    def ticks(self, name: str) -> "Recorded":
        """Return the recording of a process."""
        recording = read_recording(self.path(f"{name}.mcap"))
        return Recorded(
            ticks=Ticks.of_signals(recording.side, recording.signals),
            reasons=[str(reason) for reason in recording.signals["reason"]],
            overshoot_s=[float(late) for late in recording.signals["overshoot_s"]],
            begun_s=recording.begun_ns * 1e-9,
        )


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A recording of one side."""

    ticks: Ticks
    reasons: list[str]
    overshoot_s: list[float]
    begun_s: float = math.nan
    """Wall-clock time at tick time 0; NaN where unknown."""

    def last(self, seconds: float) -> Self:
        """Return its last seconds."""
        begin = int(np.searchsorted(self.ticks.time_s, self.ticks.time_s[-1] - seconds))
        return replace(
            self,
            ticks=self.ticks.between(float(self.ticks.time_s[begin])),
            reasons=self.reasons[begin:],
            overshoot_s=self.overshoot_s[begin:],
        )

    def before_end(self) -> Self:
        """Return it without the last moment, in which the other side may have ended already."""
        return replace(self, ticks=self.ticks.between(-np.inf, float(self.ticks.time_s[-1]) - APART_S))
