"""Differential inverse kinematics: the joint velocities that follow a tool velocity best within all limits.

Solving without limits and clipping what comes out is not that: the clipped joints no longer balance the others, and the
tool goes elsewhere, past limits of its own too. So the limits are in the problem, which is solved to rounding:

`minimise 1/2 |J qd - twist|_W^2 + 1/2 (l + e) |qd|^2` over the joint velocities qd of the next period, subject to
`lower <= (qd, A qd) <= upper`; rows of A are gradients of distances. The limit of the tool's speed is no row of A, but
in the cost.

Source: D. Arnstroem, A. Bemporad, D. Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using
Recursive LDL^T Updates", IEEE Trans. Automatic Control 67(8), 2022 (daqp); S. R. Buss, "Introduction to Inverse
Kinematics with Jacobian Transpose, Pseudoinverse and Damped Least Squares methods", 2004, for the cost; O. Kanoun,
F. Lamiraux, P.-B. Wieber, "Kinematic Control of Redundant Manipulators", IEEE Trans. Robotics 27(4), 2011, for
inequalities in it.
"""

import math
from dataclasses import dataclass
from functools import reduce
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np

from haptether.slave.ur.kinematics.arm import UrKinematics
from haptether.slave.ur.kinematics.constraints import (
    Distance,
    StreamingCost,
    StreamingLimits,
    arm_body,
    clearance,
    height,
    tool_height,
)
from haptether.slave.ur.kinematics.pose import Array, Numbers, Vector
from haptether.slave.ur.kinematics.symbolic import Buffered, Symbol, casadi_module

# Solutions that the search for its multiplier may take; 1 to 4 are common.
MAX_SOLUTIONS: Final = 40
# From this multiplier on, (m/s)^-2, the cost drowns in rounding: then the tool cannot be that slow.
MAX_MULTIPLIER: Final = 1e6


class QuadraticProgram(NamedTuple):
    """`minimise 1/2 x'Hx + f'x` subject to `lower <= (x, A x) <= upper`, over m numbers x."""

    hessian: Array
    """H, (m, m), positive definite."""
    linear: Array
    """f, (m,)."""
    rows: Array
    """A, (n, m)."""
    lower: Array
    """(m + n,); -1e30 is none."""
    upper: Array
    """(m + n,); 1e30 is none."""


class UrStreaming:
    """Joint velocities for one arm, one period after the other, for one thread.

    A limit of the tool's speed is a ball, `|J qd| <= max_speed`, and no polyhedron. Where it holds, its multiplier m
    joins the cost as `m/2 |J qd|^2`, and m is searched for which the speed is at its limit, from the m of the period
    before: what comes out is the optimum in the ball, not in a box or in facets around it.

    Args:
        kinematics: The arm with its tool.
        limits: What to keep to; what is not named costs nothing.
        period_s: Time between two calls in s.
        cost: Weights and damping.

    Raises:
        ValueError: The period is not above 0, or so long that a distance could be overrun within one.
    """

    def __init__(
        self,
        kinematics: UrKinematics,
        limits: StreamingLimits,
        *,
        period_s: float,
        cost: StreamingCost | None = None,
    ) -> None:
        if not 0 < period_s <= 1 / limits.approach_rate_hz:
            message = f"period_s = {period_s}: must be above 0 and at most 1 / approach_rate_hz"
            raise ValueError(message)
        self.kinematics = kinematics
        self.limits = limits
        self.period_s = period_s
        self.reason = ""
        """Why the last call braked; empty if it did not."""
        self.speed_multiplier = 0.0
        """m of the last solution: above 0 where the tool is at its limit of speed."""
        problem = streaming_problem(kinematics, limits, cost or StreamingCost(), period_s)
        self.rows = problem.rows
        """What each row of the program is, as text."""
        self._function = problem.function
        memory, n = problem.function.memory, len(problem.rows)
        self._floors = np.zeros(n)
        self._parameters = (self._floors,) if n else ()
        self._normals = np.array(problem.normals)
        self._distances = memory[5]
        self._program = QuadraticProgram(
            memory[0].reshape(6, 6), memory[1], memory[2].reshape(n, 6), memory[3], memory[4]
        )
        self._solver = QuadraticSolver()
        self._speed_limit: SpeedLimit | None = None
        if limits.max_tool_speed is not None:
            self._speed_limit = SpeedLimit(limits.max_tool_speed, memory[6].reshape(3, 6), memory[7].reshape(6, 6))
        self._step = None if limits.max_acceleration is None else np.array(limits.max_acceleration) * period_s

    @property
    def program(self) -> QuadraticProgram:
        """A copy of the last program, without the limit of the tool's speed."""
        return QuadraticProgram(*(array.copy() for array in self._program))

    @property
    def multipliers(self) -> Array:
        """Of the last solution, (6 + n,): positive where an upper bound holds, negative where a lower one does."""
        return self._solver.multipliers

    @property
    def held_by(self) -> str:
        """Which distances held the last solution back, as text; empty where none did."""
        held = self.multipliers[6:] < 0
        return ", ".join(row for row, is_held in zip(self.rows, held, strict=False) if is_held)

    def begin(self, q: Numbers, offset: Numbers = (0.0, 0.0, 0.0)) -> None:
        """Motion begins at joint angles: what is nearer there than it may be need not go away, but goes no nearer.

        Without this call every distance is kept above 0, and what is below comes back at up to 1 mm/s.

        Args:
            q: Joint angles, (6,), rad.
            offset: From the frame of the planes to that of the model, (3,), m: an arm of which the model is right to a
                few mm keeps its planes where its controller has them.

        Raises:
            ValueError: A number is not finite.
        """
        if not self._parameters:
            return
        self._floors[:] = self._normals @ np.array(offset, dtype=np.float64)
        self._function.all(q, np.zeros(6), np.zeros(6), self._floors)
        np.minimum(self._floors, self._distances, out=self._floors)

    def velocity(self, q: Numbers, qd: Numbers, twist: Numbers) -> Array:
        """Joint velocities for the next period, (6,), rad/s.

        Where no velocity is within all limits, or a number is not finite, it brakes, within the acceleration limits,
        and `reason` says why. It raises nothing.

        Args:
            q: Joint angles at the begin of the period, (6,), rad: those that were commanded, not the measured ones.
            qd: Joint velocities that were commanded for the period before, (6,), rad/s.
            twist: Of the tool, (6,), in the base frame: velocity of its point in m/s over angular velocity
                in rad/s.
        """
        try:
            self._function.all(q, qd, twist, *self._parameters)
        except (TypeError, ValueError) as error:
            self.reason = str(error)
            return self._braking(qd)
        solution = self._solver.solve(self._program) if self._speed_limit is None else self._within_speed()
        if solution is None:
            braking = self._braking(qd)
            self.reason = self._conflict(braking)
            return braking
        self.reason = ""
        return solution

    def _within_speed(self) -> Array | None:
        """The optimum with the tool's speed within its limit, from the multiplier of the period before."""
        limit, program = self._speed_limit, self._program
        assert limit is not None
        limit.reset()
        m = self.speed_multiplier
        for _ in range(MAX_SOLUTIONS):
            heavier = program if m == 0 else program._replace(hessian=limit.added_to(program.hessian, m))
            solution = self._solver.solve(heavier)
            if solution is None:
                break
            speed = limit.speed(solution)
            if abs(speed - limit.max_speed) <= CLOSE * limit.max_speed or (m == 0 and speed < limit.max_speed):
                self.speed_multiplier = m
                return solution
            m = limit.next(m, speed)
            if m > MAX_MULTIPLIER:
                break
        self.speed_multiplier = 0.0
        return None

    def _conflict(self, braking: Array) -> str:
        """Which limit the braking arm violates most, as text."""
        _, _, rows, lower, upper = self._program
        for joint in range(6):
            if lower[joint] > upper[joint]:
                return (
                    f"joint {joint + 1} must be at least {lower[joint]:.6g} rad/s for one limit and at most "
                    f"{upper[joint]:.6g} rad/s for another"
                )
        seen = rows @ braking
        excess = np.maximum(lower[6:] - seen, seen - upper[6:])
        worst = int(excess.argmax()) if len(excess) else -1
        if self._speed_limit is not None:
            speed, limit = self._speed_limit.speed(braking), self._speed_limit.max_speed
            if speed > limit and (worst < 0 or speed - limit > excess[worst]):
                return f"tool speed: {speed:.6g} m/s while braking, must be at most {limit:.6g} m/s"
        if worst < 0 or excess[worst] <= 0:
            return "no joint velocities are within all limits"
        return f"{self.rows[worst]}: {seen[worst]:.6g} m/s while braking, must be at least {lower[6 + worst]:.6g} m/s"

    def _braking(self, qd: Numbers) -> Array:
        """Every joint slower by as much as its acceleration limit allows; without one at rest."""
        try:
            before = np.array(qd, dtype=np.float64)
        except (TypeError, ValueError):
            return np.zeros(6)
        if before.shape != (6,) or not np.isfinite(before).all() or self._step is None:
            return np.zeros(6)
        return before - np.clip(before, -self._step, self._step)


class BrakedPoint:
    """A point that follows another as a tool would that brakes before planes, and that nothing else holds back.

    It goes to the nearest point at which every distance h to a plane is `(1 - rate T) h` at least, which is what
    `UrStreaming` leaves of it in a period T. How far a tool is from this point, then, no plane accounts for.

    Args:
        limits: Planes, of which those of the whole arm count as those of its tool, and the rate.
        period_s: Time between two calls in s.
    """

    def __init__(self, limits: StreamingLimits, period_s: float) -> None:
        self._offsets_m = np.array([plane.offset_m for plane in limits.planes])
        self._normals = np.array([plane.normal for plane in limits.planes]).reshape(-1, 3)
        self._share = 1.0 - limits.approach_rate_hz * period_s
        self._levels = self._offsets_m
        self._solver = QuadraticSolver()
        self.position = np.zeros(3)
        """m."""

    def begin(self, position: Array, offset: Array) -> None:
        """It is at a position, (3,), m; the offset and what is beyond a plane there are as in `UrStreaming.begin`."""
        self.position = position
        self._levels = np.minimum(self._offsets_m + self._normals @ offset, self._normals @ position)

    def step(self, target: Array) -> None:
        """Goes on for a period towards a target, (3,), m."""
        lower_levels = self._levels + self._share * (self._normals @ self.position - self._levels)
        if (self._normals @ target >= lower_levels).all():
            self.position = target
            return
        anywhere = np.full(3, UNBOUNDED)
        upper = np.full(len(lower_levels) + 3, UNBOUNDED)
        nearest = QuadraticProgram(np.eye(3), -target, self._normals, np.concatenate((-anywhere, lower_levels)), upper)
        solution = self._solver.solve(nearest)
        # Without a solution no plane accounts for any lag.
        self.position = target if solution is None else np.array(solution)


# ---------------------------------------------------------------------------------------------------------- the program

UNBOUNDED: Final = 1e30
"""What daqp takes for infinite."""

# Keeps the cost strictly convex where nothing else does. It slows a motion by less than 1e-5 of it where the smallest
# singular value of the weighted Jacobian is above 0.03.
REGULAR: Final = 1e-8
# Bounds that cross by no more than this, rad/s, cross by rounding: a joint that brakes just in time.
CROSSED: Final = 1e-9
# What has drifted out of bounds by the curvature of its path is brought back no faster than this, m/s.
RETURN_M_S: Final = 1e-3


@dataclass(frozen=True, slots=True)
class StreamingProblem:
    """The program as a function of (q, qd before, twist) and, where it has rows, what each distance stays above (m)."""

    function: Buffered
    """Results: H (6, 6), f (6), A' (6, rows), lower and upper (6 + rows), distances (rows) and, with a limit of the
    tool's speed, J' (6, 3) of the tool point and J'J (6, 6)."""
    rows: tuple[str, ...]
    """What each row of A is, as text."""
    normals: tuple[Vector, ...]
    """Of each row the plane's normal; 0 where the distance is not to a plane."""


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

    distances = _distances(kinematics, limits)
    floors = casadi.SX.sym("floors", len(distances))
    for row, (_, _, distance) in enumerate(distances):
        # d(distance)/dt >= -rate distance: an approach that would take for ever.
        lower.append(casadi.fmin(-limits.approach_rate_hz * (distance.value - floors[row]), RETURN_M_S))
        upper.append(UNBOUNDED)

    rows = casadi.vertcat(*[distance.gradient for _, _, distance in distances]).T if distances else casadi.SX(6, 0)
    results = [hessian, -casadi.mtimes(weighted, twist), rows, casadi.vertcat(*lower), casadi.vertcat(*upper)]
    results.append(casadi.vertcat(*[distance.value for _, _, distance in distances]) if distances else casadi.SX(0, 1))
    if limits.max_tool_speed is not None:
        linear = chain.jacobian[:3, :]
        results += [linear.T, casadi.mtimes(linear.T, linear)]
    function = Buffered("streaming", [q, before, twist, *([floors] if distances else [])], results)
    names, normals = tuple(name for name, _, _ in distances), tuple(normal for _, normal, _ in distances)
    return StreamingProblem(function, names, normals)


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
        lows: list[Symbol] = [-UNBOUNDED]
        highs: list[Symbol] = [UNBOUNDED]
        if limits.max_speed is not None:
            lows.append(-limits.max_speed[joint])
            highs.append(limits.max_speed[joint])
        step = math.inf
        if limits.max_acceleration is not None:
            step = limits.max_acceleration[joint] * period_s
            lows.append(before[joint] - step)
            highs.append(before[joint] + step)
        if limits.position_min is not None and limits.position_min[joint] > -math.inf:
            lows.append(-_last_speed(q[joint] - limits.position_min[joint], step, period_s))
        if limits.position_max is not None and limits.position_max[joint] < math.inf:
            highs.append(_last_speed(limits.position_max[joint] - q[joint], step, period_s))
        low, high = reduce(casadi.fmax, lows), reduce(casadi.fmin, highs)
        lower.append(low)
        upper.append(casadi.fmax(high, casadi.fmin(low, high + CROSSED)))
    return lower, upper


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


def _distances(kinematics: UrKinematics, limits: StreamingLimits) -> list[tuple[str, Vector, Distance]]:
    """The distances that are kept, each with what it is of, as text, and the normal of its plane, if it is to one."""
    chain, keep_out = kinematics.chain, limits.self_keep_out
    body = arm_body(kinematics.model, None if keep_out is None else keep_out.radius_m)
    found: list[tuple[str, Vector, Distance]] = []
    for number, plane in enumerate(limits.planes):
        where, normal = f"planes[{number}]", plane.normal
        found.append((f"{where}, tool", normal, tool_height(chain, normal, plane.offset_m)))
        if plane.whole_arm:
            found += [(f"{where}, {b.name}", normal, height(chain, normal, plane.offset_m, b)) for b in body.balls]
    if keep_out is not None:
        for ball, capsule in ((body.balls[ball], body.capsules[capsule]) for ball, capsule in body.pairs):
            distance = clearance(chain, ball, capsule, keep_out.margin_m)
            found.append((f"{ball.name} to {capsule.name}", (0.0, 0.0, 0.0), distance))
    return found


# --------------------------------------------------------------------------------------------------- the limit of speed

CLOSE: Final = 1e-9
"""How far the tool's speed may be from its limit where the limit holds, as a part of it."""


class SpeedLimit:
    """`|J qd| <= max_speed` as a cost `m/2 |J qd|^2`: m is searched for which the speed, which falls with m, is that.

    By 1/speed, which is all but linear in m as long as the same bounds hold; where bounds come and go it has kinks, and
    where they leave nothing to choose it is flat. So: secants from the m before, then within a bracket, which is halved
    where secants do not do that.

    Args:
        max_speed: Of the tool point, in m/s.
        jacobian: Linear velocity of the tool point by those of the joints, (3, 6); read at each call.
        squared: J'J, (6, 6); read at each call.

    Source: J. J. More, D. C. Sorensen, "Computing a Trust Region Step", SIAM J. Sci. Stat. Comput. 4(3), 1983, section
    3 (1/speed); M. Dowell, P. Jarratt, "A modified regula falsi method", BIT 11, 1971 (Illinois).
    """

    def __init__(self, max_speed: float, jacobian: Array, squared: Array) -> None:
        self.max_speed = max_speed
        self._jacobian = jacobian
        self._squared = squared
        self._sum = np.zeros((6, 6))
        self._slope = 1.0
        """Of 1/speed by m, as it was last seen."""
        self._before: tuple[float, float] | None = None
        """m and 1/speed - 1/max_speed of the try before."""
        self._fast = (0.0, -math.inf)
        """The same of the largest m that was too fast."""
        self._slow = (math.inf, math.inf)
        """The same of the smallest m that was too slow."""
        self._width = math.inf
        """Of the bracket two tries ago."""

    def speed(self, qd: Array) -> float:
        """Of the tool point in m/s."""
        return math.hypot(*(self._jacobian @ qd).tolist())

    def added_to(self, hessian: Array, m: float) -> Array:
        """H + m J'J."""
        np.multiply(self._squared, m, out=self._sum)
        np.add(self._sum, hessian, out=self._sum)
        return self._sum

    def reset(self) -> None:
        """Drops the bracket and keeps the slope, for the next program."""
        self._before, self._fast, self._slow, self._width = None, (0.0, -math.inf), (math.inf, math.inf), math.inf

    def next(self, m: float, speed: float) -> float:
        """The m to try after one that gave that speed; 0 before any other below what is needed."""
        tried = m, 1 / max(speed, 1e-12) - 1 / self.max_speed
        before, self._before = self._before, tried
        if before is not None and m != before[0]:
            slope = (tried[1] - before[1]) / (m - before[0])
            self._slope = slope if slope > 0 else self._slope
        following = m - tried[1] / self._slope
        too_fast = tried[1] < 0
        # Illinois: an end that stays a second time counts half.
        if too_fast:
            if before is not None and before[1] < 0:
                self._slow = self._slow[0], self._slow[1] / 2
            self._fast = tried
        else:
            if before is not None and before[1] > 0:
                self._fast = self._fast[0], self._fast[1] / 2
            self._slow = tried
        (low, low_value), (high, high_value) = self._fast, self._slow
        if high == math.inf:
            # With every joint at a bound the speed does not change at all, until m frees one.
            return min(following, 10 * m + 1) if following > m else 10 * m + 1
        if low_value == -math.inf:
            return max(following, 0.0)
        width, self._width = self._width, high - low
        if high - low > width / 2:
            self._width = math.inf
            return (low + high) / 2
        return (low * high_value - high * low_value) / (high_value - low_value)


# ----------------------------------------------------------------------------------------------------------- the solver

SOLVED: Final = 1
INFEASIBLE: Final = -1
# daqp's own tolerance of 1e-6 would let a joint be that much too fast. Problems here take about 10 steps; with hundreds
# it goes round in circles. Its regularisation is not needed: costs are strictly convex.
SETTINGS: Final = {"primal_tol": 1e-11, "dual_tol": 1e-12, "eps_prox": 0.0, "iter_limit": 300}


class QuadraticSolver:
    """Solves programs of one size, each from where the last one ended.

    Two traps of daqp:

    - `update` refuses a program whose bounds cross, and keeps the one before, whose solution `solve` then returns again
      as solved: that is caught here;
    - with a number that is not finite it reports success: that the caller has to check before.
    """

    def __init__(self) -> None:
        self._solver: Any = import_module("daqp").Model()
        self._is_set_up = False
        self.multipliers = np.zeros(0)
        """Of the last solution, (m + n,): positive where an upper bound holds, negative where a lower one does."""

    def solve(self, program: QuadraticProgram) -> Array | None:
        """The minimum, (m,), or None where the bounds leave nothing."""
        hessian, linear, rows, lower, upper = program
        for _ in range(2):
            if self._is_set_up:
                refused = self._solver.update(hessian, linear, rows if len(rows) else None, upper, lower) < 0
            else:
                sense = np.zeros(len(lower), dtype=np.int32)
                refused = self._solver.setup(hessian, linear, rows, upper, lower, sense)[0] < 0
                self._solver.settings = SETTINGS
            self._is_set_up = not refused
            if refused:
                return None
            solution, _, flag, info = self._solver.solve()
            if flag == SOLVED:
                self.multipliers = info["lam"]
                return solution  # type: ignore[no-any-return]
            # The next start is from scratch: where this one began may be what led it astray.
            self._is_set_up = False
            if flag == INFEASIBLE:
                return None
        return None
