"""Frames of RTDE: `uint16 size, uint8 type, payload`, the size counting all three; bytes in, requests out.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol versions 1 and 2.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from haptether.slave.ur_emulator.utf8 import utf8
from haptether.slave.ur_emulator.version import ControllerVersion

PROTOCOL_VERSION, CONTROLLER_VERSION, TEXT_MESSAGE, DATA_PACKAGE = b"VvMU"
SETUP_OUTPUTS, SETUP_INPUTS, START, PAUSE = b"OISP"

HEADER: Final = struct.Struct(">HB")
LONGEST_NAMES: Final = 2048
"""Bytes that a list of names may have."""
V1_RATE_HZ: Final = 125.0
"""What version 1, which cannot ask for a rate, is served at."""

LEVELS: Final = {"exception": 0, "error": 1, "warning": 2, "info": 3}


class FramingError(ValueError):
    """The peer sent what cannot be a frame: nothing after it can be read."""


@dataclass(frozen=True, slots=True)
class ProtocolAsked:
    """It wants to speak this version of the protocol."""

    version: int


@dataclass(frozen=True, slots=True)
class ControllerAsked:
    """It wants to know the version of the controller."""


@dataclass(frozen=True, slots=True)
class OutputsAsked:
    """It wants these outputs, so many times a second."""

    rate_hz: float
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class InputsAsked:
    """It wants to write these inputs."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StartAsked:
    """It wants data packages from now on."""


@dataclass(frozen=True, slots=True)
class PauseAsked:
    """It wants no data packages for now."""


@dataclass(frozen=True, slots=True)
class Written:
    """Values of the inputs of a recipe, still packed."""

    recipe: int
    packed: bytes


@dataclass(frozen=True, slots=True)
class Told:
    """A message for the controller's log."""

    text: str


@dataclass(frozen=True, slots=True)
class Ignored:
    """A frame that the protocol does not have, or whose payload is too short; real controllers say nothing."""

    kind: int


Request = (
    ProtocolAsked | ControllerAsked | OutputsAsked | InputsAsked | StartAsked | PauseAsked | Written | Told | Ignored
)


class FrameReader:
    """Takes a byte stream apart."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def frames(self, came: bytes) -> Iterator[tuple[int, bytes]]:
        """Type and payload of each frame that is complete.

        Raises:
            FramingError: A size below that of a header.
        """
        waiting = self._waiting
        waiting += came
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


def request_of(kind: int, payload: bytes, protocol: int) -> Request:  # noqa: PLR0911
    """What a frame of the client asks for."""
    if kind == DATA_PACKAGE:
        return Written(payload[0], payload[1:]) if payload else Ignored(kind)
    if kind == PROTOCOL_VERSION:
        return ProtocolAsked(int.from_bytes(payload, "big")) if len(payload) == 2 else Ignored(kind)
    if kind == CONTROLLER_VERSION:
        return ControllerAsked()
    if kind == SETUP_OUTPUTS:
        return _outputs_asked(payload, protocol)
    if kind == SETUP_INPUTS:
        return InputsAsked(names_of(payload))
    if kind in {START, PAUSE}:
        return StartAsked() if kind == START else PauseAsked()
    if kind == TEXT_MESSAGE:
        return _told(payload)
    return Ignored(kind)


def _outputs_asked(payload: bytes, protocol: int) -> Request:
    if protocol == 1:
        return OutputsAsked(V1_RATE_HZ, names_of(payload))
    if len(payload) < 8:
        return Ignored(SETUP_OUTPUTS)
    (rate_hz,) = struct.unpack_from(">d", payload)
    return OutputsAsked(rate_hz if math.isfinite(rate_hz) else 0.0, names_of(payload[8:]))


def _told(payload: bytes) -> Request:
    length = payload[0] if payload else 0
    if len(payload) < 1 + length:
        return Ignored(TEXT_MESSAGE)
    return Told(payload[1 : 1 + length].decode("utf-8", "replace"))


def names_of(packed: bytes) -> tuple[str, ...]:
    """The names in a list of them; some clients put a comma behind the last one."""
    text = packed.decode("ascii", "replace")
    return tuple(text.removesuffix(",").split(",")) if text else ()


# ------------------------------------------------------------------------------------------------------- answers


def frame(kind: int, payload: bytes = b"") -> bytes:
    """A frame."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def accepted(kind: int, *, yes: bool) -> bytes:
    """The answer to what is either accepted or not."""
    return frame(kind, bytes([yes]))


def controller_version(version: ControllerVersion) -> bytes:
    """The answer to `ControllerAsked`."""
    return frame(CONTROLLER_VERSION, struct.pack(">4I", version.major, version.minor, version.bugfix, version.build))


def recipe(kind: int, number: int | None, types: list[str]) -> bytes:
    """The answer to a recipe: its number, 0 if it is refused, none for outputs in version 1, and the types."""
    head = b"" if number is None else bytes([number])
    return frame(kind, head + ",".join(types).encode("ascii"))


def text_message(level: str, text: str, protocol: int) -> bytes:
    """A message of the controller."""
    said = utf8(text, 255)
    if protocol == 1:
        return frame(TEXT_MESSAGE, bytes([LEVELS[level]]) + said)
    source = b"RTDE"
    return frame(TEXT_MESSAGE, bytes([len(said)]) + said + bytes([len(source)]) + source + bytes([LEVELS[level]]))
