"""Interface of a gripper driver: one coordinate, 0 (open) to 1 (closed), and five methods."""

import math
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

MAX_SPEED: Final = 100.0
"""Largest speed in 1/s: no gripper opens within 10 ms, so a larger value was meant in mm/s."""
MAX_FORCE_N: Final = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSample:
    """Measurements of a gripper.

    Raises:
        ValueError: A value is not finite or out of range.
    """

    position: float
    """0 (open) to 1 (closed)."""
    velocity: float
    """Velocity in 1/s; positive closes."""
    force_n: float
    """Force between the jaws, 0 or more; the set force without a sensor."""
    holds_object: bool
    """True if an object blocks the jaws, from inside or outside."""
    fault: str | None = None
    """Fault of the gripper, or None. It accepts no command until the operator at this side acknowledges it."""

    def __post_init__(self) -> None:
        _check("GripperSample: position", self.position, 0.0, 1.0, "0 (open) to 1 (closed)")
        _check("GripperSample: velocity", self.velocity, -MAX_SPEED, MAX_SPEED, f"within {MAX_SPEED:g} 1/s")
        _check("GripperSample: force_n", self.force_n, 0.0, MAX_FORCE_N, f"0 to {MAX_FORCE_N:g} N")


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperCommand:
    """Target of a gripper. Speed and force outside its range are saturated.

    Raises:
        ValueError: A value is not finite or out of range.
    """

    position: float
    """0 (open) to 1 (closed)."""
    speed: float
    """Speed in 1/s, above 0, in either direction."""
    force_n: float
    """Closing force in N, 0 or more; the gripper's minimum may be far above 0."""

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
    """Gripper that moves at its own pace; only `open` and `close` may block.

    Loaded by an entry point of the group `haptether.grippers`, with the options of the scene as keyword arguments. An
    optional `acknowledge()` is called when the operator at this side acknowledges a fixed fault; it does not move the
    jaws. A gripper on the bus of its arm may have `attach(arm)`, called with the arm's driver before `open`; the arm is
    open by then, and is closed first.
    """

    def open(self) -> None:
        """Connect; called once, before any other method. The jaws move only if the options allow an activation."""

    def read(self) -> GripperSample:
        """Return the latest sample without blocking."""

    def write(self, command: GripperCommand) -> None:
        """Take the latest command without blocking; it replaces an unsent one."""

    def hold(self) -> None:
        """Stop the jaws without blocking, and keep the force on a held object, until the next `write`."""

    def close(self) -> None:
        """Disconnect within a bounded time; called once, also after an exception. The gripper keeps its grip."""


def _check(key: str, value: float, low: float, high: float, allowed: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        message = f"{key} = {value:g}: must be {allowed}"
        raise ValueError(message)
