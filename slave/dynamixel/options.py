"""Options of a servo arm's driver: `[slave.options]` of a scene."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta

from haptether.dynamixel.arm import ArmSettings, read_calibration
from haptether.dynamixel.models import OperatingMode
from haptether.options import converted, refused

DEVICE: Final = "device = dynamixel"
MAX_JOINTS: Final = 7
MODES: Final = {
    "current-position": OperatingMode.CURRENT_BASED_POSITION,
    "position": OperatingMode.EXTENDED_POSITION,
}

Torque: TypeAlias = Annotated[float, Meta(ge=0.0, le=20.0, extra={"unit": "N m"})]
Viscous: TypeAlias = Annotated[float, Meta(ge=0.0, le=20.0, extra={"unit": "N m s/rad"})]


class DynamixelSlaveOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the slave driver `dynamixel`, in SI units; lists have one entry per joint."""

    port: str
    """Serial port, such as /dev/serial/by-id/usb-FTDI_..."""
    arm: str
    """Calibration file from `haptether dynamixel calibrate`."""
    mode: Literal["current-position", "position"] = "current-position"
    """Joint control with a capped current, or with the full current."""
    max_speed: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "rad/s"})] = 1.0
    """Largest commanded joint speed."""
    max_jump: Annotated[float, Meta(gt=0.0, le=0.5, extra={"unit": "rad"})] = 0.1
    """Largest distance of a first command from the joints."""
    max_lag: Annotated[float, Meta(ge=0.05, le=1.0, extra={"unit": "rad"})] = 0.3
    """Largest distance of a goal from the joint, which bounds the jump when an obstacle gives way."""
    start: Literal["refuse", "ramp"] = "refuse"
    """Reaction to a first command beyond that: a fault, or motion at `max_speed`."""
    torque_constant: tuple[Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N m/A"})], ...] = ()
    """Output torque per ampere; by default from `arm`, the maker, or the stall."""
    coulomb: tuple[Torque, ...] = ()
    """Dry friction of each gear; by default 0, because no maker states it."""
    viscous: tuple[Viscous, ...] = ()
    """Viscous friction of each gear; by default 0."""
    force_filter_hz: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "Hz"})] | None = 20.0
    """Corner frequency of the torque low-pass; None for none."""
    watchdog_s: Annotated[float, Meta(ge=0.04, le=2.54, extra={"unit": "s"})] = 0.1
    """Silence after which the servos end their torque."""
    timeout_s: Annotated[float, Meta(ge=0.001, le=0.1, extra={"unit": "s"})] = 0.02
    """Timeout of an answer."""
    lost_after_s: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "s"})] = 0.06
    """Duration of failing reads that counts as a fault."""
    ramp_s: Annotated[float, Meta(ge=0.0, le=10.0, extra={"unit": "s"})] = 1.0
    """Time in which the arm takes over its own weight after torque is on."""
    release_s: Annotated[float, Meta(ge=0.0, le=5.0, extra={"unit": "s"})] = 1.0
    """Time for lowering the arm at the end."""
    verify_watchdog: bool = True
    """True to trip the bus watchdog once as a test before the first motion."""

    def settings(self) -> ArmSettings:
        """Return the settings of the arm from its file.

        Raises:
            ValueError: The file cannot be read, or its arm does not fit this driver.
        """
        try:
            baud, servos = read_calibration(Path(self.arm))
        except OSError as error:
            why = f"{error.strerror}: must be the file that `haptether dynamixel calibrate` writes"
            raise refused(DEVICE, "arm", self.arm, why) from None
        if len(servos) > MAX_JOINTS:
            raise refused(DEVICE, "arm", self.arm, f"has {len(servos)} servos: must have 1 to {MAX_JOINTS}")
        try:
            joints = tuple(replace(servo, mode=MODES[self.mode]) for servo in servos)
        except ValueError as error:
            raise refused(DEVICE, "mode", self.mode, str(error)) from None
        for key in ("torque_constant", "coulomb", "viscous"):
            given = getattr(self, key)
            if given and len(given) != len(servos):
                raise refused(DEVICE, key, given, f"must have {len(servos)} numbers, one of each joint")
        return ArmSettings(
            port=self.port,
            servos=joints,
            baud=baud,
            timeout_s=self.timeout_s,
            watchdog_s=self.watchdog_s,
            lost_after_s=self.lost_after_s,
            ramp_s=self.ramp_s,
            release_s=self.release_s,
            verify_watchdog=self.verify_watchdog,
        )


def dynamixel_slave_options(given: Mapping[str, Any]) -> DynamixelSlaveOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    required = {"port": "the path of the serial port", "arm": "the file of the arm"}
    return converted(DynamixelSlaveOptions, given, DEVICE, required)
