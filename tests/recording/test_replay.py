"""`haptether.replay`: bit-identical under a recording's own settings, and equal to another run under other settings."""

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.recording.files import write_recording

import haptether
from haptether import _core
from haptether.bridge import (
    LiveMaster,
    LiveSlave,
    Recording,
    SceneError,
    load,
    load_scene,
    read_recording,
    recorded_scene,
    replay,
    scene_json,
    simulate,
)
from haptether.cli import main

ALL = "safety.controllers=[vfc, hsc, wsc, pc]"
BAD_NETWORK = ["link.forward.loss=0.1", "link.backward.loss=0.1", "link.backward.jitter_s=0.02"]


def recorded(folder: Path, scene: str, *overrides: str) -> Path:
    """Return the recording of a master of a run in virtual time."""
    path = folder / "master.mcap"
    simulate(scene, overrides=overrides, record=(path, folder / "slave.mcap"))
    return path


@pytest.fixture(scope="module")
def push(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("push"), "remote_push")


@pytest.mark.parametrize("seed", [1, 7])
@pytest.mark.parametrize(
    ("scene", "overrides"),
    [
        ("remote_push", [ALL, "run.duration_s=3.2", *BAD_NETWORK]),
        ("remote_push", ['coupling.kind="pd-damped"', "coupling.damping=12", "run.duration_s=3.2", *BAD_NETWORK]),
        ("remote_push", ['coupling.kind="position-force-computed"', ALL, "run.duration_s=3.2"]),
        ("remote_push", ["safety.limiter.max_force_n=2", "master.measures_velocity=true", "run.duration_s=3.2"]),
        ("remote_push", [ALL, "link.master_clock.step_s=0.3", "link.master_clock.step_at_s=1.5", "run.duration_s=3"]),
        ("three_axis_box", [ALL]),
        ("torque_release", []),
        ("alignment", ["run.duration_s=1.5"]),
    ],
)
def test_a_run_under_its_own_settings_is_the_same_bit_for_bit(
    scene: str, overrides: list[str], seed: int, tmp_path: Path
) -> None:
    done = replay(recorded(tmp_path, scene, *overrides, f"run.seed={seed}"))
    assert done.identical
    assert (done.parts_s, done.level, done.hand, done.notes) == (None, "as measured", None, ())
    for name in ("rendered_force", "safety_force", "device_force", "grasp_force", "tripped"):
        np.testing.assert_array_equal(done.replayed[name], done.recorded[name])
    # If nothing were rendered, all results would be trivially equal.
    assert np.abs(done.replayed["device_force"]).max() > 0.1 or "device_torque" in done.replayed
    # Decisions are recomputed, not read from the recording: half the force gives another result.
    forces = {name: 0.5 * done.recorded[name] for name in done.recorded if name.startswith("requested_")}
    weaker = msgspec.structs.replace(read_recording(tmp_path / "master.mcap"), signals={**done.recorded, **forces})
    if any(force.any() for force in forces.values()):
        assert not replay(weaker).identical


@pytest.mark.parametrize(("integrator", "step_s"), [("exact", None), ("rk4", 1e-4)])
def test_a_recording_from_before_the_stepped_integrators_were_removed_is_replayed(
    integrator: str, step_s: float | None, push: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = _core.read_recording_columns

    def older(path: Path) -> SimpleNamespace:
        read = columns(path)
        scene = json.loads(read.about["scene"])
        scene["run"] |= {"integrator": integrator, "step_s": step_s}
        scene["master"]["friction_speed"] = 1e-3
        same = {name: getattr(read, name) for name in (
            "begun_ns", "causes", "columns", "meanings", "whole", "invalid", "damaged")}  # fmt: skip
        return SimpleNamespace(about={**read.about, "scene": json.dumps(scene)}, **same)

    now = read_recording(push).scene
    monkeypatch.setattr("haptether.bridge.recording.read.read_recording_columns", older)
    assert json.loads(read_recording(push).scene) == json.loads(now)
    assert replay(push).identical
    assert not replay(push, overrides=["safety.controllers=[hsc]", "safety.damping=9"]).identical
    assert recorded_scene(read_recording(push).scene) == recorded_scene(now)


def test_a_clock_that_was_set_leaves_ticks_out_and_the_past_behind(tmp_path: Path) -> None:
    step = ["link.master_clock.step_at_s=1.5", "run.duration_s=3"]
    late = read_recording(recorded(tmp_path, "remote_push", *step, "link.master_clock.step_s=0.3")).signals
    assert late["past"].tolist().count("stalled") == 1
    # 20 ms late is not a stall: the ticks between are carried over.
    slow = recorded(tmp_path, "remote_push", *step, "link.master_clock.step_s=0.02")
    assert read_recording(slow).signals["missed"].max() >= 5
    assert replay(slow).identical


def test_what_virtual_time_records_loads_as_the_run_itself(tmp_path: Path) -> None:
    path, other = tmp_path / "m.mcap", tmp_path / "s.mcap"
    run = simulate("peg_in_hole", overrides=["run.duration_s=0.5"], record=(path, other))
    read = load(path, other)
    assert read.specification == run.specification
    for name in ("position", "device_force", "slave_command", "environment_force", "orientation", "grasp_torque"):
        np.testing.assert_array_equal(read.signals[name], run.signals[name])
    with pytest.raises(SceneError, match=r"no two sides to record"):
        simulate("paper_wall", record=(path, other))
    with pytest.raises(SceneError, match=r"gone.m\.mcap: cannot be written"):
        simulate("peg_in_hole", record=(tmp_path / "gone" / "m.mcap", other))


def test_the_same_run_is_recorded_as_the_same_bytes(push: Path, tmp_path: Path) -> None:
    assert recorded(tmp_path, "remote_push").read_bytes() == push.read_bytes()


@pytest.mark.live
def test_a_live_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    specification = scene_json(load_scene("remote_push", ["operator.legs.0.duration_s=0.3", ALL]))
    paths = tmp_path / "slave.mcap", tmp_path / "master.mcap"
    how: dict[str, Any] = {"insecure": True, "min_free_bytes": 0}
    slave = LiveSlave(specification, listen="127.0.0.1:0", run_id=2, record=paths[0], **how)
    master = LiveMaster(specification, peer=slave.address, run_id=1, record=paths[1], **how)
    end_s = time.monotonic() + 20.0
    while (master.state, slave.state) != ("engaged", "engaged"):
        assert time.monotonic() < end_s, (master.state, slave.state)
        time.sleep(0.01)
    time.sleep(1.0)
    master.finish()
    slave.finish()
    done = replay(paths[1])
    assert done.identical, done.notes
    assert np.abs(done.recorded["device_force"]).max() > 0.5


@pytest.mark.parametrize(("instead", "off_by"), [("[]", 0.02), ("[hsc]", 0.1), ("[vfc]", 0.5)])
def test_a_modelled_hand_goes_as_it_would_have_under_other_settings(push: Path, instead: str, off_by: float) -> None:
    done = replay(push, overrides=[f"safety.controllers={instead}"])
    assert done.level == "hand modelled"
    assert any("is a model of it" in note for note in done.notes)
    # Compare with a run under those settings: until the arm answers, a round trip later, only the hand differs.
    truth = simulate("remote_push", overrides=[f"safety.controllers={instead}"])
    assert truth.metrics.max_ejection_velocity is not None
    assert done.after.largest_speed == pytest.approx(truth.metrics.max_ejection_velocity, rel=off_by)
    trip_s = next(event.time_s for event in load(push).events if event.kind == "trip")
    assert done.parts_s is not None
    assert done.parts_s <= trip_s
    assert not done.identical


def test_they_part_where_the_settings_first_matter(push: Path) -> None:
    done = replay(push, overrides=["safety.limiter.max_force_n=3"], hand="measured")
    force = np.abs(done.recorded["device_force"][:, 0])
    above = done.time_s[np.argmax(force > 3.001)]
    assert done.parts_s == pytest.approx(above, abs=2e-3)
    assert done.after.peak_device_force == 3.0
    scaled = replay(push, overrides=["coupling.force_scale=0.5"], hand="measured")
    held = slice(0, int(np.argmax(done.recorded["tripped"] != 0)) - 50)
    np.testing.assert_allclose(
        scaled.replayed["rendered_force"][held], 0.5 * done.recorded["rendered_force"][held], atol=2e-3
    )
    # A change without effect on the force gives the same result.
    assert replay(push, overrides=["safety.hold_off_s=0.1"], hand="measured").identical


@pytest.mark.parametrize(
    ("scene", "overrides", "stiffness", "damping"),
    [
        ("remote_push", [], 300.0, 8.0),
        ("remote_push", ["operator.stiffness=150", "operator.damping=4"], 150.0, 4.0),
        ("remote_push", ["operator.stiffness=600", "operator.damping=15", "run.seed=3"], 600.0, 15.0),
        ("three_axis_box", [], 300.0, 20.0),
        ("driving_network", [], 300.0, 8.0),
    ],
)
def test_the_hand_of_a_scene_is_identified(
    scene: str, overrides: list[str], stiffness: float, damping: float, tmp_path: Path
) -> None:
    path = recorded(tmp_path, scene, *overrides)
    hand = replay(path, overrides=["safety.controllers=[]"], hand="modelled").hand
    assert hand is not None
    # The tolerance is three of its own standard errors, plus the width of the kernel as a share of m / B.
    assert abs(hand.stiffness - stiffness) < 3.0 * hand.stiffness_error + 0.02 * stiffness
    assert hand.stiffness_error < 0.15 * stiffness
    assert abs(hand.damping - damping) < 3.0 * hand.damping_error + 0.05 * damping
    assert hand.damping_error < 0.25 * damping
    assert hand.mass_kg < 0.02, "the hand of a scene has none"
    assert hand.explained > 0.95
    release_s = next((event.time_s for event in load(path).events if event.kind == "release"), None)
    assert release_s is None or hand.held_s == pytest.approx(release_s, abs=0.1)


def test_a_hand_that_does_not_show_is_not_made_up(tmp_path: Path) -> None:
    path = recorded(tmp_path, "remote_push", "run.duration_s=0.5")
    done = replay(path, overrides=["safety.controllers=[]"])
    assert (done.level, done.hand) == ("as measured", None)
    assert any("the hand cannot be modelled, so it moves as it was measured" in note for note in done.notes)
    with pytest.raises(ValueError, match=r"the hand cannot be modelled: a force moves the hand in 0 windows"):
        replay(path, overrides=["safety.controllers=[]"], hand="modelled")


def without(recording: Recording, *ticks: int) -> Recording:
    kept = np.ones(len(recording.signals["time_ns"]), dtype=bool)
    kept[list(ticks)] = False
    return msgspec.structs.replace(
        recording, signals={name: values[kept] for name, values in recording.signals.items()}
    )


def test_ticks_that_are_not_in_the_file_are_said(push: Path) -> None:
    done = replay(without(read_recording(push), 1500, 1501, 1502))
    assert any(note.startswith("3 ticks are not in the file, the first before 1.503 s") for note in done.notes)
    before = done.time_s < 1.5
    np.testing.assert_array_equal(done.replayed["device_force"][before], done.recorded["device_force"][before])
    np.testing.assert_allclose(done.replayed["rendered_force"], done.recorded["rendered_force"], atol=0.05)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_file_that_is_cut_off_is_replayed_as_far_as_it_goes(push: Path, share: float, tmp_path: Path) -> None:
    whole = push.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(share * len(whole))])
    done = replay(cut)
    assert done.identical
    assert 0 < len(done.time_s) < 4000


def test_what_cannot_be_replayed_is_refused(push: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    old = write_recording(tmp_path / "old.mcap", "master", [{}])
    nothing = write_recording(tmp_path / "bare.mcap", "master", [{}], scene=None)
    garbled = tmp_path / "garbled.mcap"
    garbled.write_bytes(bytes(range(256)) * 40)
    slave = push.with_name("slave.mcap")
    refused: list[tuple[list[Any], str]] = [
        ([slave], "slave.mcap: of the slave, must be of the master"),
        ([old], "old.mcap: has no received_force, requested_force, gain, missed, past, given_fault: it was written by"),
        ([nothing], "bare.mcap: does not say with which scene it was run"),
        ([garbled], "garbled.mcap: no recording of Haptether"),
        ([push, "--set", "link.forward.delay_s=0.1"], "network, arm and ladder are those of the recording"),
        ([push, "--set", "safety.ladder.hold_after_s=0.1"], "network, arm and ladder are those of the recording"),
        ([push, "--set", "coupling.position_scale=2"], "does not change what is replayed"),
        ([push, "--set", "safety.controlers=[]"], "did you mean controllers?"),
        ([push, "--set", "safety.window=0"], "safety] window = 0"),
        ([push, "--plot", tmp_path / "one.gif"], "must end in .png, .pdf, .svg"),
    ]
    for arguments, text in refused:
        assert main(["replay", *(str(part) for part in arguments)]) == 2, arguments
        error = capfd.readouterr().err
        assert text in error, error
        assert len(error.splitlines()) == 1


def test_the_command_says_level_hand_and_where_they_part(
    push: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(push)]) == 0
    printed = capfd.readouterr().out
    assert "the forces of all 4000 ticks are those of the recording, bit for bit" in printed
    picture = tmp_path / "parted.svg"
    arguments = ["replay", str(push), "--set", "safety.controllers=[]", "--plot", str(picture)]
    assert main(arguments) == 0
    printed = capfd.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    trip_s = next(event.time_s for event in load(push).events if event.kind == "trip")
    speed = str(replay(push, overrides=["safety.controllers=[]"]).after.largest_speed)[:3]
    for text in ("level: hand modelled", "hand: K = 29", f"they part at {trip_s:.4f} s", speed, "is a model of it"):
        assert text in printed, text
    assert picture.read_bytes().startswith(b"<?xml")
    assert main([*arguments[:4], "--hand", "measured", "--json", "-"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert (report["level"], report["hand"], report["identical"]) == ("as measured", None, False)
    assert report["recorded"]["trips"] == 1
    assert report["replayed"]["trips"] == 0
    assert report["overrides"] == ["safety.controllers=[]"]


def test_a_recording_that_is_not_reproduced_fails(
    push: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = read_recording(push)
    force = changed.signals["device_force"].copy()
    force[2000] += 0.5
    changed = msgspec.structs.replace(changed, signals={**changed.signals, "device_force": force})
    monkeypatch.setattr("haptether.bridge.read_recording", lambda _: changed)
    assert main(["replay", str(push)]) == 1
    assert "they part at 2.0000 s" in capfd.readouterr().out


def test_it_is_a_public_name() -> None:
    assert haptether.replay is replay


def test_a_coupling_with_springs_is_not_recomputed(tmp_path: Path) -> None:
    path = recorded(tmp_path, "remote_push", 'coupling.kind="pd-damped"', "run.duration_s=1")
    replay(path, overrides=["safety.window=50"])
    with pytest.raises(SceneError, match="of the coupling position-force only, not of pd-damped"):
        replay(path, overrides=["coupling.force_scale=0.5"])
