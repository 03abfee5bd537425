"""Differential inverse kinematics: the joint velocities that follow a tool velocity best within all limits.

Solving without limits and clipping what comes out is not that: the clipped joints no longer balance the others, and the
tool goes elsewhere, past limits of its own too. So the limits are in the problem, which is solved to rounding.

Source: D. Arnstroem, A. Bemporad, D. Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using
Recursive LDL^T Updates", IEEE Trans. Automatic Control 67(8), 2022 (daqp).
"""

from collections.abc import Sequence
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from haptether.slave.ur.kinematics.arm import UrKinematics
from haptether.slave.ur.kinematics.constraints import StreamingCost, StreamingLimits
from haptether.slave.ur.kinematics.problem import streaming_problem
from haptether.slave.ur.kinematics.quadratic import QuadraticProgram, QuadraticSolver
from haptether.slave.ur.kinematics.speed_limit import CLOSE, SpeedLimit

Array: TypeAlias = npt.NDArray[np.float64]
Numbers: TypeAlias = Array | Sequence[float]

# Solutions that the search for its multiplier may take; 1 to 4 are usual.
MAX_SOLUTIONS: Final = 40
# From this multiplier on, (m/s)^-2, the cost drowns in rounding: then the tool cannot be that slow.
MAX_MULTIPLIER: Final = 1e6


class UrStreaming:
    """Joint velocities for one arm, one period after the other, for one thread.

    A limit of the tool's speed is a ball, `|J qd| <= most`, and no polyhedron. Where it holds, its multiplier m joins
    the cost as `m/2 |J qd|^2`, and m is searched for which the speed is at its limit, from the m of the period before:
    what comes out is the optimum in the ball, not in a box or in facets around it.

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
        """What each row of the program is, in words."""
        self._function = problem.function
        memory, n = problem.function.memory, len(problem.rows)
        self._program = QuadraticProgram(
            memory[0].reshape(6, 6), memory[1], memory[2].reshape(n, 6), memory[3], memory[4]
        )
        self._solver = QuadraticSolver()
        self._slower: SpeedLimit | None = None
        if limits.max_tool_speed is not None:
            self._slower = SpeedLimit(limits.max_tool_speed, memory[5].reshape(3, 6), memory[6].reshape(6, 6))
        self._step = None if limits.max_acceleration is None else np.array(limits.max_acceleration) * period_s

    @property
    def program(self) -> QuadraticProgram:
        """A copy of the last program, without the limit of the tool's speed."""
        return QuadraticProgram(*(array.copy() for array in self._program))

    @property
    def multipliers(self) -> Array:
        """Of the last solution, (6 + n,): positive where an upper bound holds, negative where a lower one does."""
        return self._solver.multipliers

    def velocity(self, q: Numbers, qd: Numbers, twist: Numbers) -> Array:
        """Joint velocities for the next period, (6,), rad/s.

        Where no velocity is within all limits, or a number is not finite, it brakes, within the acceleration limits,
        and `reason` says why. It raises nothing.

        Args:
            q: Joint angles at the begin of the period, (6,), rad: those that were commanded, not the measured ones.
            qd: Joint velocities that were commanded for the period before, (6,), rad/s.
            twist: What the tool shall do, (6,), in the base frame: velocity of its point in m/s over angular velocity
                in rad/s.
        """
        try:
            self._function.all(q, qd, twist)
        except (TypeError, ValueError) as error:
            self.reason = str(error)
            return self._braking(qd)
        solution = self._solver.solve(self._program) if self._slower is None else self._within_speed()
        if solution is None:
            braking = self._braking(qd)
            self.reason = self._conflict(braking)
            return braking
        self.reason = ""
        return solution

    def _within_speed(self) -> Array | None:
        """The optimum with the tool's speed within its limit, from the multiplier of the period before."""
        limit, program = self._slower, self._program
        assert limit is not None
        limit.begin()
        m = self.speed_multiplier
        for _ in range(MAX_SOLUTIONS):
            heavier = program if m == 0 else program._replace(hessian=limit.added_to(program.hessian, m))
            solution = self._solver.solve(heavier)
            if solution is None:
                break
            speed = limit.speed(solution)
            if abs(speed - limit.most) <= CLOSE * limit.most or (m == 0 and speed < limit.most):
                self.speed_multiplier = m
                return solution
            m = limit.next(m, speed)
            if m > MAX_MULTIPLIER:
                break
        self.speed_multiplier = 0.0
        return None

    def _conflict(self, braking: Array) -> str:
        """Which limit the braking arm is farthest from, for people."""
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
        if self._slower is not None:
            speed, most = self._slower.speed(braking), self._slower.most
            if speed > most and (worst < 0 or speed - most > excess[worst]):
                return f"tool speed: {speed:.6g} m/s while braking, must be at most {most:.6g} m/s"
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
