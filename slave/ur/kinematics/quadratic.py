"""A quadratic program with bounds, and its minimum by an active-set method.

Source: D. Arnstroem, A. Bemporad, D. Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using
Recursive LDL^T Updates", IEEE Trans. Automatic Control 67(8), 2022 (daqp).
"""

from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np

from haptether.slave.ur.kinematics.pose import Array

UNBOUNDED: Final = 1e30
"""What daqp takes for infinite."""


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
