"""Scene files: names, overrides, recordings, and their effect on a run."""

import json
import pickle
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

import haptether
from haptether.bridge import (
    Event,
    Scene,
    SceneError,
    Signals,
    load_scene,
    override_scene,
    scene_json,
    scene_names,
    simulate,
    sweep,
)
from haptether.bridge.scene.checks import checked_spec
from haptether.netsim import LinkSettings, link_spec
from haptether.studies import RAVEN_ATTACKS

if TYPE_CHECKING:
    from collections.abc import Callable

SHIPPED = {
    "active_force",
    "alignment",
    "attack_replay",
    "bilateral_joints",
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
    "try",
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
    assert set(scene_names(attacks=True)) == SHIPPED


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
        ("safety.signals=estimated", "safety.signals", "estimated"),
        ("safety.vfc-form='product'", "safety.vfc_form", "product"),
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
        "locked_axes": [], "command_speed": 3.0, "command_reach": None, "changes": [], "change_factor": 2.0,
        "rotation_scale": 1.0, "torque_scale": 1.0, "locks_rotation": False, "rotation_axis": None,
        "command_angular_speed": 2.5, "command_turn": None, "alignment": None, "reference_point": None,
        "alternatives": [],
        "stiffness": None, "damping": None, "rotational_stiffness": None, "rotational_damping": None,
        "impedance": None, "start_energy_j": None, "spread_s": None, "environment_gain": None, "grasp_gain": None,
        "play_out_s": None, "tool_mass_kg": None, "tool_damping": None, "tool_lead_s": None,
    }  # fmt: skip


# ---------------------------------------------------------------------------------------- recordings


def played(name: str) -> str:
    return f'{MINIMAL}operator = {{ recorded = {{ file = "{name}" }} }}\n'


def test_a_recording_is_read_beside_its_scene(tmp_path: Path) -> None:
    (tmp_path / "hand.csv").write_text("# a comment\ntime_s, x\n0, 0.1\n0.5,0.2\n", encoding="utf-8")
    np.savez(tmp_path / "hand.npz", time_s=[0.0, 0.5], values=[0.1, 0.2])
    # Times of another clock, or before 0: a recording begins at its first record.
    (tmp_path / "late.csv").write_text('"time_s","x"\n1700000000,"0.1"\n1700000000.5,0.2\n', encoding="utf-8")
    np.savez(tmp_path / "early.npz", time_s=[-2.0, -1.5], values=[0.1, 0.2])
    for name in ("hand.csv", "hand.npz", "late.csv", "early.npz"):
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
        ("hand.csv", "time_s,x\n0,1e5\n", "hand.csv: Expected `float` <= 10000.0 - at `$.values[0][0]`"),
        ("hand.csv", None, "cannot be read: No such file"),
        ("hand.txt", "", "hand.txt: must be a .csv or .npz file"),
        ("hand.npz", "no zip", "hand.npz: is no .npz file of NumPy, or a damaged one"),
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
    """A result of the extension."""

    def __init__(self, ticks: int) -> None:
        self.signals = {"time_s": np.arange(ticks) * 1e-3, "position": np.zeros((ticks, 3))}
        self.events = [(0.1, "trip", "WSC"), (0.2, "release", "")]
        self.metrics = {"max_ejection_velocity": 0.5, "time_to_trip_s": None, "diverged": False, "ticks": ticks}
        self.reports = None


@pytest.fixture
def scenes_run(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Return the scenes passed to the extension."""
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
    # TOML's reader would need 1.6 GB for 40 kB of one dotted key.
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
    """Return the output of a separate Python process."""
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
