"""Activation of a gripper, which moves it."""

from collections.abc import Generator
from typing import Final

from haptether.slave.robotiq.protocol import ACTIVE, FAULTS, RESET, Request, fault_text, get, set_

POLL_S: Final = 0.1
RESET_TRIES: Final = 50
PAUSE_S: Final = 0.5
"""Pause in s between a confirmed reset and the activation."""
BEGUN_S: Final = 1.0
"""Time in s before the activation is first checked."""
ACTIVE_TRIES: Final = 150
"""15 s; a real gripper takes a few."""
PENDING: Final = frozenset({0, 5, 7})
"""FLT values during an activation."""


class ActivationError(RuntimeError):
    """The gripper did not become active."""


def activation() -> Generator[Request | float, int | None, None]:
    """Reset and activate: yields requests, to be sent their replies, and waiting times in s.

    The reset is repeated until confirmed, because a busy URCap drops settings.

    Raises:
        ActivationError: The gripper is not active in time, or has a fault.

    Source: order and pauses of GELLO's gripper class, wuphilipp/gello_software.
    """
    for _ in range(RESET_TRIES):
        yield set_({"ACT": 0})
        yield set_({"ATR": 0})
        active, state = (yield get("ACT")), (yield get("STA"))
        if (active, state) == (0, RESET):
            break
        yield POLL_S
    else:
        message = f"reset: ACT {active} and STA {state} after {RESET_TRIES * POLL_S:g} s: must both be 0"
        raise ActivationError(message)
    yield PAUSE_S
    yield set_({"ACT": 1})
    yield BEGUN_S
    for _ in range(ACTIVE_TRIES):
        active, state, flt = (yield get("ACT")), (yield get("STA")), (yield get("FLT"))
        if (active, state) == (1, ACTIVE):
            return
        if flt in FAULTS and flt not in PENDING:
            raise ActivationError(fault_text(flt))
        yield POLL_S
    message = f"ACT {active} and STA {state} after {BEGUN_S + ACTIVE_TRIES * POLL_S:g} s: must be 1 and 3"
    raise ActivationError(message)
