"""Couplings with two halves: intervals against eigenvalues and simulated runs, findings against closed forms."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from tests.scene.two_sides import two_sides

from haptether.bridge import Scene, coupling_facts, override_scene, simulate
from haptether.safety import ejection_bound
from haptether.studies import Finding, Follower, check_scene
from haptether.studies.design.contact import scene_numbers
from haptether.studies.design.coupled import (
    CoupledLoop,
    Tool,
    coupled_delays,
    coupled_loops,
    stable_ticks,
    virtual_tool,
)
from haptether.studies.design.couplings import bearable_delays
from haptether.studies.design.gains import advised_coupling

Array = npt.NDArray[np.float64]
KINDS = ("position-force-computed", "position-position", "pd-damped")
MOST_TICKS = 40


def held(matrix: Array, push: Array, period_s: float) -> tuple[Array, Array]:
    """Discretise `x' = A x + B u` under a held u."""
    states, inputs = push.shape
    whole = expm(period_s * np.block([[matrix, push], [np.zeros((inputs, states + inputs))]]))
    return whole[:states, :states], whole[:states, states:]


def queue_matrix(loop: CoupledLoop, ticks: int) -> Array:
    """Return the state matrix of a loop whose messages wait in a queue, all of them on the way back."""
    period_s, tool, arm = loop.period_s, loop.tool, loop.follower
    hand, pushed = held(
        np.array([[0.0, 1.0], [-loop.hand_stiffness / loop.mass_kg, -loop.damping / loop.mass_kg]]),
        np.array([[0.0], [1.0 / loop.mass_kg]]),
        period_s,
    )
    wall = np.array([loop.environment_stiffness, loop.environment_damping])
    follows = arm.damping if arm.follows_velocity else 0.0
    moved, led = held(
        np.array([[0.0, 1.0], [-(arm.stiffness + wall[0]) / arm.mass_kg, -(arm.damping + wall[1]) / arm.mass_kg]]),
        np.array([[0.0, 0.0], [arm.stiffness / arm.mass_kg, follows / arm.mass_kg]]),
        period_s,
    )

    # x_m, v_m, x_m before, x_v, v_v, x_a, v_a, then (x_v, v_a, F_c) of each tick on its way.
    size = 7 + 3 * ticks
    unit = np.eye(size)
    x_m, v_m, before, x_v, v_v, x_a, v_a = unit[:7]
    seen = v_m if loop.velocity is None else (x_m - before) / period_s
    own = (x_a, v_a) if tool is None else (x_v, v_v)
    force = np.array(loop.slave) @ np.stack((*own, x_m, seen))
    sent = np.stack((own[0], v_a, force))
    heard = sent if ticks == 0 else unit[size - 3 :]
    on_hand = -loop.scale * (np.array(loop.master) @ np.vstack((x_m, seen, heard)))
    step = np.zeros((size, size))
    step[:2] = hand @ np.stack((x_m, v_m)) + pushed @ on_hand[None]
    if tool is None:
        inertia = np.array([[0.0, 1.0], [-wall[0] / arm.mass_kg, -(arm.damping + wall[1]) / arm.mass_kg]])
        moved, led = held(inertia, np.array([[0.0], [1.0 / arm.mass_kg]]), period_s)
        step[2], step[5:7] = x_m, moved @ np.stack((x_a, v_a)) + led @ force[None]
    else:
        speed = (v_v + period_s / tool.mass_kg * (force - wall @ np.stack((x_a, v_a)))) / (
            1.0 + period_s * tool.damping / tool.mass_kg
        )
        place = x_v + period_s * speed
        step[2], step[3], step[4] = x_m, place, speed
        step[5:7] = moved @ np.stack((x_a, v_a)) + led @ np.stack((place + tool.lead_s * speed, speed))
    if ticks:
        step[7:10], step[10:] = sent, unit[7 : size - 3]
    return step


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log(low), math.log(high)).map(math.exp)


@st.composite
def loops(draw: st.DrawFn) -> CoupledLoop:
    kind, stiffness, damping = draw(st.sampled_from(KINDS)), draw(floats(50.0, 1500.0)), draw(floats(0.3, 10.0))
    facts = coupling_facts(kind, stiffness=stiffness, damping=damping)
    assert facts.master is not None
    assert facts.slave is not None
    mass_kg, pole = draw(floats(0.5, 6.0)), draw(floats(30.0, 200.0))
    follows = draw(st.booleans())
    share = 1.0 if not follows else 0.25
    tool = Tool(mass_kg=draw(floats(0.2, 5.0)), damping=draw(floats(0.5, 20.0)), lead_s=draw(st.floats(0.0, 0.02)))
    arm = Follower(
        mass_kg=mass_kg,
        stiffness=share * mass_kg * pole**2,
        damping=2.0 * share**0.5 * mass_kg * pole,
        follows_velocity=follows,
    )
    takes_force = draw(st.booleans())
    return CoupledLoop(
        period_s=1e-3,
        mass_kg=draw(floats(0.05, 0.5)),
        damping=draw(floats(0.1, 3.0)),
        hand_stiffness=draw(floats(10.0, 100.0)),
        scale=draw(floats(0.3, 2.0)),
        master=tuple(facts.master),
        slave=tuple(facts.slave),
        velocity=draw(st.sampled_from([None, (1e3, -1e3)])),
        tool=None if takes_force else tool,
        follower=Follower(mass_kg=mass_kg, stiffness=0.0, damping=tool.damping) if takes_force else arm,
        environment_stiffness=draw(st.sampled_from([0.0, 100.0, 1000.0, 5000.0])),
        environment_damping=draw(st.floats(0.0, 5.0)),
    )


@given(loop=loops(), ticks=st.integers(0, MOST_TICKS))
def test_intervals_agree_with_the_eigenvalues_of_the_loop_with_its_queue(loop: CoupledLoop, ticks: int) -> None:
    intervals = stable_ticks(loop, MOST_TICKS)
    ends = [end for interval in intervals for end in interval if 0.0 < end < MOST_TICKS]
    for tried in {ticks, *map(math.floor, ends[:2]), *map(math.ceil, ends[:2])}:
        largest = float(np.abs(np.linalg.eigvals(queue_matrix(loop, tried))).max())
        is_stable = any(low <= tried <= high for low, high in intervals)
        if abs(largest - 1.0) > 1e-5:
            assert is_stable == (largest < 1.0), (tried, largest)


def linear(kind: str, gains: tuple[float, float], stiffness: float, delay_s: float) -> Scene:
    """Return a linear loop: a soft hand nudges the device, whose arm hangs on a spring."""
    link = {"delay_s": delay_s}
    spring = {"shape": {"kind": "spring"}, "contact": {"stiffness": stiffness}}
    return two_sides(
        run={"duration_s": 6.0, "diverged_position": 1e3, "diverged_speed": 1e3},
        master={"device": None, "mass_kg": 0.157, "viscous": 0.1, "encoder_quantum": 0.0},
        operator={
            "stiffness": 30.0, "damping": 0.5, "grip_strength_n": None, "start": 0.0,
            "legs": [{"duration_s": 0.3, "end": 0.01}, {"duration_s": 0.1, "end": 0.0}],
        },
        slave={"max_speed": "unbounded"},
        environment={"objects": [spring]},
        coupling={"kind": kind, "stiffness": gains[0], "damping": gains[1], "command_speed": "unbounded"},
        link={"forward": link, "backward": link},
        safety={"limiter": {"enabled": False}},
    )  # fmt: skip


def growth(scene: Scene) -> float:
    """Return the logarithmic growth of the device's speed between two late times."""
    run = simulate(scene)
    if run.metrics.diverged:
        return math.inf
    time_s, speed = run.signals.time_s, np.abs(np.ravel(run.signals.velocity))
    early, late = (speed[(time_s > at) & (time_s < at + 1.5)].max() for at in (2.5, 4.4))
    return math.log(late / early)


TAKES_FORCE = ("slave.takes_force=true", "slave.mass_kg=1.5", "slave.viscous=4", "slave.max_force_n=1000")
PD_ARM = ("slave.control=pd", "slave.stiffness=2000", "slave.damping=60")


@pytest.mark.parametrize(
    ("kind", "gains", "stiffness", "overrides"),
    [
        ("pd-damped", (300.0, 2.0), 400.0, ("master.measures_velocity=true",)),
        ("pd-damped", (300.0, 2.0), 400.0, ()),
        ("pd-damped", (300.0, 2.0), 400.0, ("coupling.force_scale=0.5", "coupling.position_scale=1.5")),
        ("position-position", (200.0, 1.0), 400.0, ()),
        ("position-position", (400.0, 10.0), 2000.0, ("slave.control=velocity",)),
        ("position-force-computed", (300.0, 8.0), 400.0, ()),
        ("position-force-computed", (150.0, 4.0), 400.0, PD_ARM),
        ("pd-damped", (1000.0, 2.0), 400.0, TAKES_FORCE),
        ("position-force-computed", (150.0, 4.0), 400.0, TAKES_FORCE),
    ],
)
def test_simulated_sides_swing_beyond_the_interval_and_settle_within(
    kind: str, gains: tuple[float, float], stiffness: float, overrides: tuple[str, ...]
) -> None:
    def scene(ticks: int) -> Scene:
        return override_scene(linear(kind, gains, stiffness, ticks * 1e-3), overrides)

    (loop,) = coupled_loops(scene(0))
    ((low, high),) = stable_ticks(loop, 100)
    assert low == 0.0
    assert 5.0 < high < 90.0
    # A tick each way is two of d.
    last = math.floor(high / 2.0)
    assert growth(scene(last)) < 0.0 < growth(scene(last + 1))


@pytest.mark.parametrize("control", ["position", "velocity", "pd"])
def test_virtual_tool_is_that_of_the_run(control: str) -> None:
    pd = {"stiffness": 3000.0, "damping": 80.0} if control == "pd" else {}
    scene = two_sides(
        run={"duration_s": 1.5},
        slave={"control": control, **pd},
        coupling={"kind": "pd-damped"},
        environment={"objects": [{"contact": {"stiffness": 100.0}}, {"contact": {"stiffness": 700.0}}]},
    )
    tool = virtual_tool(scene_numbers(scene))
    told = [
        f"coupling.tool_mass_kg={tool.mass_kg!r}",
        f"coupling.tool_damping={tool.damping!r}",
        f"coupling.tool_lead_s={tool.lead_s!r}",
    ]
    command = simulate(scene).signals.slave_command
    assert np.ptp(command) > 0.01
    # The two sides round 2 pi in different orders.
    np.testing.assert_allclose(simulate(override_scene(scene, told)).signals.slave_command, command, atol=1e-9)
    other = override_scene(scene, [f"coupling.tool_mass_kg={1.5 * tool.mass_kg!r}"])
    assert np.abs(simulate(other).signals.slave_command - command).max() > 1e-5


def pressing(round_trip_s: float, **changed: Any) -> Scene:  # noqa: ANN401  # tables as in TOML
    """Return a hand that presses a stiff wall through an arm that takes positions."""
    link = {"delay_s": round_trip_s / 2.0}
    return two_sides(
        run={"duration_s": 8.0},
        operator={"stiffness": 100.0, "damping": 3.0},
        environment={"objects": [{"contact": {"stiffness": 2000.0}}]},
        link={"forward": link, "backward": link},
        **changed,
    )


@pytest.mark.parametrize("round_trip_s", [0.004, 0.04, 0.2])
def test_the_advised_coupling_holds_contact_at_its_closed_form(round_trip_s: float) -> None:
    scene = pressing(round_trip_s)
    advised = advised_coupling(scene, 0.5)
    assert advised is not None
    run = simulate(override_scene(scene, advised.changes))
    late = np.ravel(run.signals.environment_force)[run.signals.time_s > 6.5]
    assert scene.operator is not None
    arm = coupled_loops(override_scene(scene, advised.changes))[0].follower.stiffness
    series = 1.0 / scene.operator.stiffness + 1.0 / advised.stiffness + 1.0 / arm + 1.0 / 2000.0
    # Coulomb friction of the device holds back up to c.
    assert np.ptp(late) < 1e-3
    assert late.mean() == pytest.approx(0.03 / series, abs=0.038 / (series * 100.0))
    least = coupling_facts(advised.kind, stiffness=advised.stiffness, round_trip_s=round_trip_s + 2e-3).least_damping
    assert least is not None
    assert advised.damping > least


def found(scene: Scene, name: str, **options: Any) -> Finding | None:  # noqa: ANN401
    return next((one for one in check_scene(scene, **options).findings if one.name == name), None)


def test_little_damping_is_a_warning_and_the_advised_value_mends_it() -> None:
    scene = pressing(0.04, coupling={"kind": "pd-damped", "stiffness": 100.0, "damping": 1.0})
    finding = found(scene, "passivity")
    assert finding is not None
    assert finding.state == "warning"
    # K (T1 + T2) / 2 + K dT, with the two ticks of the sides.
    assert finding.value == pytest.approx(100.0 * (0.042 / 2.0 + 1e-3))
    assert finding.changes == ("coupling.damping=2.9",)
    after = found(override_scene(scene, finding.changes), "passivity", remedies=False)
    assert after is not None
    assert after.state == "good"


def test_a_delay_beyond_the_interval_is_bad_and_other_gains_mend_it() -> None:
    scene = linear("pd-damped", (300.0, 2.0), 400.0, 0.02)
    finding = found(scene, "delay margin")
    assert finding is not None
    assert finding.state == "bad"
    assert finding.limit == pytest.approx(bearable_delays(scene, 0.5)[0])
    assert finding.changes
    mended = override_scene(scene, finding.changes)
    after = found(mended, "delay margin", remedies=False)
    assert after is not None
    assert after.state == "good"
    assert growth(scene) > 0.0 > growth(mended)


def test_felt_stiffness_is_that_of_springs_in_series() -> None:
    finding = found(pressing(0.01, coupling={"kind": "position-position"}), "felt stiffness", remedies=False)
    assert finding is not None
    arm = 4.0 * (2.0 * math.pi * 15.0) ** 2
    assert finding.value == pytest.approx(1.0 / (1.0 + 2000.0 * (1.0 / 100.0 + 1.0 / arm)))


def test_a_delay_counts_with_the_tick_of_the_hold_and_all_loops_have_to_be_stable() -> None:
    scene = linear("pd-damped", (300.0, 2.0), 400.0, 0.02)
    (loop,) = coupled_loops(scene)
    (low, high), *_ = stable_ticks(loop, 100)
    ((begin_s, end_s),) = coupled_delays([loop], 0.1)
    assert (begin_s, end_s) == pytest.approx((low * 1e-3, (high + 1.0) * 1e-3))
    free = coupled_loops(scene, held=False)
    assert coupled_delays([loop, *free], 0.1) == coupled_delays([*free, loop], 0.1)
    assert bearable_delays(scene, 0.1, 100.0)[0] > bearable_delays(scene, 0.1)[0]


def test_a_coupling_is_advised_where_position_force_lacks_margin_only() -> None:
    near, far = pressing(0.0), pressing(0.2, safety={"limiter": {"max_force_n": 4.0}})
    for scene in (near, far):
        finding, advice = found(scene, "delay margin", remedies=False), found(scene, "coupling")
        assert finding is not None
        assert (advice is not None) == (finding.state in {"bad", "warning"})
    advice = found(far, "coupling")
    assert advice is not None
    assert 'kind = "pd-damped"' in advice.text


@pytest.mark.parametrize("kind", ["position-force", *KINDS])
def test_the_bound_of_hsc_holds_for_couplings_whose_push_does_not_grow(kind: str) -> None:
    scene = pressing(0.01, coupling={"kind": kind}, master={"stops": [[-0.08, 0.08]]}, safety={"controllers": ["hsc"]})
    may_grow = coupling_facts(kind).push_may_grow
    bound = ejection_bound(scene)
    assert (bound.speed is None) == may_grow
    assert ("may grow" in (bound.reason or "")) == may_grow
    assert (found(scene, "push", remedies=False) is not None) == may_grow
    watched = override_scene(scene, ["safety.controllers=[hsc, wsc]"])
    both = ejection_bound(watched)
    assert both.speed is not None
    assert any("neither grows" in one for one in both.assumptions) == (not may_grow)
