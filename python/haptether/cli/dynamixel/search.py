"""Search for servos on a port, for the commands."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.dynamixel.arm.guide import FoundServo


def found_servos(port: str, baud: int | None, ids: Sequence[int]) -> "list[FoundServo]":
    """Return the answering servos, in the order of the ids.

    Raises:
        OSError: The port cannot be opened.
        ValueError: A rate or an id that no servo has.
    """
    from haptether.dynamixel import BAUD_RATES
    from haptether.dynamixel.arm.guide import find_servos

    if baud is not None and baud not in BAUD_RATES:
        message = f"baud = {baud}: must be one of {', '.join(map(str, BAUD_RATES))}"
        raise ValueError(message)
    for servo_id in ids:
        if not 0 <= servo_id <= 252:
            message = f"ids: {servo_id}: must be 0 to 252"
            raise ValueError(message)
    if not ids or len(set(ids)) < len(ids):
        message = f"ids: {' '.join(map(str, ids))}: must be different ones"
        raise ValueError(message)
    rates = BAUD_RATES if baud is None else (baud,)
    found = find_servos(port, ids, rates)
    return sorted(found, key=lambda servo: (rates.index(servo.baud), ids.index(servo.servo_id)))
