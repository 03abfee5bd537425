"""Reads of a servo arm that its joints can have reached since the last one."""

import math
import time
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from haptether.dynamixel.arm.settings import ServoSettings
from haptether.dynamixel.control_table import RAD_PER_TICK

MAX_DOUBTFUL: Final = 3
"""Largest number of reads in a row that are left out as wrong."""
FASTEST_SHARE: Final = 2.0
"""Speed of a joint, as a multiple of the no-load speed of its servo, beyond which a read is not plausible."""
PAUSE_S: Final = 0.02
"""Longest time in s for which one read is trusted to have moved at that speed."""
QUANTA_RAD: Final = 2.0 * RAD_PER_TICK


class PlausibleReads:
    """Joint angles of the last plausible read, from read to read.

    Up to three wrong reads in a row are left out. The fourth is a jump, unless the joints may have moved so far in the
    whole time since the last plausible read.
    """

    def __init__(self, servos: Sequence[ServoSettings]) -> None:
        self.position: NDArray[np.float64] = np.full(len(servos), np.nan)
        """q in rad, shape (n,)."""
        self._ids = [servo.servo_id for servo in servos]
        self._fastest = FASTEST_SHARE * np.array([servo.servo.no_load_rad_s for servo in servos])
        self._moved = np.empty(len(servos))
        self._at_s, self._doubtful = 0.0, 0

    def restart(self, position: NDArray[np.float64]) -> None:
        """Start from these joint angles."""
        self.position[:] = position
        self._at_s, self._doubtful = time.monotonic(), 0

    def take(self, position: NDArray[np.float64], now_s: float) -> str | None:
        """Take a plausible read and hold back another one; return the text of a jump."""
        moved, since_s = self._moved, now_s - self._at_s
        np.subtract(position, self.position, out=moved)
        np.abs(moved, out=moved)
        self._doubtful += 1
        span_s = min(since_s, PAUSE_S) if self._doubtful <= MAX_DOUBTFUL else since_s
        excess = moved - (self._fastest * span_s + QUANTA_RAD)
        index = int(excess.argmax())
        if excess[index] <= 0.0:
            np.copyto(self.position, position)
            self._at_s, self._doubtful = now_s, 0
        elif self._doubtful > MAX_DOUBTFUL or moved[index] > math.pi:
            return (
                f"servo {self._ids[index]} went {moved[index]:.2f} rad in {1e3 * since_s:.0f} ms: must be at most"
                f" {self._fastest[index]:.1f} rad/s: see its supply and its cable"
            )
        return None
