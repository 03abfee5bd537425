"""Differential inverse kinematics: joint velocities that best follow a tool velocity within all limits.

Clipping an unconstrained solution does not achieve this: clipped joints no longer balance the others, so the tool
deviates, possibly beyond its own limits. Therefore the limits are part of the problem, which is solved to rounding:
`minimise 1/2 |J qd - twist|_W^2 + 1/2 (l + e) |qd|^2` over the joint velocities qd of the next period, subject to
`lower <= (qd, A qd) <= upper`; rows of A are gradients of distances. The tool speed limit is not a row of A but part of
the cost.

Source: S. R. Buss, "Introduction to Inverse Kinematics with Jacobian Transpose, Pseudoinverse and Damped Least Squares
methods", 2004, for the cost; O. Kanoun, F. Lamiraux, P.-B. Wieber, "Kinematic Control of Redundant Manipulators", IEEE
Trans. Robotics 27(4), 2011, for inequalities in it.
"""

from typing import Final

import numpy as np

from haptether.slave.ur.kinematics.arm import UrKinematics
from haptether.slave.ur.kinematics.constraints import StreamingCost, StreamingLimits
from haptether.slave.ur.kinematics.models import Six
from haptether.slave.ur.kinematics.pose import Array, Numbers
from haptether.slave.ur.kinematics.program import ITSELF, PLANES, BoundedProgram
from haptether.slave.ur.kinematics.quadratic import UNBOUNDED, QuadraticProgram, QuadraticSolver

STANDING: Final[Six] = (0.0,) * 6


class UrStreaming:
    """Joint velocities of one arm, period by period, for one thread.

    The tool speed limit is a ball, `|J qd| <= max_speed`, not a polyhedron. If active, its multiplier m joins the cost
    as `m/2 |J qd|^2`. The search for the m that reaches the limit starts from the previous period's m. The result is
    the optimum within the ball, not within a box or facets around it.

    Distances dominate the program's cost. They are omitted while no velocity within the joint bounds can activate them
    (`BoundedProgram.is_apart`): self distances, or self and plane distances.

    Args:
        kinematics: Kinematics of the arm with its tool.
        limits: Limits; absent ones cost nothing.
        period_s: Time between two calls in s.
        cost: Cost weights and damping.

    Raises:
        ValueError: The period is not positive, or so long that a distance could be crossed within one.
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
        """Reason why the last call braked; empty otherwise."""
        self.speed_multiplier = 0.0
        """m of the last solution: positive if the tool speed limit is active."""
        cost = cost or StreamingCost()
        self._near = BoundedProgram(kinematics, limits, cost, period_s)
        self._far: BoundedProgram | None = None
        if limits.self_keep_out is not None:
            self._far = BoundedProgram(kinematics, limits, cost, period_s, keeps_itself=False)
        self._free: BoundedProgram | None = None
        """Program without distances; None without planes, because `_far` is the same."""
        if limits.planes:
            # Without self distances nothing needs a certificate.
            itself = limits.self_keep_out is None
            self._free = BoundedProgram(kinematics, limits, cost, period_s, keeps_itself=itself, keeps_planes=False)
        self._is_far = False
        self._is_free = False
        self._last = self._near
        self.rows = self._near.rows
        """Text of each row of the program."""
        self._step = None if limits.max_acceleration is None else np.array(limits.max_acceleration) * period_s

    @property
    def program(self) -> QuadraticProgram:
        """Return a copy of the last program, without the tool speed limit."""
        if self.looks_away:
            self._near.function.all(*self._last.function.given)
        return QuadraticProgram(*(array.copy() for array in self._near.quadratic))

    @property
    def looks_away(self) -> bool:
        """True if the last program omitted distances that could not be active."""
        return self._last is not self._near

    @property
    def multipliers(self) -> Array:
        """Multipliers of the last solution, (6 + n,): positive for an active upper bound, negative for a lower one."""
        found = self._last.multipliers
        # Plane rows come first, self rows last. Omitted rows are inactive.
        return np.concatenate((found, np.zeros(6 + len(self.rows) - len(found))))

    @property
    def held_by(self) -> str:
        """Return the distances that limited the last solution as text; empty if none did."""
        held = self.multipliers[6:] < 0
        return ", ".join(row for row, is_held in zip(self.rows, held, strict=True) if is_held)

    def begin(self, q: Numbers, offset: Numbers = (0.0, 0.0, 0.0)) -> None:
        """Start a motion: distances that are too small need not grow, but may not shrink.

        Without this call every distance is kept above 0, and a negative one returns at up to 1 mm/s.

        Args:
            q: Joint angles, (6,), rad.
            offset: Offset from the planes' frame to the model's, (3,), m. It keeps the planes at the controller's
                positions if the model is only accurate to a few mm.

        Raises:
            ValueError: A value is not finite.
        """
        self._is_far = self._is_free = False
        for program in (self._near, self._far, self._free):
            if program is not None:
                program.begin(q, np.array(offset, dtype=np.float64))

    def distances(self, q: Numbers) -> tuple[Array, Array]:
        """Return the kept distances in m, (n,), and their gradients in m/rad, (n, 6), at joint angles in rad, (6,).

        The gradients are the same memory at every call.

        Raises:
            ValueError: A value is not finite.
        """
        self._near.function.all(q, STANDING, STANDING)
        return self._near.left, self._near.quadratic.rows

    def velocity(self, q: Numbers, qd: Numbers, twist: Numbers) -> Array:
        """Return joint velocities for the next period, (6,), rad/s.

        If the limits are infeasible, or a value is not finite, it brakes within the acceleration limits and sets
        `reason`. Never raises.

        Args:
            q: Commanded, not measured, joint angles at the start of the period, (6,), rad.
            qd: Commanded joint velocities of the previous period, (6,), rad/s.
            twist: Twist of the tool, (6,), in the base frame: linear velocity in m/s, angular velocity in rad/s.
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
        """Return the program of this period without distances that cannot be active."""
        near, far, free = self._near, self._far, self._free
        if free is not None and self._is_free:
            free.function.all(q, qd, twist)
            if free.is_apart():
                return free
        self._is_free = False
        if far is not None and self._is_far:
            far.function.all(q, qd, twist)
            if far.is_apart():
                # The certificate of this program's self distance is still valid.
                self._is_free = free is not None and free.certify(far, q, PLANES)
                return far
        near.function.all(q, qd, twist)
        self._is_far = far is not None and far.certify(near, q, ITSELF)
        if free is not None:
            is_apart = far is None or (self._is_far and free.certify(near, q, ITSELF))
            self._is_free = is_apart and free.certify(near, q, PLANES)
        return near

    def _conflict(self, braking: Array) -> str:
        """Return the limit that the braking arm violates most, as text."""
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
        """Return every joint slowed by its acceleration limit; without a limit, zero."""
        try:
            before = np.array(qd, dtype=np.float64)
        except (TypeError, ValueError):
            return np.zeros(6)
        if before.shape != (6,) or not np.isfinite(before).all() or self._step is None:
            return np.zeros(6)
        return before - np.clip(before, -self._step, self._step)


class BrakedPoint:
    """Point that follows another like a tool that brakes before planes, without further limits.

    Moves to the nearest point at which every plane distance h is at least `(1 - rate T) h`, the part that `UrStreaming`
    leaves in a period T. A tool's distance from this point is therefore not caused by planes.

    Args:
        limits: Planes and rate; planes of the whole arm count as planes of its tool.
        period_s: Time between two calls in s.
    """

    def __init__(self, limits: StreamingLimits, period_s: float) -> None:
        self._offsets_m = np.array([plane.offset_m for plane in limits.planes])
        self._normals = np.array([plane.normal for plane in limits.planes]).reshape(-1, 3)
        self._share = 1.0 - limits.approach_rate_hz * period_s
        self._levels = self._offsets_m
        self._solver = QuadraticSolver()
        self.position = np.zeros(3)
        """Position in m."""

    def begin(self, position: Array, offset: Array) -> None:
        """Start at a position, (3,), m; offset and violated planes as in `UrStreaming.begin`."""
        self.position = position
        self._levels = np.minimum(self._offsets_m + self._normals @ offset, self._normals @ position)

    def step(self, target: Array) -> None:
        """Advance one period towards a target, (3,), m."""
        lower_levels = self._levels + self._share * (self._normals @ self.position - self._levels)
        if (self._normals @ target >= lower_levels).all():
            self.position = target
            return
        anywhere = np.full(3, UNBOUNDED)
        upper = np.full(len(lower_levels) + 3, UNBOUNDED)
        nearest = QuadraticProgram(np.eye(3), -target, self._normals, np.concatenate((-anywhere, lower_levels)), upper)
        solution = self._solver.solve(nearest)
        # Without a solution no plane explains a lag.
        self.position = target if solution is None else np.array(solution)
