"""Solvers of the program of a streamed step, for the bench of UR kinematics."""

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
import numpy.typing as npt

from haptether.slave import QuadraticProgram
from haptether.slave.ur.kinematics.quadratic import QuadraticSolver

Array = npt.NDArray[np.float64]
Solve = Callable[[QuadraticProgram], Array | None]

ABSENT = 1e30


def infinite(bounds: Array) -> Array:
    """Return the bounds, with absent ones as infinite."""
    return np.where(np.abs(bounds) >= ABSENT, np.sign(bounds) * np.inf, bounds)


def one_sided(program: QuadraticProgram) -> tuple[Array, Array]:
    """Return all existing bounds as `G x >= h`."""
    constraints = np.vstack((np.eye(6), program.rows))
    low, high = program.lower > -ABSENT, program.upper < ABSENT
    return (
        np.vstack((constraints[low], -constraints[high])),
        np.concatenate((program.lower[low], -program.upper[high])),
    )


def ours(_: list[QuadraticProgram]) -> Solve:
    """`QuadraticSolver`: daqp, started at the last program's solution."""
    return QuadraticSolver().solve


def daqp_as_it_is(_: list[QuadraticProgram]) -> Solve:
    """`daqp.solve` with its own tolerances, from scratch."""
    package: Any = importlib.import_module("daqp")

    def solve(program: QuadraticProgram) -> Array | None:
        solution, _, flag, _ = package.solve(
            program.hessian, program.linear, program.rows, program.upper, program.lower
        )
        return solution if flag == 1 else None

    return solve


def solve_then_clip(_: list[QuadraticProgram]) -> Solve:
    """Minimum without bounds, with each joint clipped to its own."""

    def solve(program: QuadraticProgram) -> Array:
        free = np.linalg.solve(program.hessian, -program.linear)
        return np.clip(free, program.lower[:6], program.upper[:6])

    return solve


def qrqp(programs: list[QuadraticProgram]) -> Solve:
    """CasADi's active set solver."""
    shapes = {"h": casadi.Sparsity.dense(6, 6), "a": casadi.Sparsity.dense(len(programs[0].rows), 6)}
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    solver: Any = casadi.conic("qrqp", "qrqp", shapes, quiet)

    def solve(program: QuadraticProgram) -> Array | None:
        lower, upper = infinite(program.lower), infinite(program.upper)
        found = solver(
            h=program.hessian,
            g=program.linear,
            a=program.rows,
            lbx=lower[:6],
            ubx=upper[:6],
            lba=lower[6:],
            uba=upper[6:],
        )
        return np.asarray(found["x"]).ravel() if solver.stats()["success"] else None

    return solve


def proxqp(eps_abs: float | None) -> Callable[[list[QuadraticProgram]], Solve]:
    """ProxQP's dense solver, started at the last program's solution; None for its own tolerance."""

    def prepare(programs: list[QuadraticProgram]) -> Solve:
        proxsuite: Any = importlib.import_module("proxsuite")
        count = 6 + len(programs[0].rows)
        solver = proxsuite.proxqp.dense.QP(6, 0, count)
        if eps_abs is not None:
            solver.settings.eps_abs = eps_abs
        solver.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        begun = False

        def solve(program: QuadraticProgram) -> Array | None:
            nonlocal begun
            constraints = np.vstack((np.eye(6), program.rows))
            call = solver.update if begun else solver.init
            call(H=program.hessian, g=program.linear, C=constraints, l=program.lower, u=program.upper)
            begun = True
            solver.solve()
            solved = solver.results.info.status == proxsuite.proxqp.PROXQP_SOLVED
            return solver.results.x.copy() if solved else None

        return solve

    return prepare


def quadprog(_: list[QuadraticProgram]) -> Solve:
    """Goldfarb and Idnani's dual method in quadprog."""
    package: Any = importlib.import_module("quadprog")

    def solve(program: QuadraticProgram) -> Array:
        above, lower_bounds = one_sided(program)
        found: Array = package.solve_qp(program.hessian, -program.linear, above.T, lower_bounds)[0]
        return found

    return solve


def solvers() -> dict[str, Callable[[list[QuadraticProgram]], Solve]]:
    """Return all installed solvers, by name."""
    found: dict[str, Callable[[list[QuadraticProgram]], Solve]] = {
        "ours (daqp, warm)": ours,
        "daqp.solve": daqp_as_it_is,
        "solve, then clip": solve_then_clip,
        "CasADi qrqp": qrqp,
    }
    if importlib.util.find_spec("proxsuite") is not None:
        found |= {"proxqp": proxqp(None), "proxqp, 1e-9": proxqp(1e-9)}
    if importlib.util.find_spec("quadprog") is not None:
        found["quadprog"] = quadprog
    return found
