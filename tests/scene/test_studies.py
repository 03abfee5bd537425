"""Sweeps of values other than numbers, of tied fields and of samples: each row is the run of its own scene."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haptether.bridge import SceneError, load_scene, scene_toml, simulate, sweep
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
    assert label(True) == "true"  # the column's text for it


def test_preset_values_are_not_taken_from_another_scene() -> None:
    """Both scenes resolve to the same values; in the second, another preset changes no mass."""
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
    assert seen[-1] == 6
    seen.clear()
    # One row is valid, and one is refused.
    sweep("remote_push", {"safety.window": [0, 1]}, overrides=["run.duration_s=0.1"], progress=seen.append)
    assert seen[-1] == 2
    assert seen.count(2) == 1


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
    np.testing.assert_allclose(np.asarray(lines["no controller"].get_ydata(), dtype=float), [1.0, 1.1, 1.2])
    points = draw_sweep("s", columns, ["safety.controllers"]).axes[0]
    assert [tick.get_text() for tick in points.get_xticklabels()] == ["no\ncontroller", "HSC + WSC"]
    columns["safety.vfc_form"] = np.repeat(["product"], 6)
    with pytest.raises(ValueError, match="a picture has one choice"):
        draw_sweep("s", columns, ["safety.controllers", "safety.vfc_form"])
    columns["safety.controllers"] = np.repeat(["none", "hsc+xyz"], 3)
    with pytest.raises(ValueError, match="'xyz' is none of none, vfc, hsc, wsc, pc"):
        draw_sweep("s", columns, ["safety.controllers"])


@pytest.mark.parametrize(
    ("law", "mean", "within"),
    [
        # Integrals of smooth functions over 256 scrambled points have errors of about 1e-4 of the range.
        (SampleLaw("uniform", (2.0, 4.0)), 3.0, 1e-3),
        (SampleLaw("normal", (9.0, 1.0)), 9.0, 0.02),
        (SampleLaw("lognormal", (9.0, 1.0)), 9.0, 0.02),
        (SampleLaw("loguniform", (1.0, np.e)), np.e - 1.0, 2e-3),
        # Half of it is uniform between 0 and 1, half between 1 and 5.
        (SampleLaw("quantiles", (0.0, 0.0, 0.5, 1.0, 1.0, 5.0)), 1.75, 5e-3),
    ],
)
def test_a_sobol_sequence_fills_its_law_evenly(law: SampleLaw, mean: float, within: float) -> None:
    points = sobol_points(["a", "b"], 256, 1)
    assert abs(law.quantile(points["a"]).mean() - mean) < within
    # Each of 256 equal parts has one point.
    assert np.unique((points["b"] * 256).astype(int)).size == 256
    again = sobol_points(["a", "b"], 256, 1)
    assert all((points[name] == again[name]).all() for name in points)
    assert (sobol_points(["a"], 256, 2)["a"] != sobol_points(["a"], 256, 1)["a"]).any()


# ---------------------------------------------------------------------------------------------------- whole scenes


def test_rows_of_a_scene_that_is_a_choice_are_the_runs_of_that_scene() -> None:
    given = ["run.duration_s=1.0"]
    found = sweep("paper_wall", {"scene": ["paper_wall", "remote_push"], "operator.damping": [6.0, 12.0]},
                  overrides=given, threads=2)  # fmt: skip
    assert found["scene"].tolist() == ["paper_wall"] * 2 + ["remote_push"] * 2
    for row in found.rows():
        expected = simulate(row["scene"], overrides=[*given, f"operator.damping={row['operator.damping']}"]).metrics
        assert {name: row[name] for name in METRICS} == {name: getattr(expected, name) for name in METRICS}
    assert found["position_rmse_m"].tolist()[2:] != found["position_rmse_m"].tolist()[:2]
    alone = sweep("remote_push", {"scene": ["remote_push"]}, overrides=[*given, "run.seed=7"])
    assert (
        alone["peak_device_force"][0]
        == simulate("remote_push", overrides=[*given, "run.seed=7"]).metrics.peak_device_force
    )


def test_scenes_in_memory_are_choices_by_their_title() -> None:
    scenes = [load_scene("paper_wall", [f"title={name}", f"operator.damping={damping}", "run.duration_s=0.5"])
              for name, damping in (("light", 6), ("firm", 20))]  # fmt: skip
    found = sweep(scenes[0], {"scene": scenes})
    assert found["scene"].tolist() == ["light", "firm"]
    assert len(set(found["peak_device_force"].tolist())) == 2
    with pytest.raises(ValueError, match="two scenes have this name"):
        sweep(scenes[0], {"scene": [scenes[0], load_scene("paper_wall", ["title=light"])]})
    with pytest.raises(ValueError, match="must be a list of scenes"):
        sweep("paper_wall", {"scene": "paper_wall"})
    with pytest.raises(SceneError, match=r"scene = 1\.0: must be a scene"):
        sweep("paper_wall", {"scene": [1.0]})
    with pytest.raises(SceneError, match="no shipped scene and no such file"):
        sweep("paper_wall", {"scene": ["paper_wal"]})


def test_a_field_that_one_of_the_scenes_does_not_have_refuses_its_rows_alone() -> None:
    found = sweep("remote_push", {"scene": ["paper_wall", "remote_push"], "link.forward.loss": [0.0]},
                  overrides=["run.duration_s=0.5"])  # fmt: skip
    assert found["outcome"].tolist()[0] == "refused"
    assert found["outcome"].tolist()[1] != "refused"
    assert "link" in found["reason"].tolist()[0]


def test_scenes_are_compared_on_the_command_line_and_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, out = tmp_path / "own.toml", tmp_path / "rows.csv"
    file.write_text(scene_toml(load_scene("paper_wall", ["operator.damping=15"])))
    command = ["sweep", "paper_wall", "--vary", f"scene=paper_wall,{file}", "--samples", "3", "--set",
               "run.duration_s=0.5", "--out", str(out)]  # fmt: skip
    summary = ["--summary", "peak_device_force", "--against", "scene=paper_wall"]
    assert main([*command, *summary]) == 0
    said = capsys.readouterr().out
    assert "difference" in said
    whole = out.read_bytes()
    assert whole.count(str(file).encode()) == 3
    out.unlink()
    # The kept rows of an interrupted sweep do not fit a scene that was changed meanwhile.
    monkeypatch.setattr("haptether.bridge.scene.sweeps.store._written", interrupted)
    assert main(command) == 130
    monkeypatch.undo()
    before = file.read_text()
    file.write_text(scene_toml(load_scene("paper_wall", ["operator.damping=16"])))
    assert main([*command, "--resume"]) == 2
    assert f"scenes.{file}" in " ".join(capsys.readouterr().err.split())
    file.write_text(before)
    assert main([*command, "--resume"]) == 0
    assert out.read_bytes() == whole


def test_hands_of_a_population_are_drawn_for_all_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rows.csv"
    command = ["sweep", "remote_push", "--vary", "scene=remote_push,paper_wall", "--population", "stylus-arm",
               "--samples", "3", "--set", "run.duration_s=0.3", "--out", str(out)]  # fmt: skip
    assert main(command) == 0, capsys.readouterr().err
    with out.open() as file:
        rows = list(csv.DictReader(file))
    stiffnesses = [row["operator.stiffness"] for row in rows]
    assert len(set(stiffnesses)) > 1
    assert stiffnesses[:3] == stiffnesses[3:]
    samples: dict[str, list[Any]] = {"scene": ["remote_push", "paper_wall"], "run.seed": [1.0, 2.0]}
    found = sweep("remote_push", samples=samples, population="stylus-arm", overrides=["run.duration_s=0.3"])
    assert len(found) == 2


def test_a_path_in_quotes_may_have_a_comma(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "a,b.toml", tmp_path / "rows.csv"
    file.write_text(scene_toml(load_scene("paper_wall", ["operator.damping=15"])))
    command = ["sweep", "paper_wall", "--vary", f'scene=paper_wall,"{file}"', "--set", "run.duration_s=0.3"]
    assert main([*command, "--out", str(out)]) == 0, capsys.readouterr().err
    with out.open() as rows:
        assert [row["scene"] for row in csv.DictReader(rows)] == ["paper_wall", str(file)]


def test_scenes_are_read_before_anything_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", "paper_wall", "--vary", "scene=paper_wall,there_is_none"]) == 2
    said = capsys.readouterr().err
    assert "there_is_none" in said
    assert "0/2" not in said


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


# ---------------------------------------------------------------------------------------------------- what is refused


def test_each_reason_is_shown_once_with_a_row_that_has_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The 30 valid rows come first and fill the table."""
    command = ["sweep", "remote_push", "--vary", "link.forward.delay_s=0.05,0.06,0.001", "--vary", "run.seed=1:30:30",
               "--set", "run.duration_s=0.1"]  # fmt: skip
    for more in ([], ["--out", str(tmp_path / "rows.csv")]):
        assert main([*command, *more]) == 0
        lines = [line for line in capsys.readouterr().out.splitlines() if ": refused: " in line]
        (line,) = lines
        assert line.startswith("row 60, link.forward.delay_s = 0.001, run.seed = 1: refused: [link.forward] jitter_s")
        assert line.endswith("(30 rows)")


def test_of_many_reasons_the_first_are_shown_and_the_others_counted(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["sweep", "remote_push", "--vary", "operator.damping=-9:1:11", "--set", "run.duration_s=0.1"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert [line.partition(",")[0] for line in said.splitlines() if ": refused: " in line] == [
        f"row {row}" for row in range(5)
    ]
    assert "and 4 more rows with other reasons; --out and --json have all" in said
    assert "9 refused" in said
