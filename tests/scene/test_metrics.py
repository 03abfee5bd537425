"""A sweep measures the requested columns only, with the same numbers as beside all others."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haptether import _core
from haptether.bridge import load_scene, sweep, sweep_to_file
from haptether.bridge.scene.sweep import ENDING as OF_ENDING
from haptether.bridge.scene.sweep import METRICS
from haptether.cli.entry import main

ENDING = [name for name in METRICS if name in OF_ENDING]
MEASURED = list(_core.METRICS)
OF_ROTATION = {"max_ejection_rate", "peak_device_torque", "orientation_rmse_rad", "torque_rmse_n_m"}
CASES = {
    "paper_wall": ("paper_wall", ()),
    "remote_push": ("remote_push", ("run.duration_s=3.5",)),
    "three_axis_box": ("three_axis_box", ("run.duration_s=1.5", "operator.release.at_s=0.8")),
    "torque_release": ("torque_release", ()),
}
QUIET = {"time_to_trip_s", "false_trips", "intervention_s", "intervention_ticks"}
"""Metrics that may be 0 or missing in all rows of a case in which nothing intervenes."""


@pytest.mark.parametrize("case", CASES)
def test_a_column_alone_has_the_numbers_that_it_has_beside_all_others(case: str) -> None:
    name, overrides = CASES[case]
    grid: dict[str, Any] = {"safety.controllers": [[], ["wsc"]], "run.seed": [1, 2]}
    whole = sweep(name, grid, overrides=overrides)
    is_pose = load_scene(name).master.kind == "pose"
    assert (OF_ROTATION & whole.columns.keys() != set()) == is_pose
    for metric in MEASURED:
        alone = sweep(name, grid, overrides=overrides, metrics=[metric])
        assert list(alone.columns) == [*grid, "outcome", metric, "diverged", "ticks", "reason"]
        for column in [*ENDING, metric]:
            if column in whole.columns:
                np.testing.assert_array_equal(alone[column], whole[column], err_msg=f"{metric}: {column}")
            else:
                assert np.isnan(alone[column]).all(), column
    # The compared columns have content.
    for metric in set(whole.columns) & set(MEASURED) - QUIET:
        if np.isnan(whole[metric]).all():
            assert load_scene(name).slave is None, metric
        else:
            assert (whole[metric] != 0.0).any(), metric


def test_which_columns_there_are_and_in_which_order() -> None:
    def columns(metrics: Any) -> list[str]:  # noqa: ANN401  # also invalid ones
        return list(sweep("paper_wall", {"run.seed": [1]}, metrics=metrics).columns)[1:]

    forces = ["outcome", "max_ejection_velocity", "peak_device_force", "diverged", "ticks", "reason"]
    for metrics in (
        ["peak_device_force", "max_ejection_velocity"],
        ("max_ejection_velocity", "peak_device_force", "outcome", "peak_device_force"),
        iter(forces),
    ):
        assert columns(metrics) == forces
    assert columns("outcome") == columns(["reason"]) == ENDING
    every = columns(None)
    assert [name for name in columns(METRICS) if name not in OF_ROTATION] == every
    for wrong, said in (
        ([], "none given: must be one or more of outcome, max_ejection_velocity, "),
        (["peak_force"], r"'peak_force': did you mean peak_device_force\?"),
        (["ticks", "xyz"], "'xyz': there is diverged, false_trips, "),
        ("", "'': there is diverged, "),
    ):
        with pytest.raises(ValueError, match=rf"metrics: {said}"):
            columns(wrong)


def test_what_cannot_be_built_or_has_no_rotation_has_the_columns_as_well() -> None:
    asked = ["peak_device_force", "max_ejection_rate"]
    columns = ["outcome", *asked, "diverged", "ticks", "reason"]
    refused = sweep("paper_wall", {"safety.window": [50, 0]}, metrics=asked)
    assert list(refused.columns) == ["safety.window", *columns]
    assert refused["outcome"].tolist() == ["complete", "refused"]
    assert np.isnan(refused["peak_device_force"]).tolist() == [False, True]
    mixed = sweep("valve", {"scene": ["paper_wall", "valve"]}, overrides=["run.duration_s=0.5"], metrics=asked)
    assert list(mixed.columns) == ["scene", *columns]
    assert np.isnan(mixed["max_ejection_rate"]).tolist()[0]


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_file_has_the_columns_that_are_asked_for(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"rows{suffix}"
    found = sweep_to_file(
        "remote_push", path, {"run.seed": [1, 2]}, overrides=["run.duration_s=1"], collect=True,
        metrics=["peak_device_force"],
    ).whole  # fmt: skip
    columns = ["run.seed", "outcome", "peak_device_force", "diverged", "ticks", "reason"]
    assert found is not None
    assert list(found.columns) == columns
    if suffix == ".csv":
        assert path.read_text().splitlines()[0] == ",".join(columns)
    else:
        with np.load(path) as arrays:
            assert list(arrays) == columns


def test_a_sweep_of_other_columns_is_no_resume(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"

    def run(metrics: list[str] | None, *, resume: bool) -> int:
        def interrupt(done: int) -> None:
            if done and not resume:
                raise KeyboardInterrupt

        return sweep_to_file(
            "paper_wall", path, {"run.seed": np.arange(1.0, 41.0)}, metrics=metrics, resume=resume, progress=interrupt
        ).rows

    with pytest.raises(KeyboardInterrupt):
        run(["false_trips", "outcome"], resume=False)
    for others in (None, ["peak_device_force"]):
        with pytest.raises(ValueError, match="metrics"):
            run(others, resume=True)
    # The `outcome` is a column in any case.
    assert run(["false_trips"], resume=True) == 40


def test_the_command_measures_what_it_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rows.csv"
    command = ["sweep", "paper_wall", "--vary", "run.seed=1,2"]
    asked = ["--metrics", "false_trips, outcome", "--metrics", "max_ejection_velocity"]
    assert main([*command, *asked, "--out", str(out), "--summary", "max_ejection_velocity>0.1"]) == 0
    assert out.read_text().splitlines()[0].split(",")[1:4] == ["outcome", "max_ejection_velocity", "false_trips"]
    assert "peak" not in capsys.readouterr().out
    assert main([*command, "--metrics", "intervention_ticks"]) == 0
    assert "ticks" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--metrics false_trips --summary peak_device_force>1", "peak_device_force is not measured: name it with"),
        ("--summary peak_force>1", "no column 'peak_force': there is run.seed, outcome, max_ejection_velocity, "),
        ("--summary peak_device_force>=1", "must be peak_device_force > NUMBER, peak_device_force < NUMBER or"),
        ("--summary outcome=complet", "--summary 'outcome=complet': must be one of complete, settled, diverged, "),
        ("--summary ticks>", "--summary 'ticks>': must be METRIC > NUMBER, METRIC < NUMBER, METRIC = NUMBER or"),
        ("--summary outcome", "--summary 'outcome': is text: give a share, outcome = VALUE"),
        (
            "--summary ticks --against run.seed=1",
            "--against: run.seed is none of what varies: nothing but samples does",
        ),
        (
            "--vary safety.window=50,70 --summary ticks --against safety.window=60",
            "safety.window = 60: must be of 50, 70",
        ),
        ("--vary safety.window=50,70,50", "--vary safety.window: 50 is there more than once"),
        ("--vary safety.window=50,70 --set safety.window=60", "--vary safety.window, --set safety.window: one field"),
        (
            "--vary link.forward.delay_s=0.1,0.2 --tie link.backward.delay_s --set link.backward.delay-s=0.1",
            "--tie link.backward.delay_s, --set link.backward.delay_s: one field is given twice",
        ),
        (
            "--samples 2 --draw operator.damping=uniform:0:1 --set operator.damping=3",
            "--draw operator.damping, --set operator.damping: one field is given twice",
        ),
        ("--threads 100000", "threads = 100000: must be 1 to 1024"),
        ("--address tcp://127.0.0.1:1", "--address tcp://127.0.0.1:1: give --engine dask, too"),
        ("--metrics peak_force", "metrics: 'peak_force': did you mean peak_device_force?"),
        ("--metrics ticks --plot PLACE/a.png", "--plot: nothing to draw: name with --metrics one or more of "),
    ],
)
def test_what_the_command_cannot_do_is_refused_before_a_row_is_run(
    options: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("haptether._core.sweep_scenes", None)
    words = options.replace("PLACE", str(tmp_path)).split()
    assert main(["sweep", "paper_wall", "--vary", "run.seed=1,2", *words]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_samples_alone_are_one_combination(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["sweep", "paper_wall", "--samples", "3", "--metrics", "ticks", "--summary", "ticks", "--json", "-"]
    assert main([*command, "--set", "run.stop_early=false", "--set", "run.duration_s=3"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["summary"]
    assert (row["group"], row["rows"], row["mean"]) == ({}, 3, 3000.0)


@pytest.mark.parametrize("named", ["[wsc]", "wsc", "[ wsc ]"])
def test_a_baseline_is_named_as_it_is_varied_or_as_tables_show_it(
    named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    vary = ["--vary", "safety.controllers=[wsc],[hsc]", "--vary", "run.seed=1,2"]
    summary = ["--summary", "ticks", "--against", f"safety.controllers={named}"]
    assert main(["sweep", "paper_wall", *vary, *summary]) == 0
    assert "difference" in capsys.readouterr().out


def test_a_level_of_a_range_is_named_as_tables_show_it(capsys: pytest.CaptureFixture[str]) -> None:
    middle = float(np.linspace(0.01, 0.1, 3)[1])
    assert middle != 0.055
    vary = ["--vary", "operator.damping=0.01:0.1:3", "--vary", "run.seed=1,2", "--set", "run.duration_s=0.1"]
    summary = ["--summary", "ticks", "--against", "operator.damping=0.055"]
    assert main(["sweep", "paper_wall", *vary, *summary]) == 0
    assert "difference" in capsys.readouterr().out


def test_a_scene_that_cannot_be_is_refused_before_a_bar_begins(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", "no-such-scene", "--vary", "run.seed=1,2"]) == 2
    assert capsys.readouterr().err.startswith("haptether: no-such-scene: no shipped scene")
