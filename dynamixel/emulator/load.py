"""Arm on emulated servos: gravity of the whole chain acts on each joint."""

from collections.abc import Sequence
from typing import Final

import msgspec

from haptether.dynamixel.description import ArmDescription, ArmKinematics
from haptether.dynamixel.emulator.joint import MAX_CATCH_UP_S, STEP_S, JointSettings
from haptether.dynamixel.emulator.servo import Servo

MAX_START_RAD: Final = 13.0


def mounted(arm: ArmDescription, offsets: Sequence[float] = (), signs: Sequence[int] = ()) -> ArmDescription:
    """Return a described arm with differently mounted servos, for a calibration to detect.

    p = sign_0 sign q + offset_0 + offset, with sign_0 and offset_0 from the description.

    Args:
        arm: Description of the arm.
        offsets: Offset of each joint in rad; by default 0.
        signs: Sign of each joint, 1 or -1; by default 1.

    Raises:
        ValueError: The number of values differs from the number of joints, or a value is invalid.
    """
    count = len(arm.joints)
    for name, values in (("offsets", offsets), ("signs", signs)):
        if values and len(values) != count:
            message = f"{name}: {len(values)}: must be {count}, one of each joint of {arm.name}"
            raise ValueError(message)
    for offset in offsets:
        if not abs(offset) <= MAX_START_RAD:
            message = f"offset = {offset:g}: must be at most {MAX_START_RAD:g} rad"
            raise ValueError(message)
    for sign in signs:
        if sign not in {1, -1}:
            message = f"sign = {sign}: must be 1 or -1"
            raise ValueError(message)
    joints = zip(arm.joints, offsets or (0.0,) * count, signs or (1,) * count, strict=True)
    return msgspec.structs.replace(
        arm,
        joints=tuple(
            msgspec.structs.replace(joint, offset_rad=joint.offset_rad + offset, sign=joint.sign * sign)
            for joint, offset, sign in joints
        ),
    )


def servos_of(arm: ArmDescription, *, baud: int, firmware: int, start: Sequence[float] = ()) -> list[Servo]:
    """Return the servos of a description with their loads, the open trigger, and the shadows.

    A joint's inertia is that of motor and gears (default: suited to the model) plus that of the links at the start. It
    stays constant: joints are coupled by gravity only.

    Args:
        arm: Description of the arm.
        baud: Bus rate in bit/s.
        firmware: Firmware version.
        start: Joint angles in rad; by default the start angles of the description.

    Raises:
        ValueError: The number of angles is wrong, or an angle is invalid.
    """
    q = list(start) or [joint.start_rad for joint in arm.joints]
    if len(q) != len(arm.joints):
        message = f"start: {len(q)} angles: must be {len(arm.joints)}, one of each joint of {arm.name}"
        raise ValueError(message)
    for angle in q:
        if not abs(angle) <= MAX_START_RAD:
            message = f"start = {angle:g}: must be at most {MAX_START_RAD:g} rad"
            raise ValueError(message)
    carried = ArmKinematics(arm).link_inertia(q)
    servos = []
    for joint, angle, inertia in zip(arm.joints, q, carried, strict=True):
        default = JointSettings.of(joint.servo_model)
        own = default.inertia if joint.inertia_kg_m2 is None else joint.inertia_kg_m2
        settings = JointSettings(
            inertia=joint.motors * own + inertia,
            viscous=joint.motors * default.viscous if joint.viscous_nm_s is None else joint.viscous_nm_s,
            coulomb=joint.motors * default.coulomb if joint.coulomb_nm is None else joint.coulomb_nm,
        )
        servos.append(
            Servo(
                joint.servo_model,
                joint.servo,
                baud=baud,
                firmware=firmware,
                position_rad=joint.sign * angle + joint.offset_rad,
                joint=settings,
                motors=joint.motors,
            )
        )
    if arm.trigger is not None:
        servos.append(
            Servo(
                arm.trigger.servo_model,
                arm.trigger.servo,
                baud=baud,
                firmware=firmware,
                position_rad=arm.trigger.open_rad,
            )
        )
    for joint, servo in zip(arm.joints, list(servos), strict=False):
        for servo_id in joint.shadows:
            shadow = Servo(joint.servo_model, servo_id, baud=baud, firmware=firmware)
            # The main servo drives the joint for all.
            shadow.joint = servo.joint
            item = shadow.model.table["Secondary(Shadow) ID"]
            shadow.write(item.address, item.encoded(joint.servo), 0.0)
            servos.append(shadow)
    return servos


class ArmLoad:
    """Apply gravity to the servos of an arm in steps of `STEP_S`.

    Args:
        arm: Description of the arm.
        servos: Servos from `servos_of`.
        mass_scale: Factor of the described masses.
    """

    def __init__(self, arm: ArmDescription, servos: Sequence[Servo], *, mass_scale: float = 1.0) -> None:
        self._kinematics = ArmKinematics(arm)
        self._mass_scale = mass_scale
        self._servos = list(servos)
        self._joints = [
            (servo.joint, float(joint.sign), joint.offset_rad) for joint, servo in zip(arm.joints, servos, strict=False)
        ]
        self._time_s: float | None = None

    def advance(self, now_s: float) -> None:
        """Advance all servos to a time, step by step."""
        if self._time_s is None or now_s - self._time_s > MAX_CATCH_UP_S:
            self._time_s = now_s if self._time_s is None else now_s - MAX_CATCH_UP_S
        while self._time_s + STEP_S <= now_s:
            self._time_s += STEP_S
            q = [sign * (joint.position_rad - offset) for joint, sign, offset in self._joints]
            for (joint, sign, _), torque in zip(self._joints, self._kinematics.gravity(q), strict=True):
                joint.load_nm = -self._mass_scale * sign * torque
            for servo in self._servos:
                servo.move(self._time_s)
