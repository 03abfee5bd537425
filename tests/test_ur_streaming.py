"""Streamed joint velocities: optimal to rounding, within every limit that is named, and braking where there is none."""

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st
from tests.ur_arms import CALIBRATIONS, TOOL

from haptether.slave import (
    QuadraticProgram,
    SelfKeepOut,
    StreamingCost,
    StreamingLimits,
    UrKinematics,
    UrStreaming,
    WorkspacePlane,
    model_limits,
    ur_model,
)
from haptether.slave.ur_body import Ball, Capsule, arm_body
from haptether.slave.ur_chain import DhRows, cos_sin, dh_rows

Array = npt.NDArray[np.float64]

PERIOD_S = 0.002
MODEL = ur_model("ur5e")
JOINTS = model_limits(MODEL)
TABLE = WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=0.0, whole_arm=True)
WALL = WorkspacePlane(normal=(-1.0, 0.0, 0.0), offset_m=-0.6)
LIMITS: dict[str, StreamingLimits] = {
    "none": StreamingLimits(),
    "joints": JOINTS,
    "position": StreamingLimits(position_min=MODEL.position_min, position_max=MODEL.position_max),
    "tool speed": StreamingLimits(max_tool_speed=0.4),
    "joints and tool speed": msgspec.structs.replace(JOINTS, max_tool_speed=0.4),
    "planes": StreamingLimits(planes=(TABLE, WALL)),
    "all": msgspec.structs.replace(
        JOINTS, max_tool_speed=0.4, planes=(TABLE, WALL), self_keep_out=SelfKeepOut(margin_m=0.02)
    ),
}


@dataclass(frozen=True)
class Step:
    """A random state that is within limits, and a wish."""

    q: Array
    qd: Array
    twist: Array


def steps(count: int, seed: int = 3) -> list[Step]:
    """Postures in front of the arm, of which each joint's range has some at its ends."""
    draws = np.random.default_rng(seed)
    middle = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3))
    return [
        Step(middle + draws.normal(0, 0.5, 6), draws.normal(0, 0.05, 6), draws.normal(0, 1.5, 6)) for _ in range(count)
    ]


def residual(streaming: UrStreaming, q: Array, x: Array, multipliers: Array) -> float:
    """Largest residual of the conditions of Karush, Kuhn and Tucker, from program, arm and limits alone.

    Source: S. Boyd, L. Vandenberghe, "Convex Optimization", 2004, section 5.5.3.
    """
    program, m = streaming.program, streaming.speed_multiplier
    constraints = np.vstack((np.eye(6), program.rows))
    values = constraints @ x
    gradient = program.hessian @ x + program.linear + constraints.T @ multipliers
    infeasible = np.maximum(values - program.upper, program.lower - values).clip(min=0)
    # A positive multiplier is of an upper bound, a negative one of a lower bound: its sign is its feasibility.
    slack = np.where(multipliers > 0, program.upper - values, np.where(multipliers < 0, values - program.lower, 0.0))
    parts = [infeasible.max(), np.abs(multipliers * slack).max()]
    most = streaming.limits.max_tool_speed
    if most is not None:
        # 1/2 |J x|^2 <= 1/2 most^2
        jacobian = streaming.kinematics.forward_and_jacobian(q)[1][:3]
        gradient = gradient + m * jacobian.T @ (jacobian @ x)
        excess = (float(np.sum((jacobian @ x) ** 2)) - most**2) / 2
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
    """The same minimum by another way: least distance programming, by non-negative least squares.

    With `H = L'L`, `z = L x - b` and `G x >= h` for all bounds, it is `min |z|` subject to `G L^-1 z >= h - G L^-1 b`.

    Source: C. L. Lawson, R. J. Hanson, "Solving Least Squares Problems", 1974, chapter 23, section 4.
    """
    root = np.linalg.cholesky(program.hessian).T
    goal = -np.linalg.solve(root.T, program.linear)
    constraints = np.vstack((np.eye(6), program.rows))
    low, high = program.lower > -1e30, program.upper < 1e30
    above = np.vstack((constraints[low], -constraints[high]))
    least = np.concatenate((program.lower[low], -program.upper[high]))
    across = np.linalg.solve(root.T, above.T)
    left = least - across.T @ goal
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
        # It goes through the root of H, whose condition is up to 1e4, and its inverse.
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
        # Its slopes are differences, so it ends within 1e-8 or so of the limit, which may be a gain.
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


# ------------------------------------------------------------------------------------------ joints


@given(
    distance=st.floats(0, 1),
    speed=st.floats(0.3, math.pi),
    acceleration=st.floats(0.5, 40),
    period_s=st.sampled_from([0.002, 0.008]),
)
def test_a_joint_that_is_pushed_at_its_end_stops_there(
    distance: float, speed: float, acceleration: float, period_s: float
) -> None:
    limits = StreamingLimits(
        position_min=(-3.0,) * 6,
        position_max=(3.0,) * 6,
        max_speed=(speed,) * 6,
        max_acceleration=(acceleration,) * 6,
        approach_rate_hz=1.0,
    )
    streaming = UrStreaming(UrKinematics(MODEL), limits, period_s=period_s)
    q, qd = np.full(6, 3.0 - distance), np.zeros(6)
    # Through the buffer of the bounds alone: what the task wants does not matter here, the upper bound is taken.
    for _ in range(round((distance / speed + speed / acceleration) / period_s) + 10):
        streaming.velocity(q, qd, np.zeros(6))
        after = streaming.program.upper[:6]
        assert (after - qd >= -acceleration * period_s - 1e-9).all()
        assert (after <= speed).all()
        q, qd = q + after * period_s, after
        assert (q <= 3.0 + 1e-12).all()
    # What is left is less than a step of braking over a period.
    assert (3.0 - q <= acceleration * period_s**2 + 1e-9).all()


def test_past_its_end_a_joint_may_only_go_back() -> None:
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    q = np.array((0.3, -1.2, 1.4, 0.2, 0.9, 6.5))
    for twist in np.vstack((np.eye(6), -np.eye(6))):
        velocity = streaming.velocity(q, np.zeros(6), twist)
        assert streaming.reason == ""
        assert velocity[5] <= 1e-12
    assert streaming.program.lower[5] == pytest.approx(-8.0 * PERIOD_S)


# ---------------------------------------------------------------------------------------- distances


def frames(rows: DhRows, q: Array) -> list[Array]:
    """base_from_link of every link, in plain NumPy."""
    found = [np.eye(4)]
    for angle, theta, a, d, alpha in zip(q, rows.theta, rows.a, rows.d, rows.alpha, strict=True):
        (c, s), (ca, sa) = cos_sin(angle + theta), cos_sin(alpha)
        link = np.array(((c, -s * ca, s * sa, a * c), (s, c * ca, -c * sa, a * s), (0, sa, ca, d), (0, 0, 0, 1.0)))
        found.append(found[-1] @ link)
    return found


def at(found: list[Array], link: int, place: tuple[float, float, float]) -> Array:
    point: Array = (found[link] @ np.array((*place, 1.0)))[:3]
    return point


def apart(found: list[Array], ball: Ball, capsule: Capsule) -> float:
    """Distance by a search along the capsule's axis: nothing shared with the closed form."""
    centre = at(found, ball.link, ball.place)
    start, end = at(found, capsule.link, capsule.start), at(found, capsule.link, capsule.end)

    def away(t: float) -> float:
        return float(np.linalg.norm(centre - start - t * (end - start)))

    t = float(scipy.optimize.minimize_scalar(away, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-12}).x)
    return min(away(t), away(0.0), away(1.0)) - ball.radius_m - capsule.radius_m


def distances(limits: StreamingLimits, q: Array, tool: Array) -> Array:
    found = frames(dh_rows(MODEL), q)
    body = arm_body(MODEL)
    values = []
    for plane in limits.planes:
        points = [((found[6] @ tool)[:3, 3], 0.0)]
        if plane.whole_arm:
            points += [(at(found, ball.link, ball.place), ball.radius_m) for ball in body.balls]
        values += [float(np.dot(plane.normal, point)) - radius - plane.offset_m for point, radius in points]
    if limits.self_keep_out is not None:
        margin = limits.self_keep_out.margin_m
        values += [apart(found, body.balls[b], body.capsules[c]) - margin for b, c in body.pairs]
    return np.array(values)


def test_rows_are_the_distances_and_their_gradients() -> None:
    limits = LIMITS["all"]
    streaming = UrStreaming(UrKinematics(MODEL, tool=TOOL), limits, period_s=PERIOD_S)
    h = 1e-5
    for step in steps(20, seed=7):
        streaming.velocity(step.q, step.qd, step.twist)
        program, here = streaming.program, distances(limits, step.q, TOOL)
        count = len(here)
        assert count == len(streaming.rows)
        expected = np.minimum(-10.0 * here, 1e-3)
        # The search is right to 1e-9 m, ten times that as a rate.
        np.testing.assert_allclose(program.lower[6 : 6 + count], expected, rtol=0, atol=2e-8)
        for joint in range(6):
            after, before = (distances(limits, step.q + sign * h * np.eye(6)[joint], TOOL) for sign in (1, -1))
            # Central differences of distances that are right to 1e-12 m or so, with curvatures up to 1/0.05 m.
            np.testing.assert_allclose(
                program.rows[:count, joint], (after - before) / (2 * h), rtol=0, atol=2e-6, err_msg=str(streaming.rows)
            )


def test_names_of_rows_say_what_they_are() -> None:
    rows = UrStreaming(UrKinematics(MODEL), LIMITS["all"], period_s=PERIOD_S).rows
    assert rows[:3] == ("planes[0], tool", "planes[0], elbow", "planes[0], forearm")
    assert rows[7] == "planes[1], tool"
    assert rows[8] == "forearm to base"
    assert rows[-1] == "flange to upper arm"


# ------------------------------------------------------------------------------------- closed loops


def drive(streaming: UrStreaming, q: Array, twists: Array) -> tuple[Array, Array, set[str]]:
    """Joint angles and velocities of a run, and why it braked."""
    places, speeds, reasons = [q], [np.zeros(6)], set()
    for twist in twists:
        velocity = streaming.velocity(places[-1], speeds[-1], twist)
        if streaming.reason:
            reasons.add(streaming.reason)
        places.append(places[-1] + velocity * streaming.period_s)
        speeds.append(velocity.copy())
    return np.array(places), np.array(speeds), reasons


@pytest.mark.parametrize("seed", range(2))
def test_a_long_run_keeps_within_every_limit(seed: int) -> None:
    kinematics, limits = UrKinematics(MODEL, tool=TOOL), LIMITS["all"]
    streaming = UrStreaming(kinematics, limits, period_s=PERIOD_S)
    draws = np.random.default_rng(seed)
    # Each wish holds for 0.4 s: into the table, the wall, the arm itself, and beyond every speed.
    twists = np.repeat(draws.normal(0, 1.0, (15, 6)), 200, axis=0)
    q = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3))
    places, speeds, _ = drive(streaming, q, twists)
    assert np.abs(np.diff(speeds, axis=0)).max() <= 8.0 * PERIOD_S + 1e-9
    assert np.abs(speeds).max() <= math.pi + 1e-9
    assert np.abs(places).max() <= 2 * math.pi
    for q_now, qd_now in zip(places[:-1:15], speeds[1::15], strict=True):
        # While it brakes, the tool may be as fast as it was; the joints' acceleration bounds by how much that can be.
        assert np.linalg.norm((kinematics.forward_and_jacobian(q_now)[1] @ qd_now)[:3]) <= 0.4 + 0.03
        # A ball goes 0.5 mm a period, on a path that bends by 1/0.05 m: 6e-6 m beyond, and back at 1 mm/s.
        assert distances(limits, q_now, TOOL).min() >= -1e-3


def test_a_plane_is_approached_and_kept() -> None:
    limits = msgspec.structs.replace(JOINTS, planes=(WALL,))
    kinematics = UrKinematics(MODEL)
    streaming = UrStreaming(kinematics, limits, period_s=PERIOD_S)
    q = np.array((-0.2, -1.5, 1.9, -2.0, -1.57, 0.0))
    # The tool is in front of the base, with the wall at 0.6 m.
    q[0] += math.pi
    assert 0.2 < float(kinematics.forward(q)[0, 3]) < 0.6
    twist = np.array((0.3, 0.1, 0.0, 0.0, 0.0, 0.0))
    places, _, reasons = drive(streaming, q, np.repeat(twist[None], 1500, axis=0))
    x = np.array([kinematics.forward(place)[0, 3] for place in places])
    assert not reasons
    assert x.max() <= 0.6 + 1e-5
    assert x[-1] == pytest.approx(0.6, abs=1e-3)


@pytest.mark.parametrize("calibration", ["ur5", None])
def test_joints_stay_slow_through_the_wrists_singularity(calibration: str | None) -> None:
    model, deltas = CALIBRATIONS[calibration] if calibration else (MODEL, None)
    kinematics = UrKinematics(model, deltas)
    streaming = UrStreaming(kinematics, StreamingLimits(), period_s=PERIOD_S)
    q = np.array((0.4, -1.3, 1.1, 0.6, 0.3, -2.0))
    # Turns the wrist through q5 = 0, with a part of the turn that no joint can do there.
    twists = np.repeat(np.array((0.0, 0.0, 0.0, 0.0, 0.3, 0.2))[None], 1000, axis=0)
    _, speeds, reasons = drive(streaming, q, twists)
    assert not reasons
    # Damped least squares passes on at most 1/(2 sqrt(damping)) of the weighted twist, sqrt(0.1) |twist|: full damping
    # sets in at the singularity only, so twice that.
    assert np.abs(speeds).max() < 2 * math.sqrt(0.1) * 0.36 / (2 * math.sqrt(0.01))


# ------------------------------------------------------------------------------------------ braking


def test_it_brakes_with_a_reason_and_goes_on_after() -> None:
    limits = msgspec.structs.replace(JOINTS, max_tool_speed=0.1)
    streaming = UrStreaming(UrKinematics(MODEL), limits, period_s=PERIOD_S)
    q, fast = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3)), np.array((1.5, -0.01, 0.0, 0.0, 0.0, 0.0))
    # No acceleration within bounds makes the tool slow at once.
    velocity = streaming.velocity(q, fast, np.zeros(6))
    assert "tool speed" in streaming.reason
    assert "must be at most 0.1 m/s" in streaming.reason
    np.testing.assert_allclose(velocity, (1.5 - 8.0 * PERIOD_S, 0.0, 0.0, 0.0, 0.0, 0.0), rtol=0, atol=1e-15)
    for _ in range(200):
        velocity = streaming.velocity(q, velocity, np.zeros(6))
    assert streaming.reason == ""
    np.testing.assert_allclose(velocity, 0, atol=1e-6)


def test_bounds_that_cross_brake_too() -> None:
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    q, qd = np.zeros(6), np.zeros(6)
    q[1], qd[1] = 2 * math.pi - 1e-4, 1.0
    for _ in range(3):
        velocity = streaming.velocity(q, qd, np.ones(6))
        assert "joint 2 must be at least 0.984 rad/s" in streaming.reason
        np.testing.assert_allclose(velocity, (0, 1.0 - 0.016, 0, 0, 0, 0), rtol=0, atol=1e-15)
    qd[1] = 0.0
    streaming.velocity(q, qd, np.ones(6))
    assert streaming.reason == ""


def test_without_an_acceleration_limit_braking_is_standing_still() -> None:
    # Clear of a table below it and of one above it at once: not to be had.
    floor = WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=5.0)
    ceiling = WorkspacePlane(normal=(0.0, 0.0, -1.0), offset_m=5.0)
    streaming = UrStreaming(UrKinematics(MODEL), StreamingLimits(planes=(floor, ceiling)), period_s=PERIOD_S)
    velocity = streaming.velocity(np.ones(6), np.ones(6), np.ones(6))
    assert streaming.reason.startswith("planes[")
    np.testing.assert_array_equal(velocity, np.zeros(6))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(3))
def test_a_number_that_is_not_finite_brakes(bad: float, which: int) -> None:
    streaming = UrStreaming(UrKinematics(MODEL), LIMITS["all"], period_s=PERIOD_S)
    step = steps(1)[0]
    given = [step.q.copy(), np.full(6, 0.1), step.twist.copy()]
    given[which][3] = bad
    velocity = streaming.velocity(*given)
    assert "must be finite" in streaming.reason
    expected = np.zeros(6) if which == 1 else np.full(6, 0.1 - 8.0 * PERIOD_S)
    np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-15)
    streaming.velocity(step.q, np.zeros(6), step.twist)
    assert streaming.reason == ""


@pytest.mark.parametrize("bad", [np.zeros(5), np.zeros((2, 3)), "motion", None])
def test_what_is_no_vector_brakes(bad: Any) -> None:  # noqa: ANN401
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    np.testing.assert_array_equal(streaming.velocity(np.ones(6), np.zeros(6), bad), np.zeros(6))
    assert streaming.reason
    np.testing.assert_array_equal(streaming.velocity(np.ones(6), bad, np.zeros(6)), np.zeros(6))
    assert streaming.reason


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"position_min": (0.0,) * 6}, "must both be given"),
        ({"position_min": (1.0,) * 6, "position_max": (1.0,) * 6}, "position_min = 1.0: must be less than"),
        ({"position_min": (math.nan,) * 6, "position_max": (1.0,) * 6}, "position_min = nan"),
        ({"max_speed": (0.0,) * 6}, "max_speed = 0.0: must be above 0"),
        ({"max_acceleration": (math.inf,) * 6}, "max_acceleration = inf"),
        ({"max_tool_speed": -1.0}, "max_tool_speed = -1.0"),
        ({"approach_rate_hz": 0.0}, "approach_rate_hz = 0.0"),
    ],
)
def test_limits_that_cannot_be_are_refused(fields: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        StreamingLimits(**fields)


def test_parts_of_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="length 1"):
        WorkspacePlane(normal=(0.0, 0.0, 2.0), offset_m=0.0)
    with pytest.raises(ValueError, match="offset_m = nan"):
        WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=math.nan)
    with pytest.raises(ValueError, match="margin_m"):
        SelfKeepOut(margin_m=-0.1)
    with pytest.raises(ValueError, match="radius_m"):
        SelfKeepOut(radius_m=0.0)
    with pytest.raises(ValueError, match="weights"):
        StreamingCost(weights=(0.0,) * 6)
    with pytest.raises(ValueError, match="damping = nan"):
        StreamingCost(damping=math.nan)
    with pytest.raises(ValueError, match="damping_below"):
        StreamingCost(damping_below=0.0)
    for period_s in (0.0, -1.0, 0.11, math.nan):
        with pytest.raises(ValueError, match="period_s"):
            UrStreaming(UrKinematics(MODEL), JOINTS, period_s=period_s)
