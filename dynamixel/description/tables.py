"""The tables of a description.

All frames are turned as the base where every q is 0, so that a joint is a point and an axis. Lengths in m, angles in
rad, masses in kg, torques in N m.
"""

import math
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from haptether.dynamixel.models import SERVO_MODELS, ServoModel

MAX_JOINTS = 7
LENGTH = 2.0
ANGLE = 4.0 * math.pi
UNIT = 1e-6
"""How far the length of an axis or a quaternion may be from 1."""

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
    """Refuses what it does not know."""


class Link(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a joint moves, up to the next joint."""

    mass_kg: Annotated[float, Meta(gt=0.0, le=100.0)]
    com_m: Triple
    """Its centre of mass, from the joint's point."""
    source: Said

    def __post_init__(self) -> None:
        for value in self.com_m:
            _check("com_m", value, -LENGTH, LENGTH)


class Joint(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A joint and the servo that turns it: q = sign (p - offset_rad), p from the servo's mechanical centre."""

    name: str
    servo: ServoId
    model: str
    """A name of `SERVO_MODELS`."""
    sign: int
    xyz_m: Triple
    """A point on its axis, from that of the joint before it, where every q is 0."""
    axis: Triple
    """Unit vector; a right-handed turn about it is positive."""
    low_rad: float
    high_rad: float
    offset_rad: float = 0.0
    """p where q is 0: of one unit, so that a description of many has 0 until it is calibrated."""
    near_rad: float | None = None
    """Where q is about when the arm is started; by default the middle of its limits."""
    shadows: tuple[ServoId, ...] = ()
    """Servos that obey this one's id and turn the same joint."""
    cap_a: Annotated[float, Meta(gt=0.0, le=10.0)] | None = None
    """Greatest current of each servo; by default a share of what the model can."""
    coulomb_nm: NonNegative | None = None
    """Friction of the joint; not known by default, and then not compensated."""
    viscous_nm_s: NonNegative | None = None
    inertia_kg_m2: Annotated[float, Meta(gt=0.0, le=10.0)] | None = None
    """Of rotor and gears at the output; not known by default."""
    friction_source: Said | None = None
    link: Link | None = None
    """None where the mass is not known: then the arm has no gravity compensation."""

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
        """The model."""
        return SERVO_MODELS[self.model]

    @property
    def start_rad(self) -> float:
        """Where q is about when the arm is started."""
        return 0.5 * (self.low_rad + self.high_rad) if self.near_rad is None else self.near_rad

    @property
    def motors(self) -> int:
        """How many servos turn it."""
        return 1 + len(self.shadows)


class Trigger(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A servo that a finger turns: 0 open, 1 closed."""

    servo: ServoId
    model: str
    open_rad: float
    """p of the servo where it is open."""
    closed_rad: float
    lever_m: Annotated[float, Meta(gt=0.0, le=0.5)]
    """From its axis to the finger."""
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
        """The model."""
        return SERVO_MODELS[self.model]

    @property
    def sign(self) -> int:
        """1 where closing is positive at the servo."""
        return 1 if self.closed_rad > self.open_rad else -1


class Tool(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Point and frame that the hand leads, from the last joint's point, where every q is 0."""

    xyz_m: Triple = (0.0, 0.0, 0.0)
    quat_wxyz: Quat = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for value in self.xyz_m:
            _check("xyz_m", value, -LENGTH, LENGTH)
        if not abs(math.hypot(*self.quat_wxyz) - 1.0) <= UNIT:
            message = f"`quat_wxyz` = {list(self.quat_wxyz)}: must be of length 1"
            raise ValueError(message)


class ArmDescription(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An arm of servos."""

    name: str
    title: str
    source: Said
    """Of the geometry."""
    notes: tuple[str, ...] = ()
    """What is not known or was chosen."""
    gravity_m_s2: Triple = (0.0, 0.0, -9.81)
    """In the base frame: of an arm whose base is not level, another."""
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
        """Whether gravity can be compensated."""
        return all(joint.link is not None for joint in self.joints)

    @property
    def knows_friction(self) -> bool:
        """Whether friction can be compensated."""
        return all(joint.coulomb_nm is not None for joint in self.joints)
