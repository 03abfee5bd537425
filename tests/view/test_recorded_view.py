"""Recordings and stored runs: one side or both, with and without a scene, and arms that they do not name."""

import json
import secrets
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.view.shown import shown

from haptether.bridge import LiveMaster, Metrics, Run, Signals, load, load_scene, scene_json, scene_names
from haptether.cli import main
from haptether.dynamixel.description import ArmKinematics, arm_names, load_arm
from haptether.view import describe
from haptether.view.saved import saved_run
from haptether.view.scene3d.chain import chain_frames
from haptether.view.scene3d.settings import scene_of_settings


def run_of(signals: Mapping[str, Any]) -> Run:
    arrays = {name: np.asarray(values) for name, values in signals.items()}
    return Run(scene="of a test", seed=0, version="", signals=Signals(arrays), events=(), metrics=Metrics())


@pytest.mark.parametrize("name", scene_names(attacks=True))
def test_settings_are_the_scene_as_far_as_it_is_drawn(name: str) -> None:
    scene = load_scene(name)
    again = scene_of_settings(json.loads(scene_json(scene)))
    assert again is not None
    assert again.master.axes == scene.master.axes
    assert again.safety.controllers == scene.safety.controllers
    assert (again.operator is None) == (scene.operator is None)
    given, read = (None if one is None else one for one in (scene.environment, again.environment))
    assert (read is None) == (given is None)
    if given is not None and read is not None:
        assert [type(thing.shape) for thing in read.objects] == [type(thing.shape) for thing in given.objects]
        assert [len(read.holes), len(read.handles), len(read.bodies)] == [
            len(given.holes), len(given.handles), len(given.bodies),
        ]  # fmt: skip


def test_a_saved_run_is_where_it_was(tmp_path: Path) -> None:
    run, scene, whole = shown("remote_push")
    run.save(tmp_path / "push.npz")
    again = saved_run(tmp_path / "push.npz")
    described = describe(again, scene)
    for time_s in (0.5, 2.5, 2.75):
        for part in ("stylus", "tool", "contact 0"):
            given, expected = described.part(part).pose(time_s), whole.part(part).pose(time_s)
            assert (given is None) == (expected is None)
            assert given is None or expected is None or np.array_equal(given, expected)
    trips = [(event.time_s, event.detail) for event in run.events if event.kind == "trip"]
    assert [(event.time_s, event.detail) for event in again.events if event.kind == "trip"] == trips
    assert any("no scene" in note for note in describe(again).notes)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"a": [1.0]}, "must have time_s and position"),
        ({"time_s": [0.0, 1.0], "position": [0.0]}, "position: must have one value for each of time_s"),
        (None, "no file of `Run.save`"),
    ],
)
def test_what_is_no_saved_run_is_refused(arrays: dict[str, list[float]] | None, said: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    if arrays is None:
        path.write_bytes(b"nothing of it")
    else:
        columns: dict[str, Any] = {name: np.array(values) for name, values in arrays.items()}
        np.savez(path, **columns)
    with pytest.raises(ValueError, match=said):
        saved_run(path)


def test_a_slave_alone_is_one_end() -> None:
    run, scene, whole = shown("remote_push")
    kept = {name: run.signals[name] for name in run.signals if name.startswith(("slave_", "environment_"))}
    described = describe(run_of(kept), scene)
    assert set(described.views) == {"robot"}
    assert any("nothing of the master" in note for note in described.notes)
    assert np.array_equal(described.part("tool").pose(2.5), whole.part("tool").pose(2.5))  # type: ignore[arg-type]


@pytest.mark.live
def test_the_recording_of_a_master_alone(tmp_path: Path) -> None:
    path, picture = tmp_path / "master.mcap", tmp_path / "a.png"
    spec = scene_json(load_scene("remote_push"))
    # Nobody answers at this port: the master ends by itself after half a second.
    master = LiveMaster(
        spec, peer="127.0.0.1:9", run_id=secrets.randbits(64), insecure=True, patience_s=0.5, record=path,
        min_free_bytes=0,
    )  # fmt: skip
    while not master.finished:
        time.sleep(0.02)
    master.finish()
    run = load(path)
    described = describe(run)
    assert set(described.views) == {"hand"}
    at = described.part("stylus").pose(0.3)
    assert at is not None
    assert at[0, 3] == pytest.approx(run.signals["position"][0])
    assert main(["view", str(path), "--at-s", "0.2", "--size", "320x240", "--screenshot", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", arm_names())
def test_a_chain_of_servos_ends_where_its_kinematics_do(name: str) -> None:
    arm = load_arm(name)
    q = np.linspace(-0.7, 0.9, len(arm.joints))
    tool, _, _ = ArmKinematics(arm).state(q.tolist(), [0.0] * len(q))
    assert chain_frames(arm, q)[-1][:3, 3] == pytest.approx(tool, abs=1e-12)
    time_s = np.array([0.0, 1.0])
    angles = np.stack([np.zeros(len(q)), q])
    signals = {"time_s": time_s, "position": angles, "slave_time_s": time_s, "slave_position": angles}
    described = describe(run_of(signals), arm=name, leader=name)
    for part in ("tool", "handle"):
        at = described.part(part).pose(1.0)
        assert at is not None
        assert at[:3, 3] == pytest.approx(tool, abs=1e-12)


def sent_and_pushed(force_n: tuple[float, float, float]) -> tuple[Run, ArmKinematics]:
    """Return servos that follow 0.1 s late, and the joint torques of a force at their tip."""
    arm = load_arm("gello-ur")
    kinematics = ArmKinematics(arm)
    time_s = np.arange(0.0, 1.0, 0.01)
    angles = np.array([0.3, -0.8, 1.2, 0.4, 0.5, 0.2]) + 0.5 * np.sin(3.0 * time_s)[:, None]
    late = np.concatenate([angles[:1].repeat(10, axis=0), angles[:-10]])
    torques = [kinematics.torques(q.tolist(), [*force_n, 0.0, 0.0, 0.0]) for q in late]
    signals = {
        "time_s": time_s, "position": angles, "slave_time_s": time_s, "slave_position": late, "slave_command": angles,
        "environment_force": torques,
    }  # fmt: skip
    return run_of(signals), kinematics


def test_servos_have_a_ghost_trails_and_what_acts_on_them() -> None:
    force_n = np.array([3.0, 1.0, -5.0])
    run, kinematics = sent_and_pushed((3.0, 1.0, -5.0))
    described = describe(run, arm="gello-ur", leader="gello-ur")
    moment = described.at(0.5)

    def tip(name: str, index: int) -> list[float]:
        return kinematics.state(run.signals[name][index].tolist(), [0.0] * 6)[0]

    ghost = moment.poses["ghost of the command: tool"]
    assert ghost is not None
    assert ghost[:3, 3] == pytest.approx(tip("slave_command", 50), abs=1e-12)
    for trail, name in (("tool trail", "slave_position"), ("command trail", "slave_command")):
        assert moment.trails[trail].shape == (51, 3)
        assert moment.trails[trail][20] == pytest.approx(tip(name, 20), abs=1e-12)
    arrows = {arrow.name: arrow for arrow in described.arrows}
    torques = run.signals["environment_force"][50]
    for joint, torque in enumerate(torques):
        arrow = arrows[f"robot torque {joint + 1}"]
        assert arrow.heads == 2
        assert np.linalg.norm(arrow.vector(0.5)) == pytest.approx(abs(torque))
    at_tip = arrows["robot tip force"]
    assert at_tip.vector(0.5) == pytest.approx(force_n, rel=0.03)
    assert at_tip.tail(0.5) == pytest.approx(tip("slave_position", 50), abs=1e-12)
    ((name, value, unit),) = described.status.at(0.5).numbers
    assert (name, unit) == ("T tool", "N m")
    assert value == pytest.approx(np.abs(torques).max())


def test_a_torque_that_no_force_at_the_tip_exerts_is_none() -> None:
    run, kinematics = sent_and_pushed((0.0, 0.0, 0.0))
    turning = kinematics.torques(run.signals["slave_position"][50].tolist(), [0.0, 0.0, 0.0, 0.5, 0.5, 0.5])
    run.signals["environment_force"][50] = turning
    described = describe(run, arm="gello-ur")
    (at_tip,) = [arrow for arrow in described.arrows if arrow.name == "robot tip force"]
    assert at_tip.length(0.5) == 0.0


def test_a_ur_that_no_recording_names() -> None:
    time_s = np.arange(0.0, 1.0, 0.02)
    position = np.stack([-0.3 + 0.1 * time_s, np.full_like(time_s, -0.4), np.full_like(time_s, 0.3)], axis=1)
    described = describe(run_of({"slave_time_s": time_s, "slave_position": position}), arm="ur5e")
    at = described.part("tool").pose(0.5)
    assert at is not None
    assert at[:3, 3] == pytest.approx(position[25])
    assert not any("chosen" in note for note in described.notes)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--connect", "a", "remote_push"], "--connect and a run or scene: must be one of the two"),
        (["--connect", "a", "--connect", "b", "--connect", "c"], "given 3 times, must be once for each side"),
        (["a.mcap", "b.npz"], "must be one scene, one .npz, or the .mcap of one side or of each"),
        (["a.npz", "--set", "run.seed=2"], "--set and --compare change scenes, not recordings"),
        (["remote_push", "--scene", "ur_pick"], "--scene and --slave-begun-s are of recordings"),
        (["remote_push", "--arm", "ur99", "--html", "a.html"], "--arm ur99: must be one of ur3"),
        (["remote_push", "--leader", "ur5e", "--html", "a.html"], "--leader ur5e: must be one of aloha-wx250s"),
    ],
)
def test_what_does_not_go_together_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["view", *arguments]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
