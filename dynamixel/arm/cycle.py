"""Bus time of one cycle of an arm."""

from typing import Final

from haptether.dynamixel.arm.settings import ArmSettings
from haptether.dynamixel.models import OperatingMode

BITS: Final = 10
"""Bits of a byte on the line: start, eight, stop."""
REQUEST: Final = 14
"""Bytes of a sync read or sync write without the part per servo."""
ANSWER: Final = 11
"""Bytes of a status packet without data."""
FAST_ANSWER: Final = 8
"""Bytes of a fast answer without the parts of the servos."""
FAST_SHARE: Final = 4
"""Bytes of the part of a servo without data."""
MEASURED: Final = 10
"""Bytes of Present Current, Velocity and Position."""


def cycle_s(settings: ArmSettings, *, fast: bool, return_delay_s: float = 0.0) -> float:
    r"""Return the shortest time in s of one cycle of an arm: read all servos, then write to all.

    .. math:: T = \frac{10}{R} (B_\mathrm{ask} + B_\mathrm{answer} + B_\mathrm{write}) + n t_\mathrm{delay}

    R is the rate in bit/s, n the number of servos, B the bytes of the three parts.

    Args:
        settings: Rate and servos, including a gripper.
        fast: If true, the servos answer with one common status packet.
        return_delay_s: Delay of each servo before its answer in s.

    Source: ROBOTIS e-Manual, Protocol 2.0, "Sync Read", "Fast Sync Read", "Sync Write".
    """
    count = len(settings.servos)
    in_current = sum(servo.mode == OperatingMode.CURRENT for servo in settings.servos)
    asked = REQUEST + count
    answers = FAST_ANSWER + count * (FAST_SHARE + MEASURED) if fast else count * (ANSWER + MEASURED)
    written = sum(
        REQUEST + members * (1 + size) for members, size in ((in_current, 2), (count - in_current, 4)) if members
    )
    return BITS * (asked + answers + written) / settings.baud + count * return_delay_s
