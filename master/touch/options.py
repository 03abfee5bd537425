"""Options of a Touch's driver: `[master.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from haptether.master.frame import DeviceFrame, check_frame
from haptether.options import converted, refused

DEVICE: Final = "driver = touch"


class TouchOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `touch`, in SI units."""

    library: str = ""
    """Path of the vendor's libHD; by default searched for."""
    device_name: str = ""
    """Name in the vendor's Touch_Setup; by default the default device."""
    orientation: bool = False
    """True to use the orientation of the stylus, required for scenes of kind "pose"."""
    axes: list[str] = msgspec.field(default_factory=lambda: ["z", "x", "y"])
    """Device axis for each scene axis: by default x towards the user, y to the right, z up."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the scene in m in the device frame."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "N"})] = 3.0
    """Largest force in N, also limited by the device; a longer vector is shortened to it."""
    watchdog_s: Annotated[float, Meta(ge=0.003, le=0.05, extra={"unit": "s"})] = 0.010
    """Time in s without a new force after which the vendor's thread exerts none."""
    sample_timeout_s: Annotated[float, Meta(ge=0.003, le=0.018, extra={"unit": "s"})] = 0.015
    """Timeout in s of a scheduler frame, after which the force ends."""
    device_velocity: bool = False
    """True to use the library's velocity, whose filter is undocumented, not the own estimate."""

    @property
    def frame(self) -> DeviceFrame:
        """Map from the device frame to the scene frame."""
        return DeviceFrame(self.axes, self.origin)


def touch_options(given: Mapping[str, Any]) -> TouchOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown, or a value is invalid; names the key.
    """
    options = converted(TouchOptions, given, DEVICE, {})
    if "\0" in options.device_name:
        raise refused(DEVICE, "device_name", options.device_name, "must be a name")
    check_frame(DEVICE, options.axes, options.origin)
    if options.orientation and len(options.axes) != 3:
        raise refused(DEVICE, "orientation", options.orientation, "must be false with fewer than three axes")
    return options
