"""The quadratic program of one period of a streamed motion, and its minimum.

Bounds of the joints' velocities are by speed, acceleration, and what a joint can brake from before its end; each row
keeps a distance. The minimum without any limit comes from the Cholesky factor of H; where that is within all limits it
is the minimum, and no solver is asked.

Source: D. Arnstroem, A. Bemporad, D. Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using
Recursive LDL^T Updates", IEEE Trans. Automatic Control 67(8), 2022 (daqp).
"""

import math
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
    link_levers,
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


UNBOUNDED: Final = 1e30
"""What daqp takes for infinite."""

# Keeps the cost strictly convex where nothing else does. It slows a motion by less than 1e-5 of it where the smallest
# singular value of the weighted Jacobian is above 0.03.
REGULAR: Final = 1e-8
# Bounds that cross by no more than this, rad/s, cross by rounding: a joint that brakes just in time.
CROSSED: Final = 1e-9
# What has drifted out of bounds by the curvature of its path is brought back no faster than this, m/s.
RETURN_M_S: Final = 1e-3


class BoundedProgram:
    """The program as a function of joint angles, joint velocities before, and the tool's twist; and its minimum.

    Args:
        kinematics: The arm with its tool.
        limits: What to keep to: each row is one of their distances, and what they do not name is not there.
        cost: Weights and damping.
        period_s: Time between two calls in s.
        keeps_itself: Whether the distances of the arm to itself are among the rows.
    """

    def __init__(
        self,
        kinematics: UrKinematics,
        limits: StreamingLimits,
        cost: StreamingCost,
        period_s: float,
        *,
        keeps_itself: bool = True,
    ) -> None:
        casadi = casadi_module()
        chain, q = kinematics.chain, kinematics.chain.q
        before, twist = casadi.SX.sym("qd", 6), casadi.SX.sym("twist", 6)

        weights = casadi.diag(casadi.DM(list(cost.weights)))
        weighted = casadi.mtimes(chain.jacobian.T, weights)
        damping = _damping(kinematics, cost) + REGULAR
        hessian = casadi.mtimes(weighted, chain.jacobian) + damping * casadi.SX.eye(6)
        lows, highs = _joint_bounds(q, before, limits, period_s)

        distances = _distances(kinematics, limits, keeps_itself=keeps_itself)
        n = len(distances)
        floors, certificate = casadi.SX.sym("floors", n), casadi.SX.sym("certificate", 7)
        # d(distance)/dt >= -rate distance: an approach that would take for ever.
        left = [distance.value - floors[row] for row, (_, _, distance) in enumerate(distances)]
        lower = casadi.vertcat(*lows, *[casadi.fmin(-limits.approach_rate_hz * each, RETURN_M_S) for each in left])
        upper = casadi.vertcat(*highs)
        rows = casadi.vertcat(*[distance.gradient for _, _, distance in distances]) if n else casadi.SX(0, 6)
        values = casadi.vertcat(*[distance.value for _, _, distance in distances]) if n else casadi.SX(0, 1)

        factor = casadi.chol(hessian)
        free = casadi.solve(factor, casadi.solve(factor.T, casadi.mtimes(weighted, twist)))
        within = [casadi.vertcat(free, casadi.mtimes(rows, free)) - lower, upper - free]
        speed = []
        if limits.max_tool_speed is not None:
            linear = chain.jacobian[:3, :]
            within.append(limits.max_tool_speed - casadi.norm_2(casadi.mtimes(linear, free)))
            speed = [linear.T, casadi.mtimes(linear.T, linear)]

        # Of all joints within their bounds, the fastest that a distance of the arm to itself can change, over the rate.
        levers = casadi.DM(list(link_levers(kinematics)))
        need = casadi.dot(levers, casadi.fmax(casadi.fabs(lower[:6]), casadi.fabs(upper))) / limits.approach_rate_hz
        itself = [each for each, (_, normal, _) in zip(left, distances, strict=True) if not any(normal)]
        nearest = casadi.mmin(casadi.vertcat(*itself)) if itself else casadi.SX(UNBOUNDED)
        spare = certificate[6] - casadi.dot(levers, casadi.fabs(q - certificate[:6])) - need

        # A factor that is none, by rounding, makes each of the six not a number, and with them the least of these.
        slack = casadi.mmin(casadi.vertcat(*within))
        bounds = casadi.vertcat(upper, UNBOUNDED * casadi.SX.ones(n))
        results = [hessian, -casadi.mtimes(weighted, twist), rows.T, lower, bounds, values, free, *speed]
        scalars = [slack, spare, nearest, need]
        self.function = Buffered("streaming", [q, before, twist, floors, certificate], [*results, *scalars], kept=2)
        self.rows = tuple(name for name, _, _ in distances)
        """What each row of A is, as text."""
        memory = self.function.memory
        self.quadratic = QuadraticProgram(
            memory[0].reshape(6, 6), memory[1], memory[2].reshape(n, 6), memory[3], memory[4]
        )
        """Of the last call of `function`."""
        self.speed_limit: SpeedLimit | None = None
        if limits.max_tool_speed is not None:
            self.speed_limit = SpeedLimit(limits.max_tool_speed, memory[7].reshape(3, 6), memory[8].reshape(6, 6))
        self._normals = np.array([normal for _, normal, _ in distances]).reshape(n, 3)
        self._distances, self._free = memory[5], memory[6]
        self._slack, self._spare, self._nearest, self._need = self.function.numbers[-4:]
        self._solver = QuadraticSolver()
        self._unheld = np.zeros(6 + n)
        self.multipliers = self._unheld
        """Of the last minimum, (6 + n,): positive where an upper bound holds, negative where a lower one does."""

    def begin(self, q: Numbers, offset: Array) -> None:
        """Motion begins at joint angles: what is nearer there than it may be goes no nearer; planes lie at an offset.

        Raises:
            ValueError: A number is not finite.
        """
        floors = self._normals @ offset
        self.function.keep(0, floors)
        self.function.all(q, np.zeros(6), np.zeros(6))
        self.function.keep(0, np.minimum(floors, self._distances))

    def certify(self, near: "BoundedProgram", q: Numbers) -> bool:
        """Takes over how far the arm is from itself; whether that is twice what one period needs."""
        left = near._nearest[0]
        if not left > 2.0 * near._need[0]:
            return False
        self.function.keep(1, np.array((*q, left)))
        return True

    def is_apart(self) -> bool:
        """Whether nothing of the arm can be kept from itself in this period, by the last certificate.

        A distance h was at least h_c at the angles q_c, and changes by at most `sum L_i |dq_i|`. A row
        `dh/dt >= -rate h` then holds for all velocities within the joints' bounds w if
        `h_c - sum L_i |q_i - q_ci| >= sum L_i w_i / rate`: the program without it has the same minimum.
        """
        return bool(self._spare[0] >= 0.0)

    def minimum(self, multiplier: float) -> tuple[Array | None, float]:
        """Joint velocities, (6,), or None where the bounds leave nothing, and m; from the m of the period before."""
        # Not a number is not within.
        if self._slack[0] >= 0.0:
            self.multipliers = self._unheld
            return self._free.copy(), 0.0
        if self.speed_limit is None:
            found, m = self._solver.solve(self.quadratic), 0.0
        else:
            found, m = self._within_speed(self.speed_limit, multiplier)
        self.multipliers = self._solver.multipliers
        return found, m

    def _within_speed(self, limit: "SpeedLimit", m: float) -> tuple[Array | None, float]:
        """The optimum with the tool's speed within its limit, and its multiplier."""
        program = self.quadratic
        limit.reset()
        for _ in range(MAX_SOLUTIONS):
            heavier = program if m == 0 else program._replace(hessian=limit.added_to(program.hessian, m))
            solution = self._solver.solve(heavier)
            if solution is None:
                break
            speed = limit.speed(solution)
            if abs(speed - limit.max_speed) <= CLOSE * limit.max_speed or (m == 0 and speed < limit.max_speed):
                return solution, m
            m = limit.next(m, speed)
            if m > MAX_MULTIPLIER:
                break
        return None, 0.0


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


def _distances(
    kinematics: UrKinematics, limits: StreamingLimits, *, keeps_itself: bool
) -> list[tuple[str, Vector, Distance]]:
    """The distances that are kept, each with what it is of, as text, and the normal of its plane, if it is to one."""
    chain, keep_out = kinematics.chain, limits.self_keep_out
    body = arm_body(kinematics.model, None if keep_out is None else keep_out.radius_m)
    found: list[tuple[str, Vector, Distance]] = []
    for number, plane in enumerate(limits.planes):
        where, normal = f"planes[{number}]", plane.normal
        found.append((f"{where}, tool", normal, tool_height(chain, normal, plane.offset_m)))
        if plane.whole_arm:
            found += [(f"{where}, {b.name}", normal, height(chain, normal, plane.offset_m, b)) for b in body.balls]
    if keep_out is not None and keeps_itself:
        for ball, capsule in ((body.balls[ball], body.capsules[capsule]) for ball, capsule in body.pairs):
            distance = clearance(chain, ball, capsule, keep_out.margin_m)
            found.append((f"{ball.name} to {capsule.name}", (0.0, 0.0, 0.0), distance))
    return found


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
