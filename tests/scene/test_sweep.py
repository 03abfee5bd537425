"""`sweep`: its arguments and refusals, the contents of its rows, and its files."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from haptether.bridge import Scene, SceneError, Sweep, load_scene, override_scene, scene_json, simulate, sweep
from haptether.bridge.codes import LADDER_STATES
from haptether.bridge.scene.load import loaded
from haptether.bridge.scene.sweep import OUTCOMES, sweep_columns
from haptether.bridge.scene.sweeps.design import design_of


def spec(scene: Scene) -> dict[str, Any]:
    filled: dict[str, Any] = json.loads(scene_json(scene))
    return filled


def columns(varied: dict[str, Any], name: str = "remote_push") -> dict[str, list[float]]:
    arrays = {path: np.asarray(values, dtype=np.float64) for path, values in varied.items()}
    found, refused = sweep_columns(loaded(name), arrays)
    assert not refused
    return {path: column.tolist() for path, column in found}


@pytest.mark.parametrize(
    ("varied", "expected"),
    [
        ({"safety.window": [50, 200]}, {"safety.window": [50, 200]}),
        ({"operator.damping": [5, 8]}, {"operator.damping": [5, 8]}),
        ({"operator.legs.0.end": [-0.03]}, {"operator.legs.0.end.0": [-0.03]}),
        ({"operator.legs.0.end.0": [-0.03]}, {"operator.legs.0.end.0": [-0.03]}),
        ({"link.forward.delay-s": [0.02, 0.05]}, {"link.forward.delay_s": [0.02, 0.05]}),
        (
            {"environment.objects.0.contact.stiffness": [100]},
            {"environment.objects.0.contact.stiffness": [100]},
        ),
        # values derived from a number vary with it
        (
            {"master.encoder_quantum": [1e-5, 2e-5]},
            {"master.encoder_quantum": [1e-5, 2e-5], "safety.estimator.quantum_m": [1e-5, 2e-5]},
        ),
        ({"run.period_s": [1e-3, 5e-4]}, {"run.period_s": [1e-3, 5e-4], "slave.period_s": [1e-3, 5e-4]}),
        ({"slave.position": [0.02]}, {"slave.position.0": [0.02]}),
        # valid together, but not alone
        (
            {"link.forward.delay_s": [0.005], "link.forward.jitter_s": [0.001]},
            {"link.forward.delay_s": [0.005], "link.forward.jitter_s": [0.001]},
        ),
    ],
)
def test_paths_become_the_numbers_of_the_specification(
    varied: dict[str, list[float]], expected: dict[str, list[float]]
) -> None:
    assert columns(varied) == expected


def test_a_number_for_every_axis_is_spread() -> None:
    assert columns({"operator.legs.0.end": [0.01, 0.02]}, "three_axis_box") == {
        f"operator.legs.0.end.{axis}": [0.01, 0.02] for axis in range(3)
    }
    of_mass = columns({"master.mass_kg": [0.1, 0.02]}, "three_axis_box")
    assert of_mass.pop("safety.damping") == [5.0, 4.0]
    assert of_mass.pop("safety.pc_max_damping") == [10.0, 4.0]
    assert of_mass.pop("safety.probe_force_n") == pytest.approx([0.6, 0.48])
    assert of_mass.pop("safety.energy_threshold_j") == pytest.approx([-0.1 * 0.29**2 / 0.1, -0.02 * 0.29**2 / 0.1])
    assert of_mass == {f"master.mass_kg.{axis}": [0.1, 0.02] for axis in range(3)}


def test_a_varied_number_wins_over_its_default_from_another_varied_one() -> None:
    found = columns({"safety.energy_threshold_j": [-0.05, -0.06], "master.mass_kg": [0.1, 0.02]}, "three_axis_box")
    assert found["safety.energy_threshold_j"] == [-0.05, -0.06]


def test_the_columns_are_those_of_each_scene_by_itself() -> None:
    base = load_scene("remote_push")
    rng = np.random.default_rng(3)
    varied = {
        "link.forward.delay_s": rng.uniform(0.02, 0.2, 20), "safety.window": rng.integers(1, 500, 20),
        "operator.stiffness": rng.uniform(100, 500, 20), "master.mass_kg": rng.uniform(0.01, 0.2, 20),
        "run.duration_s": rng.uniform(1, 5, 20),
    }  # fmt: skip
    found = columns(varied)
    for row in range(20):
        alone = spec(override_scene(base, [f"{path}={values[row].item()!r}" for path, values in varied.items()]))
        changed = spec(base)
        for path, values in found.items():
            *tables, key = (int(step) if step.isdigit() else step for step in path.split("."))
            table: Any = changed
            for step in tables:
                table = table[step]
            table[key] = values[row]
        assert changed == alone


@pytest.mark.parametrize(
    ("varied", "said"),
    [
        ({"safety.windw": [1]}, "[safety] has no key windw: did you mean window?"),
        ({"safety.window": [-1, 0]}, "row 0: [safety] window = -1: must be 1 to 3600000"),
        ({"safety.window": [1.5]}, "row 0: [safety] window = 1.5: must be a whole number, 1 to 3600000"),
        ({"link.forward.delay_s": [0.001]}, "row 0: [link.forward] jitter_s"),
        ({"link.forward.queue_ms": [10]}, "link.forward.queue_ms: the scene leaves it out"),
        ({"operator.regrasp.rise_s": [1]}, "[operator.regrasp] rise_s: the scene has no such part"),
        ({"slave.max_acceleration": [1]}, "slave.max_acceleration: the scene leaves it out"),
        ({"operator.legs.3.end": [1]}, "[operator.legs.3] end: the scene has no such part"),
        ({"safety.signals": [1]}, 'safety.signals = "estimated": a sweep of numbers cannot change it'),
        ({"safety.controllers": [1]}, 'safety.controllers.0 = "wsc": a sweep of numbers cannot change it'),
        ({"run.seed": [-1e16]}, "row 0: [run] seed = -1e+16: must be a whole number, at least 0"),
        ({"run.seed": [2.0**60]}, "row 0: [run] seed = 1.152921504606847e+18: must be a whole number below 2^53: the"),
        (
            {"master.encoder_quantum": [0, 1e-5]},
            "row 0: master.measures_velocity = false: a sweep of numbers cannot change it",
        ),
    ],
)
def test_a_sweep_without_a_row_that_can_be_is_refused(varied: dict[str, list[float]], said: str) -> None:
    with pytest.raises(SceneError) as refused:
        columns(varied)
    assert str(refused.value).startswith(said)


@pytest.mark.parametrize(
    ("varied", "row", "said"),
    [
        ({"safety.window": [10, 0]}, 1, "[safety] window = 0: must be 1 to 3600000"),
        ({"operator.damping": [1, 2, -1]}, 2, "[operator] damping = -1: must be 0 to 1e9"),
        ({"link.forward.delay_s": [0.05, 0.001]}, 1, "[link.forward] jitter_s"),
        ({"link.forward.delay_s": [-1, 0.05]}, 0, "[link.forward] delay_s = -1: must be 0 to 3600"),
        ({"master.mass_kg": [0.1, 0.0]}, 1, "[master] mass_kg = 0: must be above 0"),
    ],
)
def test_a_row_that_cannot_be_is_refused_and_the_others_are_run(
    varied: dict[str, list[float]], row: int, said: str
) -> None:
    result = sweep("remote_push", varied, overrides=["run.duration_s=0.1"])
    rows = list(result.rows())
    refused = rows.pop(row)
    assert refused["outcome"] == "refused"
    assert refused["reason"].startswith(said)
    measured = refused.keys() - varied.keys() - {"outcome", "reason", "ticks"}
    assert {refused[name] for name in measured} == {None}
    assert [other["outcome"] for other in rows] == ["not-released"] * len(rows)
    assert all(other["peak_device_force"] is not None and other["reason"] is None for other in rows)
    # The other rows are the same without it.
    ((path, values),) = varied.items()
    alone = sweep("remote_push", {path: [value for index, value in enumerate(values) if index != row]},
                  overrides=["run.duration_s=0.1"])  # fmt: skip
    assert list(alone.rows()) == rows


def test_each_row_has_its_own_outcome_and_reason() -> None:
    speeds = [100.0, 0.02, 0.02, 100.0, 0.01, 0.02, 100.0]
    rows = list(sweep("paper_wall", {"run.diverged_speed": speeds}).rows())
    alone = [next(sweep("paper_wall", {"run.diverged_speed": [speed]}).rows()) for speed in speeds]
    assert rows == alone
    assert len({row["reason"] for row in rows}) == 3
    assert [row["outcome"] == "diverged" for row in rows] == [speed < 1.0 for speed in speeds]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_row_that_never_engages_has_no_metrics(threads: int, tmp_path: Path) -> None:
    delays = [0.05, 2.5, 20.0]
    result = sweep("remote_push", {"link.forward.delay_s": delays}, threads=threads)
    coupled, late, apart = result.rows()
    assert coupled["outcome"] == "complete"
    assert coupled["max_ejection_velocity"] > 0.1
    # The run ended before the hand let go: its further motion is unknown.
    assert (late["outcome"], late["max_ejection_velocity"], late["time_to_trip_s"]) == ("not-released", None, None)
    assert late["position_rmse_m"] > 0.0
    assert apart["outcome"] == "never-engaged"
    measured = apart.keys() - {"link.forward.delay_s", "outcome", "reason", "ticks"}
    assert {apart[name] for name in measured} == {None}
    assert np.isnan(result["max_ejection_velocity"]).tolist() == [False, True, True]
    result.save(tmp_path / "rows.csv")
    *_, last = (tmp_path / "rows.csv").read_text().splitlines()
    assert last == "20.0,never-engaged,,,,,,,,,,,4000,"
    alone = simulate("remote_push", overrides=["link.forward.delay_s=20"]).metrics
    assert (alone.outcome, alone.max_ejection_velocity, alone.peak_device_force) == ("never-engaged", None, None)


def test_rows_without_an_arm_say_whether_the_hand_let_go() -> None:
    for lanes in (True, False):
        result = sweep("paper_wall", {"operator.release.at_s": [0.5, 6.6999, 1e6]}, lanes=lanes)
        assert result["outcome"].tolist() == ["complete", "not-released", "not-released"]
        assert np.isnan(result["max_ejection_velocity"]).tolist() == [False, True, True]
        assert (result["peak_device_force"] > 0.0).all()


def test_a_sweep_goes_to_polars_with_nulls() -> None:
    pytest.importorskip("polars")
    frame = sweep("remote_push", {"link.forward.delay_s": [0.05, 20.0]}).to_polars()
    assert frame["max_ejection_velocity"].null_count() == frame["false_trips"].null_count() == 1
    assert frame["false_trips"].dtype.is_integer()


@pytest.fixture
def sweeps_run(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Return the arguments of the extension's sweep."""
    given: list[dict[str, Any]] = []

    def sweep_scenes(
        parts: list[tuple[bytes, list[tuple[str, npt.NDArray[np.float64]]]]],
        threads: int,
        lanes: bool,
        progress: Callable[[int], None] | None,
        _research: object = None,
        metrics: list[str] | None = None,
    ) -> list[dict[str, npt.NDArray[Any]]]:
        ((scene, columns),) = parts
        assert metrics is None
        given.append({"scene": scene, "columns": dict(columns), "threads": threads, "lanes": lanes})
        rows = len(columns[0][1])
        if progress is not None:
            progress(rows)
        return [{
            "outcome": np.array(["complete"] * rows), "max_ejection_velocity": np.linspace(0, 1, rows),
            "time_to_trip_s": np.full(rows, np.nan),
        }]  # fmt: skip

    monkeypatch.setattr("haptether._core.sweep_scenes", sweep_scenes, raising=False)
    return given


def test_a_grid_is_every_combination_and_the_last_varies_fastest(sweeps_run: list[dict[str, Any]]) -> None:
    done: list[int] = []
    result = sweep(
        "paper_wall",
        {"environment.objects.0.contact.stiffness": [200, 300], "safety.window": [50, 100, 200]},
        threads=3, lanes=False, progress=done.append,
    )  # fmt: skip
    assert len(result) == 6
    assert result["environment.objects.0.contact.stiffness"].tolist() == [200, 200, 200, 300, 300, 300]
    assert result["safety.window"].tolist() == [50, 100, 200] * 2
    assert result["max_ejection_velocity"].tolist() == np.linspace(0, 1, 6).tolist()
    (given,) = sweeps_run
    assert given["scene"] == scene_json(load_scene("paper_wall"))
    assert (given["threads"], given["lanes"], done) == (3, False, [6])
    assert all(column.dtype == np.float64 and column.flags.c_contiguous for column in given["columns"].values())


def test_samples_are_taken_row_by_row(sweeps_run: list[dict[str, Any]]) -> None:
    result = sweep("paper_wall", samples={"safety.window": [10, 20], "operator.damping": np.array([5.0, 6.0])})
    assert [(row["safety.window"], row["operator.damping"]) for row in result.rows()] == [(10, 5), (20, 6)]
    assert sweeps_run[0]["threads"] >= 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({}, "give grid or samples"),
        ({"samples": 3}, "samples = 3: must be values by path"),
        ({"grid": ["safety.window"]}, "grid = ['safety.window']: must be values by path"),
        ({"grid": {"safety.window": [1]}, "samples": {"safety.window": [1]}}, "give grid or samples"),
        ({"grid": {}}, "nothing to vary"),
        ({"grid": {"safety.window": []}}, "safety.window: values of shape (0,)"),
        ({"grid": {"safety.window": [1], "safety.hold-off-s": [1], "safety.hold_off_s": [2]}}, "is the same field as"),
        ({"grid": {"safety.window": ["a"]}}, 'window = "a": must be a whole number'),
        ({"grid": {"safety.window": [np.inf]}}, "safety.window = inf: must be a finite number"),
        (
            {"samples": {"safety.window": [1], "operator.damping": [1, 2]}},
            "window has 1, operator.damping has 2",
        ),
        ({"grid": {5: [1]}}, "grid = {5: [1]}: must be values by path"),
        ({"grid": {"safety.window": 0.01}}, "safety.window = 0.01: must be a list of values, such as [1, 2, 3]"),
        ({"grid": {"safety.window": np.float64(3)}}, "safety.window = 3: must be a list of values"),
        ({"grid": {"safety.window": np.array(3)}}, "safety.window = 3: must be a list of values"),
        ({"grid": {"safety.window": None}}, "safety.window = nothing: must be a list of values"),
        ({"grid": {"safety.window": {1}}}, "safety.window = {1}: must be a list of values"),
        ({"grid": {"safety.window": [10**400]}}, "safety.window: a number beyond 1.8e+308"),
        ({"grid": {"safety.window": [1, None]}}, "safety.window = nothing: must be numbers, strings, booleans, lists"),
        ({"grid": {"run.seed": [1, 2**53]}}, "run.seed = 9007199254740992: must be a whole number below 2^53: the"),
        ({"samples": {"run.seed": np.array([2**53 + 1])}}, "run.seed = 9007199254740993: must be a whole number below"),
        ({"grid": {"operator.stiffness": ["300"]}}, '[operator] stiffness = "300": must be a number, 0 to 1e9'),
        ({"grid": {"safety.controllers": [[10**400]]}}, ": holds a whole number beyond 64 bits"),
        ({"grid": {"master.device": ["\ud800"]}}, "master.device = '\\ud800': holds text that UTF-8 cannot write"),
        (
            {"grid": {"safety.controllers": [[1j]]}},
            "safety.controllers = [1j]: holds a complex: must be numbers, strings, booleans, lists or tables",
        ),
        (
            {"grid": {"link": [1]}},
            "link: is a table, no number: name a key of it, link.KEY: there is backward, forward",
        ),
        ({"grid": {"operator.legs": [1]}}, "is a list of tables, no number: name a key of it, operator.legs.0.KEY: "),
        ({"grid": {"safety.signals": [1]}}, 'safety.signals: takes no numbers, must be one of "estimated", '),
        (
            {"grid": {"safety.window": [1]}, "ties": {"safety.controllers": "safety.window"}},
            'safety.controllers is tied to safety.window: takes no numbers, must be a list of any of "hsc", ',
        ),
        ({"grid": {"scene": 5}}, "scene = 5: must be a list of scenes"),
        ({"grid": {"safety.window": [1]}, "ties": 3}, "ties = 3: must be paths by path, such as {"),
        ({"grid": {"safety.window": [1]}, "ties": {3: "safety.window"}}, "ties = {3: 'safety.window'}: must be paths"),
        ({"grid": {"safety.window": [1]}, "ties": {"run.seed": ["a"]}}, "ties = {'run.seed': ['a']}: must be paths"),
        ({"grid": {"safety.window": [1]}, "metrics": 5}, "metrics = 5: must be a list of names, one or more of out"),
        ({"grid": {"safety.window": [1]}, "overrides": 5}, "overrides = 5: must be a list of texts, such as ["),
        ({"grid": {"safety.window": [1]}, "overrides": "run.seed=3"}, 'overrides = "run.seed=3": must be a list'),
        ({"grid": {"safety.window": [1]}, "threads": 0}, "threads = 0: must be 1 to 1024"),
        ({"grid": {"safety.window": [1]}, "threads": "2"}, 'threads = "2": must be a whole number, 1 to 1024'),
        ({"grid": {"safety.window": [1]}, "threads": 1.0}, "threads = 1.0: must be a whole number, 1 to 1024"),
        ({"grid": {"safety.window": [1]}, "threads": 1.5}, "threads = 1.5: must be a whole number, 1 to 1024"),
        ({"grid": {"safety.window": [1]}, "threads": True}, "threads = true: must be a whole number, 1 to 1024"),
        ({"grid": {"safety.window": [1]}, "seed": "a"}, 'seed = "a": must be a whole number, 0 or more'),
        ({"grid": {"safety.window": [1]}, "progress": 5}, "progress = 5: must be a function"),
        ({"grid": {"safety.window": [1]}, "lanes": "no"}, 'lanes = "no": must be true or false'),
        ({"grid": {"run.seed": range(10**9), "safety.window": [1]}}, "run.seed: 1000000000 values: must be at most"),
        (
            {"grid": {"run.seed": range(10**4), "safety.window": range(10**4)}},
            "100000000 rows: must be at most 10000000 in",
        ),
        ({"samples": {"run.seed": range(10**9)}}, "samples = 1000000000: must be at most 10000000"),
        (
            {"samples": {"run.seed": range(10**9)}, "population": "handle"},
            "samples = 1000000000: must be at most 10000000",
        ),
    ],
)
def test_a_sweep_of_nothing_is_refused(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=r".") as refused:
        sweep("paper_wall", **arguments)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("path", "numpy_values", "values"),
    [
        ("operator.legs.0.end", [[np.float64(0.01)]], [[0.01]]),
        ("operator.legs.0.end", [np.array([0.01])], [[0.01]]),
        ("safety.signals", np.array(["estimated", "true"]), ["estimated", "true"]),
        ("safety.controllers", [[np.str_("wsc")], ()], [["wsc"], []]),
        ("operator.legs.0", [{"end": np.float32(0.5), "duration_s": np.int64(1)}], [{"end": 0.5, "duration_s": 1}]),
        ("safety.window", np.array([3, 4], dtype=np.uint8), [3, 4]),
        ("scene", (name for name in ("paper_wall", "remote_push")), ["paper_wall", "remote_push"]),
    ],
)
def test_values_of_numpy_are_those_of_python(path: str, numpy_values: object, values: list[object]) -> None:
    found, expected = (
        sweep("paper_wall", {path: cast("Any", of)}, overrides=["run.duration_s=0.1"]) for of in (numpy_values, values)
    )
    assert list(found.rows()) == list(expected.rows())
    assert "refused" not in found["outcome"]


def levels_or_refusal(path: str, values: "list[Any] | npt.NDArray[Any]") -> tuple[str, list[Any]]:
    """Return type and values of a sweep over these values, or the reason of a refusal."""
    try:
        levels = design_of({path: values}).factors[path]
    except SceneError as refused:
        return str(refused), []
    return str(levels.dtype), levels.tolist()


@pytest.mark.parametrize(
    ("path", "values"),
    [
        ("operator.stiffness", np.linspace(100, 400, 7)),
        ("operator.stiffness", np.array([0.1, 200], dtype=np.float32)),
        ("safety.window", np.array([1, 300], dtype=np.uint16)),
        ("run.seed", np.array([2**53, 2**63], dtype=np.uint64)),
        ("run.seed", np.array([1, 2.0**60])),
        ("operator.stiffness", np.array([300, np.inf])),
        ("operator.stiffness", np.array([np.nan, 300])),
        ("operator.stiffness", np.array([])),
        ("operator.stiffness", np.array([[300.0]])),
        ("operator.stiffness", np.ma.array([300.0, 400.0], mask=[False, True])),
        ("run.stop_early", np.array([True, False])),
        ("safety.signals", np.array(["true", "estimated"])),
    ],
)
def test_an_array_is_the_list_of_its_values(path: str, values: npt.NDArray[Any]) -> None:
    assert levels_or_refusal(path, values) == levels_or_refusal(path, values.tolist())


def test_outcomes_are_the_names_that_runs_end_with() -> None:
    source = Path(__file__).parents[2] / "bridge" / "src"

    def names(of: str, path: str) -> set[str]:
        body = (source / path).read_text(encoding="utf-8").partition(f"impl {of} {{")[2]
        return set(re.findall(r'Self::\w+ => "(.+)",', body.partition("\n}\n")[0]))

    endings, states = names("Ending", "scene/measures.rs"), names("LadderState", "ladder/table.rs")
    assert len(endings) == 5
    assert states == set(LADDER_STATES)
    # Coupled states are not endings.
    assert set(OUTCOMES) == endings | states - {"engaged", "stale"} | {"refused"}


def test_a_value_that_is_there_twice_is_run_twice() -> None:
    result = sweep("paper_wall", {"run.seed": [1, 1]}, overrides=["run.duration_s=0.1"])
    first, second = result.rows()
    assert first == second


def test_a_sweep_can_be_kept(tmp_path: Path) -> None:
    result = Sweep({"safety.window": np.array([1.0, 2.0]), "ticks": np.array([3, 4])})
    result.save(tmp_path / "sweep.csv")
    assert (tmp_path / "sweep.csv").read_text() == "safety.window,ticks\n1.0,3\n2.0,4\n"
    result.save(tmp_path / "sweep.npz")
    with np.load(tmp_path / "sweep.npz") as arrays:
        assert arrays["ticks"].tolist() == [3, 4]
    with pytest.raises(ValueError, match=r"must end in \.csv, \.parquet or \.npz"):
        result.save(tmp_path / "sweep.txt")
    with pytest.raises(KeyError, match=r"no column 'x': there is safety\.window, ticks"):
        result["x"]
    assert "2 rows" in repr(result)
