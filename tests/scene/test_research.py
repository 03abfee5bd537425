"""Controllers in Python: they act like those in Rust, their errors are reported, and live sides take none."""

import importlib.util
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from haptether.bridge import (
    LiveMaster,
    LiveSlave,
    SceneError,
    controller_names,
    controller_time,
    load_scene,
    register_controller,
    scene_json,
    simulate,
    sweep,
    sweep_to_file,
)
from haptether.bridge.scene import research
from haptether.safety import ResearchObservation, ejection_bound
from haptether.studies import evaluate, evaluation_html

Force = npt.NDArray[np.float64] | None
PRINTED = ["safety.hold_off_s=0", "safety.release_ramp_s=0", "safety.probe_force_n=0", "safety.release_tries=0"]
"""No hold-off, ramp or probe: only the law of a controller decides."""
OURS = [*PRINTED, "safety.controllers=[]", 'safety.research.controller="by-hand"']


class ByHand:
    """VFC, Eq. 1 and 2 of the paper."""

    def __init__(self, velocity_threshold: float = 0.6, force_threshold_n: float = 1.0, damping: float = 5.0) -> None:
        self.thresholds, self.damping = velocity_threshold * force_threshold_n, damping

    def step(self, seen: ResearchObservation) -> Force:
        if float(seen.velocity @ seen.rendered_force) / self.thresholds > 1.0:
            return -seen.rendered_force - seen.velocity * self.damping
        return None


@pytest.fixture(autouse=True)
def by_hand() -> Iterator[None]:
    before = dict(research._REGISTERED)
    register_controller("by-hand", ByHand)
    yield
    research._REGISTERED.clear()
    research._REGISTERED.update(before)


@pytest.mark.parametrize("scene", ["paper_wall", "remote_push", "three_axis_box"])
def test_the_law_of_vfc_acts_as_vfc_does(scene: str) -> None:
    """Compare with VFC. Three axes sum their products in another order: only the leading bits agree."""
    thresholds = ["safety.velocity_threshold=0.2", "safety.vfc_force_threshold_n=0.5", "safety.vfc_form=product"]
    recorded = ["record.every=1", *thresholds]
    options = ["safety.research.options={velocity_threshold=0.2, force_threshold_n=0.5}"]
    shipped = simulate(scene, overrides=[*PRINTED, *recorded, "safety.controllers=[vfc]"])
    written = simulate(scene, overrides=[*OURS, *recorded, *options])
    damped = {"shipped": (shipped.signals.tripped == 1).sum(), "written": (written.signals.tripped == 128).sum()}
    assert damped["shipped"] == damped["written"] > 0
    exact = scene != "three_axis_box"
    np.testing.assert_allclose(
        written.signals.device_force, shipped.signals.device_force, rtol=0.0, atol=0.0 if exact else 1e-9
    )
    assert written.metrics.max_ejection_velocity == pytest.approx(
        shipped.metrics.max_ejection_velocity, rel=0.0 if exact else 1e-9
    )
    assert [event.detail for event in written.events if event.kind == "trip"][:1] == ["research"]


def test_taking_the_force_away_is_whole_while_the_authority_fades() -> None:
    class Cancelling:
        def step(self, seen: ResearchObservation) -> Force:
            return -seen.rendered_force

    register_controller("cancelling", Cancelling)
    outage = 'link.backward.outages=[{times={kind="once",at_s=2.5,duration_s=0.5}}]'
    asked = ["safety.controllers=[]", 'safety.research.controller="cancelling"', "record.every=1", outage]
    signals = simulate("remote_push", overrides=asked).signals
    faded = np.abs(signals.rendered_force.ravel()) > 1.0
    assert faded[2500:2700].any()
    np.testing.assert_array_equal(signals.device_force, 0.0)


def test_a_failure_ends_a_sweep_at_once() -> None:
    steps = 0

    class Failing:
        def step(self, seen: ResearchObservation) -> Force:
            nonlocal steps
            steps += 1
            assert seen.time_s < 0.005
            return None

    register_controller("failing", Failing)
    with pytest.raises(RuntimeError, match=r"failing failed at 0\.005000 s: AssertionError"):
        sweep("remote_push", {"run.seed": list(range(50))}, overrides=['safety.research.controller="failing"'])
    assert steps == 6


def test_a_row_that_ends_early_has_no_step_after_its_end() -> None:
    steps = 0

    class Counting:
        def step(self, seen: ResearchObservation) -> Force:  # noqa: ARG002
            nonlocal steps
            steps += 1
            return None

    register_controller("counting", Counting)
    asked = ['safety.research.controller="counting"', "run.diverged_speed=0.2"]
    assert simulate("remote_push", overrides=asked).metrics.diverged
    of_run, steps = steps, 0
    sweep("remote_push", {"run.seed": [load_scene("remote_push").run.seed]}, overrides=asked)
    assert steps == of_run > 100


def test_others_run_beside_it() -> None:
    """Run another thread beside it, like the one that waits for Ctrl-C, also after the last call of `step`."""

    class Stopped:
        def step(self, _: ResearchObservation) -> Force:
            return None

    register_controller("stopped", Stopped)
    gaps, ended = [0.0], threading.Event()

    def beside() -> None:
        before = time.monotonic()
        while not ended.wait(0.002):
            gaps.append(time.monotonic() - before)
            before = time.monotonic()

    thread = threading.Thread(target=beside)
    thread.start()
    try:
        simulate("remote_push", overrides=["run.duration_s=60", 'safety.research.controller="stopped"'])
    finally:
        ended.set()
        thread.join()
    assert len(gaps) > 10
    assert max(gaps) < 2.0


def test_rows_of_a_controller_that_was_changed_are_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, out = tmp_path / "brakes.py", tmp_path / "rows.csv"

    def defined(text: str) -> None:
        file.write_text(text)
        spec = importlib.util.spec_from_file_location("brakes", file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "brakes", module)
        spec.loader.exec_module(module)
        register_controller("brake", module.Brake)

    def stored(*, resume: bool) -> int:
        def stop(done: int) -> None:
            if done >= 64 and not resume:
                raise KeyboardInterrupt

        return sweep_to_file(
            "paper_wall", out, {"run.seed": list(range(1, 101))}, overrides=['safety.research.controller="brake"'],
            resume=resume, progress=stop,
        ).rows  # fmt: skip

    defined("class Brake:\n    def step(self, seen):\n        return None\n")
    with pytest.raises(KeyboardInterrupt):
        stored(resume=False)
    defined("class Brake:\n    def step(self, seen):\n        return -seen.rendered_force\n")
    with pytest.raises(ValueError, match="controllers in Python"):
        stored(resume=True)
    defined("class Brake:\n    def step(self, seen):\n        return None\n")
    assert stored(resume=True) == 100


def test_it_is_drawn(tmp_path: Path) -> None:
    run = simulate("paper_wall", overrides=[*OURS, "record.every=1", "safety.research.options.velocity_threshold=0.1"])
    figure = run.plot(tmp_path / "run.png")
    assert "research" in [label.get_text() for axes in figure.axes for label in axes.get_yticklabels()]


def test_it_leaves_a_run_alone_while_it_adds_nothing() -> None:
    class Idle:
        def step(self, _: ResearchObservation) -> Force:
            return None

    register_controller("idle", Idle)
    scene = "remote_push"
    alone = simulate(scene, overrides=["record.every=1"]).signals
    idle = simulate(scene, overrides=["record.every=1", 'safety.research.controller="idle"']).signals
    for name in alone:
        np.testing.assert_array_equal(idle[name], alone[name])


def test_it_sees_what_is_recorded_at_each_tick() -> None:
    seen: list[tuple[float, ...]] = []

    class Watching:
        def __init__(self, axes: int, period_s: float, **_: object) -> None:
            assert (axes, period_s) == (1, 1e-3)

        def step(self, observation: ResearchObservation) -> Force:
            seen.append(
                (observation.time_s, *observation.velocity, *observation.rendered_force, *observation.grasp_force)
            )
            return None

    register_controller("watching", Watching)
    watching = ["record.every=1", "run.duration_s=0.5", 'safety.research={controller="watching", options={any=1}}']
    signals = simulate("paper_wall", overrides=[*watching, "safety.controllers=[hsc]"]).signals
    columns = np.array(seen).T
    np.testing.assert_allclose(columns[0], signals.time_s, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(columns[2], signals.rendered_force.ravel())
    np.testing.assert_array_equal(columns[3], signals.grasp_force.ravel())


class Wrong:
    """A controller with one defect."""

    def __init__(self, what: str) -> None:
        self.what = what

    def step(self, seen: ResearchObservation) -> object:
        match self.what if seen.time_s >= 0.1 else "nothing":
            case "raise":
                return [] / 0  # type: ignore[operator]
            case "many":
                return [0.0, 0.0]
            case "text":
                return "much"
            case "nan":
                return np.full(1, np.nan)
            case "huge":
                return 1e9
        return None


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("raise", "TypeError: unsupported operand"),
        ("many", r"step returned \[0.0, 0.0\]: must be a number "),
        ("text", "step returned 'much': must be a number "),
        ("nan", "step returned NaN N: must be a number .finite and at most 10000 N., or None"),
        ("huge", "step returned 1000000000 N: must be"),
    ],
)
@pytest.mark.parametrize("scene", ["paper_wall", "remote_push"])
def test_what_it_does_wrong_ends_the_run_with_its_cause(scene: str, what: str, said: str) -> None:
    register_controller("wrong", Wrong)  # type: ignore[arg-type]
    asked = [f'safety.research={{controller="wrong", options={{what="{what}"}}}}']
    with pytest.raises(RuntimeError, match=f"safety.research: wrong failed at 0.100000 s: .*{said}") as raised:
        simulate(scene, overrides=asked)
    assert isinstance(raised.value.__cause__, (TypeError, ValueError))
    with pytest.raises(RuntimeError, match="wrong failed at"):
        sweep(scene, {"run.seed": [1, 2]}, overrides=asked)
    # Nothing of it persists.
    assert simulate(scene, overrides=["run.duration_s=0.2"]).metrics.ticks == 200


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (['safety.research.controller="by-hant"'], "no such controller .*did you mean by-hand"),
        (['safety.research={controller="by-hand", options={thresh=1}}'], "unexpected keyword argument 'thresh'"),
        (['safety.research={controller="by-hand", options={damping=nan}}'], "must be a finite number"),
        (['safety.research={controller=""}'], "controller"),
        (["safety.research={}"], "controller is missing"),
        (['safety.research.controller="by-hand"', "safety.signals=true"], "sees what is estimated"),
        (['safety.research={controller="stepless"}'], "has no step"),
        (['safety.research={controller="refusing"}'], "limit = 3: must be below 2"),
        (['safety.research={controller="leaving"}'], r"\[safety.research\] controller = leaving: .*SystemExit"),
    ],
)
def test_what_cannot_be_is_refused_before_it_runs(overrides: list[str], said: str) -> None:
    class Stepless:
        pass

    class Refusing:
        def __init__(self) -> None:
            raise ValueError("limit = 3: must be below 2")

    register_controller("stepless", Stepless)  # type: ignore[arg-type]

    class Leaving:
        def __init__(self) -> None:
            sys.exit(0)

    register_controller("leaving", Leaving)  # type: ignore[arg-type]
    register_controller("refusing", Refusing)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match=said):
        simulate("paper_wall", overrides=overrides)


def test_it_watches_nothing_that_turns() -> None:
    with pytest.raises(SceneError, match="not what also turns"):
        load_scene("torque_release", ['safety.research.controller="by-hand"'])


def test_nothing_live_and_nothing_recorded_has_one(tmp_path: Path) -> None:
    scene = load_scene("remote_push", OURS)
    with pytest.raises(ValueError, match=r"safety\.research: runs in simulated runs and sweeps only"):
        LiveMaster(scene_json(scene), peer="127.0.0.1:9", run_id=2, key=secrets.token_bytes(32))
    with pytest.raises(ValueError, match=r"safety\.research: runs in simulated runs and sweeps only"):
        LiveSlave(scene_json(scene), listen="127.0.0.1:0", run_id=3, key=secrets.token_bytes(32))
    with pytest.raises(SceneError, match="no Python stands between a link and a hand"):
        load_scene("remote_push", [*OURS, 'master.driver="touch"'])
    with pytest.raises(SceneError, match="what is recorded is replayed"):
        simulate(scene, record=(tmp_path / "master.mcap", tmp_path / "slave.mcap"))


@pytest.mark.parametrize("name", ["wsc", "none", "", "a b", "a+b", 'a"b', "a\nb"])
def test_names_that_mean_something_else_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="must be none of"):
        register_controller(name, ByHand)


def test_rows_of_a_sweep_have_one_each_with_its_own_options() -> None:
    thresholds = [0.1, 0.3, 0.9]
    asked = [*OURS, "safety.research.options={velocity_threshold=1}"]
    before = controller_time()
    rows = sweep("paper_wall", {"safety.research.options.velocity_threshold": thresholds}, overrides=asked, threads=2)
    for threshold, row in zip(thresholds, rows.rows(), strict=True):
        alone = simulate("paper_wall", overrides=[*asked, f"safety.research.options.velocity_threshold={threshold}"])
        assert row["max_ejection_velocity"] == alone.metrics.max_ejection_velocity
    speeds = rows["max_ejection_velocity"]
    assert (np.diff(speeds) > 0.0).all(), speeds
    after = controller_time()
    assert after.ticks - before.ticks == 2 * sum(rows["ticks"].tolist())
    assert after.seconds > before.seconds


def test_whether_there_is_one_is_a_choice_like_any_other() -> None:
    table = {"controller": "by-hand", "options": {"velocity_threshold": 0.2}}
    choices: dict[str, list[object]] = {"safety.controllers": [[], ["vfc"]], "safety.research": [table]}
    rows = sweep("paper_wall", choices, overrides=PRINTED)
    none = sweep("paper_wall", {"safety.controllers": [[], ["vfc"]]}, overrides=PRINTED)
    assert (rows["max_ejection_velocity"] < none["max_ejection_velocity"]).all()


def test_it_is_evaluated_beside_the_others() -> None:
    found = evaluate(
        ["paper_wall"], controllers=["none", "by-hand"], round_trips_s=[0.0], hands=2, releases=2,
        overrides=["safety.research={controller='by-hand', options={velocity_threshold=0.2}}"],
    )  # fmt: skip
    none, ours = found.cells
    assert none.thrown == none.dangerous > 0
    assert ours.dangerous == none.dangerous
    assert ours.speed is not None
    assert none.speed is not None
    assert ours.speed < none.speed
    assert any("by-hand watches paper_wall" in line for line in found.assumed)
    assert "by-hand" in evaluation_html(found, command="haptether evaluate", worst=None)
    for wrong, said in (("by-hant", "'by-hant' is none of none, vfc, .*by-hand"), ("by-hand+other", "at most one")):
        register_controller("other", ByHand)
        with pytest.raises(ValueError, match=said):
            evaluate(["paper_wall"], controllers=[wrong], hands=1, releases=1)


def test_no_bound_is_known_of_it() -> None:
    bound = ejection_bound(load_scene("free_motion", ["safety.controllers=[wsc]"]))
    assert bound.speed is not None
    with_ours = ejection_bound(
        load_scene("free_motion", ["safety.controllers=[wsc]", 'safety.research.controller="by-hand"'])
    )
    assert with_ours.speed is None
    assert "by-hand, a controller in Python" in with_ours.text()


CONTROLLER = '''
class Braking:
    """Takes all force away after a time."""

    def __init__(self, period_s: float, after_s: float = 0.1):
        self.after_s = after_s

    def step(self, seen):
        return -seen.rendered_force if seen.time_s > self.after_s else None
'''


@pytest.mark.parametrize(
    ("controllers", "beside"),
    [(["by-hand"], []), (["by-hand", "hsc"], ["hsc"]), (["wsc", "by-hand", "hsc"], ["wsc", "hsc"])],
)
def test_controllers_may_name_one_in_python(controllers: list[str], beside: list[str]) -> None:
    short = load_scene("paper_wall", [f"safety.controllers={controllers}"])
    assert short == load_scene("paper_wall", [f"safety.controllers={beside}", 'safety.research.controller="by-hand"'])
    options = ["safety.research.options.velocity_threshold=0.2"]
    named = load_scene(
        "paper_wall", [f"safety.controllers={controllers}", 'safety.research.controller="by-hand"', *options]
    )
    assert named.safety.research is not None
    assert named.safety.research.options == {"velocity_threshold": 0.2}
    found = sweep("paper_wall", {"safety.controllers": [[], controllers]}, overrides=["run.duration_s=0.3"])
    alone = simulate(short, overrides=["run.duration_s=0.3"]).metrics
    assert found["peak_device_force"][1] == alone.peak_device_force


def test_none_stands_for_none_in_python() -> None:
    values = ["none", "by-hand"]
    found = sweep("paper_wall", {"safety.research.controller": values}, overrides=["safety.controllers=[]"])
    assert list(found["max_ejection_velocity"]) == [
        simulate("paper_wall", overrides=["safety.controllers=[]"]).metrics.max_ejection_velocity,
        simulate("paper_wall", overrides=["safety.controllers=[by-hand]"]).metrics.max_ejection_velocity,
    ]


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["safety.controllers=[by-hand,other]"], "by-hand and other: at most one in Python"),
        (["safety.controllers=[by-hand]", "safety.research.controller=other"], "by-hand and other: at most one"),
        (["safety.controllers=[by-hant]"], 'controllers.0 = "by-hant": must be one of'),
    ],
)
def test_names_of_controllers_that_cannot_be_are_refused(overrides: list[str], said: str) -> None:
    register_controller("other", ByHand)
    with pytest.raises(SceneError, match=said):
        load_scene("paper_wall", overrides)


def test_a_resume_sees_that_one_of_several_controllers_was_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = iter(["before", "after"])
    current = next(changed)
    monkeypatch.setattr("haptether.bridge.scene.sweeps.store.source_of", lambda name: f"{name} {current}")

    def stored(*, resume: bool) -> int:
        def stop(done: int) -> None:
            if done >= 64 and not resume:
                raise KeyboardInterrupt

        grid: dict[str, list[object]] = {
            "safety.controllers": [["wsc"], ["by-hand"]], "run.seed": list(range(1, 61))
        }  # fmt: skip
        short = ["run.duration_s=0.05"]
        return sweep_to_file("paper_wall", tmp_path / "a.csv", grid, overrides=short, resume=resume, progress=stop).rows

    with pytest.raises(KeyboardInterrupt):
        stored(resume=False)
    current = next(changed)
    with pytest.raises(ValueError, match="controllers in Python"):
        stored(resume=True)
    current = "before"
    assert stored(resume=True) == 120


def test_a_package_names_one_by_an_entry_point(tmp_path: Path) -> None:
    (tmp_path / "braking.py").write_text(CONTROLLER)
    metadata = tmp_path / "braking-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: braking\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[haptether.controllers]\nbrake = braking:Braking\ngone = braking:Gone\n"
    )
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); from haptether.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", code, str(tmp_path)]

    def ran(*arguments: str, status: int = 0) -> str:
        done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == status, done.stderr
        return done.stdout + done.stderr

    listed = ran("list")
    assert "brake" in listed
    assert "gone: braking:Gone of braking cannot be loaded" in " ".join(listed.split())
    said = ran("simulate", "paper_wall", "--set", 'safety.research={controller="brake", options={after_s=0.2}}')
    assert "controller in Python: 1500 ticks" in said or "controller in Python: " in said
    assert "us each" in said
    swept = ran("sweep", "paper_wall", "--vary", "safety.controllers=none,[wsc],[brake],[hsc,brake]")
    assert "hsc+brake  complete" in swept
    assert "4 rows: 4 complete" in swept
    asked = ["--quick", "--hands", "1", "--releases", "1", "--round-trip-s", "0", "--network", "steady"]
    assert "HSC + brake: " in ran("evaluate", "paper_wall", *asked, "--controller", "none", "hsc+brake")
    assert "brake" not in controller_names()
    assert "no such controller" in ran("simulate", "paper_wall", "--safety.research.controller", "brak", status=2)
