"""States of a UR arm that its joints and its tool can have reached since the last one."""

import math
from typing import Final

from haptether.slave.ur.state import UrState

MAX_DOUBTFUL: Final = 3
"""Largest number of states in a row that are left out as wrong."""
MAX_JOINT_RAD_S: Final = 3.0 * math.pi
"""1.5 times the fastest joint of any model."""
MAX_TOOL_M_S: Final = 10.0
PAUSE_S: Final = 0.02
"""Longest time in s for which one state is trusted to have moved at these speeds."""


class PlausibleStates:
    """Last plausible state, from state to state.

    A wrong state, and up to three in a row, are left out. The fourth is accepted: a fault of the arm is then judged by
    it.

    Args:
        period_s: Shortest time between two states in s.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._state: UrState | None = None
        self._at_s = 0.0
        self._doubtful = 0

    @property
    def is_doubtful(self) -> bool:
        """True if the newest state was left out."""
        return self._doubtful > 0

    def take(self, state: UrState, now_s: float) -> UrState:
        """Return the state if it is plausible, else the last plausible one."""
        last = self._state
        span_s = min(max(now_s - self._at_s, self._period_s), PAUSE_S)
        if last is not None and self._doubtful < MAX_DOUBTFUL and not _reached(last, state, span_s):
            self._doubtful += 1
            return last
        self._state, self._at_s, self._doubtful = state, now_s, 0
        return state


def _reached(last: UrState, state: UrState, span_s: float) -> bool:
    turned_rad = max(abs(a - b) for a, b in zip(last.q, state.q, strict=True))
    return turned_rad <= MAX_JOINT_RAD_S * span_s and math.dist(last.pose[:3], state.pose[:3]) <= MAX_TOOL_M_S * span_s
