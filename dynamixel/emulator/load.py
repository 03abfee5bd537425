"""An arm on emulated servos: gravity of the whole chain acts on each joint."""

from collections.abc import Sequence
from typing import Final

import msgspec

from haptether.dynamixel.description import ArmDescription, ArmKinematics
from haptether.dynamixel.emulator.joint import MAX_CATCH_UP_S, STEP_S, JointSettings
from haptether.dynamixel.emulator.servo import Servo

MAX_START_RAD: Final = 13.0


def mounted(arm: ArmDescription, offsets: Sequence[float] = (), signs: Sequence[int] = ()) -> ArmDescription:
    """An arm as it is described, whose servos are built in otherwise: what a calibration of this unit has to find.

    p = sign_0 sign q + offset_0 + offset, with sign_0 and offset_0 of the description.

    Args:
        arm: The description.
        offsets: Of each joint in rad; by default 0.
        signs: 1 or -1 of each; by default 1.

    Raises:
        ValueError: Another number of them, or one that cannot be.
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
    """The servos of a description with their loads, that of its trigger, open, and the shadows.

    A joint's inertia is that of motor and gears, by default what a servo of its model moves well, and that of the links
    at the start, which stays as it is: joints are coupled by gravity alone.

    Args:
        arm: The description.
        baud: In bit/s.
        firmware: Their version.
        start: Angles of the joints in rad; by default those about which the arm is started.

    Raises:
        ValueError: Another number of angles, or one that cannot be.
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
            # The other is driven for all that turn the joint.
            shadow.joint = servo.joint
            item = shadow.model.table["Secondary(Shadow) ID"]
            shadow.write(item.address, item.encoded(joint.servo), 0.0)
            servos.append(shadow)
    return servos


class ArmLoad:
    """Lets gravity act on the servos of an arm, in steps of `STEP_S`.

    Args:
        arm: The description.
        servos: As `servos_of` made them.
        mass_scale: What its masses weigh, of what the description says.
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
        """Moves the servos on to a time, all of them step by step."""
        if self._time_s is None or now_s - self._time_s > MAX_CATCH_UP_S:
            self._time_s = now_s if self._time_s is None else now_s - MAX_CATCH_UP_S
        while self._time_s + STEP_S <= now_s:
            self._time_s += STEP_S
            q = [sign * (joint.position_rad - offset) for joint, sign, offset in self._joints]
            for (joint, sign, _), torque in zip(self._joints, self._kinematics.gravity(q), strict=True):
                joint.load_nm = -self._mass_scale * sign * torque
            for servo in self._servos:
                servo.move(self._time_s)
