"""Quadratic program with bounds, solved by an active-set method.

Source: D. Arnstroem, A. Bemporad, D. Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using
Recursive LDL^T Updates", IEEE Trans. Automatic Control 67(8), 2022 (daqp).
"""

from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np

from haptether.slave.ur.kinematics.pose import Array

UNBOUNDED: Final = 1e30
"""Value that daqp treats as infinite."""


class QuadraticProgram(NamedTuple):
    """`minimise 1/2 x'Hx + f'x` subject to `lower <= (x, A x) <= upper`, with m variables x."""

    hessian: Array
    """H, (m, m), positive definite."""
    linear: Array
    """f, (m,)."""
    rows: Array
    """A, (n, m)."""
    lower: Array
    """Lower bounds, (m + n,); -1e30 for none."""
    upper: Array
    """Upper bounds, (m + n,); 1e30 for none."""


SOLVED: Final = 1
INFEASIBLE: Final = -1
# daqp's default tolerance of 1e-6 would allow a joint to exceed its speed by that much. Problems here take about 10
# steps; with hundreds it cycles. Its regularisation is not needed, because costs are strictly convex.
SETTINGS: Final = {"primal_tol": 1e-11, "dual_tol": 1e-12, "eps_prox": 0.0, "iter_limit": 300}


class QuadraticSolver:
    """Solver for programs of one size, each warm-started from the last.

    Two pitfalls of daqp:

    - `update` refuses a program with crossing bounds and keeps the previous one, whose solution `solve` then returns as
      solved. This class detects it.
    - With a non-finite number it reports success. The caller must check for it.
    """

    def __init__(self) -> None:
        self._solver: Any = import_module("daqp").Model()
        self._is_set_up = False
        self.multipliers = np.zeros(0)
        """Multipliers of the last solution, (m + n,): positive for an active upper bound, negative for a lower one."""

    def solve(self, program: QuadraticProgram) -> Array | None:
        """Return the minimum, (m,), or None if infeasible."""
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
            # Cold start next, because the warm start may have caused the failure.
            self._is_set_up = False
            if flag == INFEASIBLE:
                return None
        return None
