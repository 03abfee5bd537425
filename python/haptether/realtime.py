"""Scheduling of the process of an emulated device: before ordinary processes, as a device of its own would run."""

import contextlib
import os
from collections.abc import Iterator
from typing import Final, Literal

PRIORITY: Final = 80
"""Under SCHED_FIFO: that of a bridge, so that a client that spins cannot hold the device up."""


@contextlib.contextmanager
def realtime(wanted: Literal["auto", "off", "require"]) -> Iterator[str]:
    """Runs under SCHED_FIFO where the system grants it, until the end; yields what was granted, for the screen.

    Raises:
        OSError: It is required and was not granted.
    """
    if wanted == "off":
        yield "not asked for"
        return
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        reason = getattr(error, "strerror", None) or "this system has no SCHED_FIFO"
        if wanted == "require":
            message = f"real time: not granted: {reason}"
            raise OSError(message) from None
        yield f"not granted: {reason}"
        return
    try:
        yield f"SCHED_FIFO {PRIORITY}"
    finally:
        os.sched_setscheduler(0, *before)
