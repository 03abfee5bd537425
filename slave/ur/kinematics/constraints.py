"""Limits of a streamed motion, and distances to keep: to planes, and between parts of the arm.

A limit that is not given is not in the problem. The arm's body is approximated by balls and capsules on its links. This
guides a planner and is not a safety function: link radii are chosen, and a gripper is only a ball.

Source: Universal Robots' ROS description, `config/<model>/physical_parameters.yaml` and `visual_parameters.yaml`:
offset of upper arm and forearm from the plane through the shoulder, "measured from model".
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from haptether.slave.ur.kinematics.chain import Chain
from haptether.slave.ur.kinematics.models import SAME_ARM, Six, UrModel
from haptether.slave.ur.kinematics.pose import Quaternion, Vector
from haptether.slave.ur.kinematics.symbolic import Symbol, casadi_module

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.arm import UrKinematics

UNIT: Final = 1e-9
"""Allowed deviation of a normal's length from 1."""


class WorkspacePlane(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Plane in the base frame; its subject stays where `normal . p >= offset_m`.

    Raises:
        ValueError: A number is not finite, or the normal is not of length 1.
    """

    normal: tuple[float, float, float]
    """Unit normal towards the allowed side."""
    offset_m: float
    """Distance of the plane from the origin in m, along the normal."""
    whole_arm: bool = False
    """True to apply to the balls of elbow, forearm, wrist and flange, as for a table; False for the tool point only."""

    @classmethod
    def through(cls, nx: float, ny: float, nz: float, d: float) -> "WorkspacePlane":
        """Return the plane `n . p = d` for the tool point.

        Args:
            nx: x of a normal n towards the allowed side, without unit, of any length above 0.
            ny: y of n.
            nz: z of n.
            d: Offset in m times |n|.
        """
        length = math.hypot(nx, ny, nz)
        return cls(normal=(nx / length, ny / length, nz / length), offset_m=d / length)

    def __post_init__(self) -> None:
        if not math.isfinite(self.offset_m):
            raise _out_of_range("offset_m", self.offset_m, "finite")
        if not abs(math.hypot(*self.normal) - 1) <= UNIT:
            raise _out_of_range("normal", list(self.normal), "of length 1")


class ToolCone(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cone in the base frame for the tool's z axis; the tilt is the angle to the cone's axis.

    Raises:
        ValueError: A number is not finite, the axis is not of length 1, or the angle is not above 0 and below pi.
    """

    axis: Vector
    """Unit axis."""
    half_angle: float
    """Half angle in rad."""

    @classmethod
    def around(cls, x: float, y: float, z: float, half_angle: float) -> "ToolCone":
        """Return the cone around an axis of any length above 0."""
        length = math.hypot(x, y, z)
        return cls(axis=(x / length, y / length, z / length), half_angle=half_angle)

    def __post_init__(self) -> None:
        if not abs(math.hypot(*self.axis) - 1) <= UNIT:
            raise _out_of_range("axis", list(self.axis), "of length 1")
        if not 0 < self.half_angle < math.pi:
            raise _out_of_range("half_angle", self.half_angle, "above 0 and below pi")

    def tilt(self, quat_wxyz: Quaternion) -> tuple[float, Vector]:
        """Return the tilt of a tool orientation in rad, and the unit axis about which a turn increases it."""
        (cx, cy, cz), (ax, ay, az) = self.axis, tool_axis(quat_wxyz)
        nx, ny, nz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        length = math.hypot(nx, ny, nz)
        if length < UNIT:
            # On the axis, in either direction, all transverse turns are equivalent.
            nx, ny, nz = (0.0, -cz, cy) if abs(cx) < abs(cy) else (cz, 0.0, -cx)
        scale = 1.0 / math.hypot(nx, ny, nz)
        return math.atan2(length, cx * ax + cy * ay + cz * az), (nx * scale, ny * scale, nz * scale)


def tool_axis(quat_wxyz: Quaternion) -> Vector:
    """Return the tool's z axis in the base frame: `R e_z`."""
    w, x, y, z = quat_wxyz
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


class SelfKeepOut(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keep forearm, wrist and flange clear of base, shoulder and upper arm.

    Raises:
        ValueError: A value is out of range.
    """

    margin_m: float = 0.01
    """Distance between the surfaces in m."""
    radius_m: float | None = None
    """Radius of all links in m; by default from the model."""

    def __post_init__(self) -> None:
        if not 0 <= self.margin_m < math.inf:
            raise _out_of_range("margin_m", self.margin_m, "0 or more")
        if self.radius_m is not None and not 0 < self.radius_m < math.inf:
            raise _out_of_range("radius_m", self.radius_m, "above 0")


class StreamingLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of a streamed motion, joints from base to flange.

    Raises:
        ValueError: A value is out of range.
    """

    position_min: Six | None = None
    """Smallest angles in rad, -inf for an unlimited joint."""
    position_max: Six | None = None
    """Largest angles in rad."""
    max_speed: Six | None = None
    """Largest speeds in rad/s."""
    max_acceleration: Six | None = None
    """Largest accelerations in rad/s^2, also for braking; None allows velocity jumps."""
    max_tool_speed: float | None = None
    """Largest speed of the tool point in m/s."""
    planes: tuple[WorkspacePlane, ...] = ()
    self_keep_out: SelfKeepOut | None = None
    approach_rate_hz: float = 10.0
    """A distance to a plane, or between links, shrinks at most at this rate times the remaining distance."""

    def __post_init__(self) -> None:
        if (self.position_min is None) != (self.position_max is None):
            message = "position_min and position_max: must both be given or both be left out"
            raise ValueError(message)
        for low, high in zip(self.position_min or (), self.position_max or (), strict=True):
            if not low < high:
                raise _out_of_range("position_min", low, f"less than position_max = {high}")
        for name in ("max_speed", "max_acceleration"):
            for number in getattr(self, name) or ():
                if not 0 < number < math.inf:
                    raise _out_of_range(name, number, "above 0 for every joint")
        if self.max_tool_speed is not None and not 0 < self.max_tool_speed < math.inf:
            raise _out_of_range("max_tool_speed", self.max_tool_speed, "above 0")
        if not 0 < self.approach_rate_hz < math.inf:
            raise _out_of_range("approach_rate_hz", self.approach_rate_hz, "above 0")


def model_limits(model: UrModel, max_acceleration: float = 8.0) -> StreamingLimits:
    """Return position and speed limits from the model's data sheet, and one acceleration for all joints in rad/s^2.

    The vendor publishes no largest acceleration; the chosen 8 stops a joint from 3 rad/s within 0.6 rad.
    """
    return StreamingLimits(
        position_min=model.position_min,
        position_max=model.position_max,
        max_speed=model.max_speed,
        max_acceleration=(max_acceleration,) * 6,
    )


class StreamingCost(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cost of a streamed motion.

    Raises:
        ValueError: A value is out of range.
    """

    weights: Six = (1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
    """Weights of the squared tool velocity error: linear in (m/s)^-2, angular in (rad/s)^-2. With a tenth, 1 rad/s
    counts like 0.3 m/s.
    """
    damping: float = 0.01
    """Weight of joint velocities at a singularity in (rad/s)^-2."""
    damping_below: float = 0.05
    """Manipulability, as a fraction of `|a2 a3| (|a2| + |a3|)`, below which damping starts."""

    def __post_init__(self) -> None:
        for number in self.weights:
            if not 0 < number < math.inf:
                raise _out_of_range("weights", number, "above 0 for every axis")
        if not 0 <= self.damping < math.inf:
            raise _out_of_range("damping", self.damping, "0 or more")
        if not 0 < self.damping_below < math.inf:
            raise _out_of_range("damping_below", self.damping_below, "above 0")


# Offsets of upper arm and forearm along the axes of joints 2 and 3 in m.
OFFSETS_M: Final[dict[str, tuple[float, float]]] = {
    "ur3": (0.1198, 0.0275),
    "ur5": (0.13585, 0.0165),
    "ur10": (0.220941, 0.049042),
    "ur3e": (0.120, 0.027),
    "ur5e": (0.138, 0.007),
    "ur10e": (0.1762, 0.0393),
    "ur16e": (0.1762, 0.0393),
    "ur20": (0.260, 0.043),
    "ur30": (0.260, 0.043),
}

# Chosen: the vendor's cylinder of the base (0.06 m for a UR5e, 0.075 m for a UR10e and UR20), and more for the two
# large arms, whose joints are wider.
RADII_M: Final[dict[str, float]] = {
    "ur3": 0.06,
    "ur5": 0.06,
    "ur10": 0.075,
    "ur3e": 0.06,
    "ur5e": 0.06,
    "ur10e": 0.075,
    "ur16e": 0.075,
    "ur20": 0.1,
    "ur30": 0.1,
}

# Adds less than 0.1 um to a distance, and keeps its slope finite at 0.
ROUNDED_M: Final = 1e-8


@dataclass(frozen=True, slots=True)
class Ball:
    """Ball on a link; link 0 is the base, link i follows joint i."""

    name: str
    link: int
    place: Vector
    """Centre in the link frame in m."""
    radius_m: float


@dataclass(frozen=True, slots=True)
class Capsule:
    """Cylinder with hemispherical ends on a link."""

    name: str
    link: int
    start: Vector
    end: Vector
    radius_m: float


@dataclass(frozen=True, slots=True)
class Body:
    """Collision geometry of the arm."""

    balls: tuple[Ball, ...]
    """Balls from elbow to flange."""
    capsules: tuple[Capsule, ...]
    """Capsules from base to elbow."""
    pairs: tuple[tuple[int, int], ...]
    """Pairs of ball and capsule that are not neighbours."""


def arm_body(model: UrModel, radius_m: float | None = None) -> Body:
    """Return balls along forearm and wrist, and capsules along base, shoulder and upper arm."""
    arm = SAME_ARM.get(model.name, model.name)
    upper, lower = OFFSETS_M[arm]
    radius = RADII_M[arm] if radius_m is None else radius_m
    origin = (0.0, 0.0, 0.0)
    balls = (
        Ball("elbow", 2, (0.0, 0.0, upper), radius),
        Ball("forearm", 3, (-model.a[2] / 2, 0.0, lower), radius),
        Ball("wrist 1", 3, (0.0, 0.0, lower), radius),
        Ball("wrist 2", 4, origin, radius),
        Ball("wrist 3", 5, origin, radius),
        Ball("flange", 6, origin, radius),
    )
    capsules = (
        Capsule("base", 0, origin, (0.0, 0.0, model.d[0]), radius),
        Capsule("shoulder", 1, origin, (0.0, 0.0, upper), radius),
        Capsule("upper arm", 2, (-model.a[1], 0.0, upper), (0.0, 0.0, upper), radius),
    )
    # The elbow is on the upper arm, the forearm starts there, and wrist 1 folds beside it.
    base_and_shoulder = tuple((ball, capsule) for ball in range(1, 6) for capsule in (0, 1))
    return Body(balls, capsules, base_and_shoulder + tuple((ball, 2) for ball in (3, 4, 5)))


def link_levers(kinematics: "UrKinematics") -> tuple[float, ...]:
    """Return the largest change of a self distance per joint in m/rad: the largest distance of a ball from the axis.

    Joints before a capsule turn ball and capsule equally, and a capsule on a joint's axis is invariant under that
    joint.
    """
    body = arm_body(kinematics.model)
    levers = [0.0] * 6
    for ball, capsule in ((body.balls[ball], body.capsules[capsule]) for ball, capsule in body.pairs):
        is_on_axis = not any((*capsule.start[:2], *capsule.end[:2]))
        for joint in range(capsule.link + is_on_axis, ball.link):
            levers[joint] = max(levers[joint], _lever(kinematics, joint, ball.link, ball.place))
    return tuple(levers)


def plane_levers(kinematics: "UrKinematics", planes: Iterable[WorkspacePlane]) -> tuple[float, ...]:
    """Return the largest change of a plane distance per joint in m/rad; the base axis does not move along itself."""
    x, y, z = kinematics.tool[:3, 3].tolist()
    tool = (6, (x, y, z))
    balls = tuple((ball.link, ball.place) for ball in arm_body(kinematics.model).balls)
    levers = [0.0] * 6
    for plane in planes:
        for link, place in (tool, *(balls if plane.whole_arm else ())):
            for joint in range(link):
                share = math.hypot(*plane.normal[:2]) if joint == 0 else 1.0
                levers[joint] = max(levers[joint], share * _lever(kinematics, joint, link, place))
    return tuple(levers)


def _lever(kinematics: "UrKinematics", joint: int, link: int, place: Vector) -> float:
    """Return the largest distance in m of a link's point from the axis of a preceding joint."""
    rows = kinematics.rows
    # The joint's own d is along the axis and adds no lever.
    between = sum(abs(rows.a[i]) + abs(rows.d[i]) for i in range(joint + 1, link))
    return abs(rows.a[joint]) + between + math.hypot(*place)


@dataclass(frozen=True, slots=True)
class Distance:
    """Distance in m and its gradient by the joint angles, (1, 6), as expressions."""

    value: Symbol
    gradient: Symbol


def clearance(chain: Chain, ball: Ball, capsule: Capsule, margin_m: float) -> Distance:
    """Return the distance between ball and capsule, minus a margin.

    The capsule's nearest point is `s + t (e - s)` with `t = clip((c - s)'(e - s) / |e - s|^2, 0, 1)`. To first order
    only the ball's motion relative to the capsule's link changes the distance, because the nearest point moves
    tangentially.

    Source: C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.2.
    """
    casadi = casadi_module()
    centre = _in_base(chain, ball.link, ball.place)
    start, end = _in_base(chain, capsule.link, capsule.start), _in_base(chain, capsule.link, capsule.end)
    length = sum((one - other) ** 2 for one, other in zip(capsule.end, capsule.start, strict=True))
    along = casadi.fmin(casadi.fmax(casadi.dot(centre - start, end - start) / length, 0.0), 1.0)
    apart = centre - start - along * (end - start)
    distance = casadi.sqrt(casadi.dot(apart, apart) + ROUNDED_M**2)
    gradient = _gradient(chain, apart / distance, centre, range(capsule.link, ball.link))
    return Distance(distance - ball.radius_m - capsule.radius_m - margin_m, gradient)


def height(chain: Chain, normal: Vector, offset_m: float, ball: Ball) -> Distance:
    """Return the height of a ball above a plane."""
    casadi = casadi_module()
    direction, centre = casadi.SX(casadi.DM(list(normal))), _in_base(chain, ball.link, ball.place)
    value = casadi.dot(direction, centre) - ball.radius_m - offset_m
    return Distance(value, _gradient(chain, direction, centre, range(ball.link)))


def tool_height(chain: Chain, normal: Vector, offset_m: float) -> Distance:
    """Return the height of the tool point above a plane."""
    casadi = casadi_module()
    direction = casadi.SX(casadi.DM(list(normal)))
    value = casadi.dot(direction, chain.transform[:3, 3]) - offset_m
    return Distance(value, casadi.mtimes(direction.T, chain.jacobian[:3, :]))


def _in_base(chain: Chain, link: int, place: Vector) -> Symbol:
    """Return a point of a link in the base frame, (3, 1)."""
    casadi = casadi_module()
    rotation, origin = _frame(chain, link)
    return origin + casadi.mtimes(rotation, casadi.SX(casadi.DM(list(place))))


def _frame(chain: Chain, link: int) -> tuple[Symbol, Symbol]:
    casadi = casadi_module()
    return (casadi.SX.eye(3), casadi.SX.zeros(3)) if link == 0 else chain.joint_frames[link - 1]


def _gradient(chain: Chain, direction: Symbol, point: Symbol, joints: range) -> Symbol:
    """Return the gradient of `direction . point` by the joints that move it.

    `direction . (z x (point - o))`; joint i, from 0, turns about z of frame i. The product of axis and point does not
    depend on the direction, so it is computed once per point.
    """
    casadi = casadi_module()
    columns = [casadi.SX(0)] * 6
    for joint in joints:
        rotation, origin = _frame(chain, joint)
        columns[joint] = casadi.dot(direction, casadi.cross(rotation[:, 2], point - origin))
    return casadi.horzcat(*columns)


def _out_of_range(name: str, seen: object, allowed: str) -> ValueError:
    return ValueError(f"{name} = {seen}: must be {allowed}")
