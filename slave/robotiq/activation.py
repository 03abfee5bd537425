"""How a gripper is activated: it moves."""

from collections.abc import Generator
from typing import Final

from haptether.slave.robotiq.protocol import ACTIVE, FAULTS, RESET, Request, fault_text, get, set_

POLL_S: Final = 0.1
RESET_TRIES: Final = 50
PAUSE_S: Final = 0.5
"""Between a reset that is seen and the activation."""
BEGUN_S: Final = 1.0
"""After which the activation is looked at first."""
ACTIVE_TRIES: Final = 150
"""15 s; a real one takes a few."""
PENDING: Final = frozenset({0, 5, 7})
"""Values of FLT that an activation goes through."""


class ActivationError(RuntimeError):
    """The gripper did not become active."""


def activation() -> Generator[Request | float, int | None, None]:
    """Resets and activates: yields requests, to be sent their replies, and times in s to wait.

    Resetting is repeated until it shows, since a URCap that is busy drops a setting.

    Raises:
        ActivationError: It has not become active in time, or has a fault.

    Source: the order and pauses of GELLO's gripper class, wuphilipp/gello_software.
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
