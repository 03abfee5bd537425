"""Faults of a servo arm; each has a kind and stays until a person acknowledges it."""

from enum import StrEnum
from typing import Final


class FaultKind(StrEnum):
    """Kind of a fault."""

    SILENT = "no answer"
    UNPLUGGED = "unplugged"
    UNREADABLE = "unreadable answers"
    BROWN_OUT = "brown-out or cut cable"
    REBOOTED = "reboot"
    TORQUE_OFF = "torque off"
    INPUT_VOLTAGE = "input voltage"
    OVERHEATING = "overheating"
    ENCODER = "encoder"
    ELECTRICAL_SHOCK = "electrical shock"
    OVERLOAD = "overload"
    WATCHDOG = "bus watchdog"
    JUMP = "jump of a position"
    OVER_SPEED = "over-speed"
    NOT_FINITE = "number that is none"
    NOT_READY = "not ready"


HARDWARE_ERRORS: Final = {
    0: (FaultKind.INPUT_VOLTAGE, "see supply and cables"),
    2: (FaultKind.OVERHEATING, "let it cool down"),
    3: (FaultKind.ENCODER, "its motor or encoder does not work: replace it"),
    4: (FaultKind.ELECTRICAL_SHOCK, "its circuit had a shock, or too little power: see supply and wiring"),
    5: (FaultKind.OVERLOAD, "take the load off"),
}
"""Bits of address 70 with remedies. Source: ROBOTIS e-Manual, Hardware Error Status."""


class ArmFaultError(RuntimeError):
    """Fault with its kind."""

    def __init__(self, kind: FaultKind, text: str) -> None:
        super().__init__(f"{kind}: {text}")
        self.kind = kind


def hardware_error(servo_id: int, status: int) -> ArmFaultError:
    """Return the fault for a non-zero address 70."""
    named = [HARDWARE_ERRORS[bit] for bit in HARDWARE_ERRORS if status & (1 << bit)]
    if not named:
        return ArmFaultError(FaultKind.TORQUE_OFF, f"servo {servo_id} has a hardware error of code {status}")
    others = "".join(f", {kind}" for kind, _ in named[1:])
    kind, remedy = named[0]
    return ArmFaultError(kind, f"servo {servo_id}{others}: {remedy}, then acknowledge: it is started anew")
