"""What a streamed motion must keep to. A limit that is not named is not in the problem."""

import math
from typing import Final

import msgspec

from haptether.slave.ur.kinematics.models import Six, UrModel

UNIT: Final = 1e-9


def _refuse(name: str, seen: object, allowed: str) -> ValueError:
    return ValueError(f"{name} = {seen}: must be {allowed}")


class WorkspacePlane(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A plane in the base frame; what it is for stays where `normal . p >= offset_m`.

    Raises:
        ValueError: A number is not finite, or the normal is not of length 1.
    """

    normal: tuple[float, float, float]
    """Points to where the arm may be; of length 1."""
    offset_m: float
    whole_arm: bool = False
    """For the balls of elbow, forearm, wrist and flange, as a table is; else for the tool point alone."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.offset_m):
            raise _refuse("offset_m", self.offset_m, "finite")
        if not abs(math.hypot(*self.normal) - 1) <= UNIT:
            raise _refuse("normal", list(self.normal), "of length 1")


class SelfKeepOut(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Forearm, wrist and flange stay clear of base, shoulder and upper arm.

    Raises:
        ValueError: A number is out of range.
    """

    margin_m: float = 0.01
    """Left between the surfaces, m."""
    radius_m: float | None = None
    """Of all links, m; without it that of the model in `ur_body`."""

    def __post_init__(self) -> None:
        if not 0 <= self.margin_m < math.inf:
            raise _refuse("margin_m", self.margin_m, "0 or more")
        if self.radius_m is not None and not 0 < self.radius_m < math.inf:
            raise _refuse("radius_m", self.radius_m, "above 0")


class StreamingLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of a streamed motion, joints from the base to the flange.

    Raises:
        ValueError: A number is out of range.
    """

    position_min: Six | None = None
    """rad, -inf for a joint that turns without end."""
    position_max: Six | None = None
    """rad."""
    max_speed: Six | None = None
    """rad/s."""
    max_acceleration: Six | None = None
    """rad/s^2, also for braking. Without it the velocity may jump."""
    max_tool_speed: float | None = None
    """Length of the tool point's velocity, m/s."""
    planes: tuple[WorkspacePlane, ...] = ()
    self_keep_out: SelfKeepOut | None = None
    approach_rate_hz: float = 10.0
    """A distance to a plane, or between links, shrinks at most at this rate times what is left of it."""

    def __post_init__(self) -> None:
        if (self.position_min is None) != (self.position_max is None):
            message = "position_min and position_max: must both be given or both be left out"
            raise ValueError(message)
        for least, most in zip(self.position_min or (), self.position_max or (), strict=True):
            if not least < most:
                raise _refuse("position_min", least, f"less than position_max = {most}")
        for name in ("max_speed", "max_acceleration"):
            for number in getattr(self, name) or ():
                if not 0 < number < math.inf:
                    raise _refuse(name, number, "above 0 for every joint")
        if self.max_tool_speed is not None and not 0 < self.max_tool_speed < math.inf:
            raise _refuse("max_tool_speed", self.max_tool_speed, "above 0")
        if not 0 < self.approach_rate_hz < math.inf:
            raise _refuse("approach_rate_hz", self.approach_rate_hz, "above 0")


def model_limits(model: UrModel, max_acceleration: float = 8.0) -> StreamingLimits:
    """Position and speed as the model's data sheet has them, and one acceleration for all joints in rad/s^2.

    The vendor publishes no largest acceleration: 8 is chosen, and lets a joint stop from 3 rad/s within 0.6 rad.
    """
    return StreamingLimits(
        position_min=model.position_min,
        position_max=model.position_max,
        max_speed=model.max_speed,
        max_acceleration=(max_acceleration,) * 6,
    )


class StreamingCost(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a streamed motion is to be good at.

    Raises:
        ValueError: A number is out of range.
    """

    weights: Six = (1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
    """Of what is missing of the tool's velocity, squared: linear in (m/s)^-2, angular in (rad/s)^-2. A tenth makes
    1 rad/s weigh as much as 0.3 m/s."""
    damping: float = 0.01
    """Weight of joint velocities at a singularity, (rad/s)^-2."""
    damping_below: float = 0.05
    """Manipulability, as a part of `|a2 a3| (|a2| + |a3|)`, below which damping sets in."""

    def __post_init__(self) -> None:
        for number in self.weights:
            if not 0 < number < math.inf:
                raise _refuse("weights", number, "above 0 for every axis")
        if not 0 <= self.damping < math.inf:
            raise _refuse("damping", self.damping, "0 or more")
        if not 0 < self.damping_below < math.inf:
            raise _refuse("damping_below", self.damping_below, "above 0")
