"""Types of RTDE on the wire: all big-endian, packed without padding.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", section on field types.
"""

from dataclasses import dataclass
from typing import Final

Number = float | int | bool
Value = Number | tuple[Number, ...]
"""A scalar, or the components of a vector."""


@dataclass(frozen=True, slots=True)
class WireType:
    """A field type: its name in recipes, its `struct` code and how many of these it has."""

    name: str
    code: str
    count: int = 1

    @property
    def format(self) -> str:
        """Its part of a `struct` format."""
        return self.code * self.count

    @property
    def zero(self) -> Value:
        """What a variable holds before anybody has written it."""
        number: Number = {"d": 0.0, "?": False}.get(self.code, 0)
        return number if self.count == 1 else (number,) * self.count


BOOL: Final = WireType("BOOL", "?")
UINT8: Final = WireType("UINT8", "B")
UINT32: Final = WireType("UINT32", "I")
UINT64: Final = WireType("UINT64", "Q")
INT32: Final = WireType("INT32", "i")
DOUBLE: Final = WireType("DOUBLE", "d")
VECTOR3D: Final = WireType("VECTOR3D", "d", 3)
VECTOR6D: Final = WireType("VECTOR6D", "d", 6)
VECTOR6INT32: Final = WireType("VECTOR6INT32", "i", 6)
VECTOR6UINT32: Final = WireType("VECTOR6UINT32", "I", 6)

NOT_FOUND: Final = "NOT_FOUND"
"""In the place of a type: the controller has no such variable."""
IN_USE: Final = "IN_USE"
"""In the place of a type: another client writes this input."""
