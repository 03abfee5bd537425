"""Faults that concern stop and press: a terminal that nobody reads, a driver that blocks, no memory."""

import contextlib
import os
import pty
import resource
import signal
import subprocess
import textwrap
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tests.faults.processes import DisturbedError, Judged, Limits, again
from tests.faults.rows import Row
from tests.faults.running import Process, Recorded, Stage
from tests.faults.signals import ENGAGED, STALE
from tests.live.sides import free_port

from haptether.bridge import read_recording

ENDS_S = 6.0
"""Longest time from a signal to the end of the process, in s: blocked output is dropped after 1 s."""
AT_ONCE_S = 1.5
"""Longest time from a second Ctrl-C to the end, in s."""
ENGAGES_S = 20.0
COUPLED_S = 0.6
"""Time for which both sides are coupled before a fault, in s."""
AFTER_S = 1.0
"""Time for which the other side continues, in s."""


@contextlib.contextmanager
def blocked_sink(kind: str) -> Iterator[int]:
    """Open a full pipe or terminal that nobody reads."""
    reader, writer = os.pipe() if kind == "pipe" else pty.openpty()
    try:
        os.set_blocking(writer, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writer, b"\n" if kind == "pty" else b" " * 64)
        os.set_blocking(writer, True)
        yield writer
    finally:
        os.close(reader)
        os.close(writer)


def until_coupled(path: Path) -> None:
    """Wait until the recording shows a side that has been coupled for a while.

    Raises:
        DisturbedError: The side never coupled.
    """
    end_s = time.monotonic() + ENGAGES_S
    while time.monotonic() < end_s:
        with contextlib.suppress(OSError, ValueError, KeyError):
            states = list(read_recording(path).signals["state"])[-int(COUPLED_S * 1e3) :]
            if len(states) >= COUPLED_S * 1e3 and set(states) <= {"engaged", "stale"}:
                return
        time.sleep(0.1)
    raise DisturbedError("never engaged")


def pair_with_sink(stage: Stage, side: str, sink: int) -> tuple[Process, Process]:
    """Start and couple both sides, one with `sink` as its output; return that one first."""
    listen = f"127.0.0.1:{free_port()}"
    to: dict[str, Any] = {"sink": sink}
    slave = stage.slave(listen=listen, **(to if side == "slave" else {}))
    master = stage.master(listen, "master", "--patience-s", "30", **(to if side == "master" else {}))
    until_coupled(stage.path("slave.mcap"))
    until_coupled(stage.path("master.mcap"))
    return (slave, master) if side == "slave" else (master, slave)


def ended(process: Process, within_s: float) -> float | None:
    """Wait for the end of a process; return the elapsed time in s, None after the timeout."""
    begun_s = time.monotonic()
    try:
        process.process.wait(within_s)
    except subprocess.TimeoutExpired:
        return None
    return time.monotonic() - begun_s


def uncoupled_after_s(recorded: Recorded, ended_s: float, signal_s: float) -> float:
    """Return the time from a signal to the last coupled tick of the other side; both by the clock of this process."""
    ticks = recorded.ticks
    coupled = np.flatnonzero((ticks.state == ENGAGED) | (ticks.state == STALE))
    before_end_s = float(ticks.time_s[-1] - ticks.time_s[coupled[-1]])
    return ended_s - before_end_s - signal_s


def stopped_by(side: str, kind: str, number: signal.Signals, _limits: Limits) -> Row:
    """Send a signal that ends a side while a full pipe or terminal takes no output."""
    other = "slave" if side == "master" else "master"
    with blocked_sink(kind) as sink, Stage.set() as stage:
        process, beside = pair_with_sink(stage, side, sink)
        signal_s = time.monotonic()
        process.send(number)
        took_s = ended(process, ENDS_S)
        status = process.process.returncode
        time.sleep(AFTER_S)
        beside.process.terminate()
        requested_s = time.monotonic()
        beside.end(None)
        after_s = uncoupled_after_s(stage.ticks(other), requested_s, signal_s)
        if took_s is not None:
            whole = read_recording(stage.path(f"{side}.mcap")).whole
            report = stage.path(f"{side}.json").exists()
    judged = Judged(_limits)
    judged.wrong.check(took_s is not None, f"it had not ended after {ENDS_S:g} s")
    if took_s is not None:
        judged.wrong.check(status == 0, f"status {status}")
        judged.wrong.check(whole and report, "the recording or the report is not whole")
        judged.say(f"ended after {took_s:.1f} s; the {other} left after {after_s * 1e3:.0f} ms")
    judged.wrong.check(after_s < 0.5, f"the {other} was coupled for {after_s:.2f} s")
    return judged.row(stop_name(side, kind, number), "the loop ends at once, the process soon")


def stop_name(side: str, kind: str, number: signal.Signals) -> str:
    """Return the name of the row."""
    return f"{side}: {number.name} while a full {kind} takes no output"


def pressed_while_blocked(_limits: Limits) -> Row:
    """A press while a full terminal takes no output acts at once; one during a sleep of the process has no effect."""
    with blocked_sink("pty") as sink, Stage.set() as stage:
        master, slave = pair_with_sink(stage, "master", sink)
        slave.frozen(0.1)
        time.sleep(0.5)
        held = list(read_recording(stage.path("slave.mcap")).signals["state"])[-1]
        master.send(signal.SIGUSR1)
        time.sleep(1.5)
        again_engaged = list(read_recording(stage.path("slave.mcap")).signals["state"])[-1]
        # Press during the sleep: the operator has not seen the state that the press would meet after it.
        master.send(signal.SIGSTOP)
        time.sleep(0.4)
        master.send(signal.SIGUSR1)
        time.sleep(0.2)
        master.send(signal.SIGCONT)
        time.sleep(1.5)
        slept = list(read_recording(stage.path("slave.mcap")).signals["state"])[-1]
        # Both signals wait at the wake-up: the stop wins.
        master.send(signal.SIGSTOP)
        master.send(signal.SIGUSR1)
        master.send(signal.SIGTERM)
        master.send(signal.SIGCONT)
        took_s = ended(master, ENDS_S)
        slave.end()
    judged = Judged(_limits)
    judged.wrong.check(held in {"hold", "stop"}, f"the slave stood in {held} after it had slept")
    judged.wrong.check(again_engaged == "engaged", f"the press led to {again_engaged}")
    judged.wrong.check(slept in {"hold", "stop"}, f"a press from while the master slept led to {slept}")
    judged.wrong.check(took_s is not None, f"it had not ended after {ENDS_S:g} s")
    judged.say("a press engages; one from while it slept does not; a stop beside a press stops")
    return judged.row(PRESSED, "a press acts now or not at all; a stop wins")


PRESSED = "master: SIGUSR1 while a full pty takes no output"

HANGING = """
import ctypes, os, time
from haptether.slave import SlaveSample

class Arm:
    paces = False
    def __init__(self) -> None:
        self.position, self.begun_s = 0.02, None
    def open(self): pass
    def read(self):
        if os.path.exists(os.environ["HANG"]):
            HANG
        return SlaveSample(self.position, 0.0, max(0.0, -100.0 * self.position))
    def write(self, position, velocity): self.position = position[0]
    def stop(self): pass
    def close(self): pass
"""
HANGS = {"waits": "time.sleep(1000)", "keeps the interpreter": "ctypes.PyDLL(None).sleep(1000)"}


def pair_with_driver(stage: Stage, hang: Path, hangs: str) -> tuple[Process, Process]:
    """Start and couple a master and a slave with a driver in Python; it runs `hangs` once `hang` exists."""
    (stage.folder / "bench_arm.py").write_text(textwrap.dedent(HANGING).replace("HANG\n", f"{hangs}\n"))
    package = stage.folder / "bench_arm-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-arm\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[haptether.slaves]\nbench = bench_arm:Arm\n")
    found = os.pathsep.join(filter(None, (str(stage.folder), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": found, "HANG": str(hang)}
    scene = ("--scene", "remote_push")
    slave = stage.slave("slave", *scene, "--set", "slave.device=bench", environment=environment)
    master = stage.master(slave.address, "master", *scene)
    until_coupled(stage.path("slave.mcap"))
    until_coupled(stage.path("master.mcap"))
    return master, slave


def second_interrupt(how: str, _limits: Limits) -> Row:
    """A driver never returns from `read`: the other side learns of it, and Ctrl-C ends the process.

    The first Ctrl-C is enough if the interpreter is free: other threads then leave the device.
    """
    is_free = how == "waits"
    with Stage.set() as stage:
        hang = stage.path("hang")
        master, slave = pair_with_driver(stage, hang, HANGS[how])
        hang.touch()
        time.sleep(1.2)
        held = list(read_recording(stage.path("master.mcap")).signals["state"])[-1]
        slave.send(signal.SIGINT)
        if not is_free:
            time.sleep(0.7)
            is_there = slave.process.poll() is None
            slave.send(signal.SIGINT)
        took_s = ended(slave, ENDS_S)
        status = slave.process.returncode
        slave.end(None if took_s is not None else signal.SIGKILL)
        said = master.end()
    judged = Judged(_limits)
    judged.wrong.check(held in {"hold", "stop"}, f"the master stood in {held}")
    judged.wrong.check(
        "Arm: KEEPS ITS LAST COMMAND, switch it off: read has not returned" in said, "it was told nothing"
    )
    judged.wrong.check(took_s is not None and (is_free or took_s < AT_ONCE_S), f"the end took {took_s} s")
    judged.wrong.check(status == (1 if is_free else 130), f"status {status}")
    judged.wrong.check(is_free or is_there, "it ended at the first")
    which = "first" if is_free else "second"
    judged.say(f"the master held, and names the driver; the {which} Ctrl-C ended it after {took_s or 0.0:.1f} s")
    return judged.row(second_name(how), "the other side holds and is told; the first or a second Ctrl-C ends it")


def second_name(how: str) -> str:
    """Return the name of the row."""
    return f"slave: SIGINT while its driver {how} for ever"


def without_memory(side: str, given: str, _limits: Limits) -> Row:
    """Limit the address space of a coupled side to its current size, or less: each further mapping fails."""
    other = "slave" if side == "master" else "master"
    with Stage.set() as stage:
        if given == "a driver":
            master, slave = pair_with_driver(stage, stage.path("hang"), "pass")
        else:
            slave = stage.slave()
            master = stage.master(slave.address)
            until_coupled(stage.path("slave.mcap"))
            until_coupled(stage.path("master.mcap"))
        process, beside = (slave, master) if side == "slave" else (master, slave)
        status_line = Path(f"/proc/{process.process.pid}/status").read_text()
        (size,) = [int(line.split()[1]) * 1024 for line in status_line.splitlines() if line.startswith("VmSize:")]
        if given == "less than it has":
            size //= 2
        signal_s = time.monotonic()
        resource.prlimit(process.process.pid, resource.RLIMIT_AS, (size, size))
        took_s = ended(process, ENDS_S)
        status = process.process.returncode
        time.sleep(AFTER_S)
        beside.process.terminate()
        requested_s = time.monotonic()
        sent = "the peer has ended the session" in beside.end(None)
        said = process.end(None if took_s is not None else signal.SIGKILL)
        after_s = uncoupled_after_s(stage.ticks(other), requested_s, signal_s)
    judged = Judged(_limits)
    judged.wrong.check(took_s is not None, f"it had not ended after {ENDS_S:g} s")
    judged.wrong.check(status == 1, f"status {status}: {said[-300:]}")
    judged.wrong.check("no memory was left" in said, f"it said {said[-300:]!r}")
    judged.wrong.check(sent, f"the {other} was sent no end")
    judged.wrong.check(after_s < 0.5, f"the {other} was coupled for {after_s:.2f} s")
    judged.say(f"ended after {took_s or 0.0:.1f} s; the {other} left after {after_s * 1e3:.0f} ms, sent the end")
    return judged.row(memory_name(side, given), "ends in good order: no force, the other side is sent the end")


WITHOUT_MEMORY = (
    ("master", "what it has"), ("master", "less than it has"), ("slave", "what it has"), ("slave", "a driver"),
)  # fmt: skip


def memory_name(side: str, given: str) -> str:
    """Return the name of the row."""
    return f"{side}: no memory left while engaged, {given}"


def rows(limits: Limits | None = None) -> dict[str, Callable[[], Row]]:
    """Return all rows by name, to run one after the other."""
    bounds = limits or Limits()
    measures: dict[str, Callable[[Limits], Row]] = {}
    for side in ("master", "slave"):
        for kind in ("pipe", "pty"):
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                measures[stop_name(side, kind, number)] = partial(stopped_by, side, kind, number)
    measures[PRESSED] = pressed_while_blocked
    for how in HANGS:
        measures[second_name(how)] = partial(second_interrupt, how)
    for side, given in WITHOUT_MEMORY:
        measures[memory_name(side, given)] = partial(without_memory, side, given)
    return {fault: again(partial(measure, bounds), fault) for fault, measure in measures.items()}
