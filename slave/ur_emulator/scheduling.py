"""Asks the system to let the control cycle go first."""

import os
from typing import Literal

PRIORITY = 80
"""Under SCHED_FIFO: that of a bridge, so that a client that spins cannot hold the controller up."""


def ask_realtime(wanted: Literal["auto", "off", "require"]) -> str:
    """Asks for SCHED_FIFO; what was granted, for people.

    Raises:
        OSError: It is required and was not granted.
    """
    if wanted == "off":
        return "not asked for"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        reason = getattr(error, "strerror", None) or "this system has no SCHED_FIFO"
        if wanted == "require":
            message = f"real time: not granted: {reason}"
            raise OSError(message) from None
        return f"not granted: {reason}"
    return f"SCHED_FIFO {PRIORITY}"
