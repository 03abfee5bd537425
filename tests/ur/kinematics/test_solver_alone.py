"""The quadratic solver and the search for the tool's speed work without an arm, its limits and CasADi."""

import subprocess
import sys

import numpy as np

from haptether.slave.ur.kinematics.quadratic import UNBOUNDED, QuadraticProgram, QuadraticSolver
from haptether.slave.ur.kinematics.speed_limit import SpeedLimit

LOADED = """
import sys
import haptether.slave.ur.kinematics.quadratic, haptether.slave.ur.kinematics.speed_limit
room = "haptether.slave.ur.kinematics."
print(sorted(name.removeprefix(room) for name in sys.modules if name.startswith(room) or name == "casadi"))
"""


def test_neither_loads_an_arm() -> None:
    """From its own room each imports the types of numbers only."""
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "['pose', 'quadratic', 'speed_limit']"


def test_a_ball_bounds_a_program_of_six_numbers() -> None:
    """A point outside a ball about 0 is shortened to its surface: H = 1, f = -c, J the first three rows of 1."""
    centre = np.array((0.3, -0.4, 1.2, 0.1, 0.2, -0.3))
    jacobian = np.eye(6)[:3]
    limit, solver = SpeedLimit(0.26, jacobian, jacobian.T @ jacobian), QuadraticSolver()
    wide = np.full(6, UNBOUNDED)
    multiplier, found = 0.0, centre
    for _ in range(40):
        hessian = limit.added_to(np.eye(6), multiplier)
        solution = solver.solve(QuadraticProgram(hessian, -centre, np.zeros((0, 6)), -wide, wide))
        assert solution is not None
        found = solution
        if abs(limit.speed(found) - limit.max_speed) < 1e-9:
            break
        multiplier = limit.next(multiplier, limit.speed(found))
    np.testing.assert_allclose(found[:3], centre[:3] / 5.0, atol=1e-8)
    np.testing.assert_allclose(found[3:], centre[3:], atol=1e-12)
