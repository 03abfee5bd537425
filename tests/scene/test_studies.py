"""Sweeps of what is no number, of tied fields and of samples: each row is the run of its own scene."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haptether.bridge import SceneError, simulate, sweep
from haptether.bridge.scene.sweep import label
from haptether.bridge.scene.sweeps.laws import SampleLaw, sobol_points
from haptether.cli.entry import main
from haptether.view.figures.sweep import draw_sweep

METRICS = ("max_ejection_velocity", "peak_device_force", "time_to_trip_s", "false_trips", "position_rmse_m")


def alone(*overrides: str) -> dict[str, Any]:
    metrics = simulate("remote_push", overrides=overrides).metrics
    return {name: getattr(metrics, name) for name in METRICS}


def test_each_row_is_the_run_of_its_own_scene() -> None:
    found = sweep(
        "remote_push",
        {"safety.controllers": [[], ["hsc", "wsc"]], "link.forward.delay_s": [0.05, 0.1], "run.seed": [1, 2]},
        ties={"link.backward.delay_s": "link.forward.delay_s"},
        overrides=["run.duration_s=3.2"],
        threads=2,
    )
    assert found["safety.controllers"].tolist() == ["none"] * 4 + ["hsc+wsc"] * 4
    assert found["run.seed"].tolist() == [1.0, 2.0] * 4
    np.testing.assert_array_equal(found["link.backward.delay_s"], found["link.forward.delay_s"])
    for row in found.rows():
        expected = alone(
            f"safety.controllers=[{'' if row['safety.controllers'] == 'none' else 'hsc,wsc'}]",
            *(f"link.{direction}.delay_s={row[f'link.{direction}.delay_s']}" for direction in ("forward", "backward")),
            f"run.seed={int(row['run.seed'])}", "run.duration_s=3.2",
        )  # fmt: skip
        assert {name: row[name] for name in METRICS} == expected


def test_the_order_of_paths_is_that_of_the_rows_and_threads_change_nothing() -> None:
    choices: list[Any] = ["product", "both"]
    grid = {"run.seed": [3, 1], "safety.vfc_form": choices}
    how: dict[str, Any] = {"overrides": ["safety.controllers=[vfc]", "run.duration_s=3"]}
    found = [sweep("remote_push", grid, threads=threads, **how) for threads in (1, 2)]
    assert found[0]["safety.vfc_form"].tolist() == ["product", "both"] * 2
    for name, column in found[0].columns.items():
        np.testing.assert_array_equal(column, found[1][name])
    turned = sweep("remote_push", dict(reversed(grid.items())), **how)
    np.testing.assert_array_equal(turned["peak_device_force"].reshape(2, 2).T.ravel(), found[0]["peak_device_force"])


@pytest.mark.parametrize(
    ("path", "values", "labels"),
    [
        ("master.device", ["touch", "phantom-desktop"], ["touch", "phantom-desktop"]),
        (
            "safety.estimator",
            [{"kind": "kalman"}, {"kind": "dual-kalman"}],
            ['{"kind":"kalman"}', '{"kind":"dual-kalman"}'],
        ),
        ("link.forward.preset", ["wired-lan", "5g-static"], ["wired-lan", "5g-static"]),
    ],
)
def test_choices_are_strings_tables_and_booleans(path: str, values: list[Any], labels: list[str]) -> None:
    found = sweep("remote_push", {path: values}, overrides=["run.duration_s=3"])
    assert found[path].tolist() == labels
    assert set(found["outcome"].tolist()) == {"complete"}
    assert len(set(found["max_ejection_velocity"].tolist())) == 2
    assert label(True) == "true"  # what a column says of it


def test_what_a_scene_leaves_to_a_preset_is_not_taken_from_another_scene() -> None:
    """Both resolve to the same: of the second, another preset changes no mass."""
    presets = {"master.device": ["phantom-omni"]}
    given = ["master.device=phantom-desktop", "run.duration_s=0.4"]
    written = [*given, "master.mass_kg=0.157"]
    alone = [sweep("paper_wall", presets, overrides=one)["peak_device_force"].tolist() for one in (written, given)]
    again = [sweep("paper_wall", presets, overrides=one)["peak_device_force"].tolist() for one in (given, written)]
    assert alone == again[::-1]
    assert alone[0] != alone[1]


def test_a_choice_that_cannot_be_built_is_refused_with_its_reason() -> None:
    found = sweep("remote_push", {"safety.controllers": [["hsc"], ["nobody"]], "run.seed": [1, 2]})
    assert found["outcome"].tolist() == ["complete"] * 2 + ["refused"] * 2
    assert '"nobody": must be one of' in found["reason"][2]
    assert next(row for row in found.rows() if row["outcome"] == "refused")["peak_device_force"] is None
    with pytest.raises(SceneError, match="nobody"):
        sweep("remote_push", {"safety.controllers": [["nobody"]]})
    with pytest.raises(SceneError, match="must be a list of values"):
        sweep("remote_push", {"safety.vfc_form": "both"})


def test_progress_counts_rows_of_all_choices() -> None:
    seen: list[int] = []
    sweep("remote_push", {"safety.vfc_form": ["product", "both"], "run.seed": [1, 2, 3]},
          overrides=["run.duration_s=0.5"], progress=seen.append, threads=1)  # fmt: skip
    assert seen == sorted(seen)
    assert not seen or seen[-1] <= 6


def test_samples_are_the_same_in_every_combination(tmp_path: Path) -> None:
    target = tmp_path / "rows.json"
    assert main([
        "sweep", "remote_push", "--vary", "safety.controllers=none,[wsc]", "--vary", "link.forward.delay_s=0.05,0.1",
        "--tie", "link.backward.delay_s", "--samples", "3", "--draw", "operator.stiffness=loguniform:200:600",
        "--draw", "operator.damping=normal:15:2", "--set", "run.duration_s=0.8", "--json", str(target),
    ]) == 0  # fmt: skip
    rows = json.loads(target.read_text())["rows"]
    assert len(rows) == 12
    drawn = [(row["run.seed"], row["operator.stiffness"], row["operator.damping"]) for row in rows]
    assert drawn == drawn[:3] * 4
    assert [seed for seed, _, _ in drawn[:3]] == [1.0, 2.0, 3.0]
    assert all(200.0 < stiffness < 600.0 for _, stiffness, _ in drawn)
    assert len({stiffness for _, stiffness, _ in drawn}) == 3
    assert all(row["link.backward.delay_s"] == row["link.forward.delay_s"] for row in rows)


def test_choices_are_drawn_as_lines_or_points() -> None:
    number, choice = np.tile([0.0, 0.1, 0.2], 2), np.repeat(["none", "hsc+wsc"], 3)
    columns: dict[str, Any] = {"safety.controllers": choice, "link.forward.delay_s": number}
    columns["peak_device_force"] = number + (choice == "none")
    figure = draw_sweep("s", columns, ["safety.controllers", "link.forward.delay_s"])
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    np.testing.assert_allclose(np.asarray(lines["none"].get_ydata(), dtype=float), [1.0, 1.1, 1.2])
    points = draw_sweep("s", columns, ["safety.controllers"]).axes[0]
    assert [tick.get_text() for tick in points.get_xticklabels()] == ["none", "hsc+wsc"]
    columns["safety.vfc_form"] = np.repeat(["product"], 6)
    with pytest.raises(ValueError, match="a picture has one choice"):
        draw_sweep("s", columns, ["safety.controllers", "safety.vfc_form"])
    columns["safety.controllers"] = np.repeat(["none", "hsc+xyz"], 3)
    with pytest.raises(ValueError, match="'xyz' is none of none, vfc, hsc, wsc, pc"):
        draw_sweep("s", columns, ["safety.controllers"])


@pytest.mark.parametrize(
    ("law", "mean", "within"),
    [
        # Integrals of smooth functions over 256 scrambled points err by some 1e-4 of the range.
        (SampleLaw("uniform", (2.0, 4.0)), 3.0, 1e-3),
        (SampleLaw("normal", (9.0, 1.0)), 9.0, 0.02),
        (SampleLaw("lognormal", (9.0, 1.0)), 9.0, 0.02),
        (SampleLaw("loguniform", (1.0, np.e)), np.e - 1.0, 2e-3),
        # Half of it even between 0 and 1, half between 1 and 5.
        (SampleLaw("quantiles", (0.0, 0.0, 0.5, 1.0, 1.0, 5.0)), 1.75, 5e-3),
    ],
)
def test_a_sobol_sequence_fills_its_law_evenly(law: SampleLaw, mean: float, within: float) -> None:
    points = sobol_points(["a", "b"], 256, 1)
    assert abs(law.quantile(points["a"]).mean() - mean) < within
    # Each of 256 equal parts has one.
    assert np.unique((points["b"] * 256).astype(int)).size == 256
    again = sobol_points(["a", "b"], 256, 1)
    assert all((points[name] == again[name]).all() for name in points)
    assert (sobol_points(["a"], 256, 2)["a"] != sobol_points(["a"], 256, 1)["a"]).any()
