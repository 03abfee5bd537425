"""`make soak`: master, network and slave for ten minutes; their memory must stay constant.

Prints a line per second and a table at the end, and writes JSON. Exit status 1: memory that is not flat, or a process
that ended by itself.
"""

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.soak import commands
from tests.soak.memory import Growth, anonymous_bytes, growth, loop_sleeps

from haptether.bridge import write_key

SAMPLE_S = 1.0
MIN_S = 160.0
"""Shortest duration in s that is judged. A loop touches each page of its ring of 65536 records only after 66 s, and the
judgement uses the second half."""
END_S = 30.0
LOOPS = ("slave", "master")
"""Processes with a control loop, in their starting order."""


class Running:
    """A command with its measurements of each second."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                        stderr=subprocess.PIPE, text=True)  # fmt: skip
        assert self.process.stderr is not None
        # It opens its socket before it prints this line.
        self.headline = self.process.stderr.readline()
        self.bytes: list[int] = []
        self.late: list[int] = []
        self._slept: tuple[float, int] | None = None

    def address(self) -> str:
        """Address at which it listens.

        Raises:
            RuntimeError: The first line has no address.
        """
        found = re.search(r"(?:listens on|proxy on|master on) (\S+:\d+)", self.headline)
        if found is None:
            raise RuntimeError(f"{self.headline.strip()!r}: must say where it listens")
        return found[1].rstrip(",")

    def sample(self, has_loop: bool) -> None:
        """Take its memory, and its late cycles since the last sample."""
        self.bytes.append(anonymous_bytes(self.process.pid))
        if not has_loop:
            return
        now, sleeps = time.monotonic(), loop_sleeps(self.process.pid)
        if self._slept is not None:
            then, before = self._slept
            due = round((now - then) / commands.PERIOD_S)
            # The two clocks may differ by a cycle.
            self.late.append(max(due - (sleeps - before) - 1, 0))
        self._slept = (now, sleeps)

    def end(self) -> str:
        """Ask it to end, and return its output."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            _, said = self.process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            _, said = self.process.communicate()
        return said or ""


def soak(duration_s: float, log: Callable[[str], None]) -> dict[str, Any]:
    """Run the three processes for `duration_s`, and return the result of each."""
    with tempfile.TemporaryDirectory() as folder:
        results = {name: Path(folder, f"{name}.json") for name in ("slave", "network", "master")}
        running: dict[str, Running] = {}
        try:
            write_key(results["slave"].with_name("soak.key"))
            running["slave"] = Running(commands.slave(results["slave"]))
            running["network"] = Running(commands.proxy(running["slave"].address(), results["network"]))
            running["master"] = Running(commands.master(running["network"].address(), results["master"]))
            ended = watch(running, duration_s, log)
        finally:
            said = {name: running[name].end() for name in reversed(running)}
        reports = {name: json.loads(path.read_text()) for name, path in results.items() if path.exists()}
    processes = {name: summary(one, reports.get(name)) for name, one in running.items()}
    for name in ended:
        processes[name]["ended_early"] = said[name].strip().splitlines()[-3:]
    is_flat = all(one["is_flat"] for one in processes.values())
    return {"duration_s": duration_s, "passed": is_flat and not ended, "processes": processes}


def watch(running: dict[str, Running], duration_s: float, log: Callable[[str], None]) -> list[str]:
    """Sample until the time is over or a process has ended; return the ended ones."""
    begun = time.monotonic()
    for n in range(1, round(duration_s / SAMPLE_S) + 1):
        time.sleep(max(begun + n * SAMPLE_S - time.monotonic(), 0.0))
        ended = [name for name, one in running.items() if one.process.poll() is not None]
        if ended:
            return ended
        for name, one in running.items():
            one.sample(name in LOOPS)
        held = ", ".join(f"{name} {one.bytes[-1] / 1024:.0f} KiB" for name, one in running.items())
        late = ", ".join(f"{name} {one.late[-1]}" for name, one in running.items() if one.late)
        log(f"{n * SAMPLE_S:5.0f} s  {held}; late cycles: {late or '-'}")
    return []


def summary(one: Running, report: object) -> dict[str, Any]:
    """Return the measurements of a process with its own report."""
    enough = len(one.bytes) >= 4
    grown = growth(one.bytes, SAMPLE_S) if enough else Growth(first_bytes=0, last_bytes=0, allowed_bytes=0)
    return {
        "is_flat": grown.is_flat and enough,
        "first_bytes": grown.first_bytes,
        "last_bytes": grown.last_bytes,
        "grown_bytes": grown.grown_bytes,
        "allowed_bytes": grown.allowed_bytes,
        "late_cycles": sum(one.late),
        "most_late_cycles_in_a_second": max(one.late, default=0),
        "sampled_bytes": one.bytes,
        "sampled_late_cycles": one.late,
        "report": report,
    }


def table(result: dict[str, Any]) -> str:
    """Return the results as a table."""
    heads = ("KiB at half", "at the end", "grown", "allowed", "late cycles", "most/s")
    widths = (12, 11, 7, 8, 12, 7)
    lines = [" ".join([" " * 8, *(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True))])]
    for name, one in result["processes"].items():
        kib = [one[key] / 1024 for key in ("first_bytes", "last_bytes", "grown_bytes", "allowed_bytes")]
        late, worst = one["late_cycles"], one["most_late_cycles_in_a_second"]
        verdict = "flat" if one["is_flat"] else "NOT FLAT"
        if "ended_early" in one:
            verdict = "ended early: " + " / ".join(one["ended_early"])
        lines.append(
            f"{name:8} {kib[0]:12.0f} {kib[1]:11.0f} {kib[2]:+7.0f} {kib[3]:8.0f} {late:12} {worst:7}  {verdict}"
        )
    return "\n".join(lines)


def main() -> int:
    """Run a soak as the command line requests."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help=f"how long, {MIN_S:g} to 1e6; 600 by default")
    parser.add_argument("--json", type=Path, help="where the same goes for machines")
    arguments = parser.parse_args()
    if not MIN_S <= arguments.seconds <= 1e6:
        parser.error(f"--seconds {arguments.seconds:g}: must be {MIN_S:g} to 1e6, the ring of a loop is full before")
    result = soak(arguments.seconds, lambda line: print(line, flush=True))
    print(table(result))
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
