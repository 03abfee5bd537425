"""What the driver of an arm of servos is called with: `[slave.options]` of a scene."""

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
    """Options of the driver `dynamixel` of a slave, in SI units; lists have an entry of each joint."""

    port: str
    """The serial port, such as /dev/serial/by-id/usb-FTDI_..."""
    arm: str
    """The file of the arm, which `haptether dynamixel calibrate` writes."""
    mode: Literal["current-position", "position"] = "current-position"
    """How the servos hold a joint: with a current below its cap, or with all that they have."""
    max_speed: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "rad/s"})] = 1.0
    """Fastest that a joint is sent."""
    max_jump: Annotated[float, Meta(gt=0.0, le=0.5, extra={"unit": "rad"})] = 0.1
    """How far from the joints a first command may be."""
    max_lag: Annotated[float, Meta(ge=0.05, le=1.0, extra={"unit": "rad"})] = 0.3
    """How far a joint is sent beyond where it is: so far it springs when what blocked it gives way."""
    start: Literal["refuse", "ramp"] = "refuse"
    """What a first command does that is further: it is a fault, or the joints go there at `max_speed`."""
    torque_constant: tuple[Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N m/A"})], ...] = ()
    """Torque at the output per ampere; by default that of `arm`, what the maker states, or that of the stall."""
    coulomb: tuple[Torque, ...] = ()
    """Dry friction of each gear; by default 0, for no maker states it."""
    viscous: tuple[Viscous, ...] = ()
    """Viscous friction of each gear; by default 0."""
    force_filter_hz: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "Hz"})] | None = 20.0
    """Corner of the low-pass on the torque; None for none."""
    watchdog_s: Annotated[float, Meta(ge=0.04, le=2.54, extra={"unit": "s"})] = 0.1
    """Silence after which the servos end their torque by themselves."""
    timeout_s: Annotated[float, Meta(ge=0.001, le=0.1, extra={"unit": "s"})] = 0.02
    """How late an answer may come."""
    lost_after_s: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "s"})] = 0.06
    """For so long reads may fail until it is a fault."""
    ramp_s: Annotated[float, Meta(ge=0.0, le=10.0, extra={"unit": "s"})] = 1.0
    """In which the arm takes up its own weight after it has torque."""
    release_s: Annotated[float, Meta(ge=0.0, le=5.0, extra={"unit": "s"})] = 1.0
    """In which it lets itself down at the end."""
    verify_watchdog: bool = True
    """Let the bus watchdog fire once before the first motion."""

    def settings(self) -> ArmSettings:
        """Those of the arm, from its file.

        Raises:
            ValueError: The file cannot be read, or has an arm that cannot be one of this driver.
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
    """The options from what a scene has, whose numbers may be written as text.

    Raises:
        ValueError: A key that there is not or that is missing, or a value that it cannot have; names the key.
    """
    required = {"port": "the path of the serial port", "arm": "the file of the arm"}
    return converted(DynamixelSlaveOptions, given, DEVICE, required)
