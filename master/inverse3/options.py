"""Options of an Inverse3's driver: `[master.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from haptether.master.frame import DeviceFrame, check_frame
from haptether.options import check_host, converted, refused

DEVICE: Final = "driver = inverse3"
Port = Annotated[int, Meta(ge=1, le=65535)]


class Inverse3Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `inverse3`, in SI units."""

    host: str = "127.0.0.1"
    """Host of the service: an IPv4 address or a name."""
    port: Port = 10001
    """Port of its WebSocket."""
    event_port: Port = 10020
    """Port of its events, the only source of emergency brake, stall and sleep."""
    device_id: str = ""
    """Id of the Inverse3, such as `049D`; by default the only one."""
    grip: Literal["none", "wireless", "wired", "custom"] = "none"
    """VerseGrip for orientation and buttons; "none" gives neither."""
    axes: list[str] = msgspec.field(default_factory=lambda: ["x", "y", "z"])
    """Device axis for each scene axis."""
    origin: tuple[float, float, float] = (0.0, -0.12, 0.15)
    """Origin of the scene in m in the device frame; by default the workspace centre, as in the vendor's examples."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N"})] = 4.0
    """Largest force in N; a longer vector is shortened to it."""
    reply_timeout_s: Annotated[float, Meta(ge=0.002, le=0.015, extra={"unit": "s"})] = 0.010
    """Timeout in s of a reply, after which force and connection end."""
    device_velocity: bool = False
    """True to use the service's velocity, whose filter is undocumented, not the own estimate."""
    force_gate: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Force gate of the service; by default unchanged and reported."""
    damping: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Damping of the service; by default unchanged and reported."""

    @property
    def frame(self) -> DeviceFrame:
        """Map from the device frame to the scene frame."""
        return DeviceFrame(self.axes, self.origin)


def inverse3_options(given: Mapping[str, Any]) -> Inverse3Options:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown, or a value is invalid; names the key.
    """
    options = converted(Inverse3Options, given, DEVICE, {})
    check_host(DEVICE, options.host)
    if options.event_port == options.port:
        raise refused(DEVICE, "event_port", options.event_port, "must be another port than `port`: that of the events")
    if not all(sign.isalnum() or sign in "-_" for sign in options.device_id):
        raise refused(DEVICE, "device_id", options.device_id, "must be letters and digits")
    check_frame(DEVICE, options.axes, options.origin)
    return options
