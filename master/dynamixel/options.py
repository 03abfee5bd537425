"""Options of a leader arm's driver: `[master.options]` of a scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from haptether.dynamixel import BAUD_RATES
from haptether.dynamixel.arm import ArmSettings, ServoSettings, read_calibration
from haptether.dynamixel.description import ArmDescription, Joint, arm_names, load_arm
from haptether.options import converted, refused

DRIVER: Final = "driver = dynamixel"
SPEED_SHARE: Final = 0.7
"""Fraction of the no-load speed; a motor that drives only its joint reaches all of it."""
DEFAULT_BAUD: Final = 4_000_000
BEYOND_RAD: Final = 0.5
"""Largest valid angle in rad of a trigger beyond its ends."""


class LeaderOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `dynamixel`, in SI units."""

    port: str
    """Port path, such as /dev/serial/by-id/usb-FTDI_..."""
    arm: str
    """Name of a shipped description, which requires `calibration`, or `offsets` and `signs`; or the path of a
    description.
    """
    kind: Literal["joints", "pose"] = "joints"
    """Kind of the scene: joint angles, or tool position and orientation by forward kinematics."""
    baud: int | None = None
    """Bus rate of the servos in bit/s; by default from the calibration, or 4 Mbit/s."""
    offsets: tuple[float, ...] | None = None
    """Servo angle of each joint in rad at q = 0 of this unit; by default from a custom description."""
    signs: tuple[Literal[-1, 1], ...] | None = None
    """Direction of each joint's servo; by default from a custom description."""
    calibration: str | None = None
    """Calibration file of this unit from `haptether dynamixel calibrate`. By servo id it gives signs and offsets,
    limits and caps in addition to those of the description, and the rate.
    """
    torque_constant: tuple[Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N m/A"})], ...] | None = None
    """Largest possible torque constant at the output of each joint's servo; by default the calibrated one, or the
    largest published one of its model.
    """
    gravity_gain: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Compensated fraction of gravity; by default 1 if the masses are known."""
    friction_gain: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Compensated fraction of friction."""
    friction_speed: Annotated[float, Meta(ge=0.01, le=1.0, extra={"unit": "rad/s"})] = 0.1
    """Speed in rad/s below which the fraction decreases to 0."""
    limit_margin: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "rad"})] = 0.1
    """Distance in rad from a joint's limit at which the spring starts."""
    limit_stiffness: Annotated[float, Meta(ge=0.0, le=20.0, extra={"unit": "N m/rad"})] = 1.0356
    """Stiffness of that spring; FACTR's joint_limit_barrier."""
    limit_damping: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "N m s/rad"})] = 0.0432
    """Damping within the spring in inward direction; same source."""
    damping: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "N m s/rad"})] = 0.0
    """Damping of each joint at every angle."""
    force_share: Annotated[float, Meta(ge=0.1, le=1.0)] = 0.3
    """Fraction of each joint's largest torque that is reserved for the reflected force."""
    max_speed: tuple[Annotated[float, Meta(ge=0.1, le=60.0, extra={"unit": "rad/s"})], ...] | None = None
    """Largest speed of each joint in rad/s; beyond it a fault ends all torque; by default 0.7 of the no-load speed."""
    ramp_s: Annotated[float, Meta(ge=0.1, le=10.0, extra={"unit": "s"})] = 1.0
    """Rise time in s of all torque from 0 after the start and after a fault."""
    timeout_s: Annotated[float, Meta(ge=0.001, le=0.1, extra={"unit": "s"})] = 0.02
    """Timeout in s of an answer in addition to its bytes."""
    watchdog_s: Annotated[float, Meta(ge=0.02, le=0.5, extra={"unit": "s"})] = 0.1
    """Silence in s after which the servos end their torque."""
    verify_watchdog: bool = True
    """True to trip the watchdog once as a test before the first force."""


def leader_options(given: Mapping[str, Any]) -> tuple[LeaderOptions, ArmDescription]:
    """Convert the options of a scene, and load the arm that they name.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    required = {"port": "the port of the arm's adapter", "arm": "a shipped description, or the path of one"}
    options = converted(LeaderOptions, given, DRIVER, required)
    try:
        arm = load_arm(options.arm)
    except ValueError as error:
        raise refused(DRIVER, "arm", options.arm, str(error)) from None
    if options.baud is not None and options.baud not in BAUD_RATES:
        raise refused(DRIVER, "baud", options.baud, f"must be one of {', '.join(map(str, BAUD_RATES))}")
    for key, values in (
        ("offsets", options.offsets), ("signs", options.signs), ("torque_constant", options.torque_constant),
        ("max_speed", options.max_speed),
    ):  # fmt: skip
        if values is not None and len(values) != len(arm.joints):
            raise refused(DRIVER, key, values, f"must be {len(arm.joints)} numbers, one of each joint of {arm.name}")
    if options.gravity_gain and not arm.knows_masses:
        raise refused(DRIVER, "gravity_gain", options.gravity_gain, f"{arm.name} has joints without a mass: must be 0")
    if options.friction_gain and not arm.knows_friction:
        raise refused(
            DRIVER, "friction_gain", options.friction_gain, f"{arm.name} has joints without a friction: must be 0"
        )
    for joint in (*arm.joints, *((arm.trigger,) if arm.trigger is not None else ())):
        if not joint.servo_model.has_current_control:
            raise refused(DRIVER, "arm", options.arm, f"servo {joint.servo}: a {joint.model} has no current control")
    given_both = options.offsets is not None and options.signs is not None
    if options.calibration is not None:
        for key in ("offsets", "signs"):
            if getattr(options, key) is not None:
                raise refused(DRIVER, key, getattr(options, key), "must not be given where the calibration has them")
    elif options.arm in arm_names() and not given_both:
        # The zeros determine gravity, springs and the direction of each force.
        text = (
            "its zeros are of one build, not of this unit: give calibration, the file that `haptether dynamixel"
            " calibrate` writes, or offsets and signs"
        )
        raise refused(DRIVER, "arm", options.arm, text)
    return options, arm


def with_unit(options: LeaderOptions, arm: ArmDescription) -> tuple[LeaderOptions, ArmDescription]:
    """Merge the data of this unit into the description: offsets, signs, narrower limits, lower caps, rate.

    Raises:
        ValueError: The calibration cannot be read, lacks a servo, or has another model.
    """
    joints = list(arm.joints)
    if options.calibration is not None:
        try:
            baud, servos = read_calibration(Path(options.calibration))
        except OSError as error:
            why = f"{error.strerror}: must be the file that `haptether dynamixel calibrate` writes"
            raise refused(DRIVER, "calibration", options.calibration, why) from None
        except ValueError as error:
            raise refused(DRIVER, "calibration", options.calibration, str(error)) from None
        found = {servo.servo_id: servo for servo in servos}
        for index, joint in enumerate(joints):
            servo = found.get(joint.servo)
            if servo is None or servo.model != joint.model:
                seen = "lacks it" if servo is None else f"has it as a {servo.model}"
                message = f"servo {joint.servo} must be a {joint.model}: the file {seen}"
                raise refused(DRIVER, "calibration", options.calibration, message)
            joints[index] = _of_unit(options.calibration, joint, servo)
        if options.baud not in {None, baud}:
            message = f"must be {baud}, which {options.calibration} has"
            raise refused(DRIVER, "baud", options.baud, message)
        options = msgspec.structs.replace(options, baud=baud)
        if options.torque_constant is None:
            most = tuple(found[joint.servo].most_nm_per_a for joint in joints)
            options = msgspec.structs.replace(options, torque_constant=most)
    if options.offsets is not None:
        for index, (joint, at) in enumerate(zip(joints, options.offsets, strict=True)):
            try:
                joints[index] = msgspec.structs.replace(joint, offset_rad=at)
            except ValueError as error:
                why = f"joint {joint.name} (servo {joint.servo}): {error}"
                raise refused(DRIVER, "offsets", options.offsets, why) from None
    if options.signs is not None:
        joints = [msgspec.structs.replace(joint, sign=sign) for joint, sign in zip(joints, options.signs, strict=True)]
    return options, msgspec.structs.replace(arm, joints=tuple(joints))


def _of_unit(file: str, joint: Joint, servo: ServoSettings) -> Joint:
    """Merge the servo of this unit into a described joint.

    Raises:
        ValueError: The two contradict each other.
    """
    if servo.shadows and servo.shadows != joint.shadows:
        message = f"servo {servo.servo_id}: shadows {list(servo.shadows)}: the description has {list(joint.shadows)}"
        raise refused(DRIVER, "calibration", file, message)
    caps = [cap for cap in (joint.cap_a, servo.cap_a) if cap is not None]
    try:
        return msgspec.structs.replace(
            joint,
            sign=servo.sign,
            offset_rad=servo.offset_rad,
            low_rad=max(joint.low_rad, servo.low_rad),
            high_rad=min(joint.high_rad, servo.high_rad),
            cap_a=min(caps, default=None),
        )
    except ValueError as error:
        message = f"servo {servo.servo_id}, with the limits of the description: {error}"
        raise refused(DRIVER, "calibration", file, message) from None


def speed_limits(options: LeaderOptions, arm: ArmDescription) -> tuple[float, ...]:
    """Return the speed limit of each joint in rad/s."""
    return options.max_speed or tuple(SPEED_SHARE * joint.servo_model.no_load_rad_s for joint in arm.joints)


def arm_settings(options: LeaderOptions, arm: ArmDescription) -> ArmSettings:
    """Return the bus settings of all servos: joints and trigger, whose q is 0 when open."""
    constants = options.torque_constant or (None,) * len(arm.joints)
    servos = [
        ServoSettings(
            servo_id=joint.servo, model=joint.model, sign=joint.sign, offset_rad=joint.offset_rad,
            low_rad=joint.low_rad - BEYOND_RAD, high_rad=joint.high_rad + BEYOND_RAD, near_rad=joint.start_rad,
            cap_a=joint.cap_a, torque_constant=constant, shadows=joint.shadows,
        )
        for joint, constant in zip(arm.joints, constants, strict=True)
    ]  # fmt: skip
    if (trigger := arm.trigger) is not None:
        servos.append(
            ServoSettings(
                servo_id=trigger.servo,
                model=trigger.model,
                sign=trigger.sign,
                offset_rad=trigger.open_rad,
                low_rad=-BEYOND_RAD,
                high_rad=abs(trigger.closed_rad - trigger.open_rad) + BEYOND_RAD,
                near_rad=0.0,
                cap_a=trigger.cap_a,
            )
        )
    return ArmSettings(
        port=options.port, servos=tuple(servos), baud=options.baud or DEFAULT_BAUD, timeout_s=options.timeout_s,
        watchdog_s=options.watchdog_s, lost_after_s=0.6 * options.watchdog_s, ramp_s=options.ramp_s,
        verify_watchdog=options.verify_watchdog,
    )  # fmt: skip
