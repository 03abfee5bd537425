"""`haptether dynamixel`: its commands."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Dynamixel:
    """Set up an arm of Dynamixel servos: which servos answer, and where its zero is.

    docs/dynamixel.md has wiring, first run, and what the drivers check before there is torque.

    Examples:

    haptether dynamixel find /dev/ttyUSB0

    haptether dynamixel calibrate /dev/ttyUSB0 arm.toml --round
    """
