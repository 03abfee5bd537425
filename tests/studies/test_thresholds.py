"""Thresholds: intervals against exact sums, hands and releases, counts of tasks, the command."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import binom, chi2

from haptether.bridge import RecordTable, load_population, load_scene, override_scene, save_scene, simulate
from haptether.cli.entry import main
from haptether.studies import (
    EVALUATED_NETWORKS,
    THRESHOLD_LAWS,
    THRESHOLD_TASKS,
    HandBounds,
    ThresholdLaw,
    TradeOff,
    measure_thresholds,
)
from haptether.studies.intervals import median_interval, poisson_interval, wilson_interval
from haptether.studies.task import FIXED, STIFFER, Task, refuse_fixed

pytestmark = pytest.mark.slow

WSC = ThresholdLaw(
    name="WSC", controller="wsc", source="paper", threshold="energy_threshold_j", unit="J", values=(-1e-4, -0.03, -9.0)
)


@pytest.mark.parametrize(
    ("count", "low", "high"),
    [(0, 0.0, 3.689), (1, 0.0253, 5.572), (5, 1.623, 11.668), (10, 4.795, 18.390), (100, 81.364, 121.627)],
)
def test_an_interval_of_a_count_is_the_published_one(count: int, low: float, high: float) -> None:
    """Garwood 1936, to the digits of the table."""
    assert poisson_interval(count) == pytest.approx((low, high), abs=6e-4)


def test_an_interval_of_a_share_has_its_closed_forms() -> None:
    z2 = 1.959964**2
    assert wilson_interval(0, 10) == pytest.approx((0.0, z2 / (10 + z2)))
    assert wilson_interval(10, 10) == pytest.approx((10 / (10 + z2), 1.0))


@pytest.mark.parametrize("count", [6, 8, 9, 10, 12, 20, 101, 1040, 5000])
def test_the_interval_of_a_median_is_the_narrowest_that_holds_it_at_95_percent(count: int) -> None:
    found = median_interval([float(value) for value in range(count, 0, -1)])
    assert found is not None
    low, high = found
    rank = int(low)
    assert high == count + 1 - rank
    beyond = 2.0 * binom.cdf(np.array([rank - 1, rank]), count, 0.5)
    assert beyond[1] > 0.05
    assert beyond[0] <= 0.05


@pytest.mark.parametrize("count", range(6))
def test_fewer_than_six_values_have_no_interval_of_their_median(count: int) -> None:
    """The outermost of five values contain it with only 1 - 2 / 32 = 94 %."""
    assert median_interval([float(value) for value in range(count)]) is None


@pytest.mark.parametrize("count", [1, 999, 20_000, 300_000])
def test_an_interval_of_many_counts_has_its_quantiles_of_chi_squared(count: int) -> None:
    exact = 0.5 * chi2.ppf(0.025, 2 * count), 0.5 * chi2.ppf(0.975, 2 * count + 2)
    assert poisson_interval(count) == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("name", THRESHOLD_TASKS)
def test_hands_are_the_same_at_every_round_trip_and_stiffer_than_what_they_feel(name: str) -> None:
    near, far = Task(name, 0.0), Task(name, 0.3)
    bounds = HandBounds()
    hands, again = near.hands(50, 7, bounds), far.hands(50, 7, bounds)
    for path, values in hands.items():
        np.testing.assert_array_equal(values, again[path])
    stiffness = hands["operator.stiffness"]
    assert stiffness.min() >= STIFFER * near.felt_stiffness()
    assert stiffness.max() <= bounds.stiffness[1]
    assert np.ptp(hands["operator.damping"]) > 5.0
    assert (near.hands(50, 8, bounds)["operator.stiffness"] != stiffness).all()


@pytest.fixture(scope="module")
def wall() -> TradeOff:
    return measure_thresholds(
        tasks=("paper_wall", "free_motion"), laws=(WSC,), round_trips_s=(0.0, 0.1), hands=4, releases=2, threads=1
    )


def test_the_most_sensitive_threshold_trips_most_and_the_dullest_misses_all(wall: TradeOff) -> None:
    for round_trip_s in wall.round_trips_s:
        counts = [wall.over("WSC", value, round_trip_s=round_trip_s) for value in WSC.values]
        trips, missed = [of.false_trips for of in counts], [of.missed for of in counts]
        assert trips[0] > trips[1] >= trips[2] == 0
        # 9 J are never stored here: this threshold acts like no controller.
        assert missed[0] <= missed[1] < missed[2] == counts[2].releases > 0
    # In the air nothing is felt, so there is no release.
    assert wall.over("WSC", -0.03, task="free_motion").releases == 0
    held = wall.over("WSC", -0.03, task="free_motion", round_trip_s=0.0).hours * 3600.0
    bounds = HandBounds()
    # The scene at its slowest, then out, in and out again.
    assert held == pytest.approx(4 * (2.5 * bounds.pace[1] + 3 * bounds.withdrawal_s[1]), rel=1e-3)


def test_threads_change_nothing(wall: TradeOff) -> None:
    again = measure_thresholds(
        tasks=wall.tasks, laws=(WSC,), round_trips_s=wall.round_trips_s, hands=4, releases=2, threads=2
    )
    assert again.rows == wall.rows


def test_a_velocity_threshold_spares_hands_that_take_up_a_load_and_catches_those_that_let_go() -> None:
    laws = [
        ThresholdLaw(name=name, controller="hsc", source=name, threshold="hsc_force_threshold_n", unit="N",
                     values=(0.1,), fixed={"hsc_velocity_threshold": slowest})
        for name, slowest in (("printed", 0.0), ("ours", 0.05))
    ]  # fmt: skip
    found = measure_thresholds(
        tasks=("sliding_mass", "active_force"), laws=laws, round_trips_s=(0.0,), hands=6, releases=3, threads=1
    )
    printed, ours = (found.over(law.name, 0.1) for law in laws)
    assert printed.releases > 0
    assert ours.missed == printed.missed == 0
    assert ours.false_trips < 0.5 * printed.false_trips


def test_the_command_has_a_row_for_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target, picture = tmp_path / "found.json", tmp_path / "found.png"
    arguments = ["--controller", "vfc", "--round-trip-s", "0.0", "--hands", "2", "--releases", "1", "--threads", "1"]
    assert main(["thresholds", "active_force", *arguments, "--json", str(target), "--plot", str(picture)]) == 0
    laws = [law for law in THRESHOLD_LAWS if law.controller == "vfc"]
    found = json.loads(target.read_text())
    rows, points = found["rows"], found["points"]
    assert len(points) == len(rows)
    low, high = points[0]["false_trips_per_h_interval"]
    assert low <= points[0]["false_trips_per_h"] <= high
    assert [(row["law"], row["threshold"]) for row in rows] == [(law.name, at) for law in laws for at in law.values]
    assert {row["task"] for row in rows} == {"active_force"}
    shown = capsys.readouterr().out
    assert "VFC, as printed" in shown
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--hands", "0"], "hands = 0: must be 1 or more"),
        (["--seed", "-1"], "seed = -1: must be 0 or more"),
        (["--controller", "pc"], "'pc' is none of hsc, vfc, wsc"),
        (["--plot", "picture"], "must end in .png"),
        (["--round-trip-s"], "round_trips_s = []: must be one or more, each once"),
        (["--round-trip-s", "0", "0.1", "0"], "round_trips_s = [0.0, 0.1, 0.0]: must be one or more, each once"),
        (["--round-trip-s", "-0.1"], "--round-trip-s -0.1: must be 0 to 60 s"),
        (["--set", "safety.probe_force_n=0.6"], "safety.probe_force_n is the same for every law here, or the law"),
        (["--set", "safety.energy_threshold_j=-0.1"], "safety.energy_threshold_j is the same for every law here"),
    ],
)
def test_what_cannot_be_is_refused(arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["thresholds", "paper_wall", *arguments]) == 2
    assert problem in capsys.readouterr().err


def test_what_never_engages_is_no_measurement() -> None:
    found = measure_thresholds(tasks=("remote_push",), laws=(WSC,), round_trips_s=(30.0,), hands=1, threads=1)
    for point in found.points():
        assert (point.false_trips_per_h, point.false_trips_per_h_interval, point.missed_share) == (None, None, None)


@pytest.mark.parametrize(
    ("override", "leaf"),
    [
        ("safety={controllers=['wsc']}", "safety.controllers"),
        ("safety.rotation.controllers=[wsc]", "safety.rotation.controllers"),
        ("link={forward={delay-s=1.0}}", "link.forward.delay_s"),
        ("environment.delay-ticks=3", "environment.delay_ticks"),
        ("operator.stiffness=100", "operator.stiffness"),
        ("operator.tremor.amplitude=0", "operator.tremor.amplitude"),
        ("run.seed=3", "run.seed"),
        ("run.duration-s=3", "run.duration_s"),
        ("safety={}", "safety"),
    ],
)
def test_what_a_task_sets_is_refused_however_it_is_written(override: str, leaf: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"{override}: {leaf} is set")):
        refuse_fixed([override], FIXED, "is set")
    refuse_fixed(["safety={window=10}", "operator.legs.0.end=0.1", "coupling.force_scale=0.5"], FIXED, "is set")


def test_what_a_scene_has_beside_its_delay_is_named_where_a_network_replaces_it() -> None:
    steady = EVALUATED_NETWORKS[0]
    driving = Task("driving_network", 0.1, network=steady)
    assert driving.replaced() == ("driving_network is run without what its own link has: preset.",)
    attacked = Task("raven_hijack", 0.1, network=steady).replaced()
    assert "attacks" in attacked[0]
    assert attacked[1:] == ("raven_hijack is run without its security.",)
    # Clocks are not part of a network.
    clocked = Task("remote_push", 0.1, ["link.master_clock.drift_ppm=30"], network=steady)
    assert clocked.held.link is not None
    assert clocked.held.link.master_clock is not None
    assert clocked.held.link.master_clock.drift_ppm == 30


def test_controllers_of_torque_and_trigger_are_those_of_the_force() -> None:
    overrides = ["safety.rotation.controllers=[wsc]", "safety.gripper.controllers=[vfc]"]
    scene = override_scene(load_scene("torque_release"), overrides[:1])
    alone = Task("torque_release", 0.0).with_controllers(scene, None, {})
    assert simulate(alone).metrics.max_ejection_rate == pytest.approx(22.9, abs=0.1)
    rotation = Task("torque_release", 0.0).with_controllers(scene, "hsc", {}).safety.rotation
    assert rotation is not None
    assert rotation.controllers is None
    gripper = Task("torque_release", 0.0).with_controllers(
        override_scene(load_scene("felt_trigger"), overrides[1:]), None, {}
    )
    assert gripper.safety.gripper is not None
    assert gripper.safety.gripper.controllers is None


def test_each_hand_lets_go_while_it_feels_more_than_half_of_its_own_largest_force() -> None:
    task, bounds = Task("paper_wall", 0.1), HandBounds()
    hands = task.hands(3, 1, bounds)
    held = task.hold(task.with_controllers(task.lasting(bounds), None, {}), hands, 1)
    found = task.releases(hands, held, 3)
    assert found is not None
    recorded = replace(task.with_controllers(task.lasting(bounds), None, {}), record=RecordTable())
    for hand, at_s in enumerate(found.rows["operator.release.at_s"]):
        run = simulate(task.alone(recorded, hands, hand))
        felt = np.abs(run.signals["device_force"])
        assert felt[round(at_s * 1e3)] >= 0.5 * felt.max() > 0.0
    # Hands with their own paces have different times.
    assert np.unique(found.rows["run.duration_s"]).size == 3


def test_held_time_is_coupled_time() -> None:
    """A link that fails at 2 s causes one HOLD, and the rest of the run is not held."""
    network = "[{times={kind='once', at_s=2.0, duration_s=9.0}}]"
    task, bounds = Task("remote_push", 0.02, [f"link.forward.outages={network}"]), HandBounds()
    (run,) = task.hold(task.with_controllers(task.lasting(bounds), None, {}), task.hands(1, 1, bounds), 1)
    assert run.engaged_s is not None
    assert run.holds == 1
    assert run.coupled_s == pytest.approx(2.0 - run.engaged_s, abs=0.1)


def test_a_scene_by_its_path_has_the_hands_of_its_name(tmp_path: Path) -> None:
    save_scene(load_scene("paper_wall"), tmp_path / "paper_wall.toml")
    by_name, by_path = Task("paper_wall", 0.0), Task(str(tmp_path / "paper_wall.toml"), 0.0)
    for path, values in by_name.hands(3, 1, HandBounds()).items():
        np.testing.assert_array_equal(values, by_path.hands(3, 1, HandBounds())[path])


def test_a_scene_without_a_hand_is_no_task(tmp_path: Path) -> None:
    nobody = replace(load_scene("paper_wall"), operator=None)
    save_scene(nobody, tmp_path / "nobody.toml")
    with pytest.raises(ValueError, match="nobody holds its device"):
        Task(str(tmp_path / "nobody.toml"), 0.0)


def test_hands_of_a_population_do_a_task_where_they_are_stiff_enough() -> None:
    bounds = HandBounds(population="stylus-arm")
    near, far = Task("remote_push", 0.0), Task("remote_push", 0.3)
    hands, usual = near.hands(20, 3, bounds), near.hands(20, 3, HandBounds())
    assert hands.keys() == usual.keys()
    drawn = load_population("stylus-arm").draws(64 * 20, 3)
    stiff = drawn["operator.stiffness"] >= 1.25 * near.felt_stiffness()
    # The hands are the first complete draws that are stiff enough, for any round trip. Fields that the population lacks
    # are drawn as before.
    for path in ("operator.stiffness", "operator.damping", "operator.tremor.amplitude", "operator.tremor.frequency_hz"):
        np.testing.assert_array_equal(hands[path], drawn[path][stiff][:20])
        np.testing.assert_array_equal(far.hands(20, 3, bounds)[path], hands[path])
    for path in hands.keys() - drawn.keys():
        np.testing.assert_array_equal(hands[path], usual[path])
    share = 100.0 * stiff.mean()
    assert 0.0 < share < 100.0
    assert any(f"the stiffest {share:.0f} % of stylus-arm" in said for said in near.replaced())
    with pytest.raises(ValueError, match=r"paper_wall: of 128 hands of handle 0 have the 250 N/m below which"):
        Task("paper_wall", 0.1).hands(2, 1, HandBounds(population="handle"))
