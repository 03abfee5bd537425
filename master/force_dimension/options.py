"""What the driver of a Force Dimension device is called with: `[master.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from haptether.master.frame import DeviceFrame
from haptether.options import converted, refused

DEVICE: Final = "driver = force-dimension"
Gap = Annotated[float, Meta(ge=0.0, le=0.2, extra={"unit": "m"})]


class ForceDimensionOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `force-dimension`, in SI units."""

    library: str = ""
    """The file of the vendor's libdrd or libdhd; by default it is looked for."""
    serial: Annotated[int, Meta(ge=0, le=65535)] | None = None
    """Serial number of the device; by default the only one."""
    wrist: bool = False
    """Take the orientation of its wrist, as scenes of kind "pose" need it."""
    axes: list[str] = msgspec.field(default_factory=lambda: ["x", "y", "z"])
    """Which axis of the device is each of ours."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where our origin is, in m in the device's frame."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N"})] = 4.0
    """Longer forces are shortened to this."""
    max_torque_n_m: Annotated[float, Meta(gt=0.0, le=1.0, extra={"unit": "N m"})] = 0.1
    """Longer torques of an active wrist are shortened to this."""
    gripper_open_m: Gap | None = None
    """What `dhdGetGripperGap` says of an open gripper, in m: with it the gripper is the trigger."""
    gripper_closed_m: Gap = 0.0
    """What it says of a closed one."""
    gripper_sign: Literal[-1, 1] = -1
    """Which sign a force that closes the gripper has for the SDK; its documents do not say, users saw -1."""
    max_gripper_force_n: Annotated[float, Meta(gt=0.0, le=8.0, extra={"unit": "N"})] = 4.0
    """Greater forces at the gripper are cut to this."""
    gravity_compensation: bool = True
    """Whether the SDK adds the weight of the device to each force."""
    effector_mass_kg: Annotated[float, Meta(ge=0.0, le=2.0, extra={"unit": "kg"})] | None = None
    """Of another end-effector than the vendor's, for its gravity compensation."""
    watchdog_s: Annotated[float, Meta(ge=0.002, le=0.0318, extra={"unit": "s"})] = 0.02
    """Without a new force for so long the controller ends all force by itself; in steps of 125 µs."""
    require_watchdog: bool = True
    """Refuse a device whose controller has none."""
    device_velocity: bool = False
    """Take the SDK's velocity, a difference over 20 ms, rather than our own estimate."""

    @property
    def frame(self) -> DeviceFrame:
        """Of the device in ours."""
        return DeviceFrame(self.axes, self.origin)

    @property
    def watchdog_steps(self) -> int:
        """As `dhdSetWatchdog` takes it."""
        return round(self.watchdog_s / WATCHDOG_STEP_S)


WATCHDOG_STEP_S: Final = 125e-6


def force_dimension_options(given: Mapping[str, Any]) -> ForceDimensionOptions:
    """The options from what a scene has, whose numbers may be written as text.

    Raises:
        ValueError: A key that there is not, or a value that it cannot have; names the key.
    """
    options = converted(ForceDimensionOptions, given, DEVICE, {})
    try:
        frame = options.frame
    except ValueError as error:
        message = f"{DEVICE}: {error}"
        raise ValueError(message) from None
    if not all(abs(part) <= 1.0 for part in frame.origin):
        raise refused(DEVICE, "origin", options.origin, "must be within 1 m")
    if options.wrist and len(options.axes) != 3:
        raise refused(DEVICE, "wrist", options.wrist, "must be false with fewer than three axes")
    if options.gripper_open_m is not None and not options.gripper_open_m - options.gripper_closed_m >= 1e-3:
        raise refused(
            DEVICE, "gripper_open_m", options.gripper_open_m,
            f"must be at least 1 mm above gripper_closed_m = {options.gripper_closed_m:g}",
        )  # fmt: skip
    return options
