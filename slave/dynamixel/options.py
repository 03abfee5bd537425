"""Options of a servo arm's driver: `[slave.options]` of a scene."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta

from haptether.dynamixel.arm import ArmSettings, ServoSettings, read_calibration
from haptether.dynamixel.description import ArmDescription, load_arm
from haptether.dynamixel.models import OperatingMode
from haptether.options import converted, refused

DEVICE: Final = "device = dynamixel"
MAX_JOINTS: Final = 7
MODES: Final = {
    "current": OperatingMode.CURRENT,
    "current-position": OperatingMode.CURRENT_BASED_POSITION,
    "position": OperatingMode.EXTENDED_POSITION,
}

Torque: TypeAlias = Annotated[float, Meta(ge=0.0, le=20.0, extra={"unit": "N m"})]
Viscous: TypeAlias = Annotated[float, Meta(ge=0.0, le=20.0, extra={"unit": "N m s/rad"})]
Inertia: TypeAlias = Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "kg m^2"})]


class DynamixelSlaveOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the slave driver `dynamixel`, in SI units; lists have one entry per joint."""

    port: str
    """Serial port, such as /dev/serial/by-id/usb-FTDI_..."""
    arm: str
    """Calibration file from `haptether dynamixel calibrate`."""
    mode: Literal["current-position", "position", "current"] = "current-position"
    """Joint control with a capped current, or with the full current; or currents, for an arm that takes forces."""
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
    """Corner frequency of the torque low-pass; None for none. Mode `current` has `observer_bandwidth` instead."""
    inertia: tuple[Inertia, ...] = ()
    """Mode `current`: inertia of each joint at its output; with a description that of motors and gears, to which its
    links are added.
    """
    description: str | None = None
    """Mode `current`: name or path of a description of the arm, for gravity, inertia and friction."""
    gravity_gain: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Mode `current`: compensated fraction of gravity; by default 1 if the masses are known."""
    friction_gain: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Mode `current`: compensated fraction of the friction: of `coulomb` and `viscous`, or of the description."""
    friction_speed: Annotated[float, Meta(ge=0.01, le=1.0, extra={"unit": "rad/s"})] = 0.1
    """Mode `current`: speed below which that fraction decreases to 0."""
    joint_bandwidth: Annotated[float, Meta(ge=1.0, le=60.0, extra={"unit": "rad/s"})] = 25.0
    """Mode `current`: w of the joint spring M w^2 and damper 2 M w, which follow positions and hold."""
    max_torque: tuple[Torque, ...] = ()
    """Mode `current`: largest commanded torque of each joint; by default that of its current cap."""
    limit_margin: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "rad"})] = 0.1
    """Mode `current`: distance from a joint's limit in which a commanded torque towards it fades to 0."""
    observer_bandwidth: Annotated[float, Meta(ge=1.0, le=500.0, extra={"unit": "rad/s"})] = 50.0
    """Mode `current`: g of the observer of the environment's torque."""
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
        for key in ("torque_constant", "coulomb", "viscous", "inertia", "max_torque"):
            given = getattr(self, key)
            if given and len(given) != len(servos):
                raise refused(DEVICE, key, given, f"must have {len(servos)} numbers, one of each joint")
        if self.mode == "current" and not self.inertia and self.description is None:
            raise refused(DEVICE, "inertia", self.inertia, "must be given in mode = current, or a description")
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

    def described(self, servos: Sequence[ServoSettings]) -> ArmDescription | None:
        """Return the description of the arm, or None without one.

        Raises:
            ValueError: The description cannot be read, has other servos, or lacks a required value.
        """
        if self.description is None:
            return None
        try:
            arm = load_arm(self.description)
            arm.motor_inertia(self.inertia or None)
        except ValueError as error:
            raise refused(DEVICE, "description", self.description, str(error)) from None
        found = [(joint.servo, joint.model, joint.shadows) for joint in arm.joints]
        if found != [(servo.servo_id, servo.model, servo.shadows) for servo in servos]:
            why = f"must have the servos of {self.arm}, with their models and shadows, in the same order"
            raise refused(DEVICE, "description", self.description, why)
        if self.gravity_gain and not arm.knows_masses:
            raise refused(DEVICE, "gravity_gain", self.gravity_gain, f"{arm.name} has joints without a mass: must be 0")
        return arm


def dynamixel_slave_options(given: Mapping[str, Any]) -> DynamixelSlaveOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    required = {"port": "the path of the serial port", "arm": "the file of the arm"}
    return converted(DynamixelSlaveOptions, given, DEVICE, required)
