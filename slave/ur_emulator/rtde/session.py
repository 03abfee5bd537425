"""RTDE of one connection: its recipes, answers and data packages."""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from haptether.slave.ur_emulator.rtde import frames
from haptether.slave.ur_emulator.rtde.variables import (
    NOT_FOUND,
    ControllerVersion,
    Number,
    RtdeInputs,
    Value,
    WireType,
)

MAX_RECIPES: Final = 255
MAX_INPUT_FIELDS: Final = 4096
"""Fields of all input recipes of a connection; ur_rtde has about 300."""
PROTOCOLS: Final = frozenset({1, 2})
MIN_RATE_HZ: Final = 1.0
V1_RATE_HZ: Final = 125.0
"""Rate of protocol version 1, in which a client cannot request a rate."""


@dataclass(slots=True)
class InputRecipe:
    """Inputs of one data package."""

    names: tuple[str, ...]
    kinds: tuple[WireType, ...]
    layout: struct.Struct

    def values(self, packed: bytes) -> dict[str, Value] | None:
        """Return the values of a package; None if it is too short. The tail of a longer one is ignored."""
        if len(packed) < self.layout.size:
            return None
        numbers = self.layout.unpack_from(packed)
        values: dict[str, Value] = {}
        at = 0
        for name, kind in zip(self.names, self.kinds, strict=True):
            values[name] = numbers[at] if kind.count == 1 else numbers[at : at + kind.count]
            at += kind.count
        return values


@dataclass(slots=True)
class OutputRecipe:
    """Outputs of one data package, and its rate."""

    names: tuple[str, ...]
    scalar: tuple[bool, ...]
    layout: struct.Struct
    head: bytes
    share: float
    """Packages per control cycle, at most 1."""
    due: float = 0.0

    def packed(self, outputs: Mapping[str, Value]) -> bytes:
        """Return a data package with the present values."""
        numbers: list[Number] = []
        for name, scalar in zip(self.names, self.scalar, strict=True):
            value = outputs[name]
            if scalar:
                numbers.append(value)  # type: ignore[arg-type]  # the table says that it is a number
            else:
                numbers.extend(value)  # type: ignore[arg-type]  # the table says that it is a vector
        return self.head + self.layout.pack(*numbers)

    def is_due(self, cycles: int) -> bool:
        """Return True if a package is due after `cycles` control cycles; only the newest of several is sent."""
        self.due += self.share * cycles
        # A share such as 1/3 must not lose a package to rounding.
        whole = math.floor(self.due + 1e-9)
        self.due -= whole
        return whole > 0


@dataclass(slots=True)
class RtdeSession:
    """Protocol of one connection; it owns no socket.

    Call `receive` with received bytes and send its result; call `package` once a control cycle and send its result.
    """

    number: int
    rate_hz: float
    """Rate of the control cycle."""
    version: Callable[[], ControllerVersion]
    """Returns the version that clients see."""
    inputs: RtdeInputs
    outputs: Mapping[str, Value]
    output_types: Mapping[str, WireType]
    log: Callable[[str], None]
    """Receives text messages of the client."""
    protocol: int = 1
    started: bool = False
    _reader: frames.FrameReader = field(default_factory=frames.FrameReader)
    _recipes: dict[int, InputRecipe] = field(default_factory=dict)
    _output: OutputRecipe | None = None

    def receive(self, received: bytes) -> bytes:
        """Return the answers to received bytes.

        Raises:
            FramingError: The bytes are not RTDE.
        """
        answer = bytearray()
        for kind, payload in self._reader.frames(received):
            answer += self._answer(kind, payload)
        return bytes(answer)

    def package(self, cycles: int = 1) -> bytes | None:
        """Return the data package that is due after `cycles` control cycles, if any."""
        if not self.started or self._output is None or not self._output.is_due(cycles):
            return None
        return self._output.packed(self.outputs)

    def close(self) -> None:
        """Free the inputs of the connection."""
        self.inputs.release(self.number)

    def _answer(self, kind: int, payload: bytes) -> bytes:  # noqa: PLR0911
        """Return the answer to a frame; like a real controller, none for an unknown type or a short payload."""
        match kind:
            case frames.DATA_PACKAGE if payload:
                self._write(payload[0], payload[1:])
            case frames.PROTOCOL_VERSION if len(payload) == 2:
                return self._negotiated(int.from_bytes(payload, "big"))
            case frames.CONTROLLER_VERSION:
                of = self.version()
                return frames.frame(kind, struct.pack(">4I", of.major, of.minor, of.bugfix, of.build))
            case frames.SETUP_OUTPUTS if self.protocol == 1:
                return self._set_up_outputs(V1_RATE_HZ, frames.names_in(payload))
            case frames.SETUP_OUTPUTS if len(payload) >= 8:
                (rate_hz,) = struct.unpack_from(">d", payload)
                return self._set_up_outputs(rate_hz, frames.names_in(payload[8:]))
            case frames.SETUP_INPUTS:
                return self._set_up_inputs(frames.names_in(payload))
            case frames.START:
                return self._start()
            case frames.PAUSE:
                self.started = False
                return frames.acceptance(frames.PAUSE, yes=True)
            case frames.TEXT_MESSAGE if payload and len(payload) > payload[0]:
                self.log(payload[1 : 1 + payload[0]].decode("utf-8", "replace"))
        return b""

    def _negotiated(self, version: int) -> bytes:
        fits = version in PROTOCOLS
        if fits:
            self.protocol = version
        return frames.acceptance(frames.PROTOCOL_VERSION, yes=fits)

    def _set_up_outputs(self, rate_hz: float, names: tuple[str, ...]) -> bytes:
        self.started = False
        self._output = None
        number = None if self.protocol == 1 else 0
        if not self._fits(names):
            return frames.recipe(frames.SETUP_OUTPUTS, number, [])
        types = [kind.name if (kind := self.output_types.get(name)) else NOT_FOUND for name in names]
        kinds = [kind for name in names if (kind := self.output_types.get(name))]
        fits = names and NOT_FOUND not in types and MIN_RATE_HZ <= rate_hz < math.inf
        if fits:
            layout = struct.Struct(">" + "".join(kind.format for kind in kinds))
            body = b"\x01" if self.protocol != 1 else b""
            size = frames.HEADER.size + len(body) + layout.size
            self._output = OutputRecipe(
                names,
                tuple(kind.count == 1 for kind in kinds),
                layout,
                frames.HEADER.pack(size, frames.DATA_PACKAGE) + body,
                min(1.0, rate_hz / self.rate_hz),
            )
        if self.protocol != 1:
            number = int(bool(fits))
        return frames.recipe(frames.SETUP_OUTPUTS, number, types)

    def _set_up_inputs(self, names: tuple[str, ...]) -> bytes:
        if not self._fits(names):
            return frames.recipe(frames.SETUP_INPUTS, 0, [])
        fields = sum(len(recipe.names) for recipe in self._recipes.values()) + len(names)
        fits = bool(names) and len(self._recipes) < MAX_RECIPES and fields <= MAX_INPUT_FIELDS
        types, kinds = self.inputs.claim(self.number, names, wanted=fits)
        number = 0
        if fits and kinds is not None:
            number = len(self._recipes) + 1
            layout = struct.Struct(">" + "".join(kind.format for kind in kinds))
            # Use the table's names, not the client's: one copy in memory.
            self._recipes[number] = InputRecipe(self.inputs.known(names), kinds, layout)
        return frames.recipe(frames.SETUP_INPUTS, number, types)

    def _fits(self, names: tuple[str, ...]) -> bool:
        """Return True if a list of names is short enough; a longer one is logged."""
        fits = sum(len(name) + 1 for name in names) <= frames.MAX_NAME_LIST
        if not fits:
            self.log(f"list of {len(names)} names refused: must have at most {frames.MAX_NAME_LIST} bytes")
        return fits

    def _start(self) -> bytes:
        if self._output is None:
            return frames.acceptance(frames.START, yes=False)
        self.started = True
        self._output.due = 0.0
        # Clients wait without a timeout for the first package, so it goes with the answer.
        return frames.acceptance(frames.START, yes=True) + self._output.packed(self.outputs)

    def _write(self, number: int, packed: bytes) -> None:
        # ur_rtde writes to recipes that it has not yet set up while it reconnects: not an error.
        known = self._recipes.get(number)
        if known is not None and (values := known.values(packed)) is not None:
            self.inputs.write(values)
