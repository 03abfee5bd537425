"""`haptether playback`: a recorded force acts on another hand, in virtual time and live."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.recording.files import write_recording

from haptether.bridge import LiveMaster, LiveSlave, load, playback_scene, scene_json, simulate
from haptether.cli import main


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("push")
    paths = folder / "master.mcap", folder / "slave.mcap"
    simulate("remote_push", record=paths)
    return paths


@pytest.mark.parametrize("side", [0, 1])
def test_the_force_that_was_recorded_is_rendered(files: tuple[Path, Path], side: int) -> None:
    scene = playback_scene(files[side])
    assert scene.link is None
    played, was = simulate(scene), load(*files)
    name = ("received_force", "environment_force")[side]
    begun = int(np.argmax(was.signals[("state", "slave_state")[side]] == 2))
    force = was.signals[name][begun:]
    rendered = played.signals.rendered_force
    first = int(np.argmax(played.signals.state == 2))
    held = slice(300, 2500)
    # One tick from the arm to the hand, and one for its measurement.
    np.testing.assert_allclose(rendered[first:][held], force[held], atol=0.05)
    recorded = simulate("remote_push").metrics.max_ejection_velocity
    assert played.metrics.max_ejection_velocity == pytest.approx(recorded, rel=0.1)
    assert np.abs(rendered[-200:]).max() == 0.0, "it ends with the recording"


def test_the_safety_layer_is_there_and_can_be_changed(files: tuple[Path, Path]) -> None:
    guarded = simulate(playback_scene(files[1])).metrics.max_ejection_velocity
    bare = simulate(playback_scene(files[1], overrides=["safety.controllers=[]"])).metrics.max_ejection_velocity
    assert guarded is not None
    assert bare is not None
    assert bare > 4.0 * guarded


def test_three_axes_and_a_hand_that_turns(tmp_path: Path) -> None:
    for scene in ("three_axis_box", "torque_release"):
        paths = tmp_path / "m.mcap", tmp_path / "s.mcap"
        simulate(scene, overrides=["run.duration_s=1.5"], record=paths)
        played = simulate(playback_scene(paths[1]))
        assert not played.metrics.diverged
        was = load(paths[1]).signals.environment_force
        assert np.abs(played.signals.environment_force).max() == pytest.approx(np.abs(was).max(), abs=0.05)


def test_what_cannot_be_played_back_is_refused(
    files: tuple[Path, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    apart = tmp_path / "apart.mcap"
    simulate("remote_push", overrides=["run.duration_s=0.05"], record=(tmp_path / "m.mcap", apart))
    bare = write_recording(tmp_path / "bare.mcap", "slave", [{}], scene=None)
    refused: list[tuple[list[Any], str]] = [
        ([apart], "the two sides never engaged, so that there is no force to play back"),
        ([bare], "does not say with which scene it was run"),
        ([files[1], "--key", "k"], "--key: without --listen there is no live side: leave it out"),
        ([files[1], "--listen", "127.0.0.1:0", "--insecure", "--plot", tmp_path], "with --listen nothing is drawn"),
        ([files[1], "--set", "safety.controlers=[]"], "did you mean controllers?"),
        ([files[1], "--listen", "127.0.0.1:0"], "--key PATH is missing"),
    ]
    for arguments, text in refused:
        assert main(["playback", *(str(part) for part in arguments)]) == 2, arguments
        error = capfd.readouterr().err
        assert text in error, error


def test_the_command_plays_it_in_virtual_time(
    files: tuple[Path, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["playback", str(files[1]), "--plot", str(tmp_path), "--out", str(tmp_path / "run.npz")]) == 0
    assert "trip  wsc" in capfd.readouterr().out
    assert (tmp_path / "playback.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.live
def test_a_live_master_feels_it_after_its_clutch_and_nothing_after_the_end(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    scene = playback_scene(files[1])
    how: dict[str, Any] = {"insecure": True, "min_free_bytes": 0}
    slave = LiveSlave(scene_json(scene), listen="127.0.0.1:0", run_id=2, **how)
    path = tmp_path / "felt.mcap"
    # The master has its own scene, and knows nothing of a recording.
    master = LiveMaster(
        scene_json(playback_scene(files[1], overrides=["environment.pushers=[]", "safety.controllers=[wsc]"])),
        peer=slave.address, run_id=1, record=path, **how,
    )  # fmt: skip
    end_s = time.monotonic() + 20.0
    while master.state != "engaged":
        assert time.monotonic() < end_s
        time.sleep(0.01)
    time.sleep(1.6)
    slave.finish()
    time.sleep(0.3)
    master.finish()
    felt = load(path).signals
    first = int(np.argmax(felt.state == 2))
    assert not felt.device_force[:first].any(), "before the clutch there is no force"
    was = load(files[1]).signals
    begun = int(np.argmax(was.slave_state == 2))
    at = 1300
    assert felt.rendered_force[first + at] == pytest.approx(was.environment_force[begun + at], abs=0.5)
    assert np.abs(felt.device_force).max() > 2.0
    assert felt.device_force[-1] == 0.0, "the side that plays has ended"


@pytest.mark.live
def test_the_command_is_the_side_of_the_robot(files: tuple[Path, Path], capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["playback", str(files[1]), "--listen", "127.0.0.1:0", "--insecure", "--patience-s", "0.3"]) == 1
    assert "no master came within 0.3 s" in capfd.readouterr().err
