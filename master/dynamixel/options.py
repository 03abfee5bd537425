"""What the driver of a leader arm is called with: `[master.options]` of a scene."""

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
"""Of the no-load speed: a motor that drives nothing but its joint goes on to all of it."""
DEFAULT_BAUD: Final = 4_000_000
BEYOND_RAD: Final = 0.5
"""How far a trigger may be beyond its ends."""


class LeaderOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `dynamixel`, in SI units."""

    port: str
    """Such as /dev/serial/by-id/usb-FTDI_..."""
    arm: str
    """A shipped description, which needs `calibration`, or `offsets` and `signs`; or the path of one."""
    kind: Literal["joints", "pose"] = "joints"
    """That of the scene: angles of the joints, or place and orientation of the tool by forward kinematics."""
    baud: int | None = None
    """In bit/s, as the servos are set; by default that of the calibration, or 4 Mbit/s."""
    offsets: tuple[float, ...] | None = None
    """Angle of each joint's servo in rad where q is 0, of this unit; by default those of a description of your own."""
    signs: tuple[Literal[-1, 1], ...] | None = None
    """Direction of each joint's servo; by default those of a description of your own."""
    calibration: str | None = None
    """File of this unit that `haptether dynamixel calibrate` wrote: by the ids of its servos signs and offsets, limits
    and caps beside those of the description; and its rate."""
    torque_constant: tuple[Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N m/A"})], ...] | None = None
    """Largest torque at the output per ampere that each joint's servo may have; by default what `calibrate` measured,
    or the largest that is published of its model."""
    gravity_gain: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Share of the described gravity that is compensated; by default 1 where the masses are known."""
    friction_gain: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Share of the described friction that is compensated."""
    friction_speed: Annotated[float, Meta(ge=0.01, le=1.0, extra={"unit": "rad/s"})] = 0.1
    """Below it the share falls to 0, in rad/s."""
    limit_margin: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "rad"})] = 0.1
    """Before a joint's limits, where the spring begins, in rad."""
    limit_stiffness: Annotated[float, Meta(ge=0.0, le=20.0, extra={"unit": "N m/rad"})] = 1.0356
    """Of that spring; FACTR's joint_limit_barrier."""
    limit_damping: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "N m s/rad"})] = 0.0432
    """Within the spring, on the way in; ibid."""
    damping: Annotated[float, Meta(ge=0.0, le=1.0, extra={"unit": "N m s/rad"})] = 0.0
    """Of each joint, everywhere."""
    force_share: Annotated[float, Meta(ge=0.1, le=1.0)] = 0.3
    """Of each joint's greatest torque, what compensation and springs leave to the reflected force."""
    max_speed: tuple[Annotated[float, Meta(ge=0.1, le=60.0, extra={"unit": "rad/s"})], ...] | None = None
    """Of each joint in rad/s, beyond which it is a fault that ends all torque; by default 0.7 of its servo's no-load
    speed."""
    ramp_s: Annotated[float, Meta(ge=0.1, le=10.0, extra={"unit": "s"})] = 1.0
    """In which all torque rises from 0 after the start, and after a fault, in s."""
    timeout_s: Annotated[float, Meta(ge=0.001, le=0.1, extra={"unit": "s"})] = 0.02
    """How long an answer may take beyond its bytes, in s."""
    watchdog_s: Annotated[float, Meta(ge=0.02, le=0.5, extra={"unit": "s"})] = 0.1
    """Silence after which the servos end their torque themselves, in s."""
    verify_watchdog: bool = True
    """Let it bite once before the first force."""


def leader_options(given: Mapping[str, Any]) -> tuple[LeaderOptions, ArmDescription]:
    """The options from what a scene has, and the arm that they name.

    Raises:
        ValueError: A key that there is not or that is missing, or a value that it cannot have; names the key.
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
        # Weight, springs and the direction of each force go by where the zeros are.
        text = (
            "its zeros are of one build, not of this unit: give calibration, the file that `haptether dynamixel"
            " calibrate` writes, or offsets and signs"
        )
        raise refused(DRIVER, "arm", options.arm, text)
    return options, arm


def with_unit(options: LeaderOptions, arm: ArmDescription) -> tuple[LeaderOptions, ArmDescription]:
    """The description with what is known of this unit: offsets and signs, closer limits and lower caps, and its rate.

    Raises:
        ValueError: A calibration that cannot be read, or that lacks a servo or has another model of it.
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
    """A joint as it is described, with the servo that this unit has there.

    Raises:
        ValueError: Both cannot be.
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
    """In rad/s of each joint."""
    return options.max_speed or tuple(SPEED_SHARE * joint.servo_model.no_load_rad_s for joint in arm.joints)


def arm_settings(options: LeaderOptions, arm: ArmDescription) -> ArmSettings:
    """The servos as a bus knows them: those of the joints, and that of the trigger, whose q is 0 where it is open."""
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
