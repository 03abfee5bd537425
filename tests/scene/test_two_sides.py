"""Both sides of the bridge in virtual time, against closed forms and netsim's own verdicts."""

import math
import pickle
import re
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from tests.scene.two_sides import reports, two_sides

from haptether.bridge import (
    LinkStatistics,
    Run,
    SceneError,
    ladder_reason,
    ladder_state_name,
    simulate,
)
from haptether.netsim import (
    Attack,
    Forge,
    LinkSettings,
    Mirror,
    Replay,
    Target,
    judge,
    judge_all,
    link_bounds,
)

TICK_NS = 1_000_000
MASS = 0.157
DEVICE = {"device": None, "mass_kg": MASS}
START, TARGET = 0.02, -0.03
HAND_STIFFNESS = 600.0
WALL_STIFFNESS = 200.0
OPEN = {"limiter": {"max_force_n": 100.0, "max_slew_n_per_s": 1e6, "max_power_w": 1e4}}
"""Bounds that a sound run never reaches."""

PERFECT = LinkSettings()
# 50 ms +- 10 ms.
ROUGH = LinkSettings(delay_s=0.05, jitter_s=0.01 / math.sqrt(3.0), distribution="uniform", loss=0.01)
DEAD = LinkSettings(loss=1.0)

COUNTS = ("sent", "fresh", "late", "duplicate", "refused", "missing")
ROUND_TRIPS = ("round_trip_s", "least_round_trip_s")


def links(forward: LinkSettings, backward: LinkSettings | None = None) -> dict[str, LinkSettings]:
    return {"forward": forward, "backward": forward if backward is None else backward}


def press(
    *,
    forward: LinkSettings = PERFECT,
    backward: LinkSettings | None = None,
    seed: int = 0,
    duration_s: float = 3.0,
    wall_stiffness: float = WALL_STIFFNESS,
    hand_damping: float = 20.0,
) -> Run:
    """Run a hand that goes from before a remote wall to a target inside it within 1 s, and stays."""
    hand = {"stiffness": HAND_STIFFNESS, "damping": hand_damping, "grip_strength_n": 500.0, "start": START}
    scene = two_sides(
        run={"duration_s": duration_s, "seed": seed},
        master=DEVICE,
        operator={**hand, "legs": [{"duration_s": 1.0, "end": TARGET}]},
        environment={"objects": [{"contact": {"stiffness": wall_stiffness}}]},
        safety=OPEN,
        link=links(forward, backward),
    )
    return simulate(scene)


def contact_stiffness() -> float:
    """Return the stiffness that the master feels: the wall and the arm, of 4 kg and 15 Hz, as springs in series."""
    return 1.0 / (1.0 / (4.0 * (30.0 * math.pi) ** 2) + 1.0 / WALL_STIFFNESS)


def series_force() -> float:
    """Return the force of hand, arm and wall in series, stretched from the surface to the target."""
    return -TARGET / (1.0 / HAND_STIFFNESS + 1.0 / contact_stiffness())


def contents(run: Run) -> list[bytes]:
    counts = [getattr(report.link, n) for report in reports(run) for n in (*COUNTS, *ROUND_TRIPS)]
    return [*(signal.tobytes() for signal in run.signals.values()), repr(counts).encode()]


def test_every_signal_has_one_number_a_tick() -> None:
    run = press(duration_s=0.25)
    for name, signal in run.signals.items():
        assert signal.dtype == (np.uint8 if name in {"tripped", "state", "slave_state"} else np.float64)
        assert signal.shape == (250,)
    for time_s in (run.signals.time_s, run.signals.slave_time_s):
        assert np.allclose(time_s, np.arange(250) * 1e-3, rtol=0.0, atol=1e-15)
    for report in reports(run):
        assert (report.ticks, report.skipped, report.dropped_records, report.unsent) == (250, 0, 0, 0)


def test_the_same_seed_gives_the_same_bytes() -> None:
    runs = [contents(press(forward=ROUGH, duration_s=1.5, seed=seed)) for seed in (4, 4, 5)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_a_perfect_network_needs_no_seed() -> None:
    assert contents(press(seed=1)) == contents(press(seed=2))


def test_contact_settles_where_the_springs_in_series_do() -> None:
    run = press(duration_s=4.0)
    signals, force = run.signals, series_force()
    # 3 s after the end of the path the slowest mode, above 20 /s, has decayed to e^-60; rounding remains.
    tolerance = 1e-12 * HAND_STIFFNESS
    assert abs(signals.rendered_force[-1] - force) <= tolerance
    assert abs(signals.environment_force[-1] - force) <= tolerance
    assert abs(signals.hand_force[-1] + force) <= tolerance
    assert abs(signals.position[-1] - (TARGET + force / HAND_STIFFNESS)) <= 1e-12
    # Nothing bounds the force.
    assert np.array_equal(signals.device_force, signals.rendered_force)
    assert not signals.tripped.any()
    # A frame reaches the slave in the same tick and the master in the next.
    assert [report.engaged_s for report in reports(run)] == [0.001, 0.001]
    assert {report.link.round_trip_s for report in reports(run)} == {0.001}
    assert np.isnan(signals.age_s[0])
    assert not signals.age_s[1:].any()


def test_the_slave_follows_from_where_it_stands() -> None:
    scene = two_sides(
        run={"duration_s": 2.0},
        master=DEVICE,
        operator={
            "stiffness": 600.0, "damping": 20.0, "grip_strength_n": 500.0, "start": 0.1,
            "legs": [{"duration_s": 0.5, "end": 0.15, "shape": "linear"}],
        },
        slave={"position": -3.0},
        environment=None,
        coupling={"position_scale": 0.4},
    )  # fmt: skip
    signals = simulate(scene).signals
    # x_s = x_s0 + lambda_p (x_m - x_m0), with both taken at engagement; the command does not jump before.
    assert np.all(signals.slave_command[:2] == -3.0)
    expected = -3.0 + 0.4 * (signals.position[1:] - 0.1)
    assert np.all(abs(signals.slave_command[1:] - expected) <= 1e-14)
    assert abs(signals.slave_position[-1] - (-3.0 + 0.4 * 0.05)) <= 1e-12


def test_the_force_is_scaled_and_fades_in() -> None:
    scene = two_sides(
        run={"duration_s": 1.0},
        master=DEVICE,
        operator={"stiffness": 600.0, "damping": 20.0, "grip_strength_n": 500.0, "start": 0.0, "legs": []},
        environment={"objects": [], "pushers": [{"force_n": 6.0, "duration_s": 0.5}]},
        coupling={"force_scale": 0.5},
        safety=OPEN,
    )
    signals = simulate(scene).signals
    # The slave engages at tick 1 and is shoved from then on: the master hears of it at tick 2.
    assert np.array_equal(signals.environment_force[2:501], np.full(499, 6.0))
    gain = np.clip(np.arange(1000) / 200.0, 0.0, 1.0)
    expected = 0.5 * gain[3:501] * 6.0
    # The gain adds up 1/200 at each tick: 200 roundings of at most 1.
    assert np.all(abs(signals.rendered_force[3:501] - expected) <= 3.0 * 200 * 2.0**-53)
    assert not signals.rendered_force[:2].any()
    assert not signals.rendered_force[503:].any()


@pytest.mark.parametrize(("forward", "backward"), [(DEAD, DEAD), (DEAD, PERFECT), (PERFECT, DEAD)])
def test_without_frames_the_sides_never_engage(forward: LinkSettings, backward: LinkSettings) -> None:
    run = press(forward=forward, backward=backward, duration_s=1.0)
    signals = run.signals
    # The press is never answered; the slave aligns once it receives the press.
    assert {ladder_state_name(int(code)) for code in signals.state} == {"aligning"}
    expected = {"disengaged"} if forward == DEAD else {"aligning"}
    assert {ladder_state_name(int(code)) for code in signals.slave_state} == expected
    assert not signals.device_force.any()
    assert not signals.rendered_force.any()
    assert np.all(signals.position == START), "the hand waits"
    assert np.all(signals.slave_position == START)
    for report in reports(run):
        assert report.engaged_s == np.inf
        assert report.holds == 0
        assert report.link.sent == 1000
        # Nobody receives an echo while one direction is dead.
        assert report.link.least_round_trip_s == 0.0
    if backward == DEAD:
        assert np.all(np.isnan(signals.age_s))


def test_a_gentle_wall_stays_bounded_under_delay_jitter_and_loss() -> None:
    run = press(forward=ROUGH, duration_s=6.0, seed=11)
    signals = run.signals
    # The hand has a damping ratio of 20 / (2 sqrt(600 m)) = 1.03, the arm in contact 0.997 (overshoot below 1e-17).
    # Neither amplifies an input beyond its static gain. Delay, jitter, loss and hold pass on nothing larger than what
    # was sent. So sup F <= K (d + sup F / K_h), K < K_h.
    stiffness = contact_stiffness()
    bound = stiffness * -TARGET / (1.0 - stiffness / HAND_STIFFNESS)
    assert signals.rendered_force.max() <= bound
    assert abs(signals.position).max() <= -TARGET + bound / HAND_STIFFNESS
    # A round trip with settling takes below 0.2 s and leaves K/K_h = 1/3 of the error. Of about 9 N, 3e-10 remain 4 s
    # after the end of the path, 1e-12 after 5 s.
    assert abs(signals.rendered_force[-1] - series_force()) <= 1e-10
    assert np.ptp(signals.position[-1000:]) <= 3e-9 / HAND_STIFFNESS
    assert np.ptp(signals.slave_position[-1000:]) <= 3e-9 / HAND_STIFFNESS
    assert [report.holds for report in reports(run)] == [0, 0]
    # Engagement needs an echo: one delay in each direction, plus a few ticks for lost frames.
    for report in reports(run):
        assert 0.08 <= report.engaged_s <= 0.13
        assert 0.08 <= report.link.least_round_trip_s <= report.link.round_trip_s <= 0.121
    assert signals.age_s[200:].max() <= 0.02


def test_a_stiff_wall_under_the_same_network_does_not() -> None:
    # The bound is not trivial: with 15 times the stiffness and a loose hand the motion grows.
    signals = press(forward=ROUGH, duration_s=6.0, seed=11, wall_stiffness=3000.0, hand_damping=5.0).signals
    assert len(signals.time_s) == 6000
    assert signals.rendered_force[-1000:].max() > 5 * series_force()
    assert np.ptp(signals.position[-1000:]) > -TARGET


def received(
    settings: LinkSettings, direction: Literal["forward", "backward"], seed: int, ticks: int
) -> npt.NDArray[np.int64]:
    """Return the sequence numbers in their order of arrival, by netsim's verdicts alone."""
    due = judge(settings, np.arange(ticks, dtype=np.int64) * TICK_NS, direction=direction, seed=seed)
    order = np.argsort(due, kind="stable")
    order = order[(due[order] >= 0) & (due[order] <= (ticks - 1) * TICK_NS)]
    # The master's last tick comes before the slave's last frame.
    return order if direction == "forward" else order[order < ticks - 1]


@pytest.mark.parametrize(
    ("forward", "backward"),
    [
        (PERFECT, PERFECT),
        (ROUGH, ROUGH),
        (LinkSettings(loss=0.3), LinkSettings(delay_s=0.003, jitter_s=0.0015, keep_order=False)),
        (
            LinkSettings(delay_s=0.2, jitter_s=0.1, jitter_correlation_s=0.0, keep_order=False, loss=0.5),
            LinkSettings(delay_s=5.0),
        ),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_counts_are_those_of_the_verdicts(forward: LinkSettings, backward: LinkSettings, seed: int) -> None:
    ticks = 1500
    master, slave = reports(press(forward=forward, backward=backward, seed=seed, duration_s=1.5))
    directions: list[tuple[LinkStatistics, LinkSettings, Literal["forward", "backward"]]] = [
        (slave.link, forward, "forward"),
        (master.link, backward, "backward"),
    ]
    for link, settings, direction in directions:
        arrived = received(settings, direction, seed, ticks)
        assert link.sent == ticks
        assert link.fresh + link.late == len(arrived)
        assert (link.duplicate, link.refused) == (0, 0)
        newest = np.maximum.accumulate(arrived)
        assert link.fresh == len(np.unique(newest))
        # The count spans the first arrival to the newest; frames before the first are not counted.
        if len(arrived):
            span = newest[-1] - arrived[0] + 1
            assert link.missing == span - np.count_nonzero(arrived >= arrived[0])
        else:
            assert link.missing == 0


def test_a_shove_is_felt_less_with_a_safety_controller() -> None:
    def highest_speed(*controllers: str) -> float:
        scene = two_sides(
            run={"duration_s": 2.0},
            operator={
                "stiffness": 600.0, "damping": 20.0, "grip_strength_n": 40.0, "start": 0.0, "legs": [],
                "release": {"at_s": 1.0, "decay_s": 0.04},
            },
            environment={"objects": [], "pushers": [{"at_s": 0.9, "force_n": 6.0, "duration_s": 0.25}]},
            safety={"controllers": controllers},
            link=links(ROUGH),
        )  # fmt: skip
        signals = simulate(scene).signals
        assert not controllers or signals.tripped.any()
        return float(abs(signals.velocity).max())

    loose = highest_speed()
    # 6 N on 0.157 kg for the rest of the shove is far beyond the hand's own motion.
    assert loose > 2.0
    for name in ("hsc", "wsc"):
        assert highest_speed(name) < 0.5 * loose


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("coupling.force_scale=0.0", "[coupling] force_scale = 0: must be above 0"),
        ("coupling.position_scale=-1.0", "[coupling] position_scale = -1: must be above 0"),
        ("run.period_s=0.0", "[run] period_s = 0: must be"),
        ("slave.period_s=0.021", "[slave] period_s = 0.021: must be"),
        ("run.period_s=nan", "[run] period_s = nan: must be"),
        ("slave.position=inf", "[slave] position = inf: must be"),
        ("safety.grasp_threshold=1.0", "[safety] grasp_threshold = 1: must be above 1"),
        ('safety.estimator={kind="low-pass", cutoff_hz=501.0}', "cutoff_hz"),
        *((f"run.duration_s={bad}", "[run] duration_s = ") for bad in (-1.0, 0.0, "nan", "inf")),
    ],
)
def test_sides_that_cannot_be_are_refused(override: str, said: str) -> None:
    with pytest.raises(SceneError, match=re.escape(said)):
        simulate(two_sides(), overrides=[override])


@pytest.mark.parametrize(("duration_s", "period_s", "ticks"), [(0.001, 1e-3, 1), (0.3, 1e-3, 300), (0.0105, 5e-3, 2)])
def test_a_run_has_the_whole_ticks_of_its_duration(duration_s: float, period_s: float, ticks: int) -> None:
    run = simulate(two_sides(run={"duration_s": duration_s, "period_s": period_s}, operator=None))
    assert len(run.signals.time_s) == len(run.signals.slave_time_s) == ticks
    assert {report.ticks for report in reports(run)} == {ticks}


def test_a_scene_without_an_arm_has_no_loops_to_report() -> None:
    run = simulate(two_sides(run={"duration_s": 0.1}, operator=None, slave=None))
    assert run.reports is None
    kept = simulate(two_sides(run={"duration_s": 0.1}, operator=None))
    assert pickle.loads(pickle.dumps(kept)).metrics == kept.metrics


def test_the_names_of_the_ladder() -> None:
    names = [ladder_state_name(code) for code in range(7)]
    assert names == ["disengaged", "aligning", "engaged", "stale", "hold", "stop", "fault"]
    with pytest.raises(ValueError, match=r"^state 7: must be 0 to 6$"):
        ladder_state_name(7)
    assert ladder_reason(4) == "peer is silent"
    with pytest.raises(ValueError, match=r"^reason 0: must be 1 to 24$"):
        ladder_reason(0)


def test_the_report_says_what_the_link_did() -> None:
    """One second at 5 ms each way: the same frames as the link counts, and our own clock."""
    forward = LinkSettings(delay_s=0.005, loss=0.1, mean_burst=3.0)
    master, slave = reports(press(forward=forward, backward=LinkSettings(delay_s=0.005), seed=2, duration_s=1.0))
    there, back = slave.path, master.path
    assert (there.lost, there.received) == (slave.link.missing, slave.link.fresh)
    assert there.loss == pytest.approx(there.lost / there.expected)
    assert there.lost == pytest.approx(there.bursts * there.mean_burst)
    assert there.longest_burst >= 3
    assert (back.lost, back.bursts, back.reordered, back.jitter_s) == (0, 0, 0, 0.0)
    assert back.rate_hz == pytest.approx(1000.0)
    assert there.worst_gap_s == pytest.approx(1e-3 * (there.longest_burst + 1))
    for path in (there, back):
        assert (path.clock_steps, path.clock_faults, path.last_clock_fault) == (0, 0, None)
        assert path.offset_s is not None
        assert path.offset_bound_s is not None
        assert abs(path.offset_s) <= path.offset_bound_s <= 0.006
        # The age has both directions and the wait for a tick; the expected age lies above the median by the jitter.
        assert path.usual_age_s is not None
        assert 0.010 <= path.usual_age_s <= 0.020


def counts(forward: LinkSettings) -> tuple[LinkStatistics, LinkStatistics]:
    """Return the counts of master and slave in a second of this network."""
    master, slave = reports(press(forward=forward, backward=LinkSettings(delay_s=0.005), seed=2, duration_s=1.0))
    return master.link, slave.link


def expected(forward: LinkSettings, cause: str) -> int:
    """Return how often a cause takes effect within the second."""
    sent = np.arange(1000, dtype=np.int64) * TICK_NS
    verdicts = judge_all(forward, sent, seed=2, sizes=124)
    return int(np.count_nonzero(verdicts.causes_of(cause) & (verdicts.t_out_ns <= 999 * TICK_NS)))


def test_a_copy_is_a_frame_that_had_arrived_before() -> None:
    forward = LinkSettings(delay_s=0.005, duplicate=0.1, duplicate_gap_s=0.002)
    _, slave = counts(forward)
    # A tenth of 1000 packets: 100 +- 4 * 9.5.
    assert slave.duplicate == expected(forward, "duplicate")
    assert 60 <= slave.duplicate <= 140
    assert (slave.refused, slave.late, slave.missing) == (0, 0, 0)


@pytest.mark.parametrize(
    ("cause", "settings"),
    [
        ("corrupt", {"corrupt": 0.1, "corrupt_bits": 3}),
        ("truncate", {"truncate": 0.1, "truncate_bytes": 50}),
        ("forge", {"attacks": (Attack(action=Forge(keep_bytes=64), target=Target(every=10)),)}),
    ],
)
def test_what_is_damaged_is_refused_by_its_checksum(cause: str, settings: dict[str, Any]) -> None:
    forward = LinkSettings(delay_s=0.005, **settings)
    _, slave = counts(forward)
    assert slave.refused == expected(forward, cause)
    assert 60 <= slave.refused <= 140


def test_what_is_sent_back_reaches_its_sender_who_refuses_it() -> None:
    forward = LinkSettings(delay_s=0.005, attacks=(Attack(action=Mirror(), target=Target(every=10)),))
    master, slave = counts(forward)
    assert master.refused == expected(forward, "mirror") > 90
    assert (slave.refused, slave.duplicate) == (0, 0)


def test_a_replay_seconds_later_is_held_back_until_then() -> None:
    """More frames are in transit than the delay alone explains."""
    forward = LinkSettings(attacks=(Attack(action=Replay(after_s=0.5)),))
    _, slave = counts(forward)
    assert slave.duplicate == expected(forward, "replay") == 500


def test_a_link_has_bounds() -> None:
    assert link_bounds(LinkSettings()) == (0.0, 0.0)
    assert link_bounds(LinkSettings(delay_s=0.05)) == (0.05, 0.0)
    assert link_bounds(LinkSettings(preset="starlink"))[1] == np.inf
    assert link_bounds(LinkSettings(delay_s=0.05, jitter_s=0.01, distribution="lognormal"))[0] == np.inf


@pytest.mark.parametrize("period_us", [700, 900, 1100, 1300, 1620, 1700, 1900])
@pytest.mark.parametrize("mass_kg", [0.002, 0.003, 0.0077])
def test_default_damping_is_within_its_bound_at_any_period(period_us: int, mass_kg: float) -> None:
    """The default is m / (5 dT) of the decimal period; the endpoint's period is in whole ns."""
    master = {"device": None, "mass_kg": mass_kg}
    run = {"period_s": period_us * 1e-6, "duration_s": 0.02}
    assert simulate(two_sides(master=master, run=run, safety={"controllers": ["wsc", "pc"]})).metrics.ticks > 0
