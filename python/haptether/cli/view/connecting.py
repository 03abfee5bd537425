"""Waits for a running side to send what it does."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import TelemetryReader

WAIT_S = 10.0


def connected(path: Path) -> "TelemetryReader":
    """Reads the telemetry of a side, for which it waits up to 10 s.

    Raises:
        OSError: Nobody sends there.
        ValueError: What is sent is no telemetry.
    """
    from haptether.bridge import TelemetryReader

    until_s = time.monotonic() + WAIT_S
    while True:
        try:
            return TelemetryReader(path)
        except (FileNotFoundError, ConnectionRefusedError):
            if time.monotonic() > until_s:
                message = f"{path}: nobody sends there: start master or slave with --telemetry {path}"
                raise FileNotFoundError(message) from None
            time.sleep(0.1)
