"""Tuning: quantiles against scipy, coverage of the order statistics, scores against the tick, refusals."""

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace
from scipy.stats import binomtest, gamma, nbinom
from tests.images.tuning import record_hands

from haptether.bridge import (
    Recording,
    held_ticks,
    load_scene,
    override_scene,
    read_recording,
    recorded_scene,
    replay,
    scene_json,
    scene_names,
    simulate,
)
from haptether.cli.entry import main
from haptether.studies import tune
from haptether.studies.intervals import binomial_interval, exceedance_interval, gamma_quantile
from haptether.studies.task import HandBounds, Task
from haptether.studies.tuning import TUNED_FIELDS, Exceedances, hours_for, read_normal_operation
from haptether.studies.tuning.normal_operation import Scores

RECORDINGS = 8
FIELDS = ("energy_threshold_j", "grasp_threshold", "velocity_threshold")


# ------------------------------------------------------------------------------------------------ intervals


@pytest.mark.parametrize("shape", [0.3, 1.0, 2.5, 7.0, 40.0, 500.0])
def test_quantiles_of_gamma_are_those_of_scipy(shape: float) -> None:
    for share in (0.001, 0.025, 0.5, 0.975, 0.999):
        # Bisection over 80 halvings, with P(k, x) to a relative 1e-14; the density is least at 0.001.
        assert gamma_quantile(share, shape) == pytest.approx(gamma.ppf(share, shape), rel=1e-9)


@pytest.mark.parametrize(("count", "of"), [(0, 1), (0, 5), (3, 7), (7, 7), (40, 100), (1, 300)])
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_the_exact_interval_of_a_share_is_that_of_scipy(count: int, of: int, confidence: float) -> None:
    exact = binomtest(count, of).proportion_ci(confidence)
    assert binomial_interval(count, of, confidence) == pytest.approx((exact.low, exact.high), abs=1e-9)


@pytest.mark.parametrize("order", [1.0, 3.5, 20.0])
@pytest.mark.parametrize("ratio", [0.25, 1.0, 4.0])
def test_counts_of_the_next_sample_are_negative_binomial(order: float, ratio: float) -> None:
    both = [float(nbinom.ppf(share, order, 1.0 / (1.0 + ratio))) for share in (0.025, 0.975)]
    assert list(exceedance_interval(order, ratio)) == both


# --------------------------------------------------------------------------------------------- exceedances


def series(values: npt.ArrayLike, ticks: npt.ArrayLike, blocks: npt.ArrayLike | None = None) -> Scores:
    value: npt.NDArray[np.float64] = np.atleast_1d(np.array(values, dtype=np.float64))
    of_block = np.zeros(value.size) if blocks is None else np.array(blocks)
    return Scores(value, np.array(ticks, dtype=np.int64), of_block.astype(np.int64))


def test_exceedances_closer_than_an_intervention_are_one_event() -> None:
    # 0.3 s at 1 kHz: 300 ticks apart is the same event, 301 is another.
    events = Exceedances(series([5.0, 1.0, 4.0, 3.0, 2.0], [0, 300, 600, 901, 5000]), 2.0, 1e-3)
    assert [events.count(value) for value in (0.5, 1.5, 2.0, 3.5, 4.5, 5.0)] == [3, 4, 3, 2, 1, 0]
    assert events.peaks(10) == [5.0, 3.0, 2.0]
    found = [events.boundary(order) for order in (1, 2, 3, 4, 5)]
    assert [each and each.value for each in found] == [5.0, 4.0, 3.0, 2.0, None]
    assert found[1] is not None
    assert found[1].per_hour == 1.0


def test_an_event_that_was_cut_off_is_above_every_value() -> None:
    events = Exceedances(series([np.inf, 2.0], [0, 1000]), 1.0, 1e-3)
    assert events.count(1e300) == 1
    first, second = events.boundary(1), events.boundary(2)
    assert first is not None
    assert second is not None
    assert (first.value, second.value) == (np.inf, 2.0)


def test_nothing_seen_is_the_rule_of_three() -> None:
    events = Exceedances(series([], []), 2.0, 1e-3)
    assert events.boundary(1) is None
    assert events.at_most(1e9, 0.95) is None
    assert events.count(0.0) == 0
    assert hours_for(1.0, 0.95) == pytest.approx(2.9957, abs=1e-4)
    # Garwood's 3.689 for a count of 0.
    rate, interval = events.rate_of(0.0, 0.95)
    assert rate == 0.0
    assert interval == pytest.approx((0.0, 3.6889 / 2.0), rel=1e-4)
    alone = Exceedances(series([1.0], [0]), 2.0, 1e-3).boundary(1)
    assert alone is not None
    assert alone.quantile_per_hour(0.95) == pytest.approx(hours_for(1.0, 0.95) / 2.0)


def drawn(rng: np.random.Generator, hours: float, law: Callable[..., Any], group: int) -> tuple[Scores, float]:
    """Draw the events of 100 groups per hour, each one block with nearly equal heights; return them with the hours."""
    groups = int(rng.poisson(100.0 * hours))
    heights = np.repeat(law(size=groups), group) * (1.0 + 1e-9 * rng.random(groups * group))
    return series(heights, 1000 * np.arange(groups * group), np.repeat(np.arange(groups), group)), hours


@pytest.mark.parametrize("group", [1, 3])
@pytest.mark.parametrize("order", [6, 15])
def test_the_interval_of_a_rate_covers_it_whatever_the_law(group: int, order: int) -> None:
    """Pareto tails without a mean: in 250 sets, intervals cover the true rate and the count of another set at 95 %."""
    rng = np.random.default_rng([group, order])
    sets, inside, predicted = 250, 0, 0
    for _ in range(sets):
        scores, hours = drawn(rng, 1.0, lambda size: rng.pareto(0.7, size), group)
        found = Exceedances(scores, hours, 1e-3).boundary(order)
        assert found is not None
        true = 100.0 * group * (1.0 + found.value) ** -0.7
        low, high = found.interval_per_hour(0.95)
        inside += low <= true <= high
        other, hours = drawn(rng, 0.5, lambda size: rng.pareto(0.7, size), group)
        fewest, most = found.expected_count(hours, 0.95)
        predicted += fewest <= Exceedances(other, hours, 1e-3).count(found.value) <= most
    # Binomial at 95 %: fewer than 223 of 250 have a probability below 1e-4. Counts are discrete, and covered more
    # often.
    assert inside >= 223
    assert predicted >= 223
    if group == 1:
        # The intervals are exact, so not too wide: 0.95^250 is 3e-6.
        assert inside < 250


def test_without_grouping_intervals_are_too_narrow() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        scores, hours = drawn(rng, 1.0, lambda size: rng.pareto(0.7, size), 6)
        blind = Scores(scores.value, scores.tick, np.arange(len(scores.value)))
        found = Exceedances(blind, hours, 1e-3).boundary(30)
        assert found is not None
        low, high = found.interval_per_hour(0.95)
        inside += low <= 600.0 * (1.0 + found.value) ** -0.7 <= high
    # 5 groups of 6 have a deviation of 1 / sqrt(5); the interval assumes 1 / sqrt(30).
    assert inside < 160


@pytest.mark.parametrize("per_hour", [5.0, 12.0, 40.0])
def test_the_lowest_boundary_that_keeps_a_rate_is_found(per_hour: float) -> None:
    rng = np.random.default_rng(5)
    events = Exceedances(series(rng.pareto(1.0, 300), 1000 * np.arange(300), range(300)), 3.0, 1e-3)
    found = events.at_most(per_hour, 0.95)
    assert found is not None
    assert found.quantile_per_hour(0.95) <= per_hour
    after = events.boundary(found.order + 1)
    assert after is not None
    assert after.quantile_per_hour(0.95) > per_hour
    # chi2_(2 k)(0.95) / (2 T) of scipy.
    assert found.quantile_per_hour(0.95) == pytest.approx(gamma.ppf(0.95, found.order) / 3.0, rel=1e-9)
    assert events.at_most(0.99, 0.95) is None
    # The limit permits more than all events: lower thresholds were not observed.
    largest = events.at_most(1e6, 0.95)
    assert largest is not None
    assert (largest.order, largest.value) == (1, events.peaks(1)[0])


# ----------------------------------------------------------------------------------------------- recordings


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return recordings of hands that hold, without a controller."""
    return record_hands(tmp_path_factory.mktemp("held"), RECORDINGS, seed=7)


@pytest.mark.parametrize("name", scene_names(attacks=True))
def test_the_scene_of_a_recording_is_the_one_that_was_run(name: str) -> None:
    scene = load_scene(name)
    if scene.operator is not None and scene.operator.recorded is not None:
        pytest.skip("a recorded path is in files of its own")
    ran = json.loads(scene_json(scene))
    again = json.loads(scene_json(recorded_scene(scene_json(scene))))
    for table in ("run", "master", "operator", "slave", "environment", "link", "coupling", "safety"):
        assert again[table] == ran[table], table


@pytest.mark.parametrize(
    ("field", "settings"),
    [
        ("energy_threshold_j", ()),
        ("energy_threshold_j", ("window=10", "wsc_force_threshold_n=0.3")),
        ("grasp_threshold", ()),
        ("grasp_threshold", ("hsc_velocity_threshold=0", "hsc_force_threshold_n=0.5")),
        ("hsc_force_threshold_n", ("hsc_velocity_threshold=0",)),
        ("velocity_threshold", ("vfc_form=product",)),
        ("velocity_threshold", ("vfc_form=both", "vfc_force_threshold_n=0.3")),
    ],
)
def test_the_tick_trips_below_the_largest_score_and_not_above(
    field: str, settings: tuple[str, ...], held: list[Path]
) -> None:
    """The controller is the oracle: with measured motion, nothing that an intervention alters affects a first trip."""
    about = TUNED_FIELDS[field]
    recording = read_recording(held[0])
    overrides = [f"safety.{setting}" for setting in settings]
    seen = read_normal_operation([recording], fields=[field], overrides=overrides)
    largest = float(seen.scores[field].value.max())
    assert largest > about.least
    engaged = recording.signals["state"] == "engaged"
    for share, trips in ((1.0 - 1e-6, True), (1.0 + 1e-6, False)):
        changes = [
            *overrides,
            f"safety.controllers=[{about.controller}]",
            f"safety.{field}={about.sign * largest * share}",
        ]
        found = replay(recording, overrides=changes, hand="measured")
        assert bool(found.replayed["tripped"][engaged].any()) == trips, share


def test_a_held_out_set_trips_as_often_as_predicted(held: list[Path]) -> None:
    """Fixed seeds; benches/tuned_thresholds.py has many."""
    half = RECORDINGS // 2
    seen, other = (read_normal_operation(files, fields=FIELDS) for files in (held[:half], held[half:]))
    for field in FIELDS:
        found = Exceedances(seen.scores[field], seen.hours, seen.period_s).boundary(3)
        assert found is not None
        fewest, most = found.expected_count(other.hours, 0.95)
        count = Exceedances(other.scores[field], other.hours, other.period_s).count(found.value)
        assert fewest <= count <= most < 20, field


def test_hours_are_those_in_which_the_two_are_engaged_and_nobody_intervenes(held: list[Path], tmp_path: Path) -> None:
    recording = read_recording(held[0])
    engaged = float((recording.signals["state"] == "engaged").sum()) * 1e-3
    free = read_normal_operation([recording], fields=FIELDS)
    assert free.hours * 3600.0 == pytest.approx(engaged)
    assert free.blocks == 1
    assert free.round_trip_s == pytest.approx(0.1, abs=0.005)
    task = Task("remote_push", 0.1, ["safety.preset=paper"])
    simulate(
        task.with_controllers(task.lasting(HandBounds()), "wsc", {}), record=(tmp_path / "m.mcap", tmp_path / "s.mcap")
    )
    watched = read_recording(tmp_path / "m.mcap")
    tripped = watched.signals["tripped"] != 0
    begins = np.flatnonzero(tripped & ~np.concatenate([[False], tripped[:-1]]))
    assert len(begins) > 0
    seen = read_normal_operation([watched], fields=FIELDS)
    where = [f"master at {tick * 1e-3:.3f} s" for tick in begins]
    assert [float(re.findall(r"[\d.]+", each)[0]) for each in seen.interventions["wsc"]] == pytest.approx(
        [float(re.findall(r"[\d.]+", each)[0]) for each in where], abs=2e-3
    )
    after = np.convolve(tripped, np.ones(301), "full")[: len(tripped)] > 0.5
    counted = (watched.signals["state"] == "engaged") & ~after
    assert seen.hours * 3600.0 == pytest.approx(counted.sum() * 1e-3)
    # The tripping observer's value was cut off, and counts as infinite; other observers only lose the time.
    assert np.isinf(seen.scores["energy_threshold_j"].value).sum() == len(begins)
    assert np.isfinite(seen.scores["grasp_threshold"].value).all()
    with pytest.raises(ValueError, match=r"wsc tripped \d+ times in .* record with duller thresholds"):
        tune([watched], fields=["energy_threshold_j"], false_trips_per_h=1000.0, hands=1, releases=1, threads=1)


def of_a_person(recording: Recording, **run: object) -> Recording:
    """Return the recording as that of a live hand, about which the scene says nothing."""
    scene = json.loads(recording.scene)
    scene["operator"] = None
    scene["run"] |= run
    return replace(recording, scene=json.dumps(scene).encode())


@pytest.mark.parametrize(
    ("controllers", "said"),
    [("", "nobody bears the force, and the device reaches"), ("wsc", "an intervention of"), ("hsc", "no hand answers")],
)
def test_a_release_is_found_by_the_signals_alone(controllers: str, said: str, tmp_path: Path) -> None:
    files = (tmp_path / "master.mcap", tmp_path / "slave.mcap")
    run = simulate("remote_push", overrides=[f"safety.controllers=[{controllers}]"], record=files)
    engaged_s = next(event.time_s for event in run.events if event.kind == "engaged")
    with pytest.raises(
        ValueError, match=r"master\.mcap: at 2\.692 s the modelled hand lets go: .* is no normal operation"
    ):
        read_normal_operation(files[:1], fields=FIELDS)
    with pytest.raises(ValueError, match=said) as refused:
        read_normal_operation([of_a_person(read_recording(files[0]))], fields=FIELDS)
    (at_s,) = re.findall(r"at ([\d.]+) s", str(refused.value))
    # The grip gives way within 50 ms of 2.6 s after the engagement; a smoothed force shows it at most 0.1 s later.
    assert 2.6 + engaged_s <= float(at_s) <= 2.6 + engaged_s + 0.15


def test_hands_that_hold_are_not_taken_for_released(held: list[Path]) -> None:
    for file in held:
        recording = of_a_person(read_recording(file))
        assert read_normal_operation([recording], fields=FIELDS).hours > 0.0
        device = json.loads(recording.scene)["master"]
        assert held_ticks(recording.signals["position"], recording.signals["device_force"], device, 1e-3).mean() > 0.9


def other_side(recording: Recording) -> list[Any]:
    return [replace(recording, side="slave")]


def never_engaged(recording: Recording) -> list[Any]:
    states = np.full(len(recording.signals["state"]), "aligning", dtype=object)
    return [replace(recording, signals=recording.signals | {"state": states})]


def of_joints(recording: Recording) -> list[Any]:
    (_, changed) = another("master", "kind", "joints")(recording)
    return [changed]


def another_rate(recording: Recording) -> list[Any]:
    return [recording, of_a_person(recording, period_s=0.002)]


def another(table: str, key: str, value: object) -> Callable[[Recording], list[Any]]:
    def change(recording: Recording) -> list[Any]:
        scene = json.loads(recording.scene)
        scene[table][key] = value
        return [recording, replace(recording, scene=json.dumps(scene).encode())]

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda _: [], "which recordings"),
        (other_side, "of the slave, must be of the master"),
        (never_engaged, "nobody was coupled: the two sides never engaged"),
        (of_joints, "of kind joints, must be linear or pose"),
        (another_rate, r"differ in \[run\] period_s: 0.001 and 0.002: must be of one device at one rate"),
        (another("master", "mass_kg", [0.2]), r"differ in \[master\] mass_kg: \[0.157\] and \[0.2\]"),
        (another("safety", "window", 50), r"differ in \[safety\] window: 10 and 50: .*; --set safety.window="),
    ],
)
def test_what_is_no_normal_operation_is_refused(
    change: Callable[[Recording], list[Any]], said: str, held: list[Path]
) -> None:
    with pytest.raises(ValueError, match=said):
        read_normal_operation(change(read_recording(held[0])), fields=FIELDS)


def test_a_setting_that_differs_can_be_made_the_same(held: list[Path]) -> None:
    both = another("safety", "window", 50)(read_recording(held[0]))
    seen = read_normal_operation(both, fields=["energy_threshold_j"], overrides=["safety.window=50"])
    value, _, _ = seen.scores["energy_threshold_j"]
    assert len(value) % 2 == 0
    np.testing.assert_array_equal(value[: len(value) // 2], value[len(value) // 2 :])


def test_the_same_file_twice_is_refused(held: list[Path]) -> None:
    with pytest.raises(ValueError, match="is there twice"):
        read_normal_operation([held[0], held[1], held[0]], fields=FIELDS)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"false_trips_per_h": 0.0}, "false_trips_per_h = 0.0: must be a number above 0"),
        ({"false_trips_per_h": float("nan")}, "must be a number above 0"),
        ({"confidence": 1.0}, "confidence = 1.0: must be 0.5 to 0.9999"),
        ({"round_trip_s": -0.1}, "round_trip_s = -0.1: must be 0 to 10"),
        ({"hands": 0}, "hands = 0: must be 1 or more"),
        ({"releases": 0}, "releases = 0: must be 1 or more"),
        ({"fields": ["damping"]}, "fields = damping: must be of energy_threshold_j"),
        ({"fields": ["grasp_threshold", "hsc_force_threshold_n"]}, "one of a controller"),
        ({"overrides": ["safety.hold_off_s=1"]}, "must be a setting of the observers"),
        ({"overrides": ["master.mass_kg=[1.0]"]}, "must be a setting of the observers"),
    ],
)
def test_options_that_cannot_be_are_refused_before_a_file_is_read(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        tune(["nowhere.mcap"], **options)


# -------------------------------------------------------------------------------------------------- command


def test_the_command_prints_a_table_that_can_be_pasted(
    held: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target, picture = tmp_path / "found.json", tmp_path / "found.png"
    arguments = ["--threshold", "grasp_threshold", "--hands", "1", "--releases", "1", "--threads", "1"]
    files = list(map(str, held))
    status = main(
        ["tune", *files, *arguments, "--false-trips-per-h", "300", "--json", str(target), "--plot", str(picture)]
    )
    shown = capsys.readouterr().out
    assert status == 0, shown
    assert picture.stat().st_size > 10_000
    found = json.loads(target.read_text())
    table = tomllib.loads(shown[shown.index("[safety]") : shown.index("picture:")])["safety"]
    assert tomllib.loads(found["toml"])["safety"] == table
    (tuned,) = found["thresholds"]
    point = tuned["point"]
    assert table["controllers"] == ["hsc"]
    assert table["grasp_threshold"] == point["threshold"] > 1.0
    assert tuned["most_per_h"] <= 300.0
    low, high = point["false_trips_per_h_interval"]
    assert low < point["false_trips_per_h"] < high
    assert point["false_trips_per_h"] == pytest.approx(tuned["order"] / found["hours"])
    # The same hands reach a duller threshold later.
    speeds = [of["mev"] for of in tuned["roc"]]
    assert point["releases"] > 0
    # Trips after the first one move the largest speed by less than 1 %.
    assert speeds[-1] >= 0.99 * speeds[0]
    lower, upper = binomial_interval(point["missed"], point["releases"])
    assert point["missed_interval"] == pytest.approx([lower, upper])
    # The table is valid in a scene.
    scene = override_scene(load_scene("remote_push"), [f"safety.{key}={value}" for key, value in table.items()])
    assert scene.safety.grasp_threshold == point["threshold"]
    # The training set keeps the rate: only the events above the chosen one exceed the threshold.
    seen = read_normal_operation(held, fields=["grasp_threshold"])
    events = Exceedances(seen.scores["grasp_threshold"], seen.hours, seen.period_s)
    assert events.count(point["threshold"]) < tuned["order"]


def test_recordings_that_are_too_short_are_reported(held: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--threshold", "grasp_threshold", "--hands", "1", "--releases", "1", "--threads", "1"]
    assert main(["tune", str(held[0]), *arguments, "--false-trips-per-h", "1"]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "too short: 0.155 min say no less than" in shown
    (needed_min,) = re.findall(r"; 1 take ([\d.e+]+) min", shown)
    # Three hours, or more if the events of one hand come in groups.
    assert 2.99 * 60.0 <= float(needed_min) <= 5.0 * 2.99 * 60.0
    assert "the threshold is the largest value seen" in shown


def test_without_a_hand_in_the_scene_no_release_is_reported(held: list[Path]) -> None:
    found = tune([of_a_person(read_recording(held[0]))], fields=["grasp_threshold"], false_trips_per_h=3000.0)
    assert found.reached
    assert found.thresholds[0].point.missed_interval is None
    assert found.notes == ("the recordings do not say how a hand presses: give a scene, for releases that are missed",)
    assert "missed" not in found.toml()


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["nowhere.mcap"], 2, "nowhere.mcap: no such file: give what --record of"),
        (["."], 2, ".: is a folder: give what --record of"),
        ([__file__], 2, "no recording of Haptether"),
        (["nowhere.mcap", "--seed", "-1"], 2, "seed = -1: must be 0 or more"),
        (["nowhere.mcap", "--plot", "picture.txt"], 2, "must end in"),
    ],
)
def test_an_invalid_command_is_refused_with_its_reason(
    arguments: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tune", *arguments]) == status
    assert said in capsys.readouterr().err


def test_a_scene_of_another_device_is_refused(held: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", str(held[0]), "--scene", "gripper"]) == 2
    assert "gripper: differ in [master]" in capsys.readouterr().err
