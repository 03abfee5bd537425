"""The priority of what speaks with a controller for a loop."""

import contextlib
import os
from typing import Final

PRIORITY: Final = 1
"""Under SCHED_FIFO."""


def ask_little_realtime() -> None:
    """Asks for real time of the least priority for the calling thread and what it starts; goes on without.

    Above what does not care for time, or a busy machine would starve the commands, and the watchdog of the controller
    would end its program; below the loops of bridge and emulated controller, because the vendor's library waits without
    sleeping.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
