"""When a person started this process."""

import os
import time
from pathlib import Path

from haptether.cli.interrupts import INTERRUPTS

LOADED_S = time.monotonic()
"""Where the system does not tell: when this was loaded."""


def started_s() -> float | None:
    """By `time.monotonic()`; none where the command is not the process's own.

    A process that was stopped while it loaded, or a machine that slept, does not make the start younger.
    """
    if not INTERRUPTS.begun:
        return None
    try:
        # Field 22, in ticks since the machine started, its sleep included; the name before it may have any characters.
        fields = Path("/proc/self/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return LOADED_S
    return max(0.0, min(LOADED_S, time.monotonic() - age_s))
