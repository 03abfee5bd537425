"""Common parts of scenarios: their names, the first posture, a pace."""

import time
from collections.abc import Callable
from typing import Any

START = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
PERIOD_S = 0.002
NO_TIMES = (0.0, 0.0)

Result = dict[str, Any]
SCENARIOS: dict[str, Callable[..., Result]] = {}


def scenario(function: Callable[..., Result]) -> Callable[..., Result]:
    """Register a function by its name."""
    SCENARIOS[function.__name__] = function
    return function


class Pace:
    """Absolute deadlines, and the lateness at each; late ones are never dropped."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.late_s: list[float] = []
        self._due = time.perf_counter()

    def wait(self) -> None:
        """Wait for the next deadline."""
        self._due += self.period_s
        left = self._due - time.perf_counter()
        if left > 0.0:
            time.sleep(left)
        self.late_s.append(max(0.0, time.perf_counter() - self._due))
