"""Messages to and from the service: JSON of version 3.5, as in the public client crate `haply`."""

import math
from collections.abc import Sequence
from typing import Any, Final

import msgspec

GRIPS: Final = {"wireless": "wireless_verse_grip", "wired": "verse_grip", "custom": "custom_verse_grip"}
"""Device lists of the service by option `grip`."""
PROFILE: Final = "haptether"


class MessageError(ValueError):
    """Unusable data from the service."""


class Triple(msgspec.Struct):
    """Vector."""

    x: float
    y: float
    z: float

    @property
    def xyz(self) -> tuple[float, float, float]:
        """Components."""
        return self.x, self.y, self.z


class Turned(msgspec.Struct):
    """Orientation."""

    w: float
    x: float
    y: float
    z: float

    @property
    def wxyz(self) -> tuple[float, float, float, float]:
        """Components."""
        return self.w, self.x, self.y, self.z


class Transform(msgspec.Struct):
    """Workspace transform of positions and forces. The service omits parts that are the identity."""

    position: Triple = msgspec.field(default_factory=lambda: Triple(0.0, 0.0, 0.0))
    rotation: Turned = msgspec.field(default_factory=lambda: Turned(1.0, 0.0, 0.0, 0.0))
    scale: Triple = msgspec.field(default_factory=lambda: Triple(1.0, 1.0, 1.0))

    @property
    def is_identity(self) -> bool:
        """True if it changes nothing."""
        wanted = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
        parts = (*self.position.xyz, *self.scale.xyz)
        near = all(abs(part - is_) < 1e-6 for part, is_ in zip(parts, wanted, strict=True))
        return near and abs(abs(self.rotation.w) - 1.0) < 1e-6


class InverseState(msgspec.Struct):
    """State of an Inverse3."""

    cursor_position: Triple
    cursor_velocity: Triple
    current_cursor_force: Triple | None = None
    control_mode: str | None = None
    transform: Transform | None = None


class InverseStatus(msgspec.Struct):
    """Status of an Inverse3; every flag is required to know that it is safe."""

    calibrated: bool
    in_use: bool
    power_supply: bool
    ready: bool
    started: bool


class InverseDevice(msgspec.Struct):
    """An Inverse3."""

    device_id: str
    state: InverseState
    status: InverseStatus
    config: dict[str, Any] | None = None


class Buttons(msgspec.Struct):
    """Buttons of a wireless grip."""

    a: bool = False
    b: bool = False
    c: bool = False


class GripState(msgspec.Struct):
    """State of a VerseGrip of any kind."""

    orientation: Turned | None = None
    button: bool | None = None
    buttons: Buttons | None = None


class GripStatus(msgspec.Struct):
    """Status of a VerseGrip of any kind."""

    ready: bool | None = None
    connected: bool | None = None
    awake: bool | None = None


class Grip(msgspec.Struct):
    """VerseGrip."""

    device_id: str
    state: GripState
    status: GripStatus

    @property
    def buttons(self) -> int | None:
        """Button mask: bit 0, 1, 2 for a, b, c; bit 0 for the button of a wired grip."""
        if self.state.buttons is not None:
            pressed = self.state.buttons
            return pressed.a + 2 * pressed.b + 4 * pressed.c
        return None if self.state.button is None else int(self.state.button)


class Reply(msgspec.Struct):
    """Frame of the service."""

    inverse3: list[InverseDevice] = []
    verse_grip: list[Grip] = []
    wireless_verse_grip: list[Grip] = []
    custom_verse_grip: list[Grip] = []

    def grips(self, kind: str) -> list[Grip]:
        """Return the grips of a list of the service."""
        found: list[Grip] = getattr(self, kind)
        return found


class Event(msgspec.Struct):
    """Message of the event channel."""

    name: str
    level: str = ""
    message: str | None = None
    data: dict[str, Any] | None = None


_REPLY: Final = msgspec.json.Decoder(Reply)
_EVENT: Final = msgspec.json.Decoder(Event)


def reply(received: bytes) -> Reply:
    """Parse a frame of the service.

    Raises:
        MessageError: Not JSON, a field is missing or has another type, or a number is not finite.
    """
    try:
        return _REPLY.decode(received)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        message = f"{error}: {received[:80]!r}"
        raise MessageError(message) from None


def event(received: bytes) -> Event:
    """Parse a message of the event channel.

    Raises:
        MessageError: The data is not an event.
    """
    try:
        return _EVENT.decode(received)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        message = f"{error}: {received[:80]!r}"
        raise MessageError(message) from None


def configuration(device_id: str, *, force_gate: float | None, damping: float | None) -> bytes:
    """Return the first message of a session: its name, frame and device settings, without a force."""
    device: dict[str, Any] = {"device_id": device_id, "commands": {"probe_position": {}}}
    configure: dict[str, Any] = {}
    if force_gate is not None:
        configure["force_gate"] = {"gain": force_gate}
    if damping is not None:
        configure["damping"] = {"scalar": damping}
    if configure:
        device["configure"] = configure
    session = {"configure": {"profile": {"name": PROFILE}, "basis": {"permutation": "XYZ"}}}
    return msgspec.json.encode({"session": session, "inverse3": [device]})


class ForceMessage:
    """Message of each tick: the force, and a request of the grip state.

    Args:
        device_id: Id of the Inverse3.
        grip: List and id of the grip, or None.
    """

    def __init__(self, device_id: str, grip: tuple[str, str] | None) -> None:
        probe = (
            ""
            if grip is None
            else f',"{grip[0]}":[{{"device_id":"{grip[1]}","commands":{{"probe_orientation":{{}}}}}}]'
        )
        self._begin = f'{{"inverse3":[{{"device_id":"{device_id}","commands":{{"set_cursor_force":{{"vector":{{"x":'
        self._end = f"}}}}}}}}]{probe}}}"

    def __call__(self, force: Sequence[float]) -> bytes:
        """Encode F in N in the device frame; must be finite."""
        x, y, z = force
        if not math.isfinite(x + y + z):
            message = f"force {tuple(force)}: must be finite"
            raise ValueError(message)
        return f'{self._begin}{x:.9g},"y":{y:.9g},"z":{z:.9g}{self._end}'.encode()
