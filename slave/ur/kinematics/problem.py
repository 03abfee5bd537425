"""The quadratic program of one streamed step, in CasADi symbols.

`minimise 1/2 |J qd - twist|_W^2 + 1/2 (l + e) |qd|^2` over the joint velocities qd of the next period, subject to
`lower <= (qd, A qd) <= upper`; rows of A are gradients of distances. The tool's speed is kept in `ur_streaming`.

Source: S. R. Buss, "Introduction to Inverse Kinematics with Jacobian Transpose, Pseudoinverse and Damped Least Squares
methods", 2004, for the cost; O. Kanoun, F. Lamiraux, P.-B. Wieber, "Kinematic Control of Redundant Manipulators", IEEE
Trans. Robotics 27(4), 2011, for inequalities in it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from haptether.slave.ur.kinematics.arm import UrKinematics
from haptether.slave.ur.kinematics.body import Distance, arm_body, clearance, height, tool_height
from haptether.slave.ur.kinematics.buffered import Buffered
from haptether.slave.ur.kinematics.constraints import StreamingCost, StreamingLimits
from haptether.slave.ur.kinematics.symbolic import Symbol, casadi_module

UNBOUNDED: Final = 1e30
"""What daqp takes for infinite."""

# Keeps the cost strictly convex where nothing else does. It slows a motion by less than 1e-5 of it where the least
# singular value of the weighted Jacobian is above 0.03.
REGULAR: Final = 1e-8
# Bounds that cross by no more than this, rad/s, cross by rounding: a joint that brakes just in time.
CROSSED: Final = 1e-9
# What has drifted out of bounds by the curvature of its path is brought back no faster than this, m/s.
RETURN_M_S: Final = 1e-3


@dataclass(frozen=True, slots=True)
class StreamingProblem:
    """The program as a function of (q, qd before, twist)."""

    function: Buffered
    """Results: H (6, 6), f (6), A' (6, rows), lower and upper (6 + rows) and, with a tool speed limit, J' (6, 3) of the
    tool point and J'J (6, 6)."""
    rows: tuple[str, ...]
    """What each row of A is, in words."""


def streaming_problem(
    kinematics: UrKinematics, limits: StreamingLimits, cost: StreamingCost, period_s: float
) -> StreamingProblem:
    """Builds the program with the rows that the limits name, and no others."""
    casadi = casadi_module()
    chain, q = kinematics.chain, kinematics.chain.q
    before, twist = casadi.SX.sym("qd", 6), casadi.SX.sym("twist", 6)

    weights = casadi.diag(casadi.DM(list(cost.weights)))
    weighted = casadi.mtimes(chain.jacobian.T, weights)
    damping = _damping(kinematics, cost) + REGULAR
    hessian = casadi.mtimes(weighted, chain.jacobian) + damping * casadi.SX.eye(6)
    lower, upper = _joint_bounds(q, before, limits, period_s)

    names: list[str] = []
    gradients: list[Symbol] = []
    for name, distance in _distances(kinematics, limits):
        names.append(name)
        gradients.append(distance.gradient)
        # d(distance)/dt >= -rate distance: an approach that would take for ever.
        lower.append(casadi.fmin(-limits.approach_rate_hz * distance.value, RETURN_M_S))
        upper.append(UNBOUNDED)

    rows = casadi.vertcat(*gradients).T if gradients else casadi.SX(6, 0)
    results = [hessian, -casadi.mtimes(weighted, twist), rows, casadi.vertcat(*lower), casadi.vertcat(*upper)]
    if limits.max_tool_speed is not None:
        linear = chain.jacobian[:3, :]
        results += [linear.T, casadi.mtimes(linear.T, linear)]
    return StreamingProblem(Buffered("streaming", [q, before, twist], results), tuple(names))


def _damping(kinematics: UrKinematics, cost: StreamingCost) -> Symbol:
    """`l = damping (1 - w/w0)^2` below the manipulability w0, 0 above.

    Source: Y. Nakamura, H. Hanafusa, "Inverse Kinematic Solutions with Singularity Robustness for Robot Manipulator
    Control", J. Dynamic Systems, Measurement, and Control 108, 1986, Eq. 30.
    """
    casadi = casadi_module()
    if cost.damping == 0:
        return 0.0
    a2, a3 = abs(kinematics.model.a[1]), abs(kinematics.model.a[2])
    below = cost.damping_below * a2 * a3 * (a2 + a3)
    manipulability = casadi.fabs(kinematics.determinant)
    return cost.damping * casadi.fmax(1 - manipulability / below, 0.0) ** 2


def _joint_bounds(
    q: Symbol, before: Symbol, limits: StreamingLimits, period_s: float
) -> tuple[list[Symbol], list[Symbol]]:
    """Bounds of each joint's velocity by speed, acceleration, and what it can brake from before its end."""
    casadi = casadi_module()
    lower: list[Symbol] = []
    upper: list[Symbol] = []
    for joint in range(6):
        least: list[Symbol] = [-UNBOUNDED]
        most: list[Symbol] = [UNBOUNDED]
        if limits.max_speed is not None:
            least.append(-limits.max_speed[joint])
            most.append(limits.max_speed[joint])
        step = math.inf
        if limits.max_acceleration is not None:
            step = limits.max_acceleration[joint] * period_s
            least.append(before[joint] - step)
            most.append(before[joint] + step)
        if limits.position_min is not None and limits.position_min[joint] > -math.inf:
            least.append(-_last_speed(q[joint] - limits.position_min[joint], step, period_s))
        if limits.position_max is not None and limits.position_max[joint] < math.inf:
            most.append(_last_speed(limits.position_max[joint] - q[joint], step, period_s))
        low, high = _fold(casadi.fmax, least), _fold(casadi.fmin, most)
        lower.append(low)
        upper.append(casadi.fmax(high, casadi.fmin(low, high + CROSSED)))
    return lower, upper


def _fold(choose: Callable[[Symbol, Symbol], Symbol], values: list[Symbol]) -> Symbol:
    chosen = values[0]
    for value in values[1:]:
        chosen = choose(chosen, value)
    return chosen


def _last_speed(distance: Symbol, step: float, period_s: float) -> Symbol:
    """The largest velocity now from which a joint stops within a distance, if it slows by `step` each period.

    Held for one period, then for one each of v - step, v - 2 step, ..., it goes `T ((n + 1) v - step n (n + 1) / 2)`
    with `n = floor(v / step)`. So `v = distance / ((n + 1) T) + n step / 2`, with the largest n for which
    `T step n (n + 1) / 2 <= distance`. At or past its end it is 0. From such a velocity the next one that is allowed
    is never more than a step away.
    """
    casadi = casadi_module()
    left = casadi.fmax(distance, 0.0)
    if math.isinf(step):
        return left / period_s
    n = casadi.floor((casadi.sqrt(1 + 8 * left / (step * period_s)) - 1) / 2)
    return left / ((n + 1) * period_s) + n * step / 2


def _distances(kinematics: UrKinematics, limits: StreamingLimits) -> list[tuple[str, Distance]]:
    """The distances that must stay above 0, each with what it is of."""
    chain, keep_out = kinematics.chain, limits.self_keep_out
    body = arm_body(kinematics.model, None if keep_out is None else keep_out.radius_m)
    found = []
    for number, plane in enumerate(limits.planes):
        where = f"planes[{number}]"
        found.append((f"{where}, tool", tool_height(chain, plane.normal, plane.offset_m)))
        if plane.whole_arm:
            found += [(f"{where}, {b.name}", height(chain, plane.normal, plane.offset_m, b)) for b in body.balls]
    if keep_out is not None:
        pairs = [(body.balls[ball], body.capsules[capsule]) for ball, capsule in body.pairs]
        found += [(f"{b.name} to {c.name}", clearance(chain, b, c, keep_out.margin_m)) for b, c in pairs]
    return found
