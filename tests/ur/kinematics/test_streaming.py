"""Streamed joint velocities are optimal, up to rounding, for the problem of the configured limits."""

import numpy as np
import numpy.typing as npt
import pytest
import scipy.optimize
from tests.ur.kinematics.streaming_cases import JOINTS, LIMITS, MODEL, PERIOD_S, steps

from haptether.slave import QuadraticProgram, StreamingCost, StreamingLimits, UrKinematics, UrStreaming
from ur.arms import TOOL

Array = npt.NDArray[np.float64]


def residual(streaming: UrStreaming, q: Array, x: Array, multipliers: Array) -> float:
    """Return the largest residual of the Karush-Kuhn-Tucker conditions, from program, arm and limits alone.

    Source: S. Boyd, L. Vandenberghe, "Convex Optimization", 2004, section 5.5.3.
    """
    program, m = streaming.program, streaming.speed_multiplier
    constraints = np.vstack((np.eye(6), program.rows))
    values = constraints @ x
    gradient = program.hessian @ x + program.linear + constraints.T @ multipliers
    infeasible = np.maximum(values - program.upper, program.lower - values).clip(min=0)
    # A positive multiplier belongs to an upper bound, a negative one to a lower bound: any sign is feasible.
    slack = np.where(multipliers > 0, program.upper - values, np.where(multipliers < 0, values - program.lower, 0.0))
    parts = [infeasible.max(), np.abs(multipliers * slack).max()]
    max_speed = streaming.limits.max_tool_speed
    if max_speed is not None:
        # 1/2 |J x|^2 <= 1/2 most^2
        jacobian = streaming.kinematics.forward_and_jacobian(q)[1][:3]
        gradient = gradient + m * jacobian.T @ (jacobian @ x)
        excess = (float(np.sum((jacobian @ x) ** 2)) - max_speed**2) / 2
        assert m >= 0
        parts += [max(excess, 0.0), abs(m * excess)]
    return float(max(np.abs(gradient).max(), *parts))


@pytest.mark.parametrize("name", LIMITS)
def test_solutions_satisfy_the_conditions_of_an_optimum(name: str) -> None:
    streaming = UrStreaming(UrKinematics(MODEL, tool=TOOL), LIMITS[name], period_s=PERIOD_S)
    solved = at_speed = 0
    for step in steps(400):
        velocity = streaming.velocity(step.q, step.qd, step.twist)
        if streaming.reason:
            continue
        solved += 1
        at_speed += streaming.speed_multiplier > 0
        # The search for m ends within 1e-9 of 0.4 m/s, so within 1.6e-10 m^2/s^2 of half its square, times m.
        allowed = 1e-9 * max(1.0, streaming.speed_multiplier)
        assert residual(streaming, step.q, velocity, streaming.multipliers) < allowed
    assert solved > 100
    assert (at_speed > 50) is (name == "tool speed")


def test_the_residual_notices_what_is_not_optimal() -> None:
    streaming = UrStreaming(UrKinematics(MODEL), LIMITS["tool speed"], period_s=PERIOD_S)
    step = steps(1)[0]
    velocity = streaming.velocity(step.q, step.qd, step.twist)
    assert streaming.speed_multiplier > 0
    for joint in range(6):
        moved = velocity.copy()
        moved[joint] += 1e-6
        assert residual(streaming, step.q, moved, streaming.multipliers) > 1e-8
    streaming.speed_multiplier *= 1.0001
    assert residual(streaming, step.q, velocity, streaming.multipliers) > 1e-8
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    velocity = streaming.velocity(step.q, step.qd, step.twist)
    assert np.abs(streaming.multipliers).max() > 0
    assert residual(streaming, step.q, velocity, -streaming.multipliers) > 1e-8


def least_distance(program: QuadraticProgram) -> Array:
    """Find the same minimum with another method: least distance programming, by non-negative least squares.

    With `H = L'L`, `z = L x - b` and `G x >= h` for all bounds, it is `min |z|` subject to `G L^-1 z >= h - G L^-1 b`.

    Source: C. L. Lawson, R. J. Hanson, "Solving Least Squares Problems", 1974, chapter 23, section 4.
    """
    root = np.linalg.cholesky(program.hessian).T
    goal = -np.linalg.solve(root.T, program.linear)
    constraints = np.vstack((np.eye(6), program.rows))
    low, high = program.lower > -1e30, program.upper < 1e30
    above = np.vstack((constraints[low], -constraints[high]))
    lower_bounds = np.concatenate((program.lower[low], -program.upper[high]))
    across = np.linalg.solve(root.T, above.T)
    left = lower_bounds - across.T @ goal
    # Rows of other lengths than 1 only scale the multipliers.
    system = np.vstack((across, left))
    found, _ = scipy.optimize.nnls(system, np.eye(7)[6], maxiter=1000)
    rest = system @ found - np.eye(7)[6]
    minimum: Array = np.linalg.solve(root, -rest[:6] / rest[6] + goal)
    return minimum


@pytest.mark.parametrize("name", ["joints", "planes", "all"])
def test_another_solver_finds_the_same(name: str) -> None:
    streaming = UrStreaming(UrKinematics(MODEL, tool=TOOL), LIMITS[name], period_s=PERIOD_S)
    compared = 0
    for step in steps(200, seed=4):
        velocity = streaming.velocity(step.q, step.qd, step.twist)
        if streaming.reason or streaming.speed_multiplier > 0:
            continue
        compared += 1
        # The method uses the root of H, whose condition is up to 1e4, and its inverse.
        np.testing.assert_allclose(velocity, least_distance(streaming.program), rtol=0, atol=1e-8)
    assert compared > 50


def test_scipy_finds_no_better_velocity_in_the_ball() -> None:
    kinematics = UrKinematics(MODEL)
    streaming = UrStreaming(kinematics, LIMITS["joints and tool speed"], period_s=0.05)
    for step in steps(10, seed=6):
        velocity = streaming.velocity(step.q, np.zeros(6), step.twist)
        assert streaming.reason == ""
        jacobian, program = kinematics.forward_and_jacobian(step.q)[1][:3].copy(), streaming.program

        def value(x: Array, program: QuadraticProgram = program) -> float:
            return float(0.5 * x @ program.hessian @ x + program.linear @ x)

        def within(x: Array, jacobian: Array = jacobian) -> float:
            return 0.4**2 - float(np.sum((jacobian @ x) ** 2))

        found = scipy.optimize.minimize(
            value,
            np.zeros(6),
            bounds=scipy.optimize.Bounds(program.lower[:6], program.upper[:6]),
            constraints=[{"type": "ineq", "fun": within}],
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        # The solver uses differences as slopes, so it ends within about 1e-8 of the limit; the value may thus be
        # better.
        assert value(velocity) == pytest.approx(value(found.x), rel=1e-6, abs=1e-6)


def test_without_limits_it_is_damped_least_squares() -> None:
    kinematics = UrKinematics(MODEL)
    cost = StreamingCost(weights=(1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
    streaming = UrStreaming(kinematics, StreamingLimits(), period_s=PERIOD_S, cost=cost)
    assert streaming.rows == ()
    a2, a3 = 0.425, 0.3922
    for step in steps(50):
        velocity = streaming.velocity(step.q, step.qd, step.twist)
        jacobian, weights = kinematics.forward_and_jacobian(step.q)[1], np.diag(cost.weights)
        manipulability = kinematics.manipulability(step.q)
        damping = 1e-8 + 0.01 * max(0.0, 1 - manipulability / (0.05 * a2 * a3 * (a2 + a3))) ** 2
        expected = np.linalg.solve(
            jacobian.T @ weights @ jacobian + damping * np.eye(6), jacobian.T @ weights @ step.twist
        )
        np.testing.assert_allclose(velocity, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", LIMITS)
def test_what_is_not_named_is_not_in_the_problem(name: str) -> None:
    streaming = UrStreaming(UrKinematics(MODEL), LIMITS[name], period_s=PERIOD_S)
    step = steps(1)[0]
    streaming.velocity(step.q, step.qd, step.twist)
    program, limits = streaming.program, LIMITS[name]
    per_plane = sum(7 if plane.whole_arm else 1 for plane in limits.planes)
    expected = per_plane + (13 if limits.self_keep_out else 0)
    assert len(streaming.rows) == len(program.rows) == expected
    bounded = limits.max_speed is not None or limits.position_min is not None
    assert bool((np.abs(program.upper[:6]) < 1e30).all()) is bounded
    assert bool((np.abs(program.lower[:6]) < 1e30).all()) is bounded


def test_clipping_what_was_solved_without_limits_is_another_velocity() -> None:
    kinematics = UrKinematics(MODEL)
    free = UrStreaming(kinematics, StreamingLimits(), period_s=PERIOD_S)
    limited = UrStreaming(kinematics, StreamingLimits(max_speed=(1.0,) * 6), period_s=PERIOD_S)
    apart = 0.0
    for step in steps(200):
        clipped = free.velocity(step.q, step.qd, step.twist).clip(-1.0, 1.0)
        best = limited.velocity(step.q, step.qd, step.twist)
        program = limited.program
        costs = [0.5 * x @ program.hessian @ x + program.linear @ x for x in (best, clipped)]
        assert costs[0] <= costs[1] + 1e-12
        apart = max(apart, float(np.abs(best - clipped).max()))
    assert apart > 1.0
