"""Scene files: names, overrides, recordings, and what a run and a sweep make of them."""

import json
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

import haptether
from haptether.bridge import (
    Event,
    Scene,
    SceneError,
    Signals,
    Sweep,
    load_scene,
    override_scene,
    scene_json,
    scene_names,
    simulate,
    sweep,
)
from haptether.bridge.codes import LADDER_STATES
from haptether.bridge.scene.checks import checked_spec
from haptether.bridge.scene.load import loaded
from haptether.bridge.scene.sweep import OUTCOMES, sweep_columns
from haptether.netsim import LinkSettings, link_spec
from haptether.studies import RAVEN_ATTACKS

SHIPPED = {
    "active_force",
    "alignment",
    "attack_replay",
    "driving_network",
    "felt_trigger",
    "free_motion",
    "gripper",
    "moving_wall",
    "paper_wall",
    "playback",
    *(attack.scene for attack in RAVEN_ATTACKS),
    "remote_push",
    "peg_in_hole",
    "pick_and_place",
    "sliding_mass",
    "three_axis_box",
    "torque_release",
    "valve",
    "ur_peg",
    "ur_pick",
}
MINIMAL = 'schema = 1\nmaster = { device = "touch" }\n'


def spec(scene: Scene) -> dict[str, Any]:
    filled: dict[str, Any] = json.loads(scene_json(scene))
    return filled


def file(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


# --------------------------------------------------------------------------------------------- files


def test_the_shipped_scenes_are_found_by_name() -> None:
    assert set(scene_names()) == SHIPPED


def test_the_paper_wall_is_the_operator_of_the_paper() -> None:
    from haptether.studies import Operator

    operator, depth, stiffness = Operator(), 0.039, 200.0
    hand = spec(load_scene("paper_wall"))["operator"]
    pressed = operator.pressing(stiffness, depth)
    assert hand["grip_strength_n"] == pytest.approx(operator.grip_margin * stiffness * depth)
    assert hand["release"] == {"at_s": operator.release_at_s, "decay_s": operator.release_s, "kind": "strength"}
    times = np.cumsum([leg["duration_s"] for leg in hand["legs"]])
    assert [leg["end"][0] for leg in hand["legs"]] == pytest.approx([pressed.target(at_s) for at_s in times])


def test_the_remote_push_is_that_of_the_demonstration() -> None:
    from haptether.studies import DemoScene

    demo, scene = DemoScene(), spec(load_scene("remote_push"))
    (wall,), (pusher,) = scene["environment"]["objects"], scene["environment"]["pushers"]
    assert scene["link"]["forward"] == scene["link"]["backward"]
    asked = LinkSettings(delay_s=demo.delay_s, jitter_s=demo.jitter_s, loss=demo.loss)
    assert scene["link"]["forward"] == link_spec(asked, "forward")
    assert wall["contact"]["stiffness"] == demo.wall_stiffness
    assert scene["operator"]["legs"][0]["end"] == [-demo.depth]
    assert scene["operator"]["release"]["at_s"] == demo.release_at_s
    assert (pusher["at_s"], pusher["duration_s"]) == (demo.push_at_s, demo.push_duration_s)
    assert pusher["force_n"] == [demo.push_force_n]


def test_the_recordings_of_playback_are_their_formulas() -> None:
    scene = spec(load_scene("playback"))
    hand, force = scene["operator"]["recorded"], scene["environment"]["pushers"][0]["recorded"]
    t = np.array(hand["time_s"])
    assert np.allclose(t, np.arange(201) * 0.02)
    assert np.allclose(np.ravel(hand["values"]), 0.02 * np.cos(np.pi * t) * np.exp(-t / 4), atol=1e-6)
    expected = 2.5 * np.sin(np.pi * t / 4) ** 2 * (1 + 0.3 * np.sin(6 * np.pi * t))
    assert np.allclose(np.ravel(force["values"]), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("schema = 1\n[master\n", "mine.toml: line 2, column 8: "),
        ("schema = 1\nschema = 1\n", "mine.toml: line 2, column 11: Cannot overwrite a value"),
        ("schema = 1979-05-27\nmaster = {}\n", "mine.toml: schema = 1979-05-27: must be 1"),
        ("", "mine.toml: schema is missing: must be 1"),
    ],
)
def test_what_is_no_scene_says_where(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError) as refused:
        load_scene(file(tmp_path, text))
    assert str(refused.value).startswith(said)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(b"title = '\xff'")
    with pytest.raises(SceneError, match=r"mine\.toml: must be UTF-8: invalid start byte at byte 9"):
        load_scene(path)


@pytest.mark.parametrize("name", ["remote_psh", "/no/such/remote_psh.toml"])
def test_a_scene_that_is_not_there_names_the_nearest(name: str) -> None:
    with pytest.raises(SceneError, match=r"no shipped scene and no such file: did you mean remote_push\?"):
        load_scene(name)


# ----------------------------------------------------------------------------------------- overrides


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("safety.window=50", "safety.window", 50),
        ("safety.window = 50", "safety.window", 50),
        ("run.integrator=rk4", "run.integrator", "rk4"),
        ("run.integrator='velocity-verlet'", "run.integrator", "velocity-verlet"),
        ("run.stop-early=true", "run.stop_early", True),
        ("safety.controllers=[]", "safety.controllers", []),
        ("safety.controllers=[hsc, wsc]", "safety.controllers", ["hsc", "wsc"]),
        ('safety.controllers=["vfc"]', "safety.controllers", ["vfc"]),
        ("operator.legs.0.end=-0.03", "operator.legs.0.end", [-0.03]),
        ("link.forward.delay-s=0.1", "link.forward.delay_s", 0.1),
        ("environment.objects.0.contact.stiffness=1e3", "environment.objects.0.contact.stiffness", 1e3),
        ("environment.objects.0.shape={kind=sphere, radius=0.1}", "environment.objects.0.shape.radius", 0.1),
        ("safety.limiter.max_force_n=3", "safety.limiter.max_force_n", 3),
        ("safety.estimator.jerk_density=20", "safety.estimator.jerk_density", 20),
        ("master.device=phantom-omni", "master.mass_kg", [0.045]),
        ("master.device=phantom-premium-1.5", "master.mass_kg", [0.075]),
        ("slave.force_sensor.noise_n=0.1", "slave.force_sensor.noise_n", 0.1),
        ("operator.tremor={}", "operator.tremor.frequency_hz", 10.0),
    ],
)
def test_a_field_can_be_overridden(override: str, path: str, value: object) -> None:
    before = load_scene("remote_push")
    for scene in (load_scene("remote_push", [override]), override_scene(before, [override])):
        found: Any = spec(scene)
        for step in path.split("."):
            found = found[int(step)] if isinstance(found, list) else found[step]
        assert found == value
    assert before == load_scene("remote_push")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("safety.window", '"safety.window": must be table.key=value'),
        ("safety.windw=3", "[safety] has no key windw: did you mean window?"),
        ("safty.window=3", "a scene has no key safty: did you mean safety?"),
        ("safety.window=0", "[safety] window = 0: must be 1 to 3600000"),
        ("safety.window=5.0", "[safety] window = 5.0: must be a whole number, 1 to 3600000"),
        ("operator.stiffness='300'", "[operator] stiffness = \"300\": must be a number, 0 to 1e9"),
        ("operator.stiffness=[1]", "[operator] stiffness = [1]: must be a number, 0 to 1e9"),
        ("safety.window=inf", "[safety] window = inf: must be a finite number"),
        ("safety.window=", "[safety] window = \"\": must be a value in TOML"),
        ("safety.window=1\nschema=2", "must be a value in TOML"),
        ("operator.legs.1.end=0", "[operator] legs.1: the scene has 1 of these, counted from 0"),
        ("operator.legs.x.end=0", '"operator.legs.x.end": [operator] legs has no part x: parts are counted from 0'),
        ("operator.legs.-1.end=0", '"operator.legs.-1.end": [operator] legs has no part -1: parts are counted from 0'),
        ("operator.legs.0.end.0=0", "[operator.legs.0] end.0: the scene has one number for all axes"),
        ("link.forward.delay_s=3601", "[link.forward] delay_s = 3601: must be 0 to 3600"),
        ("link.forward.preset=gee", "[link.forward] preset = \"gee\": must be one of "),
        ("link.forward.outages.0.times.at_s=1", "[link.forward] outages.0: the scene has 0 of these"),
        ("safety.estimator.cutoff_hz=3", "[safety.estimator] has no key cutoff_hz: "),
        ("=3", 'a scene has no key "": '),
    ],
)  # fmt: skip
def test_an_override_that_does_not_fit_is_refused(override: str, said: str) -> None:
    with pytest.raises(SceneError) as refused:
        load_scene("remote_push", [override])
    assert str(refused.value).startswith("remote_push.toml: ")
    assert said in str(refused.value)


def test_a_table_that_an_override_needs_is_made(tmp_path: Path) -> None:
    scene = load_scene(file(tmp_path, MINIMAL), ["slave.mass_kg=2", "link.backward.loss=0.5"])
    filled = spec(scene)
    assert filled["link"] == {
        "forward": None,
        "backward": link_spec(LinkSettings(loss=0.5), "backward"),
        "master_clock": None,
        "slave_clock": None,
    }
    assert filled["slave"]["mass_kg"] == 2
    assert filled["coupling"] == {
        "kind": "position-force", "position_scale": 1.0, "force_scale": 1.0, "quat_wxyz": [1.0, 0.0, 0.0, 0.0],
        "locked_axes": [], "command_speed": 3.0, "command_reach": None, "changes": [],
        "rotation_scale": 1.0, "torque_scale": 1.0, "locks_rotation": False, "rotation_axis": None,
        "command_angular_speed": 2.5, "command_turn": None, "alignment": None, "reference_point": None,
    }  # fmt: skip


# ---------------------------------------------------------------------------------------- recordings


def played(name: str) -> str:
    return f'{MINIMAL}operator = {{ recorded = {{ file = "{name}" }} }}\n'


def test_a_recording_is_read_beside_its_scene(tmp_path: Path) -> None:
    (tmp_path / "hand.csv").write_text("# a comment\ntime_s, x\n0, 0.1\n0.5,0.2\n", encoding="utf-8")
    np.savez(tmp_path / "hand.npz", time_s=[0.0, 0.5], values=[0.1, 0.2])
    for name in ("hand.csv", "hand.npz"):
        scene = load_scene(file(tmp_path, played(name)))
        assert spec(scene)["operator"]["recorded"] == {"time_s": [0.0, 0.5], "values": [[0.1], [0.2]]}
        assert spec(override_scene(scene, ["run.seed=3"]))["operator"]["recorded"]["values"] == [[0.1], [0.2]]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("hand.csv", "", "header '': must be time_s,x"),
        ("hand.csv", "t,x\n0,0\n", "header 't,x': must be time_s,x"),
        ("hand.csv", "time_s,x\n", "must have at least one row"),
        ("hand.csv", "time_s,x\n0,0\n1\n", "row 2 '1': must be 2 finite numbers"),
        ("hand.csv", "time_s,x\n0,nan\n", "row 1 '0,nan': must be 2 finite numbers"),
        ("hand.csv", "time_s,x\n0,zero\n", "row 1 '0,zero': must be 2 finite numbers"),
        ("hand.csv", "time_s,x\n0,0\n0,0\n", "row 2: time_s = 0: must be above the one before it, 0"),
        ("hand.csv", "time_s,x,y\n0,0,0\n", "[operator.recorded] values.0 = [0, 0]: must be one number or a list of 1"),
        ("hand.csv", "time_s,x\n-1,0\n", "hand.csv: Expected `float` >= 0.0 - at `$.time_s[0]`"),
        ("hand.csv", "time_s,x\n0,1e5\n", "hand.csv: Expected `float` <= 10000.0 - at `$.values[0][0]`"),
        ("hand.csv", None, "cannot be read: No such file"),
        ("hand.txt", "", "hand.txt: must be a .csv or .npz file"),
        ("hand.npz", "no zip", "hand.npz: must hold the arrays time_s and values"),
    ],
)
def test_a_bad_recording_is_refused_with_its_place(name: str, text: str | None, said: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(SceneError) as refused:
        load_scene(file(tmp_path, played(name)))
    assert said in str(refused.value)
    assert str(refused.value).count("\n") == 0


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"time_s": [0.0]}, "must hold the arrays time_s and values"),
        ({"time_s": [0.0], "values": ["a"]}, "must hold the arrays time_s and values of numbers"),
        ({"time_s": [0.0, 1.0], "values": [0.0]}, "must be (n,) and (n, axes)"),
        ({"time_s": [], "values": []}, "must be (n,) and (n, axes), n > 0"),
        ({"time_s": [0.0], "values": [np.nan]}, "must hold finite numbers"),
        ({"time_s": [0.0, 0.0], "values": [0.0, 0.0]}, "time_s[1] = 0: must be above the one before it"),
    ],
)
def test_a_bad_npz_is_refused(arrays: dict[str, Any], said: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "hand.npz", **arrays)
    with pytest.raises(SceneError) as refused:
        load_scene(file(tmp_path, played("hand.npz")))
    assert said in str(refused.value)


# ---------------------------------------------------------------------------------------------- runs


class FakeRun:
    """What the extension gives."""

    def __init__(self, ticks: int) -> None:
        self.signals = {"time_s": np.arange(ticks) * 1e-3, "position": np.zeros((ticks, 3))}
        self.events = [(0.1, "trip", "WSC"), (0.2, "release", "")]
        self.metrics = {"max_ejection_velocity": 0.5, "time_to_trip_s": None, "diverged": False, "ticks": ticks}
        self.reports = None


@pytest.fixture
def scenes_run(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The scenes that were given to the extension."""
    given: list[bytes] = []

    def simulate_scene(scene: bytes, record: object = None, _research: object = None) -> FakeRun:
        assert record is None
        given.append(scene)
        return FakeRun(10)

    monkeypatch.setattr("haptether._core.simulate_scene", simulate_scene, raising=False)
    return given


def test_a_run_is_what_the_extension_saw(scenes_run: list[bytes], tmp_path: Path) -> None:
    run = simulate("remote_push", overrides=["run.seed=5"])
    assert (run.scene, run.seed, run.version) == ("remote_push", 5, haptether.__version__)
    assert scenes_run == [scene_json(load_scene("remote_push", ["run.seed=5"]))]
    assert run.events == (Event(0.1, "trip", "WSC"), Event(0.2, "release", ""))
    assert run.metrics.max_ejection_velocity == 0.5
    assert run.metrics.time_to_trip_s is None
    assert run.metrics.false_trips is None
    assert run.metrics.ticks == 10
    assert run.metrics.wall_time_s >= 0.0
    assert run.signals.position.shape == (10, 3)
    assert run.signals["time_s"] is run.signals.time_s
    assert list(run.signals) == ["time_s", "position"]
    run.save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as arrays:
        assert set(arrays) == {"time_s", "position"}


@pytest.mark.usefixtures("scenes_run")
def test_a_scene_is_checked_once_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    checked = 0

    def counted(scene: Scene) -> dict[str, Any]:
        nonlocal checked
        checked += 1
        return checked_spec(scene)

    monkeypatch.setattr("haptether.bridge.scene.load.checked_spec", counted)
    scene = load_scene("remote_push")
    runs: list[Callable[[], object]] = [
        lambda: simulate("remote_push"),
        lambda: simulate("remote_push", overrides=["run.seed=5"]),
        lambda: simulate(scene, overrides=["run.seed=5"]),
        lambda: scene_json(scene),
    ]
    for run in runs:
        checked = 0
        run()
        assert checked == 1


def test_a_scene_a_name_and_a_path_do_the_same(scenes_run: list[bytes], tmp_path: Path) -> None:
    path = file(tmp_path, MINIMAL)
    assert simulate(path).scene == str(path)
    assert simulate(load_scene(path)).scene == "scene"
    assert simulate(load_scene("remote_push")).scene == "Remote push"
    assert scenes_run[0] == scenes_run[1]


def test_signals_that_are_not_there_are_named() -> None:
    signals = Signals({"time_s": np.zeros(3)})
    with pytest.raises(KeyError, match="no signal 'x': there is time_s"):
        signals["x"]
    with pytest.raises(AttributeError, match="no signal 'x': there is time_s"):
        _ = signals.x
    with pytest.raises(AttributeError, match="the scene has no \\[record\\]"):
        _ = Signals({}).x
    assert len(pickle.loads(pickle.dumps(signals))["time_s"]) == 3


def test_the_package_offers_both_without_loading_them() -> None:
    import subprocess
    import sys

    program = (
        "import sys, haptether\nassert not {'numpy', 'msgspec', 'haptether.bridge'} & set(sys.modules)\n"
        "assert haptether.simulate.__module__ == 'haptether.bridge.scene.run'\nassert haptether.sweep"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
    assert haptether.simulate is simulate
    assert haptether.sweep is sweep
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        _ = haptether.simulat


# -------------------------------------------------------------------------------------------- sweeps


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
        # what follows from a number varies with it
        (
            {"master.encoder_quantum": [1e-5, 2e-5]},
            {"master.encoder_quantum": [1e-5, 2e-5], "safety.estimator.quantum_m": [1e-5, 2e-5]},
        ),
        ({"run.period_s": [1e-3, 5e-4]}, {"run.period_s": [1e-3, 5e-4], "slave.period_s": [1e-3, 5e-4]}),
        ({"slave.position": [0.02]}, {"slave.position.0": [0.02]}),
        # together allowed, each alone not
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
    assert of_mass == {f"master.mass_kg.{axis}": [0.1, 0.02] for axis in range(3)}


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
        ({"run.integrator": [1]}, 'run.integrator = "exact": a sweep of numbers cannot change it'),
        ({"safety.controllers": [1]}, 'safety.controllers.0 = "wsc": a sweep of numbers cannot change it'),
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
    # The other rows are what they are without it.
    ((path, values),) = varied.items()
    alone = sweep("remote_push", {path: [value for index, value in enumerate(values) if index != row]},
                  overrides=["run.duration_s=0.1"])  # fmt: skip
    assert list(alone.rows()) == rows


@pytest.mark.parametrize("threads", [1, 2])
def test_a_row_that_never_engages_has_no_metrics(threads: int, tmp_path: Path) -> None:
    delays = [0.05, 2.5, 20.0]
    result = sweep("remote_push", {"link.forward.delay_s": delays}, threads=threads)
    coupled, late, apart = result.rows()
    assert coupled["outcome"] == "complete"
    assert coupled["max_ejection_velocity"] > 0.1
    # The run ended before the hand let go: what it would have done then is not known.
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
    """What was given to the extension to sweep."""
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
        (
            {"grid": {"safety.controllers": [[1j]]}},
            "safety.controllers = [1j]: holds a complex: must be numbers, strings, booleans, lists or tables",
        ),
        (
            {"grid": {"link": [1]}},
            "link: is a table, no number: name a key of it, link.KEY: there is backward, forward",
        ),
        ({"grid": {"operator.legs": [1]}}, "is a list of tables, no number: name a key of it, operator.legs.0.KEY: "),
        ({"grid": {"run.integrator": [1]}}, 'run.integrator: takes no numbers, must be one of "exact", '),
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


@pytest.mark.parametrize("scene", [5, None, b"paper_wall", Scene])
def test_what_names_no_scene_is_refused(scene: object) -> None:
    for run in (simulate, load_scene, partial(sweep, grid={"safety.window": [1]})):
        with pytest.raises(SceneError, match=r"^scene = .*: must be the name of a shipped scene or the path of a TOML"):
            run(cast("Any", scene))


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ("a.mcap", "must be two files, of master and slave"),
        (["a.mcap", "b.mcap"], "must be two files"),
        (("a.mcap", 2), "must be two files"),
        (("a.mcap", "./a.mcap"), "master and slave both name a.mcap: give two files"),
    ],
)
def test_files_to_record_that_are_no_two_are_refused(
    record: object, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=f"^record.*: {re.escape(said)}"):
        simulate("remote_push", record=cast("Any", record))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("overrides", [5, None, "safety.window=3", [5], {"safety.window": 3}])
def test_overrides_that_are_no_list_of_texts_are_refused(overrides: object) -> None:
    for scene in ("paper_wall", load_scene("paper_wall")):
        with pytest.raises(SceneError, match=r"^overrides = .*: must be a list of texts, such as \["):
            simulate(scene, overrides=cast("Any", overrides))


@pytest.mark.parametrize(
    ("path", "numpy_values", "values"),
    [
        ("operator.legs.0.end", [[np.float64(0.01)]], [[0.01]]),
        ("operator.legs.0.end", [np.array([0.01])], [[0.01]]),
        ("run.integrator", np.array(["exact", "rk4"]), ["exact", "rk4"]),
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


def test_outcomes_are_the_names_that_runs_end_with() -> None:
    source = Path(__file__).parents[2] / "bridge" / "src"

    def names(of: str, path: str) -> set[str]:
        body = (source / path).read_text(encoding="utf-8").partition(f"impl {of} {{")[2]
        return set(re.findall(r'Self::\w+ => "(.+)",', body.partition("\n}\n")[0]))

    endings, states = names("Ending", "scene/measures.rs"), names("LadderState", "ladder/table.rs")
    assert len(endings) == 5
    assert states == set(LADDER_STATES)
    # Of the states those in which the two are coupled are no end.
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
    with pytest.raises(ValueError, match=r"must end in \.csv or \.npz"):
        result.save(tmp_path / "sweep.txt")
    with pytest.raises(KeyError, match=r"no column 'x': there is safety\.window, ticks"):
        result["x"]
    assert "2 rows" in repr(result)


LONG = ".".join(["a"] * 20_000)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{LONG} = 1\n", 'line 1: "a.a.a'),
        (f"schema = 1\n[{LONG}]\n", "line 2: "),
        (f"x = {{{LONG} = 1}}\n", "a key of more than 12 parts"),
        ('"a"' + ' . "a"' * 8000 + " = 1\n", "a key of more than 12 parts"),
        ("x = " + "[" * 100_000, "too deep within each other"),
        ("x = " + "{a=" * 30_000, "too deep within each other"),
        ("x = 1\n" * 100_000, "more than 262144 bytes"),
        ("a" * 250_000, "Expected '='"),
    ],
    ids=["key", "header", "inline", "quoted", "lists", "tables", "size", "word"],
)
def test_a_file_that_would_take_all_memory_is_refused_for_little(tmp_path: Path, text: str, said: str) -> None:
    # Of 40 kB of one dotted key TOML's reader makes 1.6 GB.
    (tmp_path / "bomb.toml").write_text(text, encoding="utf-8")
    ended = run_python(
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from haptether.bridge import SceneError, load_scene\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try:\n    load_scene(Path(sys.argv[1]))\n"
        "except SceneError as error:\n    print(error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n",
        str(tmp_path / "bomb.toml"),
    )
    refusal, used_kb = ended.splitlines()
    assert said in refusal
    assert int(used_kb) < 60_000


def test_an_override_with_a_key_without_end_is_refused() -> None:
    with pytest.raises(SceneError, match="a key of more than 12 parts"):
        load_scene("remote_push", [f"operator.legs=[{{{LONG} = 1}}]"])


def run_python(code: str, *arguments: str) -> str:
    """What a Python of its own prints."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True, timeout=60
    ).stdout


@pytest.mark.parametrize(
    ("scene", "change", "why"),
    [
        ("alignment", "coupling.alignment.max_angle=0.1", "arm is turned too far from the master"),
        ("remote_push", "link.backward.loss=1.0", "master and slave did not hear each other"),
        ("remote_push", "operator.clutch=[[6.0, 7.0]]", "the clutch was not pressed"),
        ("remote_push", "run.duration_s=0.06", "the run ended before both sides had aligned"),
    ],
)
def test_a_run_that_never_engages_says_why(scene: str, change: str, why: str) -> None:
    (event,) = (event for event in simulate(scene, overrides=[change]).events if event.kind == "never-engaged")
    assert event.detail == why


@pytest.mark.parametrize(("seen", "shown"), [("remote_push", '"remote_push"'), (3, "3"), (None, "nothing"), ([], "[]")])
def test_what_is_no_scene_is_refused_with_what_makes_one(seen: object, shown: str) -> None:
    with pytest.raises(SceneError) as refused:
        scene_json(cast("Scene", seen))
    assert str(refused.value) == f"scene = {shown}: must be a Scene; load_scene makes one of a name or a file"
