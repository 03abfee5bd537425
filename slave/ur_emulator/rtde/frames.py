"""Frames of RTDE: `uint16 size, uint8 type, payload`, the size counting all three.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol versions 1 and 2.
"""

import struct
from collections.abc import Iterator
from typing import Final

PROTOCOL_VERSION, CONTROLLER_VERSION, TEXT_MESSAGE, DATA_PACKAGE = b"VvMU"
SETUP_OUTPUTS, SETUP_INPUTS, START, PAUSE = b"OISP"

HEADER: Final = struct.Struct(">HB")
MAX_NAME_LIST: Final = 2048
"""Bytes of a list of names."""


class FramingError(ValueError):
    """The peer sent what cannot be a frame: its stream cannot be read any further."""


class FrameReader:
    """Splits a byte stream into frames."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def frames(self, received: bytes) -> Iterator[tuple[int, bytes]]:
        """Type and payload of each frame that is complete.

        Raises:
            FramingError: A size below that of a header.
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
    """The names of a packed list; some clients put a comma after the last one."""
    text = packed.decode("ascii", "replace")
    return tuple(text.removesuffix(",").split(",")) if text else ()


# ------------------------------------------------------------------------------------------------------- answers


def frame(kind: int, payload: bytes = b"") -> bytes:
    """A frame of a type with its payload."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def acceptance(kind: int, *, yes: bool) -> bytes:
    """The answer to a request that is accepted or not."""
    return frame(kind, bytes([yes]))


def recipe(kind: int, number: int | None, types: list[str]) -> bytes:
    """The answer to a recipe: its number, 0 if it is refused, none for outputs in version 1, and the types."""
    head = b"" if number is None else bytes([number])
    return frame(kind, head + ",".join(types).encode("ascii"))
