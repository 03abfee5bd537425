"""What a gripper is to Haptether: one coordinate, from 0 (open) to 1 (closed), and five methods that a driver has."""

import math
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

MAX_SPEED: Final = 100.0
"""1/s: no gripper opens within 10 ms, and a faster one was meant in mm/s."""
MAX_FORCE_N: Final = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSample:
    """What a gripper has measured.

    Raises:
        ValueError: A number that is not finite or out of its range.
    """

    position: float
    """0 (open) to 1 (closed)."""
    velocity: float
    """In 1/s; positive closes."""
    force_n: float
    """Between the jaws, 0 or more; what it is set to where it has no sensor."""
    holds_object: bool
    """Whether something stops the jaws, from inside or outside."""
    fault: str | None = None
    """What the gripper says is wrong with it: it takes no command until the operator at this side acknowledges it."""

    def __post_init__(self) -> None:
        _check("GripperSample: position", self.position, 0.0, 1.0, "0 (open) to 1 (closed)")
        _check("GripperSample: velocity", self.velocity, -MAX_SPEED, MAX_SPEED, f"within {MAX_SPEED:g} 1/s")
        _check("GripperSample: force_n", self.force_n, 0.0, MAX_FORCE_N, f"0 to {MAX_FORCE_N:g} N")


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperCommand:
    """Where a gripper is to go. What it cannot do of speed and force it does as nearly as it can.

    Raises:
        ValueError: A number that is not finite or out of its range.
    """

    position: float
    """0 (open) to 1 (closed)."""
    speed: float
    """In 1/s, above 0, either way."""
    force_n: float
    """With which it closes on what is in between, 0 or more; the least that it has may be far above 0."""

    def __post_init__(self) -> None:
        _check("GripperCommand: position", self.position, 0.0, 1.0, "0 (open) to 1 (closed)")
        _check("GripperCommand: speed", self.speed, 0.0, MAX_SPEED, f"above 0 and at most {MAX_SPEED:g} 1/s")
        if self.speed == 0.0:
            message = (
                f"GripperCommand: speed = 0: must be above 0 and at most {MAX_SPEED:g} 1/s: hold() stops a gripper"
            )
            raise ValueError(message)
        _check("GripperCommand: force_n", self.force_n, 0.0, MAX_FORCE_N, f"0 to {MAX_FORCE_N:g} N")


@runtime_checkable
class Gripper(Protocol):
    """A gripper: it moves by itself, at its own pace, and no call waits for it but `open` and `close`.

    Loaded by the name of an entry point of the group `haptether.grippers`, which is called with the options of the
    scene as keywords. A driver may have `acknowledge()`, called when the operator at this side says that a fault is
    mended; it does not move the jaws. One on the bus of its arm may have `attach(arm)`, called with the arm's driver
    before `open`; the arm is opened then, and closed first.
    """

    def open(self) -> None:
        """Connects; called once, before anything else. The jaws move only where the options allow an activation."""

    def read(self) -> GripperSample:
        """The newest sample, at once."""

    def write(self, command: GripperCommand) -> None:
        """Takes the newest command, at once; one that was not sent on yet is forgotten."""

    def hold(self) -> None:
        """Stops the jaws, at once, and keeps the force on what they hold, until the next `write`."""

    def close(self) -> None:
        """Disconnects within a bounded time; called once, also after an exception. It keeps its grip."""


def _check(key: str, value: float, low: float, high: float, allowed: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        message = f"{key} = {value:g}: must be {allowed}"
        raise ValueError(message)
