"""Quadratic program of one period of a streamed motion, and its minimum.

Joint velocity bounds follow from speed, acceleration and braking distance; each row keeps a distance. The minimum
without limits comes from the Cholesky factor of H. If it satisfies all limits it is the minimum, and no solver is
needed.
"""

from typing import Final

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
    plane_levers,
    tool_height,
)
from haptether.slave.ur.kinematics.joint_bounds import joint_bounds
from haptether.slave.ur.kinematics.pose import Array, Numbers, Vector
from haptether.slave.ur.kinematics.quadratic import UNBOUNDED, QuadraticProgram, QuadraticSolver
from haptether.slave.ur.kinematics.speed_limit import CLOSE, SpeedLimit
from haptether.slave.ur.kinematics.symbolic import Buffered, Symbol, casadi_module

# Largest number of solutions in the multiplier search; 1 to 4 are common.
MAX_SOLUTIONS: Final = 40
# Multiplier in (m/s)^-2 above which rounding dominates the cost: the tool cannot be that slow.
MAX_MULTIPLIER: Final = 1e6
# Keeps the cost strictly convex in all cases. It slows a motion by less than 1e-5 of it if the smallest singular value
# of the weighted Jacobian is above 0.03.
REGULAR: Final = 1e-8
# Largest return speed in m/s after a drift out of bounds by path curvature.
RETURN_M_S: Final = 1e-3
# Kinds of distances that a program may omit.
ITSELF: Final = 0
PLANES: Final = 1


class BoundedProgram:
    """Program as a function of joint angles, previous joint velocities and tool twist, and its minimum.

    Args:
        kinematics: Kinematics of the arm with its tool.
        limits: Limits; each row is one of their distances.
        cost: Cost weights and damping.
        period_s: Time between two calls in s.
        keeps_itself: True to include self distances.
        keeps_planes: True to include plane distances.
    """

    def __init__(
        self,
        kinematics: UrKinematics,
        limits: StreamingLimits,
        cost: StreamingCost,
        period_s: float,
        *,
        keeps_itself: bool = True,
        keeps_planes: bool = True,
    ) -> None:
        casadi = casadi_module()
        chain, q = kinematics.chain, kinematics.chain.q
        before, twist = casadi.SX.sym("qd", 6), casadi.SX.sym("twist", 6)

        weights = casadi.diag(casadi.DM(list(cost.weights)))
        weighted = casadi.mtimes(chain.jacobian.T, weights)
        damping = _damping(kinematics, cost) + REGULAR
        hessian = casadi.mtimes(weighted, chain.jacobian) + damping * casadi.SX.eye(6)
        lows, highs = joint_bounds(q, before, limits, period_s)

        distances = _distances(kinematics, limits, keeps_itself=keeps_itself, keeps_planes=keeps_planes)
        n = len(distances)
        floors, certificate = casadi.SX.sym("floors", n), casadi.SX.sym("certificate", 14)
        # d(distance)/dt >= -rate distance: an asymptotic approach.
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

        left_out = [kind for kind, is_kept in enumerate((keeps_itself, keeps_planes)) if not is_kept]
        nearest = [_least(left, distances, kind) for kind in (ITSELF, PLANES)]
        needs, spare = _needs_and_spare(kinematics, limits, (q, lower[:6], upper), certificate, left_out)

        # A failed factor, by rounding, makes each of the six NaN, and thus their minimum.
        slack = casadi.mmin(casadi.vertcat(*within))
        bounds = casadi.vertcat(upper, UNBOUNDED * casadi.SX.ones(n))
        results = [hessian, -casadi.mtimes(weighted, twist), rows.T, lower, bounds, values, free, *speed]
        scalars = [slack, spare, casadi.vertcat(*nearest), casadi.vertcat(*needs)]
        self.function = Buffered("streaming", [q, before, twist, floors, certificate], [*results, *scalars], kept=2)
        self.rows = tuple(name for name, _, _ in distances)
        """Text of each row of A."""
        memory = self.function.memory
        self.quadratic = QuadraticProgram(
            memory[0].reshape(6, 6), memory[1], memory[2].reshape(n, 6), memory[3], memory[4]
        )
        """Program of the last call of `function`."""
        self.speed_limit: SpeedLimit | None = None
        if limits.max_tool_speed is not None:
            self.speed_limit = SpeedLimit(limits.max_tool_speed, memory[7].reshape(3, 6), memory[8].reshape(6, 6))
        self._normals = np.array([normal for _, normal, _ in distances]).reshape(n, 3)
        self._distances, self._free = memory[5], memory[6]
        self._floors = np.zeros(n)
        self._slack, self._spare, self._nearest, self._need = self.function.numbers[-4:]
        self._certificate = np.zeros(14)
        """Certificate per kind: joint angles, and distance there."""
        self._solver = QuadraticSolver()
        self._unheld = np.zeros(6 + n)
        self.multipliers = self._unheld
        """Multipliers of the last minimum, (6 + n,): positive for an active upper bound, negative for a lower one."""

    def begin(self, q: Numbers, offset: Array) -> None:
        """Start a motion: distances that are too small may not shrink; planes have an offset.

        Raises:
            ValueError: A value is not finite.
        """
        floors = self._normals @ offset
        self.function.keep(0, floors)
        self.function.all(q, np.zeros(6), np.zeros(6))
        self._floors = np.minimum(floors, self._distances)
        self.function.keep(0, self._floors)

    @property
    def left(self) -> Array:
        """Distances of the last call above their floors in m, (n,)."""
        return self._distances - self._floors

    def certify(self, seen: "BoundedProgram", q: Numbers, kind: int) -> bool:
        """Store a distance certificate; return True if the distance is more than twice the need of one period.

        Args:
            seen: Program with the distances of this kind, called at `q`.
            q: Joint angles in rad, (6,).
            kind: `ITSELF` or `PLANES`.
        """
        left = seen._nearest[kind]
        if not left > 2.0 * seen._need[kind]:
            return False
        self._certificate[7 * kind : 7 * kind + 7] = (*q, left)
        self.function.keep(1, self._certificate)
        return True

    def is_apart(self) -> bool:
        """Return True if no omitted distance can be active in this period, by the last certificates.

        A distance h was at least h_c at the angles q_c, and changes by at most `sum L_i |dq_i|`. A row `dh/dt >= -rate
        h` then holds for all velocities within the joints' bounds w if `h_c - sum L_i |q_i - q_ci| >= sum L_i w_i /
        rate`: the program without it has the same minimum.
        """
        return bool(self._spare[0] >= 0.0)

    def minimum(self, multiplier: float) -> tuple[Array | None, float]:
        """Return joint velocities, (6,), or None if infeasible, and m; starts from the previous period's m."""
        # NaN counts as outside.
        if self._slack[0] >= 0.0:
            self.multipliers = self._unheld
            return self._free.copy(), 0.0
        if self.speed_limit is None:
            found, m = self._solver.solve(self.quadratic), 0.0
        else:
            found, m = self._within_speed(self.speed_limit, multiplier)
        self.multipliers = self._solver.multipliers
        return found, m

    def _within_speed(self, limit: SpeedLimit, m: float) -> tuple[Array | None, float]:
        """Return the optimum within the tool speed limit, and its multiplier."""
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
    """Return `l = damping (1 - w/w0)^2` below the manipulability w0, 0 above.

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


def _least(left: list[Symbol], distances: list[tuple[str, Vector, Distance]], kind: int) -> Symbol:
    """Return the smallest remaining distance of one kind; unbounded if there are none."""
    casadi = casadi_module()
    kept = [one for one, (_, normal, _) in zip(left, distances, strict=True) if any(normal) == (kind == PLANES)]
    return casadi.mmin(casadi.vertcat(*kept)) if kept else casadi.SX(UNBOUNDED)


def _needs_and_spare(
    kinematics: UrKinematics,
    limits: StreamingLimits,
    joints: tuple[Symbol, Symbol, Symbol],
    certificate: Symbol,
    left_out: list[int],
) -> tuple[list[Symbol], Symbol]:
    """Return the distance that one period needs per kind, and the spare of the omitted kinds' certificates."""
    casadi = casadi_module()
    q, lower, upper = joints
    # Fastest change of a distance over all joints within their bounds, divided by the rate.
    fastest = casadi.fmax(casadi.fabs(lower), casadi.fabs(upper))
    levers = [casadi.DM(list(each)) for each in (link_levers(kinematics), plane_levers(kinematics, limits.planes))]
    needs = [casadi.dot(each, fastest) / limits.approach_rate_hz for each in levers]
    spares = []
    for kind in left_out:
        at, apart = certificate[7 * kind : 7 * kind + 6], certificate[7 * kind + 6]
        spares.append(apart - casadi.dot(levers[kind], casadi.fabs(q - at)) - needs[kind])
    return needs, casadi.mmin(casadi.vertcat(*spares)) if spares else casadi.SX(0)


def _distances(
    kinematics: UrKinematics, limits: StreamingLimits, *, keeps_itself: bool, keeps_planes: bool
) -> list[tuple[str, Vector, Distance]]:
    """Return the distances with their text and, for a plane, its normal."""
    chain, keep_out = kinematics.chain, limits.self_keep_out
    body = arm_body(kinematics.model, None if keep_out is None else keep_out.radius_m)
    found: list[tuple[str, Vector, Distance]] = []
    for number, plane in enumerate(limits.planes if keeps_planes else ()):
        where, normal = f"planes[{number}]", plane.normal
        found.append((f"{where}, tool", normal, tool_height(chain, normal, plane.offset_m)))
        if plane.whole_arm:
            found += [(f"{where}, {b.name}", normal, height(chain, normal, plane.offset_m, b)) for b in body.balls]
    if keep_out is not None and keeps_itself:
        for ball, capsule in ((body.balls[ball], body.capsules[capsule]) for ball, capsule in body.pairs):
            distance = clearance(chain, ball, capsule, keep_out.margin_m)
            found.append((f"{ball.name} to {capsule.name}", (0.0, 0.0, 0.0), distance))
    return found
