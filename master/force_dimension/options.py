"""Options of a Force Dimension device's driver: `[master.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from haptether.master.frame import DeviceFrame, check_frame
from haptether.options import converted, refused

DEVICE: Final = "driver = force-dimension"
Gap = Annotated[float, Meta(ge=0.0, le=0.2, extra={"unit": "m"})]


class ForceDimensionOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `force-dimension`, in SI units."""

    library: str = ""
    """Path of the vendor's libdrd or libdhd; by default searched for."""
    serial: Annotated[int, Meta(ge=0, le=65535)] | None = None
    """Serial number of the device; by default the only device."""
    wrist: bool = False
    """True to use the orientation of the wrist, required for scenes of kind "pose"."""
    axes: list[str] = msgspec.field(default_factory=lambda: ["x", "y", "z"])
    """Device axis for each scene axis."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the scene in m in the device frame."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N"})] = 4.0
    """Largest force in N; a longer vector is shortened to it."""
    max_torque_n_m: Annotated[float, Meta(gt=0.0, le=1.0, extra={"unit": "N m"})] = 0.1
    """Largest torque in N m of an active wrist; a longer vector is shortened to it."""
    gripper_open_m: Gap | None = None
    """Value of `dhdGetGripperGap` in m for an open gripper; makes the gripper the trigger."""
    gripper_closed_m: Gap = 0.0
    """Value for a closed gripper."""
    gripper_sign: Literal[-1, 1] = -1
    """Sign of a closing gripper force in the SDK; undocumented, -1 as observed by users."""
    max_gripper_force_n: Annotated[float, Meta(gt=0.0, le=8.0, extra={"unit": "N"})] = 4.0
    """Largest gripper force in N; larger forces are saturated."""
    gravity_compensation: bool = True
    """True if the SDK adds gravity compensation to each force."""
    effector_mass_kg: Annotated[float, Meta(ge=0.0, le=2.0, extra={"unit": "kg"})] | None = None
    """Mass of a non-vendor end-effector for gravity compensation."""
    watchdog_s: Annotated[float, Meta(ge=0.002, le=0.0318, extra={"unit": "s"})] = 0.02
    """Time in s without a new force after which the controller ends all force; in steps of 125 µs."""
    require_watchdog: bool = True
    """True to refuse a device without a controller watchdog."""
    device_velocity: bool = False
    """True to use the SDK's velocity, a difference over 20 ms, not the own estimate."""

    @property
    def frame(self) -> DeviceFrame:
        """Map from the device frame to the scene frame."""
        return DeviceFrame(self.axes, self.origin)

    @property
    def watchdog_steps(self) -> int:
        """Watchdog time as an argument of `dhdSetWatchdog`."""
        return round(self.watchdog_s / WATCHDOG_STEP_S)


WATCHDOG_STEP_S: Final = 125e-6


def force_dimension_options(given: Mapping[str, Any]) -> ForceDimensionOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown, or a value is invalid; names the key.
    """
    options = converted(ForceDimensionOptions, given, DEVICE, {})
    check_frame(DEVICE, options.axes, options.origin)
    if options.wrist and len(options.axes) != 3:
        raise refused(DEVICE, "wrist", options.wrist, "must be false with fewer than three axes")
    if options.gripper_open_m is not None and not options.gripper_open_m - options.gripper_closed_m >= 1e-3:
        raise refused(
            DEVICE, "gripper_open_m", options.gripper_open_m,
            f"must be at least 1 mm above gripper_closed_m = {options.gripper_closed_m:g}",
        )  # fmt: skip
    return options
