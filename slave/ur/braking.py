"""How hard a soft stop brakes a UR arm.

While the controller brakes, the vendor's library waits and says nothing, and the watchdog would end the program in the
middle of a stop that takes longer than its period. So a stop is as hard as the options ask, and harder where it would
take longer: `a = max(a_option, 2 |v| f)` for the watchdog's f in Hz, up to `HARDEST`.
"""

import math
from typing import Final

from haptether.slave.ur.options import UrOptions
from haptether.slave.ur.state import UrState

SHARE: Final = 0.5
"""Of the watchdog's period that braking may take: there is silence before, and a few cycles of words around it."""
HARDEST: Final = 20.0
"""m/s² or rad/s²; the most that the options may ask for, too. What is too fast for that the watchdog stops."""


def of_joints(options: UrOptions, state: UrState) -> float:
    """Deceleration in rad/s² of the fastest joint."""
    return _within(options, max(map(abs, state.qd)))


def of_tool(options: UrOptions, state: UrState) -> float:
    """Deceleration of the tool, in m/s² of its point and rad/s² of its turning."""
    return _within(options, max(math.hypot(*state.speed[:3]), math.hypot(*state.speed[3:])))


def _within(options: UrOptions, speed: float) -> float:
    return max(options.stop_deceleration, min(speed * options.watchdog_hz / SHARE, HARDEST))
