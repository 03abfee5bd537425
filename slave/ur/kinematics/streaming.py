"""Differential inverse kinematics: the joint velocities that follow a tool velocity best within all limits.

Solving without limits and clipping what comes out is not that: the clipped joints no longer balance the others, and the
tool goes elsewhere, past limits of its own too. So the limits are in the problem, which is solved to rounding:

`minimise 1/2 |J qd - twist|_W^2 + 1/2 (l + e) |qd|^2` over the joint velocities qd of the next period, subject to
`lower <= (qd, A qd) <= upper`; rows of A are gradients of distances. The limit of the tool's speed is no row of A, but
in the cost.

Source: S. R. Buss, "Introduction to Inverse Kinematics with Jacobian Transpose, Pseudoinverse and Damped Least Squares
methods", 2004, for the cost; O. Kanoun, F. Lamiraux, P.-B. Wieber, "Kinematic Control of Redundant Manipulators", IEEE
Trans. Robotics 27(4), 2011, for inequalities in it.
"""

import numpy as np

from haptether.slave.ur.kinematics.arm import UrKinematics
from haptether.slave.ur.kinematics.constraints import StreamingCost, StreamingLimits
from haptether.slave.ur.kinematics.pose import Array, Numbers
from haptether.slave.ur.kinematics.program import ITSELF, PLANES, BoundedProgram
from haptether.slave.ur.kinematics.quadratic import UNBOUNDED, QuadraticProgram, QuadraticSolver


class UrStreaming:
    """Joint velocities for one arm, one period after the other, for one thread.

    A limit of the tool's speed is a ball, `|J qd| <= max_speed`, and no polyhedron. Where it holds, its multiplier m
    joins the cost as `m/2 |J qd|^2`, and m is searched for which the speed is at its limit, from the m of the period
    before: what comes out is the optimum in the ball, not in a box or in facets around it.

    Distances are most of the program. While the arm is so far from itself, or from itself and from all planes, that no
    velocity within the joints' bounds could be held back by them (`BoundedProgram.is_apart`), the program without them
    is solved.

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
        cost = cost or StreamingCost()
        self._near = BoundedProgram(kinematics, limits, cost, period_s)
        self._far: BoundedProgram | None = None
        if limits.self_keep_out is not None:
            self._far = BoundedProgram(kinematics, limits, cost, period_s, keeps_itself=False)
        self._free: BoundedProgram | None = None
        """Without any distance; none where there are no planes, for then `_far` is that."""
        if limits.planes:
            # Where it does not keep itself there is nothing to certify.
            itself = limits.self_keep_out is None
            self._free = BoundedProgram(kinematics, limits, cost, period_s, keeps_itself=itself, keeps_planes=False)
        self._is_far = False
        self._is_free = False
        self._last = self._near
        self.rows = self._near.rows
        """What each row of the program is, as text."""
        self._step = None if limits.max_acceleration is None else np.array(limits.max_acceleration) * period_s

    @property
    def program(self) -> QuadraticProgram:
        """A copy of the last program, without the limit of the tool's speed."""
        if self.looks_away:
            self._near.function.all(*self._last.function.given)
        return QuadraticProgram(*(array.copy() for array in self._near.quadratic))

    @property
    def looks_away(self) -> bool:
        """Whether the last program was without distances that could not hold the arm back."""
        return self._last is not self._near

    @property
    def multipliers(self) -> Array:
        """Of the last solution, (6 + n,): positive where an upper bound holds, negative where a lower one does."""
        found = self._last.multipliers
        # Those to planes are the first rows, those of the arm to itself the last. What is not looked at holds nothing.
        return np.concatenate((found, np.zeros(6 + len(self.rows) - len(found))))

    @property
    def held_by(self) -> str:
        """Which distances held the last solution back, as text; empty where none did."""
        held = self.multipliers[6:] < 0
        return ", ".join(row for row, is_held in zip(self.rows, held, strict=True) if is_held)

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
        self._is_far = self._is_free = False
        for program in (self._near, self._far, self._free):
            if program is not None:
                program.begin(q, np.array(offset, dtype=np.float64))

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
            program = self._evaluated(q, qd, twist)
        except (TypeError, ValueError) as error:
            self.reason = str(error)
            return self._braking(qd)
        self._last = program
        solution, self.speed_multiplier = program.minimum(self.speed_multiplier)
        if solution is None:
            braking = self._braking(qd)
            self.reason = self._conflict(braking)
            return braking
        self.reason = ""
        return solution

    def _evaluated(self, q: Numbers, qd: Numbers, twist: Numbers) -> "BoundedProgram":
        """The program of this period: without those distances of which none can hold the arm back."""
        near, far, free = self._near, self._far, self._free
        if free is not None and self._is_free:
            free.function.all(q, qd, twist)
            if free.is_apart():
                return free
        self._is_free = False
        if far is not None and self._is_far:
            far.function.all(q, qd, twist)
            if far.is_apart():
                # From itself it was seen apart when this program's certificate was taken, and is still.
                self._is_free = free is not None and free.certify(far, q, PLANES)
                return far
        near.function.all(q, qd, twist)
        self._is_far = far is not None and far.certify(near, q, ITSELF)
        if free is not None:
            is_apart = far is None or (self._is_far and free.certify(near, q, ITSELF))
            self._is_free = is_apart and free.certify(near, q, PLANES)
        return near

    def _conflict(self, braking: Array) -> str:
        """Which limit the braking arm violates most, as text."""
        _, _, rows, lower, upper = self._last.quadratic
        for joint in range(6):
            if lower[joint] > upper[joint]:
                return (
                    f"joint {joint + 1} must be at least {lower[joint]:.6g} rad/s for one limit and at most "
                    f"{upper[joint]:.6g} rad/s for another"
                )
        seen = rows @ braking
        excess = np.maximum(lower[6:] - seen, seen - upper[6:])
        worst = int(excess.argmax()) if len(excess) else -1
        if (speed_limit := self._last.speed_limit) is not None:
            speed, limit = speed_limit.speed(braking), speed_limit.max_speed
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
