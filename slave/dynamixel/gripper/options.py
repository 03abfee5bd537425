"""What the driver of a gripper on a servo is called with: `[slave.gripper.options]` of a scene."""

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
"""Below a turn: a servo forgets turns with its supply."""
Angle = Annotated[float, Meta(ge=-512.0, le=512.0, extra={"unit": "rad"})]


class DynamixelGripperOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `dynamixel` of a gripper, in SI units; its port is that of the arm."""

    id: Annotated[int, Meta(ge=0, le=252)]
    """Of its servo."""
    model: str
    """Of its servo, one with current control."""
    open_rad: Angle
    """Angle of the servo from its mechanical centre where the jaws are open."""
    closed_rad: Angle
    """Where they touch."""
    lever_m: Annotated[float, Meta(gt=0.0, le=0.5, extra={"unit": "m"})]
    """Torque of the servo over force of the jaws."""
    cap_a: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "A"})] | None = None
    """Greatest current, at which the motor must be able to stand for long; by default 0.3 of what the model can."""
    max_speed: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "rad/s"})] = 3.0
    """Fastest that the servo turns."""
    torque_constant: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "N m/A"})] | None = None
    """Torque at the output per ampere, as it was measured; by default forces hold for the largest that is published."""

    def settings(self) -> GripSettings:
        """Those of the servo.

        Raises:
            ValueError: A servo that cannot be, or ends that are too near or too far apart; names the key.
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
    """The options from what a scene has, whose numbers may be written as text.

    Raises:
        ValueError: A key that there is not or that is missing, or a value that it cannot have; names the key.
    """
    required = {
        "id": "that of its servo", "model": "that of its servo", "open_rad": "the servo's angle where it is open",
        "closed_rad": "the servo's angle where it is closed", "lever_m": "torque of the servo over force of the jaws",
    }  # fmt: skip
    return converted(DynamixelGripperOptions, given, DEVICE, required)
