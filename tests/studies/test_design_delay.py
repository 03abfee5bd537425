"""Largest delay of a coupling, against the closed forms and tables of docs and literature."""

import math
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.scene.two_sides import two_sides

from haptether.bridge import Scene, load_scene, override_scene, simulate
from haptether.cli.live.sides import START_M, baseline_scene
from haptether.netsim import LinkSettings
from haptether.studies import (
    ContactLoop,
    Follower,
    LinkSummary,
    judge_link,
    largest_delay_s,
    scene_loops,
    scene_times,
    summarise_link,
)

DELAYS_S = (1e-3, 10e-3, 20e-3, 50e-3, 100e-3, 200e-3, 500e-3)
# Critical stiffness of m x'' + b x' + K x(t - T) = 0 in N/m, four digits.
DELAYED_SPRING = {
    (0.1, 0.5): (500.4, 50.41, 25.41, 10.40, 5.374, 2.837, 1.256),
    (0.1, 5.0): (5041, 537.4, 283.7, 125.6, 67.92, 36.09, 15.13),
    (1.0, 5.0): (5004, 504.1, 254.1, 103.9, 53.74, 28.37, 12.56),
}
SLOW_ARM = Follower(mass_kg=2.0, damping=80.0, stiffness=800.0, follows_velocity=True)


@pytest.mark.parametrize(("mass_kg", "damping"), DELAYED_SPRING)
def test_a_delayed_spring_oscillates_at_its_critical_stiffness(mass_kg: float, damping: float) -> None:
    for stiffness, delay_s in zip(DELAYED_SPRING[mass_kg, damping], DELAYS_S, strict=True):
        found_s = largest_delay_s(ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness))
        # The table has four digits; K goes as 1/T or weaker, so T is off by at most twice as much.
        assert found_s == pytest.approx(delay_s, rel=1e-3)


@pytest.mark.parametrize("stiffness", [0.3, 7.0, 200.0, 1e4])
@pytest.mark.parametrize("damping", [0.05, 2.0, 40.0])
def test_it_is_the_closed_form(stiffness: float, damping: float) -> None:
    mass_kg = 0.157
    # w² from |m (jw)² + b jw| = K, and T = atan(b / (m w)) / w.
    ratio = damping**2 / (2.0 * mass_kg**2)
    frequency = math.sqrt(-ratio + math.hypot(ratio, stiffness / mass_kg))
    expected_s = math.atan2(damping, mass_kg * frequency) / frequency
    loop = ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness)
    assert largest_delay_s(loop) == pytest.approx(expected_s, rel=1e-7)
    scaled = ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness / 4.0, force_scale=4.0)
    assert largest_delay_s(scaled) == pytest.approx(expected_s, rel=1e-7)


@pytest.mark.parametrize(
    ("force_scale", "delay_s"),
    [
        (0.334, 2e-3), (0.284, 5e-3), (0.232, 10e-3), (0.178, 20e-3), (0.124, 50e-3), (0.0988, 100e-3),
        (0.0739, 200e-3), (0.0358, 500e-3),
    ],
)  # fmt: skip
def test_an_arm_that_follows_slowly_is_part_of_the_loop(force_scale: float, delay_s: float) -> None:
    loop = ContactLoop(
        mass_kg=0.1, damping=5.0, environment_stiffness=1000.0, force_scale=force_scale, follower=SLOW_ARM
    )
    # The scales have three digits; the delays are up to three times as sensitive to them.
    assert largest_delay_s(loop) == pytest.approx(delay_s, rel=0.01)


@pytest.mark.parametrize(
    ("damping", "stiffness", "critical"),
    [(1, 1e2, 0.45), (1, 1e4, 0.054), (5, 1e2, 3.23), (5, 1e3, 0.383), (20, 1e3, 3.61), (20, 1e5, 0.0945)],
)
def test_beyond_the_scale_that_no_delay_bears_it_bears_none(damping: float, stiffness: float, critical: float) -> None:
    def at(force_scale: float) -> float:
        return largest_delay_s(
            ContactLoop(
                mass_kg=0.1,
                damping=damping,
                environment_stiffness=stiffness,
                force_scale=force_scale,
                follower=SLOW_ARM,
            )
        )

    assert at(0.98 * critical) > 0.0
    assert at(1.02 * critical) == 0.0


def test_a_soft_wall_under_a_firm_hand_bears_any_delay() -> None:
    loop = ContactLoop(mass_kg=0.157, damping=8.0, hand_stiffness=300.0, environment_stiffness=100.0)
    assert largest_delay_s(loop) == math.inf


def test_the_arm_of_check_link_is_the_simulated_one() -> None:
    (loop,) = scene_loops(baseline_scene())
    assert loop.follower is not None
    assert loop.follower.stiffness == pytest.approx(4.0 * (2.0 * math.pi * 15.0) ** 2, rel=1e-12)


@pytest.mark.parametrize(("share", "grows"), [(0.7, False), (1.4, True)])
def test_the_bridge_in_virtual_time_oscillates_beyond_it(share: float, grows: bool) -> None:
    """Sample the same loop, with a hand that holds: calm below the largest delay, growing above."""
    stiffness = 400.0
    wall = {"objects": [{"contact": {"stiffness": stiffness}}]}
    (loop,) = scene_loops(two_sides(environment=wall))
    # Each side adds half a period of hold, see `judge_link`, and waits for a tick for half a period on average.
    link = LinkSettings(delay_s=(share * largest_delay_s(loop) - 2e-3) / 2.0)
    scene = two_sides(
        run={"duration_s": 4.0},
        master={"encoder_quantum": 0.0, "max_force_n": "unbounded"},
        operator={"grip_strength_n": 1e3, "start": START_M, "legs": [{"duration_s": 1.2, "end": -0.045}]},
        environment=wall,
        link={"forward": link, "backward": link},
        safety={"limiter": {"max_force_n": 1e3}},
    )
    signals = simulate(scene).signals
    velocity = np.abs(signals.velocity)
    early, late = (float(velocity[(signals.time_s > at) & (signals.time_s < at + 0.5)].max()) for at in (1.7, 3.4))
    if grows:
        assert late > 0.1
    else:
        assert late < 1e-3 or late < 0.5 * early


def linear_scene(**changed: Any) -> Scene:  # noqa: ANN401  # tables as in TOML
    """Return a linear loop: a hand nudges the device, whose arm hangs on a spring."""
    raw: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": 4.0, "diverged_position": 1e3, "diverged_speed": 1e3},
        "master": {"mass_kg": 0.157, "viscous": 0.1, "encoder_quantum": 0.0},
        "operator": {
            "stiffness": 300.0,
            "damping": 8.0,
            "legs": [{"duration_s": 0.3, "end": 0.01}, {"duration_s": 0.1, "end": 0.0}],
        },
        "slave": {"max_speed": "unbounded"},
        "environment": {"objects": [{"shape": {"kind": "spring"}, "contact": {"stiffness": 400.0}}]},
        "coupling": {"command_speed": "unbounded"},
        "safety": {"limiter": {"enabled": False}},
        "record": {},
    }
    for table, fields in changed.items():
        raw[table] = {**raw.get(table, {}), **fields}
    return msgspec.convert(raw, Scene)


def critical_scale(scene: Scene) -> float:
    """Find lambda_f at which the simulated loop starts to oscillate, by bisection in virtual time."""

    def grows(force_scale: float) -> bool:
        run = simulate(scene, overrides=[f"coupling.force_scale={force_scale}"])
        time_s, speed = run.signals.time_s, np.abs(np.ravel(run.signals.velocity))
        if run.metrics.diverged:
            return True
        early, late = (speed[(time_s > at) & (time_s < at + 0.6)].max() for at in (1.6, 3.3))
        return bool(late > early)

    low, high = 1e-2, 20.0
    for _ in range(14):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return math.sqrt(low * high)


@pytest.mark.parametrize(
    ("delay_s", "period_s", "slave_period_s"),
    [(1e-3, 1e-3, 1e-3), (5e-3, 1e-3, 1e-3), (2e-2, 1e-3, 1e-3), (8e-3, 4e-3, 4e-3), (8e-3, 1e-3, 4e-3)],
)
def test_the_sampled_loop_is_later_than_its_round_trip_by_one_period(
    delay_s: float, period_s: float, slave_period_s: float
) -> None:
    """Each side adds half a period of hold.

    The delays are whole periods, so that no frame waits for a tick and the round trip is twice the delay. Two sides of
    different periods exchange messages at the slower period.
    """
    link = {"delay_s": delay_s}
    scene = linear_scene(
        run={"period_s": period_s}, slave={"period_s": slave_period_s}, link={"forward": link, "backward": link}
    )
    (loop,) = scene_loops(override_scene(scene, [f"coupling.force_scale={critical_scale(scene)}"]))
    longest_s = max(period_s, slave_period_s)
    assert scene_times(scene) == (longest_s, 0.02)
    # A hold is a delay of half a period up to terms of (w dT)²; at w of 50 rad/s and 4 ms that is a few percent.
    later_s = largest_delay_s(loop) - 2.0 * delay_s
    assert later_s == pytest.approx(longest_s, rel=0.06)


def summary_of(round_trip_s: float, early_s: float | None = None) -> LinkSummary:
    fields: dict[str, Any] = dict.fromkeys(LinkSummary.__struct_fields__, 0)
    return msgspec.structs.replace(
        LinkSummary(**fields), round_trip_p01_s=round_trip_s if early_s is None else early_s,
        round_trip_p50_s=round_trip_s, round_trip_p99_s=round_trip_s, worst_gap_s=1e-3, silence_at_end_s=0.0,
    )  # fmt: skip


POCKETS = ((0.0, 0.03), (0.057, 0.131))


@pytest.mark.parametrize(
    ("early_s", "late_s", "good", "between"),
    [
        (0.02, 0.025, True, False), (0.02, 0.035, False, False), (0.04, 0.05, False, False), (0.05, 0.07, False, False),
        (0.06, 0.12, True, True), (0.06, 0.14, False, False), (0.2, 0.2, False, False), (0.02, 0.07, False, False),
    ],
)  # fmt: skip
def test_a_link_is_borne_in_later_intervals_if_its_early_and_its_late_round_trips_are(
    early_s: float, late_s: float, good: bool, between: bool
) -> None:
    verdict = judge_link(summary_of(late_s, early_s), 0.03, 0.02, 1e-3, stable_delays_s=POCKETS)
    assert (verdict.good, verdict.is_between) == (good, between)
    # The JSON of `check-link` contains it.
    assert msgspec.to_builtins(verdict)["is_between"] == between
    if not good:
        assert "bearable is 30.0 ms, and 57.0 to 131.0 ms" in verdict.complaints[0]
    # Without the intervals only the first bound counts.
    assert judge_link(summary_of(late_s, early_s), 0.03, 0.02, 1e-3).good == (late_s + 1e-3 < 0.03)


def test_half_of_the_round_trips_below_a_later_interval_are_not_borne() -> None:
    """Use round trips of 50 ms and 120 ms, half each: median and 99 % quantile are in 57 to 131 ms."""
    ticks = 1000
    fields: dict[str, Any] = {"round_trip_s": np.where(np.arange(ticks) % 2, 0.05, 0.12), "age_s": np.zeros(ticks)}
    fields |= {"time_s": 1e-3 * np.arange(ticks), "overshoot_s": np.zeros(ticks)}
    zero = SimpleNamespace(sent=0, fresh=0, late=0, missing=0)
    path = SimpleNamespace(
        jitter_s=0.0, bursts=0, longest_burst=0, reordered=0, usual_age_s=None, offset_s=None, offset_bound_s=None,
        clock_faults=0, last_clock_fault=None,
    )  # fmt: skip
    report: Any = SimpleNamespace(realtime="", link=zero, path=path, recording=None, skipped=0)
    trace: Any = SimpleNamespace(**fields)
    summary = summarise_link(trace, report)
    assert summary.round_trip_p01_s == pytest.approx(0.05)
    verdict = judge_link(summary, 0.03, 0.02, 1e-3, stable_delays_s=POCKETS)
    assert not verdict.good
    assert not verdict.is_between
    assert "a delay of 51.0 to 121.0 ms" in verdict.complaints[0]


def test_the_verdict_counts_the_delay_of_the_sampled_loop() -> None:
    at_edge = judge_link(summary_of(0.0099), 0.011, 0.02, 1e-3)
    assert at_edge.delay_s == pytest.approx(0.0109)
    assert at_edge.good
    assert not judge_link(summary_of(0.0101), 0.011, 0.02, 1e-3).good
    assert judge_link(summary_of(0.01), 0.011, 0.02, 4e-3).delay_s == pytest.approx(0.014)


def test_the_loop_without_a_scene_is_that_of_the_device_the_hand_the_arm_and_the_wall() -> None:
    (loop,) = scene_loops(baseline_scene())
    # A PHANTOM Desktop in the hand, and the arm at 15 Hz.
    pole = 2.0 * math.pi * 15.0
    assert loop == ContactLoop(
        mass_kg=0.157,
        damping=8.0 - 0.005,
        hand_stiffness=300.0,
        environment_stiffness=100.0,
        follower=Follower(mass_kg=4.0, damping=2.0 * 4.0 * pole, stiffness=4.0 * pole**2),
    )
    assert scene_loops(two_sides()) == [loop]


@pytest.mark.parametrize(
    ("override", "field", "value"),
    [
        ("master.mass_kg=0.4", "mass_kg", 0.4),
        ("master.viscous=0.5", "damping", 8.5),
        ("operator.damping=2.0", "damping", 2.0 - 0.005),
        ("operator.stiffness=50", "hand_stiffness", 50.0),
        ("slave.mass_kg=9", "follower", Follower(mass_kg=9.0, damping=1696.46, stiffness=79943.8)),
        ("environment.objects.0.contact.stiffness=700", "environment_stiffness", 700.0),
        ("environment.objects.0.contact.damping=3", "environment_damping", 3.0),
        ("coupling.force_scale=0.3", "force_scale", 0.3),
        ("coupling.position_scale=2", "position_scale", 2.0),
        ("coupling.changes=[{at_s=1.0, force_scale=1.7}]", "force_scale", 1.7),
    ],
)
def test_the_loop_is_the_scenes(override: str, field: str, value: object) -> None:
    scene = two_sides()
    (loop,) = scene_loops(override_scene(scene, [override]))
    found = getattr(loop, field)
    if isinstance(value, Follower):
        assert msgspec.to_builtins(found) == pytest.approx(msgspec.to_builtins(value), rel=1e-5)
    else:
        assert found == pytest.approx(value)


def test_scenes_of_several_axes_count_each_that_is_felt() -> None:
    scene = load_scene("ur_peg")
    assert len(scene_loops(scene)) == 3
    assert len(scene_loops(override_scene(scene, ["coupling.locked_axes=[1]"]))) == 2
    unequal = override_scene(scene, ["master.mass_kg=[0.05, 0.2, 0.3]"])
    assert [loop.mass_kg for loop in scene_loops(unequal)] == [0.05, 0.2, 0.3]
    # Without a contact nothing oscillates.
    free = msgspec.structs.replace(scene, environment=None)
    assert all(largest_delay_s(loop) == math.inf for loop in scene_loops(free))
    assert all(loop.environment_stiffness == 250.0 for loop in scene_loops(free, 250.0))


def test_a_law_that_is_not_linear_counts_with_its_slope_at_the_largest_force() -> None:
    law = '{law="hunt-crossley", stiffness=2e4, exponent=1.5, damping=0.5}'
    scene = override_scene(
        two_sides(),
        [f"environment.objects.0.contact={law}", "safety.limiter.max_force_n=5.0"],
    )
    (loop,) = scene_loops(scene)
    depth = (5.0 / 2e4) ** (1.0 / 1.5)
    step = 1e-6 * depth
    slope = (2e4 * (depth + step) ** 1.5 - 2e4 * (depth - step) ** 1.5) / (2.0 * step)
    assert loop.environment_stiffness == pytest.approx(slope, rel=1e-6)
    assert loop.environment_damping == pytest.approx(0.5 * 5.0)


def test_a_damped_contact_bears_its_own_delay() -> None:
    """`m x'' + b x' + (K + B d/dt) x(t - T)`: at the limit `|K + jwB| = |m w² - jwb|`, with phases pi apart."""
    mass_kg, damping, stiffness, contact = 0.2, 4.0, 900.0, 1.5
    loop = ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness, environment_damping=contact)
    delay_s = largest_delay_s(loop)
    # Find w by bisection on the difference of the two magnitudes, which grows with w here.
    low, high = 1.0, 1e4
    for _ in range(200):
        w = 0.5 * (low + high)
        grown = abs(complex(-mass_kg * w * w, damping * w)) > abs(complex(stiffness, contact * w))
        low, high = (low, w) if grown else (w, high)
    loop_at = complex(stiffness, contact * w) / complex(-mass_kg * w * w, damping * w)
    phase = (math.pi + math.atan2(loop_at.imag, loop_at.real)) % (2.0 * math.pi)
    assert delay_s == pytest.approx(phase / w, rel=1e-6)
