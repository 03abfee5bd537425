"""Frames of RTDE: `uint16 size, uint8 type, payload`, the size counting all three; bytes in, requests out.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol versions 1 and 2.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from haptether.slave.ur_emulator.rtde.variables import ControllerVersion

PROTOCOL_VERSION, CONTROLLER_VERSION, TEXT_MESSAGE, DATA_PACKAGE = b"VvMU"
SETUP_OUTPUTS, SETUP_INPUTS, START, PAUSE = b"OISP"

HEADER: Final = struct.Struct(">HB")
MAX_NAME_LIST: Final = 2048
"""Bytes of a list of names."""
V1_RATE_HZ: Final = 125.0
"""Of protocol version 1, in which a client cannot request a rate."""


class FramingError(ValueError):
    """The peer sent what cannot be a frame: its stream cannot be read any further."""


@dataclass(frozen=True, slots=True)
class ProtocolRequest:
    """Requests a version of the protocol."""

    version: int


@dataclass(frozen=True, slots=True)
class VersionRequest:
    """Requests the version of the controller."""


@dataclass(frozen=True, slots=True)
class OutputsRequest:
    """Sets up a recipe of outputs at a rate."""

    rate_hz: float
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class InputsRequest:
    """Sets up a recipe of inputs."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StartRequest:
    """Starts the data packages."""


@dataclass(frozen=True, slots=True)
class PauseRequest:
    """Pauses the data packages."""


@dataclass(frozen=True, slots=True)
class DataPackage:
    """Values of the inputs of a recipe, still packed."""

    recipe: int
    packed: bytes


@dataclass(frozen=True, slots=True)
class TextMessage:
    """A text message for the controller's log."""

    text: str


@dataclass(frozen=True, slots=True)
class Ignored:
    """A frame of an unknown type or with too short a payload; real controllers do not answer it."""

    kind: int


Request = (
    ProtocolRequest
    | VersionRequest
    | OutputsRequest
    | InputsRequest
    | StartRequest
    | PauseRequest
    | DataPackage
    | TextMessage
    | Ignored
)


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


def parsed(kind: int, payload: bytes, protocol: int) -> Request:  # noqa: PLR0911
    """The request in a frame of a client."""
    if kind == DATA_PACKAGE:
        return DataPackage(payload[0], payload[1:]) if payload else Ignored(kind)
    if kind == PROTOCOL_VERSION:
        return ProtocolRequest(int.from_bytes(payload, "big")) if len(payload) == 2 else Ignored(kind)
    if kind == CONTROLLER_VERSION:
        return VersionRequest()
    if kind == SETUP_OUTPUTS:
        return _outputs_request(payload, protocol)
    if kind == SETUP_INPUTS:
        return InputsRequest(names_in(payload))
    if kind in {START, PAUSE}:
        return StartRequest() if kind == START else PauseRequest()
    if kind == TEXT_MESSAGE:
        return _text_message(payload)
    return Ignored(kind)


def _outputs_request(payload: bytes, protocol: int) -> Request:
    if protocol == 1:
        return OutputsRequest(V1_RATE_HZ, names_in(payload))
    if len(payload) < 8:
        return Ignored(SETUP_OUTPUTS)
    (rate_hz,) = struct.unpack_from(">d", payload)
    return OutputsRequest(rate_hz if math.isfinite(rate_hz) else 0.0, names_in(payload[8:]))


def _text_message(payload: bytes) -> Request:
    length = payload[0] if payload else 0
    if len(payload) < 1 + length:
        return Ignored(TEXT_MESSAGE)
    return TextMessage(payload[1 : 1 + length].decode("utf-8", "replace"))


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


def controller_version(version: ControllerVersion) -> bytes:
    """The answer to `VersionRequest`."""
    return frame(CONTROLLER_VERSION, struct.pack(">4I", version.major, version.minor, version.bugfix, version.build))


def recipe(kind: int, number: int | None, types: list[str]) -> bytes:
    """The answer to a recipe: its number, 0 if it is refused, none for outputs in version 1, and the types."""
    head = b"" if number is None else bytes([number])
    return frame(kind, head + ",".join(types).encode("ascii"))
