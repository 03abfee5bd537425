"""Scheduling of an emulated device's process: ahead of ordinary processes, like a real device."""

import contextlib
import os
from collections.abc import Iterator
from typing import Final, Literal

PRIORITY: Final = 80
"""SCHED_FIFO priority, same as the bridge, so that a spinning client cannot delay the device."""


@contextlib.contextmanager
def realtime(wanted: Literal["auto", "off", "require"]) -> Iterator[str]:
    """Run under SCHED_FIFO inside the context if the system grants it; yield the result for display.

    Raises:
        OSError: Real time is required and was not granted.
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
