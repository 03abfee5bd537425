"""Small dense quadratic programs, one like the other, by daqp."""

from importlib import import_module
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]

SOLVED: Final = 1
INFEASIBLE: Final = -1
# daqp's own tolerance of 1e-6 would let a joint be that much too fast. Problems here take about 10 steps; with hundreds
# it goes round in circles. Its regularisation is not needed: costs are strictly convex.
SETTINGS: Final = {"primal_tol": 1e-11, "dual_tol": 1e-12, "eps_prox": 0.0, "iter_limit": 300}


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


class QuadraticSolver:
    """Solves programs of one size, each from where the last one ended.

    Of daqp it takes care that

    - a program whose bounds cross is refused by `update`, which then keeps the one before, whose solution `solve` gives
      out again as solved;
    - with a number that is not finite it says it has solved: that is for the caller to see before.
    """

    def __init__(self) -> None:
        self._solver: Any = import_module("daqp").Model()
        self._begun = False
        self.multipliers = np.zeros(0)
        """Of the last solution, (m + n,): positive where an upper bound holds, negative where a lower one does."""

    def solve(self, program: QuadraticProgram) -> Array | None:
        """The minimum, (m,), or None where the bounds leave nothing."""
        hessian, linear, rows, lower, upper = program
        for _ in range(2):
            if self._begun:
                refused = self._solver.update(hessian, linear, rows if len(rows) else None, upper, lower) < 0
            else:
                sense = np.zeros(len(lower), dtype=np.int32)
                refused = self._solver.setup(hessian, linear, rows, upper, lower, sense)[0] < 0
                self._solver.settings = SETTINGS
            self._begun = not refused
            if refused:
                return None
            solution, _, flag, told = self._solver.solve()
            if flag == SOLVED:
                self.multipliers = told["lam"]
                return solution  # type: ignore[no-any-return]
            # The next start is from scratch: where this one began may be what led it astray.
            self._begun = False
            if flag == INFEASIBLE:
                return None
        return None
