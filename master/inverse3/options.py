"""What the driver of an Inverse3 is called with: `[master.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from haptether.master.frame import DeviceFrame
from haptether.options import converted, refused

DEVICE: Final = "driver = inverse3"
Port = Annotated[int, Meta(ge=1, le=65535)]


class Inverse3Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `inverse3`, in SI units."""

    host: str = "127.0.0.1"
    """Where the service runs: an IPv4 address or a name."""
    port: Port = 10001
    """Of its WebSocket."""
    event_port: Port = 10020
    """Of its events: emergency brake, stall and sleep are told there only."""
    device_id: str = ""
    """Which Inverse3, as `049D`; by default the only one."""
    grip: Literal["none", "wireless", "wired", "custom"] = "none"
    """Which VerseGrip gives orientation and buttons; without one there is neither."""
    axes: list[str] = msgspec.field(default_factory=lambda: ["x", "y", "z"])
    """Which axis of the device is each of ours."""
    origin: tuple[float, float, float] = (0.0, -0.12, 0.15)
    """Where our origin is, in m in the device's frame; by default amid the workspace, as the vendor's examples have
    it."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N"})] = 4.0
    """Longer forces are shortened to this."""
    reply_timeout_s: Annotated[float, Meta(ge=0.002, le=0.015, extra={"unit": "s"})] = 0.010
    """How long a reply may take; then the force ends, and the connection."""
    device_velocity: bool = False
    """Take the velocity that the service gives, whose filter is not documented, rather than our own estimate."""
    force_gate: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Set the service's force gate; by default it is left as it is, and said."""
    damping: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Set the service's own damping; by default it is left as it is, and said."""

    @property
    def frame(self) -> DeviceFrame:
        """Of the device in ours."""
        return DeviceFrame(self.axes, self.origin)


def inverse3_options(given: Mapping[str, Any]) -> Inverse3Options:
    """The options from what a scene has, whose numbers may be written as text.

    Raises:
        ValueError: A key that there is not, or a value that it cannot have; names the key.
    """
    options = converted(Inverse3Options, given, DEVICE, {})
    if not options.host or any(sign.isspace() or sign in ":/" for sign in options.host):
        raise refused(DEVICE, "host", options.host, "must be an IPv4 address or a name, without a port")
    if not all(sign.isalnum() or sign in "-_" for sign in options.device_id):
        raise refused(DEVICE, "device_id", options.device_id, "must be letters and digits")
    try:
        frame = options.frame
    except ValueError as error:
        message = f"{DEVICE}: {error}"
        raise ValueError(message) from None
    if not all(abs(part) <= 1.0 for part in frame.origin):
        raise refused(DEVICE, "origin", options.origin, "must be within 1 m")
    return options
