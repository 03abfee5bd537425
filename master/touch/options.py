"""What the driver of a Touch is called with: `[master.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from haptether.master.frame import DeviceFrame
from haptether.options import converted, refused

DEVICE: Final = "driver = touch"


class TouchOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `touch`, in SI units."""

    library: str = ""
    """The file of the vendor's libHD; by default it is looked for."""
    device_name: str = ""
    """As the vendor's Touch_Setup has it; by default that of its default device."""
    orientation: bool = False
    """Take the orientation of the stylus, as scenes of kind "pose" need it."""
    axes: list[str] = msgspec.field(default_factory=lambda: ["z", "x", "y"])
    """Which axis of the device is each of ours: by default x towards the user, y to the right, z up."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where our origin is, in m in the device's frame."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "N"})] = 3.0
    """Longer forces are shortened to this, and to what the device says of itself."""
    watchdog_s: Annotated[float, Meta(ge=0.003, le=0.05, extra={"unit": "s"})] = 0.010
    """Without a new force for so long the vendor's thread exerts none, whatever this process does."""
    sample_timeout_s: Annotated[float, Meta(ge=0.003, le=0.018, extra={"unit": "s"})] = 0.015
    """How long a frame of the vendor's scheduler may take; then the force ends."""
    device_velocity: bool = False
    """Take the library's velocity, whose filter is not documented, rather than our own estimate."""

    @property
    def frame(self) -> DeviceFrame:
        """Of the device in ours."""
        return DeviceFrame(self.axes, self.origin)


def touch_options(given: Mapping[str, Any]) -> TouchOptions:
    """The options from what a scene has, whose numbers may be written as text.

    Raises:
        ValueError: A key that there is not, or a value that it cannot have; names the key.
    """
    options = converted(TouchOptions, given, DEVICE, {})
    if "\0" in options.device_name:
        raise refused(DEVICE, "device_name", options.device_name, "must be a name")
    try:
        frame = options.frame
    except ValueError as error:
        message = f"{DEVICE}: {error}"
        raise ValueError(message) from None
    if not all(abs(part) <= 1.0 for part in frame.origin):
        raise refused(DEVICE, "origin", options.origin, "must be within 1 m")
    if options.orientation and len(options.axes) != 3:
        raise refused(DEVICE, "orientation", options.orientation, "must be false with fewer than three axes")
    return options
