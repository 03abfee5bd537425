"""A person's word on the terminal, before a device exerts a force by itself."""

import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from haptether.cli.shared.own_force import announce_end, exerts_by_itself

if TYPE_CHECKING:
    from haptether.bridge.devices.standalone import StandaloneRun
    from haptether.cli.shared.stop import Stopped

WAITS_S = 60.0
"""Time in s to answer; then the answer is no."""
POLL_S = 0.02
PROMPT_S = 0.5
"""Largest uncertainty of when an answer was typed; beyond it the answer does not count."""


def check_terminal(what: str, *, yes: bool) -> None:
    """Refuse a force where nobody can be asked.

    Raises:
        ValueError: Standard input is not a terminal, and `--yes` was not given.
    """
    if not yes and not sys.stdin.isatty():
        message = (
            f"{what}: a person must say yes on the terminal, and there is none: give --yes if one stands beside it"
        )
        raise ValueError(message)


def consents(question: str, stopped: "Stopped", *, yes: bool) -> bool:
    """Ask a person, and return true for a yes typed after the question.

    Args:
        question: What the device will do.
        stopped: Ends the wait.
        yes: `--yes` was given: show the question without asking.
    """
    print(question, file=sys.stderr, flush=True)
    if yes:
        print("--yes was given", file=sys.stderr, flush=True)
        return not stopped
    return says_yes("Type yes and press Enter to begin, anything else to leave it: ", lambda: bool(stopped))


def can_ask() -> bool:
    """True if a person can answer on the terminal; the system stops a background job that reads from it."""
    if not sys.stdin.isatty():
        return False
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:
        # A terminal without jobs.
        return True


def says_yes(prompt: str, is_over: Callable[[], bool]) -> bool:
    """Ask on the terminal; return true if a person types yes after `prompt`.

    An answer from before the prompt does not count. After a standstill of the process the time of an answer is unknown,
    so it asks again.

    Args:
        prompt: The text that says what to type.
        is_over: Ends the wait; it is called at least every 20 ms.
    """
    import termios

    descriptor = sys.stdin.fileno()

    def ask() -> None:
        termios.tcflush(descriptor, termios.TCIFLUSH)
        print(prompt, end="", file=sys.stderr, flush=True)

    ask()
    empty_s = time.monotonic()
    end_s = empty_s + WAITS_S
    typed = b""
    while not is_over() and time.monotonic() < end_s:
        if not select.select([descriptor], [], [], POLL_S)[0]:
            empty_s = time.monotonic()
            continue
        part = os.read(descriptor, 4096)
        if time.monotonic() - empty_s > PROMPT_S:
            print("\nThe program stood still while this was typed: once more.", file=sys.stderr, flush=True)
            ask()
            typed, empty_s = b"", time.monotonic()
            continue
        typed += part
        if not part or b"\n" in typed:
            return typed.strip().lower() == b"yes"
    print(file=sys.stderr, flush=True)
    return False


def ask_before_open(name: str, device: object, stopped: "Stopped", *, yes: bool, again: bool = False) -> None:
    """Announce a device that exerts force as soon as it is open, and ask; do nothing for other devices.

    Args:
        name: Name of the driver.
        device: The driver.
        stopped: Ends the wait.
        yes: `--yes` was given: announce without asking.
        again: The device was open before, and is closed.

    Raises:
        ValueError: Nobody can be asked.
        RuntimeError: Nobody said yes.
        KeyboardInterrupt: Ctrl-C instead.
    """
    if not exerts_by_itself(device):
        return
    check_terminal(f"{name} exerts a force by itself as soon as it is open", yes=yes)
    opened = "will be opened again" if again else "will be opened"
    question = (
        f"{name} {opened}. It EXERTS FORCE OR TORQUE BY ITSELF as soon as it is open, such as against its"
        " weight, also while zero force is commanded, and may fall when it is closed.\nIts base is clamped and its"
        " supply in reach; one hand supports it at its grip or from outside, no fingers are between its links. Ctrl-C"
        " ends it."
    )
    if not consents(question, stopped, yes=yes):
        if stopped:
            raise KeyboardInterrupt
        message = f"{name}: nobody said yes: it was not opened"
        raise RuntimeError(message)


@contextmanager
def announced(name: str, device: object) -> Iterator[list["StandaloneRun"]]:
    """Announce before a device is opened that it exerts by itself, and at the end if its force has ended.

    Yields:
        A list for the run that opens the device.
    """
    runs: list[StandaloneRun] = []
    if not exerts_by_itself(device):
        yield runs
        return
    print(f"{name}: is opened: from now on it exerts force by itself", file=sys.stderr, flush=True)
    try:
        yield runs
    finally:
        # A run whose end was awaited in vain has `failed_at`.
        closed = all(
            (run.finished or (run.failed_at is None and run.end())) and "close" not in run.watched.failed
            for run in runs
        )
        announce_end(name, closed=closed)
