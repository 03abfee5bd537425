"""Where the body of a UR arm is, roughly: balls and capsules on its links, for keep-out constraints.

A guide for a planner, not a safety function: the links' radii are chosen, and a gripper is known only by a ball.

Source: Universal Robots' ROS description, `config/<model>/physical_parameters.yaml` and `visual_parameters.yaml`: how
far upper arm and forearm lie beside the plane through the shoulder, "measured from model".
"""

from dataclasses import dataclass
from typing import Final

from haptether.slave.ur.kinematics.chain import Chain
from haptether.slave.ur.kinematics.models import SAME_ARM, UrModel
from haptether.slave.ur.kinematics.symbolic import Symbol, casadi_module

Vector = tuple[float, float, float]

# How far upper arm and forearm lie along the axes of joints 2 and 3, m.
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

# Chosen: the cylinder that the vendor gives for the base (0.06 m for a UR5e, 0.075 m for a UR10e and UR20), and more
# for the two large arms, whose joints are wider than that.
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
    """A ball on a link; link 0 is the base, link i follows joint i."""

    name: str
    link: int
    place: Vector
    """Of the centre in the link's frame, m."""
    radius_m: float


@dataclass(frozen=True, slots=True)
class Capsule:
    """A cylinder with round ends on a link."""

    name: str
    link: int
    start: Vector
    end: Vector
    radius_m: float


@dataclass(frozen=True, slots=True)
class Body:
    """What may touch something, and what it may touch of the arm itself."""

    balls: tuple[Ball, ...]
    """From the elbow to the flange."""
    capsules: tuple[Capsule, ...]
    """From the base to the elbow."""
    pairs: tuple[tuple[int, int], ...]
    """Ball and capsule that are not neighbours."""


def arm_body(model: UrModel, radius_m: float | None = None) -> Body:
    """Balls along forearm and wrist, capsules along base, shoulder and upper arm."""
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
    # The elbow is on the upper arm, the forearm hangs on it, and wrist 1 folds beside it.
    base_and_shoulder = tuple((ball, capsule) for ball in range(1, 6) for capsule in (0, 1))
    return Body(balls, capsules, base_and_shoulder + tuple((ball, 2) for ball in (3, 4, 5)))


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance in m and its gradient by the joint angles, (1, 6), as expressions."""

    value: Symbol
    gradient: Symbol


def clearance(chain: Chain, ball: Ball, capsule: Capsule, margin_m: float) -> Distance:
    """How far the two are apart, less a margin.

    The capsule's nearest point is `s + t (e - s)` with `t = clip((c - s)'(e - s) / |e - s|^2, 0, 1)`. To first order
    only the ball's motion against the capsule's link changes the distance: the nearest point moves across.

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
    """How far a ball is above a plane."""
    casadi = casadi_module()
    direction, centre = casadi.SX(casadi.DM(list(normal))), _in_base(chain, ball.link, ball.place)
    value = casadi.dot(direction, centre) - ball.radius_m - offset_m
    return Distance(value, _gradient(chain, direction, centre, range(ball.link)))


def tool_height(chain: Chain, normal: Vector, offset_m: float) -> Distance:
    """How far the tool point is above a plane."""
    casadi = casadi_module()
    direction = casadi.SX(casadi.DM(list(normal)))
    value = casadi.dot(direction, chain.transform[:3, 3]) - offset_m
    return Distance(value, casadi.mtimes(direction.T, chain.jacobian[:3, :]))


def _in_base(chain: Chain, link: int, place: Vector) -> Symbol:
    """A point of a link in the base frame, (3, 1)."""
    casadi = casadi_module()
    turn, origin = _frame(chain, link)
    return origin + casadi.mtimes(turn, casadi.SX(casadi.DM(list(place))))


def _frame(chain: Chain, link: int) -> tuple[Symbol, Symbol]:
    casadi = casadi_module()
    return (casadi.SX.eye(3), casadi.SX.zeros(3)) if link == 0 else chain.joint_frames[link - 1]


def _gradient(chain: Chain, direction: Symbol, point: Symbol, joints: range) -> Symbol:
    """Of `direction . point` by the joints that move it.

    `direction . (z x (point - o)) = z . ((point - o) x direction)`; joint i, from 0, turns about z of the frame i.
    """
    casadi = casadi_module()
    columns = [casadi.SX(0)] * 6
    for joint in joints:
        turn, origin = _frame(chain, joint)
        columns[joint] = casadi.dot(turn[:, 2], casadi.cross(point - origin, direction))
    return casadi.horzcat(*columns)
