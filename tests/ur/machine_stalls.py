"""When each processor of a machine stood still: a sleeper above all loops on each of them.

`python -m tests.ur.machine_stalls CPU` sleeps again and again until its standard input ends, and prints when it
overslept and by how much.
"""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

PRIORITY = 90
"""Above the 80 of the loops: what holds these sleepers up is none of the processes that are measured."""
SLEEP_S = 0.001
MIN_S = 0.002
"""Two periods of an arm: what is shorter makes no frame late."""


def overslept() -> list[tuple[float, float]]:
    """Until standard input ends: when a sleep ended, on the system's monotonic clock, and how much too late, in s."""
    ended = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    seen = []
    while not ended.is_set():
        due_s = time.monotonic() + SLEEP_S
        time.sleep(SLEEP_S)
        if (late_s := (now_s := time.monotonic()) - due_s) > MIN_S:
            seen.append((now_s, late_s))
    return seen


@contextlib.contextmanager
def machine_stalls() -> Iterator[list[tuple[float, float]]]:
    """At the end, when some processor stood still and for how long; empty where the system grants no real time."""
    found: list[tuple[float, float]] = []
    children = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.ur.machine_stalls", str(cpu)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for cpu in sorted(os.sched_getaffinity(0))
    ]  # fmt: skip
    try:
        yield found
    finally:
        for child in children:
            output, _ = child.communicate()
            found += [(at_s, late_s) for at_s, late_s in json.loads(output or "[]")]


if __name__ == "__main__":
    os.sched_setaffinity(0, {int(sys.argv[1])})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        # It would show what other processes take of the machine, the loops among them.
        print("[]")
    else:
        print(json.dumps(overslept()))
