"""Options of a servo gripper's driver: `[slave.gripper.options]` of a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from haptether.dynamixel.arm import GripSettings, ServoSettings
from haptether.dynamixel.models import OperatingMode
from haptether.options import converted, refused

DEVICE: Final = "gripper = dynamixel"
LEAST_WAY_RAD: Final = 0.1
MOST_WAY_RAD: Final = 6.0
"""Below one turn, because a servo loses turns at power-off."""
Angle = Annotated[float, Meta(ge=-512.0, le=512.0, extra={"unit": "rad"})]


class DynamixelGripperOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the gripper driver `dynamixel`, in SI units; its port is that of the arm."""

    id: Annotated[int, Meta(ge=0, le=252)]
    """Id of the servo."""
    model: str
    """Model of the servo; requires current control."""
    open_rad: Angle
    """Servo angle from its mechanical centre with open jaws."""
    closed_rad: Angle
    """Servo angle with closed jaws."""
    lever_m: Annotated[float, Meta(gt=0.0, le=0.5, extra={"unit": "m"})]
    """Ratio of servo torque to jaw force."""
    cap_a: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "A"})] | None = None
    """Largest current, safe for a long stall; by default 0.3 of the model's largest."""
    max_speed: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "rad/s"})] = 3.0
    """Largest servo speed."""
    torque_constant: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N m/A"})] | None = None
    """Measured output torque per ampere; by default forces use the largest published value."""

    def settings(self) -> GripSettings:
        """Return the settings of the servo.

        Raises:
            ValueError: The servo is invalid, or the ends are too close or too far apart; names the key.
        """
        way = self.closed_rad - self.open_rad
        if not LEAST_WAY_RAD <= abs(way) <= MOST_WAY_RAD:
            why = f"must be {LEAST_WAY_RAD:g} to {MOST_WAY_RAD:g} rad from open_rad = {self.open_rad:g}"
            raise refused(DEVICE, "closed_rad", self.closed_rad, why)
        try:
            servo = ServoSettings(
                servo_id=self.id,
                model=self.model,
                low_rad=min(self.open_rad, self.closed_rad),
                high_rad=max(self.open_rad, self.closed_rad),
                cap_a=self.cap_a,
                torque_constant=self.torque_constant,
                mode=OperatingMode.CURRENT_BASED_POSITION,
            )
        except ValueError as error:
            raise refused(DEVICE, "model", self.model, str(error)) from None
        return GripSettings(
            servo=servo,
            open_rad=self.open_rad,
            closed_rad=self.closed_rad,
            lever_m=self.lever_m,
            max_speed=self.max_speed,
        )


def dynamixel_gripper_options(given: Mapping[str, Any]) -> DynamixelGripperOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    required = {
        "id": "that of its servo", "model": "that of its servo", "open_rad": "the servo's angle where it is open",
        "closed_rad": "the servo's angle where it is closed", "lever_m": "torque of the servo over force of the jaws",
    }  # fmt: skip
    return converted(DynamixelGripperOptions, given, DEVICE, required)
