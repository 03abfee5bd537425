"""`haptether simulate` and `haptether sweep`: output, files and refusals, with a simulated extension."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import haptether
from haptether.cli import main
from haptether.cli.entry import with_overrides
from haptether.cli.scene.varied import values_of


class Played:
    """A run that ended well, or diverged."""

    def __init__(self, diverged: bool, ticks: int = 200) -> None:
        time_s = np.arange(ticks) * 1e-3
        self.signals = {
            "time_s": time_s, "position": np.sin(time_s), "slave_position": np.cos(time_s), "velocity": np.cos(time_s),
            "device_force": np.sin(9 * time_s), "rendered_force": np.sin(9 * time_s), "hand_force": -np.sin(9 * time_s),
            "tripped": (time_s > 0.1).astype(np.uint8) * 4,
        }  # fmt: skip
        self.reports = None
        self.events = [(0.1, "trip", "WSC")] + [(0.15, "diverged", "|x| = 12 m")] * diverged
        self.metrics = {"max_ejection_velocity": 0.5, "time_to_trip_s": None, "diverged": diverged, "ticks": ticks}


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Return the scenes that were run; a seed of 13 diverges."""
    scenes: list[dict[str, Any]] = []

    def simulate_scene(scene: bytes, _record: object = None, _research: object = None) -> Played:
        scenes.append(json.loads(scene))
        return Played(diverged=scenes[-1]["run"]["seed"] == 13)

    def sweep_scenes(
        parts: list[tuple[bytes, list[tuple[str, npt.NDArray[np.float64]]]]],
        threads: int,
        lanes: bool,
        progress: Callable[[int], None],
        _research: object = None,
        metrics: list[str] | None = None,
    ) -> list[dict[str, npt.NDArray[Any]]]:
        assert metrics in (None, ["max_ejection_velocity", "false_trips"])  # an example of the help has these
        assert threads >= 1
        assert lanes
        tables = []
        for scene, columns in parts:
            scenes.append(json.loads(scene))
            rows = len(columns[0][1])
            tables.append({
                "outcome": np.array(["complete"] * rows), "peak_device_force": np.arange(rows) * 1.0,
                "time_to_trip_s": np.full(rows, np.nan), "ticks": np.full(rows, 4000, np.uint64),
            })  # fmt: skip
        progress(sum(len(table["outcome"]) for table in tables))
        return tables

    monkeypatch.setattr("haptether._core.simulate_scene", simulate_scene, raising=False)
    monkeypatch.setattr("haptether._core.sweep_scenes", sweep_scenes, raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    return scenes


def test_a_scene_is_run_and_reported(given: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "remote_push"]) == 0
    said = capsys.readouterr().out
    assert "largest ejection velocity [m/s]" in said
    assert "0.1000 s  trip  WSC" in said
    assert given[0]["run"]["seed"] == 1


def test_json_alone_is_on_standard_output(given: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "remote_push", "--json", "-", "--run.seed", "4"]) == 0
    assert given[0]["run"]["seed"] == 4
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert report["scene"] == "remote_push"
    assert report["seed"] == 4
    assert report["version"] == haptether.__version__
    assert report["events"] == [{"time_s": 0.1, "kind": "trip", "detail": "WSC"}]
    assert set(report["metrics"]) == {
        "max_ejection_velocity", "peak_device_force", "time_to_trip_s", "false_trips", "intervention_s",
        "position_rmse_m", "force_rmse_n", "passivity_min_j", "diverged", "ticks", "wall_time_s", "outcome",
        "max_ejection_rate", "peak_device_torque", "orientation_rmse_rad", "torque_rmse_n_m",
    }  # fmt: skip
    assert report["metrics"]["time_to_trip_s"] is None
    assert "largest device force" in captured.err
    # Nothing turns in this scene: the value is null in JSON, and has no row.
    assert report["metrics"]["peak_device_torque"] is None
    assert "torque" not in captured.err


def test_signals_and_a_picture_are_kept(given: list[dict[str, Any]], tmp_path: Path) -> None:
    out, plot = tmp_path / "run.npz", tmp_path / "pictures"
    assert main(["simulate", "remote_push", "--out", str(out), "--plot", str(plot)]) == 0
    assert len(given) == 1
    with np.load(out) as arrays:
        assert arrays["position"].shape == (200,)
    (picture,) = plot.iterdir()
    assert picture.name == "remote_push.png"
    assert picture.stat().st_size > 10_000
    named = tmp_path / "named.svg"
    assert main(["simulate", "remote_push", "--plot", str(named), "--columns", "1"]) == 0
    assert named.read_bytes().startswith(b"<?xml")
    assert main(["simulate", "remote_push", "--plot", str(plot), "--format", "pdf"]) == 0
    assert (plot / "remote_push.pdf").read_bytes().startswith(b"%PDF")


def test_a_run_that_diverged_is_status_1(given: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "remote_push", "--set", "run.seed=13"]) == 1
    assert len(given) == 1
    assert capsys.readouterr().err == "haptether: remote_push diverged at 0.15 s: |x| = 12 m\n"


def test_overrides_have_two_forms(given: list[dict[str, Any]]) -> None:
    assert main([
        "simulate", "remote_push", "--link.forward.delay-s", "0.1", "--operator.legs.0.end=-0.03",
        "--set", "safety.controllers=[hsc]", "safety.window=50", "--set", "run.seed=9",
    ]) == 0  # fmt: skip
    (scene,) = given
    assert scene["link"]["forward"]["delay_s"] == 0.1
    assert scene["operator"]["legs"][0]["end"] == [-0.03]
    assert scene["safety"]["controllers"] == ["hsc"]
    assert scene["safety"]["window"] == 50
    assert scene["run"]["seed"] == 9


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["simulate", "s", "--a.b", "-1"], ["simulate", "s", "--set", "a.b=-1"]),
        (["simulate", "--a.b=-1", "s"], ["simulate", "--set", "a.b=-1", "s"]),
        (["simulate", "--set", "a=1", "b=2", "s"], ["simulate", "--set", "a=1", "--set", "b=2", "s"]),
        (["sweep", "s", "--vary", "a=1", "b=2"], ["sweep", "s", "--vary", "a=1", "--vary", "b=2"]),
        (["simulate", "s", "--set"], ["simulate", "s", "--set"]),
        (["simulate", "s", "--out", "a.npz"], ["simulate", "s", "--out", "a.npz"]),
        (["master", "--a.b", "1"], ["master", "--a.b", "1"]),
        (["identify", "d", "--options", "a=1", "b=2"], ["identify", "d", "--options", "a=1", "--options", "b=2"]),
        (["check-device", "--options", "a=1", "d"], ["check-device", "--options", "a=1", "d"]),
        ([], []),
    ],
)
def test_flags_with_a_dot_are_overrides(arguments: list[str], expected: list[str]) -> None:
    assert with_overrides(arguments) == expected


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["simulate"], "which scene? Name one of `haptether simulate --list`"),
        (["simulate", "remote_psh"], "remote_psh: no shipped scene and no such file: did you mean remote_push?"),
        (["simulate", "remote_push", "--safety.window", "0"], "remote_push.toml: [safety] window = 0: must be 1 to"),
        (["simulate", "remote_push", "--safety.windw", "3"], "remote_push.toml: [safety] has no key windw: did you"),
        (["simulate", "remote_push", "--safety.window"], "[safety] window = \"\": must be a value in TOML"),
        (["simulate", "remote_push", "--out", "run.csv"], "run.csv: must end in .npz"),
        (["simulate", "remote_push", "--out", "a.npz", "--json", "a.npz"], "a.npz: is to be written twice: give two"),
        (["simulate", "remote_push", "--run.seed", "abc"], "[run] seed = \"abc\": must be a whole number, at least 0"),
        (["simulate", "remote_push", "--safety.controllers", "hsc"], "must be a list of any of \"hsc\", \"pc\","),
        (["simulate", "remote_push", "--safety.signals", "true"], "signals: with a [slave] only \"estimated\""),
        (["simulate", "remote_push", "--run.seed", "1", "--set", "run.seed=2"], "--run.seed, --set run.seed: one sett"),
        (["simulate", "remote_push", "--set", "run.seed=1", "run.seed=2"], "--set run.seed, --set run.seed: one sett"),
        (["sweep", "remote_push", "--set=run.seed=1", "--run.seed=2"], "--set run.seed, --run.seed: one setting is"),
        (["replay", "a.mcap", "--set", "safety.window=1", "--set=safety.window=2"], "--set safety.window: one setting"),
        (["simulate", "--list", "remote_push"], "--list, SCENE remote_push: no scene is run where all are listed"),
        (["simulate", "--list", "--set", "run.seed=2"], "--list, --set: no scene is run where all are listed"),
        (["simulate", "--list", "--out", "a.npz"], "--list, --out: no scene is run where all are listed"),
        (["simulate", ""], 'scene = "": must be the name of a shipped scene or the path of a TOML file'),
        (["simulate", "."], ".: is a folder, must be the name of a shipped scene or a TOML file"),
        (["sweep", "remote_push"], "nothing to vary"),
        (["sweep", "remote_push", "--vary", "safety.window"], "--vary safety.window: must be path=a:b:n"),
        (["sweep", "remote_push", "--vary", "safety.window=-1,0"], "row 0: [safety] window = -1: must be 1 to 3600000"),
        (["sweep", "remote_push", "--vary", "safety.window=1", "--out", "a.txt"], "must end in .csv, .parquet or .npz"),
        (["sweep", "remote_push", "--vary", "run.seed=0:1:9999999", "operator.damping=1,2"], "at most 10000000 in mem"),
        (["sweep", "remote_push", "--samples", "10000001"], "samples = 10000001: must be at most 10000000"),
        (["sweep", "remote_push", "--samples", "9999999", "--vary", "safety.window=1,2"], "19999998 rows: must be at"),
        (["sweep", "remote_push", "--vary", "safety.window=1", "--threads", "0"], "threads = 0: must be 1 to 1024"),
    ],
)  # fmt: skip
def test_a_bad_request_is_one_line_and_status_2(
    arguments: list[str], said: str, given: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("haptether: ")]
    assert said in line
    assert not given


def test_signals_of_a_scene_that_records_none_are_refused(
    given: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('schema = 1\nmaster = { device = "touch" }\n')
    assert main(["simulate", str(path), "--out", str(tmp_path / "a.npz")]) == 2
    assert "has no [record], so there are no signals to keep: add --set record.every=1" in capsys.readouterr().err
    assert main(["simulate", str(path), "--out", str(tmp_path / "a.npz"), "--set", "record.every=1"]) == 0
    assert len(given) == 1


def test_the_scenes_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    from haptether.bridge import scene_names

    assert main(["simulate", "--list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in scene_names())


def test_a_sweep_is_shown_and_kept(
    given: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, table = tmp_path / "sweep.json", tmp_path / "sweep.csv"
    assert main([
        "sweep", "remote_push", "--vary", "safety.window=50,100", "--vary", "link.forward.delay_s=0.01:0.1:4",
        "--set", "run.seed=3", "--json", str(out), "--out", str(table),
    ]) == 0  # fmt: skip
    assert given[0]["run"]["seed"] == 3
    assert not (tmp_path / "sweep.csv.partial").exists()
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 8
    assert rows[5] == {
        "safety.window": 100.0, "link.forward.delay_s": 0.04, "outcome": "complete", "peak_device_force": 5.0,
        "time_to_trip_s": None, "ticks": 4000,
    }  # fmt: skip
    assert len(table.read_text().splitlines()) == 9
    said = capsys.readouterr().out
    # The name is folded over several lines of its column.
    assert re.search(r"peak_ *\n.*device_ *\n.*force", said)
    assert "trip_s" not in said
    assert "8 rows: 8 complete" in said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.b=1", ("a.b", [1.0])),
        ("a.b=1,-2,3e-1", ("a.b", [1.0, -2.0, 0.3])),
        ("a.b=0:1:3", ("a.b", [0.0, 0.5, 1.0])),
        ("safety.controllers=none,[hsc],[hsc, wsc]", ("safety.controllers", [[], ["hsc"], ["hsc", "wsc"]])),
        ("safety.vfc_form=product,both", ("safety.vfc_form", ["product", "both"])),
        (
            "safety.estimator={kind=kalman,jerk_density=3}",
            ("safety.estimator", [{"kind": "kalman", "jerk_density": 3}]),
        ),
        ("master.measures_velocity=true,false", ("master.measures_velocity", [True, False])),
        ("master.device='a,b',touch", ("master.device", ["a,b", "touch"])),
    ],
)
def test_what_varies_has_two_forms(text: str, expected: tuple[str, list[Any]]) -> None:
    assert values_of(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "a",
        "a=",
        "=1",
        "a=0:1",
        "a=0:1:0",
        "a=0:1:x",
        "a=1,,2",
        "a=1:1e400:3",
        "a=-1e308:1e308:3",
        "a=nan:1:2",
        "a=1,inf",
        "a=nan",
    ],
)
def test_what_varies_in_no_form_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="must be path=a:b:n with n of at least 1, or path=v1,v2"):
        values_of(text)


def test_a_choice_of_no_field_or_no_value_is_refused() -> None:
    with pytest.raises(ValueError, match="a"):
        values_of("a=x")
    with pytest.raises(ValueError, match="must be a value in TOML"):
        values_of("safety.controllers=[hsc")


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "nothing to vary"),
        (["--samples", "0"], "samples = 0: must be 1 or more"),
        (["--vary", "safety.window=1,2", "--draw", "operator.stiffness=uniform:1:2"], "--draw: give --samples"),
        (
            ["--samples", "2", "--draw", "operator.stiffness=uniform:2:1"],
            '--draw operator.stiffness: "uniform:2:1": must be uniform:a:b with a < b',
        ),
        (["--samples", "2", "--sobol"], "--sobol: give --draw"),
        (["--vary", "safety.window=1,2", "--sobol"], "--sobol: give --draw or --population, what is drawn"),
        (["--vary", "safety.window=1,2", "--seed", "1"], "--seed 1: give --draw or --population, what is drawn; the"),
        (["--samples", "2", "--seed", "3"], "what is drawn; the seed of all runs is --set run.seed=3"),
        (["--vary", "safety.window=1,2", "--columns", "2"], "--columns 2: no picture is asked for: give --plot, too"),
        (["--vary", "safety.window=1,2", "--summary"], "--summary: nothing is named: give metrics, or conditions"),
        (["--vary", "safety.window=1,2", "--summary", ""], "--summary '': no column ''"),
        (
            ["--vary", "coupling.force-scale=1,2", "--vary", "coupling.force_scale=3"],
            "coupling.force_scale: given twice",
        ),
        (
            ["--samples", "2", "--draw", "safety.damping=uniform:1:2", "--draw", "safety.damping=uniform:3:4"],
            "given twice",
        ),
        (
            ["--samples", "2", "--draw", "operator.stiffness=measured:"],
            '--draw operator.stiffness: "measured:": must be measured:FILE.csv:COLUMN',
        ),
        (["--vary", f"run.seed={2**53 + 1}"], f"run.seed = {2**53 + 1}: must be a whole number below 2^53: the"),
        (["--vary", f"run.seed=1:{2**53}:2"], f"run.seed = {2**53}.0: must be a whole number below 2^53: the"),
        (["--vary", "run.seed=1,1"], "--vary run.seed: 1 is there more than once"),
        (["--samples", "2", "--draw", "operator.stiffness=loguniform:0:1"], "loguniform:a:b with 0 < a < b"),
        (["--samples", "2", "--draw", "operator.stiffness=normal:1:0"], "a deviation above 0"),
        (["--samples", "2", "--draw", "operator.stiffness=cauchy:1:2"], "must be uniform:a:b"),
        (["--samples", "2", "--vary", "safety.window=50", "--draw", "safety.window=uniform:1:2"], "varies by itself"),
        (
            ["--samples", "2", "--vary", "run.seed=1,2"],
            "--samples 2: nothing is drawn, for run.seed varies: give --draw",
        ),
        (
            ["--vary", "run.seed=1:2:99999999999"],
            "--vary run.seed=1:2:99999999999: 99999999999 values: must be at most",
        ),
        (["--vary", "operator.legs.-1.end=1,2"], '"operator.legs.-1.end": [operator] legs has no part -1: parts are'),
        (["--samples", "2", "--draw", "operator.legs.-1.end=uniform:1:2"], 'haptether: "operator.legs.-1.end": [oper'),
        (["--vary", "link=1"], "link: is a table, no number: name a key of it, link.KEY: there is backward, forward"),
        (
            ["--vary", "link.forward.delay_s=0.02", "--tie", "safety.controllers=link.forward.delay-s"],
            "safety.controllers is tied to link.forward.delay_s: takes no numbers, must be a list of any of",
        ),
        (["--samples", "2", "--seed", "-1"], "seed = -1: must be 0 or more"),
        (["--vary", "safety.window=50", "--tie", "safety.window="], 'a scene has no key "": there is coupling, '),
        (["--vary", "safety.window=50", "--tie", "link.backward.delay_s"], "0 paths of that name vary"),
        (["--vary", "safety.window=50", "--tie", "safety.window=safety.window"], "varies by itself"),
        (["--vary", "safety.window=50", "--tie", "link.backward.delay_s=link.forward.delay_s"], "does not vary"),
    ],
)
def test_a_study_that_cannot_be_is_refused(
    arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sweep", "remote_push", *arguments]) == 2
    assert problem in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("varied", "problem"),
    [
        (["safety.controllers=none,[hsc]", "link.forward.distribution=normal,gamma"], "a picture has one choice"),
        (["safety.controllers=none,[hsc,of-no-name]"], "safety.controllers: 'of-no-name' is none of none, vfc, hsc"),
        (["safety.window=9,10", "safety.grasp_threshold=2,3", "link.forward.delay_s=0,1"], "a picture has at most 2"),
    ],
)
def test_a_picture_that_cannot_be_drawn_is_refused_before_the_sweep(
    varied: list[str], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def sweep(*_: object, **__: object) -> None:
        pytest.fail("rows were run")

    monkeypatch.setattr("haptether.bridge.sweep", sweep)
    picture = tmp_path / "sweep.png"
    options = [part for path in varied for part in ("--vary", path)]
    assert main(["sweep", "remote_push", *options, "--plot", str(picture)]) == 2
    assert problem in " ".join(capsys.readouterr().err.split())
    assert not picture.exists()


def test_a_run_loads_no_library_that_it_does_not_need() -> None:
    heavy = ("casadi", "matplotlib", "pyvista", "rtde_control", "scipy")
    program = f"""
import sys, numpy as np
from haptether import _core
class Run:
    signals, events, metrics, reports = {{"time_s": np.zeros(3)}}, [], {{"ticks": 3}}, None
_core.simulate_scene = lambda scene, record, research: Run()
from haptether.cli import main
assert main(["simulate", "remote_push"]) == 0
print("loaded:", *sorted(set({heavy!r}) & set(sys.modules)))
"""
    answer = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert answer.stdout.rpartition("loaded:")[2].strip() == ""


def test_a_folder_that_cannot_be_is_refused_before_the_run(
    given: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "a file"
    blocked.write_text("")
    assert main(["simulate", "remote_push", "--plot", str(blocked / "pictures")]) == 1
    assert "cannot be made: Not a directory; give another folder" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    for option in ("--plot", "--record"):
        assert main(["simulate", "remote_push", option, "-"]) == 2
        assert "-: must be a folder" in capsys.readouterr().err
        assert not Path("-").exists()
    for picture, options, why in (
        ("run.gif", [], "must be a folder, or end in .png, .pdf, .svg"),
        ("run.png", ["--format", "pdf"], "format = pdf: the two differ"),
        ("none/run.pdf", [], "cannot be written: is the folder there, and yours?"),
    ):
        status = main(["simulate", "remote_push", "--plot", str(tmp_path / picture), *options])
        assert status == (1 if "none" in picture else 2)
        assert why in capsys.readouterr().err
        assert not (tmp_path / picture).exists()
    for command in (["simulate", "remote_push"], ["sweep", "remote_push", "--vary", "run.seed=1,2"], ["paper"],
                    ["thresholds"], ["netsim", "sample", "--delay-s", "0.1"]):  # fmt: skip
        assert main([*command, "--format", "pdf"]) == 2
        assert "no picture is asked for: give --plot, too" in capsys.readouterr().err
    assert not given


def test_what_chatters_is_reported_once() -> None:
    from haptether.bridge import Event
    from haptether.view.figures.events import merged_events

    chatter = [Event(n * 0.001, ("trip", "recover")[n % 2], ("wsc", "")[n % 2]) for n in range(100)]
    around = [Event(-0.1, "contact", ""), *chatter, Event(0.2, "free", ""), Event(0.3, "trip", "hsc")]
    assert merged_events(around) == [
        (-0.1, "contact"), (0.0, "trip  wsc  50 times, until 0.0990 s"), (0.2, "free"), (0.3, "trip  hsc")
    ]  # fmt: skip


def test_trips_of_several_controllers_are_counted_each() -> None:
    from haptether.bridge import Event
    from haptether.view.figures.events import merged_events

    trips = ["wsc", "research", "research", "wsc", "wsc"]
    events = [Event(time_s=0.1 * n, kind="trip", detail=detail) for n, detail in enumerate(trips)]
    assert merged_events(events) == [(0.0, "trip  wsc 3 times, research 2 times, until 0.4000 s")]


def test_the_examples_in_the_help_work(
    given: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import inspect
    import shlex

    from haptether.cli.scene.simulate import Simulate
    from haptether.cli.scene.sweep import Sweep

    monkeypatch.chdir(tmp_path)
    (tmp_path / "my").mkdir()
    (tmp_path / "my" / "scene.toml").write_text('schema = 1\nmaster = { device = "touch" }\nrecord = {}\n')
    lines = [line for command in (Simulate, Sweep) for line in (inspect.getdoc(command) or "").splitlines()]
    examples = [shlex.split(line)[1:] for line in lines if line.startswith("haptether ")]
    assert len(examples) == 15
    for example in examples:
        assert main(example) == 0, example
        assert not re.search(r"rows: .*refused", capsys.readouterr().out), example
    # A sweep with a file has one run for each batch.
    assert len(given) >= 11


@pytest.mark.usefixtures("given")
@pytest.mark.parametrize(
    ("controllers", "said", "speed"),
    [
        ("[wsc]", "after a release at most 0.88 m/s, by wsc (the hand rested", 0.873),
        ("[vfc]", "no bound on the speed after a release: none of hsc and wsc watches", None),
        (
            "[wsc] master.viscous=-1 master.stops=[-1000,1000]",
            "viscous friction is negative (b = -1) and nothing damps once the link is lost: it may add any speed",
            None,
        ),
        ("[]", None, None),
    ],
)
def test_the_bound_on_ejection_is_said_where_a_controller_watches(
    controllers: str, said: str | None, speed: float | None, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    written = tmp_path / "run.json"
    settings = (*f"safety.controllers={controllers}".split(), "safety.preset=paper", "safety.estimator={kind=kalman}")
    arguments = ["simulate", "remote_push", *(each for setting in settings for each in ("--set", setting))]
    assert main([*arguments, "--json", str(written)]) == 0
    printed = capsys.readouterr().out
    report = json.loads(written.read_text())
    bound, release = report["ejection_bound"], report["release_law"]
    if said is None:
        assert release is None
    else:
        assert (release["release_tries"], release["hold_off_s"], release["remark"]) == (5, 0.1, None)
        assert release["probe_force"] == pytest.approx(0.12 * 5.0)
    if said is None:
        assert bound is None
        assert "after a release" not in printed.replace("time to trip after the release", "")
    else:
        assert said in printed
        assert bound["speed"] == pytest.approx(speed, abs=1e-3)
        assert (bound["reason"] is None) == (speed is not None)
