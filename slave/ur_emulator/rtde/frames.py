"""Frames of RTDE: `uint16 size, uint8 type, payload`; the size counts all three.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol versions 1 and 2.
"""

import struct
from collections.abc import Iterator
from typing import Final

PROTOCOL_VERSION, CONTROLLER_VERSION, TEXT_MESSAGE, DATA_PACKAGE = b"VvMU"
SETUP_OUTPUTS, SETUP_INPUTS, START, PAUSE = b"OISP"

HEADER: Final = struct.Struct(">HB")
MAX_NAME_LIST: Final = 2048
"""Longest list of names in bytes."""


class FramingError(ValueError):
    """Invalid frame; the stream cannot be read any further."""


class FrameReader:
    """Splits a byte stream into frames."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def frames(self, received: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield type and payload of each complete frame.

        Raises:
            FramingError: A size is below that of a header.
        """
        waiting = self._waiting
        waiting += received
        start = 0
        try:
            while len(waiting) - start >= HEADER.size:
                size, kind = HEADER.unpack_from(waiting, start)
                if size < HEADER.size:
                    message = f"RTDE frame of {size} bytes: must be at least {HEADER.size}"
                    raise FramingError(message)
                if len(waiting) - start < size:
                    return
                payload = bytes(waiting[start + HEADER.size : start + size])
                start += size
                yield kind, payload
        finally:
            del waiting[:start]


def names_in(packed: bytes) -> tuple[str, ...]:
    """Return the names of a packed list; some clients put a comma after the last one."""
    text = packed.decode("ascii", "replace")
    return tuple(text.removesuffix(",").split(",")) if text else ()


# ------------------------------------------------------------------------------------------------------- answers


def frame(kind: int, payload: bytes = b"") -> bytes:
    """Return a frame of a type with its payload."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def acceptance(kind: int, *, yes: bool) -> bytes:
    """Return the answer to an accepted or refused request."""
    return frame(kind, bytes([yes]))


def recipe(kind: int, number: int | None, types: list[str]) -> bytes:
    """Return the answer to a recipe: its types, after its number: 0 if refused, none for outputs in version 1."""
    head = b"" if number is None else bytes([number])
    return frame(kind, head + ",".join(types).encode("ascii"))
