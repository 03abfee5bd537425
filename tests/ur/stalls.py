"""Tests of several processes on a shared machine: repeated after a stall of the machine."""

import contextlib
import functools
import os
import subprocess
import threading
import time
from collections.abc import Callable
from typing import NoReturn, ParamSpec, Protocol, Self, TypeVar

from tests.left_runs import end_left_runs
from tests.retry import REPEATED

P = ParamSpec("P")
SLEEP_S = 0.002
STALL_S = 0.015
"""Shortest stall that counts, in s: below the 20 ms hold time, as a sleeper may be delayed less than the loop."""
MAX_TRIES = 3


class Run(Protocol):
    """Result of a run of two sides."""

    @property
    def holds(self) -> int:
        """Number of holds of the master."""


R = TypeVar("R", bound=Run)


class Stalls:
    """The longest delay of the sleepers; one sleeper runs on each processor, as they stall one by one."""

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


def unheld(run: Callable[[], R], otherwise: Callable[[str], NoReturn]) -> R:
    """Return the first run without a hold; a stall of the machine must explain each hold or failure."""
    for _ in range(MAX_TRIES):
        with Stalls() as stalls, contextlib.suppress(RuntimeError):
            result = run()
            if result.holds == 0:
                return result
        assert stalls.worst_s > STALL_S, "it held or failed though the machine did not stand still"
    return otherwise(f"this machine stalled a loop in each of {MAX_TRIES} runs")


def anew_after_stalls(test: Callable[P, None]) -> Callable[P, None]:
    """Repeat a test that failed during a stall of the machine, at most twice; `tests.retry` lists it."""

    @functools.wraps(test)
    def run(*arguments: P.args, **named: P.kwargs) -> None:
        for left in reversed(range(MAX_TRIES)):
            with Stalls() as stalls:
                try:
                    test(*arguments, **named)
                except (AssertionError, OSError, RuntimeError, subprocess.TimeoutExpired) as error:
                    if left == 0 or stalls.worst_s < STALL_S:
                        raise
                    message = (str(error).splitlines() or [""])[0]
                    print(f"{REPEATED} for {1e3 * stalls.worst_s:.0f} ms: {type(error).__name__}: {message}")
                    end_left_runs()
                else:
                    return

    return run
