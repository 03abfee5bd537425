"""Tests of several processes on a machine that others use, too: repeated after a stall of the machine."""

import functools
import os
import subprocess
import threading
import time
from collections.abc import Callable
from typing import ParamSpec, Self

from tests.left_runs import end_left_runs
from tests.retry import REPEATED

P = ParamSpec("P")
SLEEP_S = 0.002
STALL_S = 0.015
"""Less than the 20 ms after which a loop holds: a sleeper beside a loop need not be held up for as long as that."""
MAX_TRIES = 3


class Stalls:
    """The longest that a sleeper overslept; there is one on each processor, for they stand still one by one."""

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, args=(cpu,), daemon=True) for cpu in sorted(os.sched_getaffinity(0))
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()

    def _run(self, cpu: int) -> None:
        os.sched_setaffinity(0, {cpu})
        while not self._stopped.is_set():
            before_s = time.monotonic()
            time.sleep(SLEEP_S)
            self.worst_s = max(self.worst_s, time.monotonic() - before_s - SLEEP_S)


def anew_after_stalls(test: Callable[P, None]) -> Callable[P, None]:
    """Repeat a test that failed during a stall of the machine, up to the third try; `tests.retry` lists it."""

    @functools.wraps(test)
    def run(*arguments: P.args, **named: P.kwargs) -> None:
        for left in reversed(range(MAX_TRIES)):
            with Stalls() as stalls:
                try:
                    test(*arguments, **named)
                except (AssertionError, subprocess.TimeoutExpired) as error:
                    if left == 0 or stalls.worst_s < STALL_S:
                        raise
                    message = (str(error).splitlines() or [""])[0]
                    print(f"{REPEATED} for {1e3 * stalls.worst_s:.0f} ms: {type(error).__name__}: {message}")
                    end_left_runs()
                else:
                    return

    return run
