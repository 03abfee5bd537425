"""Streamed joint velocities keep within every named limit, period after period."""

import math

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st
from tests.ur.kinematics.streaming_cases import JOINTS, LIMITS, MODEL, PERIOD_S, TABLE, WALL, steps

from haptether.slave import SelfKeepOut, StreamingCost, StreamingLimits, UrKinematics, UrStreaming, ur_model
from haptether.slave.ur.kinematics.chain import DhRows, cos_sin, dh_rows
from haptether.slave.ur.kinematics.constraints import Ball, Capsule, arm_body, link_levers, plane_levers
from haptether.slave.ur.kinematics.program import BoundedProgram
from ur.arms import CALIBRATIONS, TOOL

Array = npt.NDArray[np.float64]


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
    # The joint follows the upper bound of the program; the task's own velocity does not matter here.
    for _ in range(round((distance / speed + speed / acceleration) / period_s) + 10):
        streaming.velocity(q, qd, np.zeros(6))
        after = streaming.program.upper[:6]
        assert (after - qd >= -acceleration * period_s - 1e-9).all()
        assert (after <= speed).all()
        q, qd = q + after * period_s, after
        assert (q <= 3.0 + 1e-12).all()
    # The remaining distance is below a step of braking over a period.
    assert (3.0 - q <= acceleration * period_s**2 + 1e-9).all()


def test_past_its_end_a_joint_may_only_go_back() -> None:
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    q = np.array((0.3, -1.2, 1.4, 0.2, 0.9, 6.5))
    for twist in np.vstack((np.eye(6), -np.eye(6))):
        velocity = streaming.velocity(q, np.zeros(6), twist)
        assert streaming.reason == ""
        assert velocity[5] <= 1e-12
    assert streaming.program.lower[5] == pytest.approx(-8.0 * PERIOD_S)


def frames(rows: DhRows, q: Array) -> list[Array]:
    """Return base_from_link of every link, in plain NumPy."""
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
    """Return the distance by a search along the capsule's axis, without the closed form."""
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
        # The search is accurate to 1e-9 m, ten times that as a rate.
        np.testing.assert_allclose(program.lower[6 : 6 + count], expected, rtol=0, atol=2e-8)
        for joint in range(6):
            after, before = (distances(limits, step.q + sign * h * np.eye(6)[joint], TOOL) for sign in (1, -1))
            # Central differences of distances that are accurate to about 1e-12 m, with curvatures up to 1/0.05 m.
            np.testing.assert_allclose(
                program.rows[:count, joint], (after - before) / (2 * h), rtol=0, atol=2e-6, err_msg=str(streaming.rows)
            )


def test_names_of_rows_say_what_they_are() -> None:
    rows = UrStreaming(UrKinematics(MODEL), LIMITS["all"], period_s=PERIOD_S).rows
    assert rows[:3] == ("planes[0], tool", "planes[0], elbow", "planes[0], forearm")
    assert rows[7] == "planes[1], tool"
    assert rows[8] == "forearm to base"
    assert rows[-1] == "flange to upper arm"


def drive(streaming: UrStreaming, q: Array, twists: Array) -> tuple[Array, Array, set[str]]:
    """Return joint angles and velocities of a run, and its reasons to brake."""
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
    # Each wish lasts 0.4 s: into the table, the wall, the arm itself, and beyond every speed.
    twists = np.repeat(draws.normal(0, 1.0, (15, 6)), 200, axis=0)
    q = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3))
    places, speeds, _ = drive(streaming, q, twists)
    assert np.abs(np.diff(speeds, axis=0)).max() <= 8.0 * PERIOD_S + 1e-9
    assert np.abs(speeds).max() <= math.pi + 1e-9
    assert np.abs(places).max() <= 2 * math.pi
    for q_now, qd_now in zip(places[:-1:15], speeds[1::15], strict=True):
        # While it brakes, the tool may keep its speed; the joints' acceleration bounds the excess.
        assert np.linalg.norm((kinematics.forward_and_jacobian(q_now)[1] @ qd_now)[:3]) <= 0.4 + 0.03
        # A ball moves 0.5 mm per period on a path that bends by 1/0.05 m: 6e-6 m beyond, and back at 1 mm/s.
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


def test_tool_that_begins_beyond_a_plane_goes_no_further() -> None:
    limits = msgspec.structs.replace(JOINTS, planes=(WALL,))
    kinematics = UrKinematics(MODEL)
    q = np.array((-0.2 + math.pi, -1.2, 1.1, -2.0, -1.57, 0.0))
    begin = kinematics.forward(q)[0, 3]
    assert begin > 0.61
    still, outward = np.zeros((200, 6)), np.repeat(np.array(((0.2, 0.1, 0.0, 0.0, 0.0, 0.0),)), 200, axis=0)
    for twists in (still, outward):
        streaming = UrStreaming(kinematics, limits, period_s=PERIOD_S)
        streaming.begin(q)
        places, _, reasons = drive(streaming, q, twists)
        assert not reasons
        x = np.array([kinematics.forward(place)[0, 3] for place in places])
        # The path bends by 1/0.7 m at 0.1 m/s, while the sideways speed builds up.
        assert np.abs(x - begin).max() < 5e-6
        assert streaming.held_by == ("planes[0], tool" if twists is outward else "")
    # Without `begin` it comes back, at 1 mm/s.
    places, _, _ = drive(UrStreaming(kinematics, limits, period_s=PERIOD_S), q, still)
    assert kinematics.forward(places[-1])[0, 3] - begin == pytest.approx(-0.4e-3, abs=2e-5)


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
    # Damped least squares passes on at most 1/(2 sqrt(damping)) of the weighted twist, sqrt(0.1) |twist|. Full damping
    # sets in only at the singularity, so twice that.
    assert np.abs(speeds).max() < 2 * math.sqrt(0.1) * 0.36 / (2 * math.sqrt(0.01))


KEEP_OUT = msgspec.structs.replace(JOINTS, self_keep_out=SelfKeepOut())


@pytest.mark.parametrize("name", ["ur3e", "ur5e", "ur10e", "ur20"])
def test_no_distance_of_the_arm_to_itself_changes_faster_than_its_levers(name: str) -> None:
    kinematics = UrKinematics(ur_model(name))
    near = BoundedProgram(kinematics, KEEP_OUT, StreamingCost(), PERIOD_S)
    fastest = np.zeros(6)
    for q in np.random.default_rng(6).uniform(-math.pi, math.pi, (3000, 6)):
        near.function.all(q, np.zeros(6), np.zeros(6))
        fastest = np.maximum(fastest, np.abs(near.quadratic.rows).max(axis=0))
    levers = np.array(link_levers(kinematics))
    assert (fastest <= levers + 1e-12).all(), (fastest, levers)
    # Levers far above the observed rates would make the arm seem near itself everywhere.
    assert (fastest[2:5] >= 0.5 * levers[2:5]).all(), (fastest, levers)
    assert (levers[0], levers[5]) == (0.0, 0.0)


# At the limit of the tool's speed, the limit is met to a relative 1e-9, and joints to that over a singular value of
# 0.05.
@pytest.mark.parametrize(("max_tool_speed", "tolerance"), [(None, 1e-9), (0.4, 1e-8)])
def test_skipping_the_self_keep_out_check_changes_nothing(max_tool_speed: float | None, tolerance: float) -> None:
    # The thicker links also apply to the planes.
    limits = msgspec.structs.replace(
        JOINTS, max_tool_speed=max_tool_speed, planes=(TABLE, WALL), self_keep_out=SelfKeepOut(radius_m=0.07)
    )
    kinematics = UrKinematics(MODEL)
    streaming = UrStreaming(kinematics, limits, period_s=PERIOD_S)
    whole = BoundedProgram(kinematics, limits, StreamingCost(), PERIOD_S)
    draws = np.random.default_rng(8)
    apart = free = held = m = 0.0
    for _ in range(40):
        # The elbow is folded up to a small angle or hardly at all, so that runs begin near and far.
        q, qd = np.array((0.3, -1.5, draws.uniform(1.5, 2.9), -1.0, -1.4, 0.2)), np.zeros(6)
        streaming.begin(q)
        whole.begin(q, np.zeros(3))
        twist = draws.normal(0, 0.7, 6)
        for _ in range(150):
            velocity = streaming.velocity(q, qd, twist)
            whole.function.all(q, qd, twist)
            expected, m = whole.minimum(m)
            assert (expected is None) == (streaming.reason != "")
            if expected is not None:
                np.testing.assert_allclose(velocity, expected, rtol=0, atol=tolerance)
                # If two rows are equal, either may hold. At the limit of the tool's speed, weights are known to a part
                # in 1e3.
                sums = [found.multipliers[6:].sum() for found in (streaming, whole)]
                assert sums[0] == pytest.approx(sums[1], rel=1e-2, abs=1e-3)
                held += (whole.multipliers[6:] < 0).any()
            program = streaming.program
            np.testing.assert_array_equal(program.rows, whole.quadratic.rows)
            np.testing.assert_array_equal(program.lower, whole.quadratic.lower)
            if streaming.looks_away:
                planes = streaming._last.quadratic.lower
                np.testing.assert_array_equal(planes, whole.quadratic.lower[: len(planes)])
            apart += streaming.looks_away
            free += streaming._last is streaming._free
            q, qd = q + velocity * PERIOD_S, velocity
    assert apart > 1000, apart
    assert free > 300, free
    assert held > 300, held


def test_no_distance_to_a_plane_changes_faster_than_its_levers() -> None:
    tool = np.eye(4)
    tool[:3, 3] = 0.05, -0.02, 0.2
    kinematics = UrKinematics(MODEL, tool=tool)
    draws = np.random.default_rng(12)
    for planes in ((TABLE,), (WALL,), (TABLE, WALL)):
        near = BoundedProgram(kinematics, StreamingLimits(planes=planes), StreamingCost(), PERIOD_S)
        fastest = np.zeros(6)
        for q in draws.uniform(-math.pi, math.pi, (3000, 6)):
            near.function.all(q, np.zeros(6), np.zeros(6))
            fastest = np.maximum(fastest, np.abs(near.quadratic.rows).max(axis=0))
        levers = np.array(plane_levers(kinematics, planes))
        assert (fastest <= levers + 1e-12).all(), (fastest, levers)
        # For the last joint only the tool's offset along its axis counts, which is not a lever.
        assert (fastest[1:5] >= 0.5 * levers[1:5]).all(), (fastest, levers)


def test_a_run_before_planes_is_the_same_without_a_look_at_them() -> None:
    """Without an active limit runs are bit-identical. With one, the solver may start elsewhere: rounding differs."""
    limits = msgspec.structs.replace(JOINTS, planes=(TABLE, WALL))
    kinematics = UrKinematics(MODEL)
    streaming = UrStreaming(kinematics, limits, period_s=PERIOD_S)
    whole = BoundedProgram(kinematics, limits, StreamingCost(), PERIOD_S)
    q, qd = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3)), np.zeros(6)
    seen, exact = {True: 0, False: 0}, 0
    for index in range(2000):
        twist = np.array((0.3 * math.sin(index / 300), 0.1, 0.0, 0.0, 0.0, 0.4))
        velocity = streaming.velocity(q, qd, twist)
        whole.function.all(q, qd, twist)
        expected, _ = whole.minimum(0.0)
        assert expected is not None
        seen[streaming.looks_away] += 1
        if streaming.looks_away:
            assert not whole.multipliers[6:].any()
            is_held = whole.multipliers.any()
            np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-13 if is_held else 0.0)
            exact += not is_held
        q, qd = q + velocity * PERIOD_S, velocity
    assert seen[True] > 1000, seen
    assert seen[False] > 10, seen
    assert exact > 50, exact
