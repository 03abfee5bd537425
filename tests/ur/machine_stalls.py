"""Stalls of a machine's processors: a sleeper above all loops on each of them.

`python -m tests.ur.machine_stalls CPU` sleeps repeatedly until its standard input ends. Then it prints when it
overslept, and by how much.
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
"""Priority of the sleepers, above the 80 of the loops: none of the measured processes can delay them."""
SLEEP_S = 0.001
MIN_S = 0.002
"""Shortest stall that counts, in s: two periods of an arm; a shorter one makes no frame late."""


def overslept() -> list[tuple[float, float]]:
    """Sleep until standard input ends; return the end (monotonic clock) and the delay of each late sleep, in s."""
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
    """Yield a list that gets the time and length of the stalls at the end; it stays empty without real-time rights."""
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
        # Without real time it would also show the load by other processes, the loops included.
        print("[]")
    else:
        print(json.dumps(overslept()))
