"""Tables of a description.

All frames are parallel to the base at q = 0, so that a joint is a point and an axis. Lengths in m, angles in rad,
masses in kg, torques in N m.
"""

import math
from collections.abc import Sequence
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from haptether.dynamixel.models import SERVO_MODELS, ServoModel

MAX_JOINTS = 7
LENGTH = 2.0
ANGLE = 4.0 * math.pi
UNIT = 1e-6
"""Allowed deviation of the norm of an axis or quaternion from 1."""

Triple: TypeAlias = tuple[float, float, float]
Quat: TypeAlias = tuple[float, float, float, float]
ServoId: TypeAlias = Annotated[int, Meta(ge=0, le=252)]
Said: TypeAlias = Annotated[str, Meta(min_length=1)]
NonNegative: TypeAlias = Annotated[float, Meta(ge=0.0, le=100.0)]


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        message = f"`{name}` = {value:g}: must be {low:g} to {high:g}"
        raise ValueError(message)


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table that refuses unknown keys."""


class Link(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Link moved by a joint, up to the next joint."""

    mass_kg: Annotated[float, Meta(gt=0.0, le=100.0)]
    com_m: Triple
    """Centre of mass, relative to the joint's point."""
    source: Said

    def __post_init__(self) -> None:
        for value in self.com_m:
            _check("com_m", value, -LENGTH, LENGTH)


class Joint(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Joint and its servo: q = sign (p - offset_rad), with p from the servo's mechanical centre."""

    name: str
    servo: ServoId
    model: str
    """Key of `SERVO_MODELS`."""
    sign: int
    xyz_m: Triple
    """Point on its axis, relative to the previous joint's point, at q = 0."""
    axis: Triple
    """Unit axis; a right-handed turn is positive."""
    low_rad: float
    high_rad: float
    offset_rad: float = 0.0
    """p at q = 0 of one unit; 0 in a description of many units until calibration."""
    near_rad: float | None = None
    """Approximate q at the start of the arm; by default the middle of its limits."""
    shadows: tuple[ServoId, ...] = ()
    """Servos that obey this id and turn the same joint."""
    cap_a: Annotated[float, Meta(gt=0.0, le=10.0)] | None = None
    """Largest current of each servo in A; by default a fraction of the model's largest."""
    coulomb_nm: NonNegative | None = None
    """Joint friction; by default unknown, and then not compensated."""
    viscous_nm_s: NonNegative | None = None
    inertia_kg_m2: Annotated[float, Meta(gt=0.0, le=10.0)] | None = None
    """Inertia of rotor and gears at the output; by default unknown."""
    friction_source: Said | None = None
    link: Link | None = None
    """Link; None if the mass is unknown, which disables gravity compensation."""

    def __post_init__(self) -> None:
        if self.model not in SERVO_MODELS:
            message = f"`model` = {self.model!r}: must be one of {', '.join(SERVO_MODELS)}"
            raise ValueError(message)
        if self.sign not in {1, -1}:
            message = f"`sign` = {self.sign}: must be 1 or -1"
            raise ValueError(message)
        for value in self.xyz_m:
            _check("xyz_m", value, -LENGTH, LENGTH)
        if not abs(math.hypot(*self.axis) - 1.0) <= UNIT:
            message = f"`axis` = {list(self.axis)}: must be of length 1"
            raise ValueError(message)
        _check("offset_rad", self.offset_rad, -ANGLE, ANGLE)
        _check("low_rad", self.low_rad, -ANGLE, ANGLE)
        _check("high_rad", self.high_rad, -ANGLE, ANGLE)
        if not self.low_rad < self.high_rad:
            message = f"`low_rad` = {self.low_rad:g}: must be below `high_rad` = {self.high_rad:g}"
            raise ValueError(message)
        _check("near_rad", self.start_rad, self.low_rad, self.high_rad)
        if (self.coulomb_nm is None) != (self.viscous_nm_s is None):
            message = "`coulomb_nm` and `viscous_nm_s`: must both be there, or neither"
            raise ValueError(message)
        if (self.coulomb_nm is not None or self.inertia_kg_m2 is not None) and self.friction_source is None:
            message = "`friction_source` is missing: friction and inertia must have one"
            raise ValueError(message)

    @property
    def servo_model(self) -> ServoModel:
        """Model of the servo."""
        return SERVO_MODELS[self.model]

    @property
    def start_rad(self) -> float:
        """Approximate q at the start of the arm."""
        return 0.5 * (self.low_rad + self.high_rad) if self.near_rad is None else self.near_rad

    @property
    def motors(self) -> int:
        """Number of servos that turn the joint."""
        return 1 + len(self.shadows)


class Trigger(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Servo turned by a finger: 0 open, 1 closed."""

    servo: ServoId
    model: str
    open_rad: float
    """p of the servo when open."""
    closed_rad: float
    lever_m: Annotated[float, Meta(gt=0.0, le=0.5)]
    """Distance in m from its axis to the finger."""
    source: Said
    cap_a: Annotated[float, Meta(gt=0.0, le=10.0)] | None = None

    def __post_init__(self) -> None:
        if self.model not in SERVO_MODELS:
            message = f"`model` = {self.model!r}: must be one of {', '.join(SERVO_MODELS)}"
            raise ValueError(message)
        _check("open_rad", self.open_rad, -ANGLE, ANGLE)
        _check("closed_rad", self.closed_rad, -ANGLE, ANGLE)
        if not abs(self.closed_rad - self.open_rad) >= 0.01:
            message = f"`closed_rad` = {self.closed_rad:g}: must be at least 0.01 rad from `open_rad`"
            raise ValueError(message)

    @property
    def servo_model(self) -> ServoModel:
        """Model of the servo."""
        return SERVO_MODELS[self.model]

    @property
    def sign(self) -> int:
        """1 if closing is positive at the servo, otherwise -1."""
        return 1 if self.closed_rad > self.open_rad else -1


class Tool(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tool point and frame, relative to the last joint's point, at q = 0."""

    xyz_m: Triple = (0.0, 0.0, 0.0)
    quat_wxyz: Quat = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for value in self.xyz_m:
            _check("xyz_m", value, -LENGTH, LENGTH)
        if not abs(math.hypot(*self.quat_wxyz) - 1.0) <= UNIT:
            message = f"`quat_wxyz` = {list(self.quat_wxyz)}: must be of length 1"
            raise ValueError(message)


class ArmDescription(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Arm of servos."""

    name: str
    title: str
    source: Said
    """Source of the geometry."""
    notes: tuple[str, ...] = ()
    """Unknown or chosen values."""
    gravity_m_s2: Triple = (0.0, 0.0, -9.81)
    """Gravity in the base frame; different if the base is not level."""
    joints: Annotated[tuple[Joint, ...], Meta(min_length=1, max_length=MAX_JOINTS)]
    tool: Tool = Tool()
    trigger: Trigger | None = None

    def __post_init__(self) -> None:
        if not math.hypot(*self.gravity_m_s2) <= 20.0:
            message = f"`gravity_m_s2` = {list(self.gravity_m_s2)}: must be at most 20 m/s^2 long"
            raise ValueError(message)
        ids = [one for joint in self.joints for one in (joint.servo, *joint.shadows)]
        ids += [self.trigger.servo] if self.trigger is not None else []
        for servo_id in ids:
            if ids.count(servo_id) > 1:
                message = f"`servo` = {servo_id} is given twice: each must have its own id"
                raise ValueError(message)

    @property
    def knows_masses(self) -> bool:
        """True if gravity can be compensated."""
        return all(joint.link is not None for joint in self.joints)

    @property
    def knows_friction(self) -> bool:
        """True if friction can be compensated."""
        return all(joint.coulomb_nm is not None for joint in self.joints)

    def motor_inertia(self, given: Sequence[float] | None = None) -> list[float]:
        """Return the inertia of motors and gears at the output of each joint in kg m^2.

        Args:
            given: Values instead of those of the description.

        Raises:
            ValueError: The description lacks a value, which must be identified.
        """
        if given is not None:
            return list(given)
        known = [joint.motors * joint.inertia_kg_m2 for joint in self.joints if joint.inertia_kg_m2 is not None]
        if len(known) < len(self.joints):
            message = f"{self.name}: the inertia of its servos is not known: give it, or identify it"
            raise ValueError(message)
        return known
