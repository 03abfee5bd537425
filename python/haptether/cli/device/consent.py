"""A person's word on the terminal, before a device exerts a force by itself."""

import os
import select
import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.cli.shared.stop import Stopped

WAITS_S = 60.0
"""For an answer; then it is no."""
POLL_S = 0.02


def check_terminal(what: str, *, yes: bool) -> None:
    """Refuses a force where nobody can be asked.

    Raises:
        ValueError: Standard input is no terminal, and `--yes` was not given.
    """
    if not yes and not sys.stdin.isatty():
        message = (
            f"{what}: a person must say yes on the terminal, and there is none: give --yes if one stands beside it"
        )
        raise ValueError(message)


def consents(question: str, stopped: "Stopped", *, yes: bool) -> bool:
    """Whether a person says yes to what is asked, now: what was typed before the question does not count.

    Args:
        question: What the device will do.
        stopped: Ends the wait.
        yes: Given as a flag: the question is shown and not asked.
    """
    print(question, file=sys.stderr, flush=True)
    if yes:
        print("--yes was given", file=sys.stderr, flush=True)
        return not stopped
    import termios

    descriptor = sys.stdin.fileno()
    termios.tcflush(descriptor, termios.TCIFLUSH)
    print("Type yes and press Enter to begin, anything else to leave it: ", end="", file=sys.stderr, flush=True)
    end_s = time.monotonic() + WAITS_S
    typed = b""
    while not stopped and time.monotonic() < end_s:
        if select.select([descriptor], [], [], POLL_S)[0]:
            part = os.read(descriptor, 4096)
            typed += part
            if not part or b"\n" in typed:
                return typed.strip().lower() == b"yes"
    print(file=sys.stderr, flush=True)
    return False
