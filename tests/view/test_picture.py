"""Pictures, films and pages: they show the description, or report why they cannot be made."""

import base64
import json
import math
import os
import re
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.view.shown import shown

from haptether.bridge import load_scene, simulate
from haptether.cli import main
from haptether.view import describe
from haptether.view.film import frame_times
from haptether.view.page.page import page
from haptether.view.picture.bands import Pixels
from haptether.view.picture.cameras import CAMERAS
from haptether.view.picture.gl import require_gl
from haptether.view.picture.layout import layout
from haptether.view.picture.picture import Picture
from haptether.view.scene3d import colours
from haptether.view.window.playback import SPEEDS, Playback, Player

SMALL = (560, 340)


def near(pixels: Pixels, colour: str, within: float) -> int:
    """Count the pixels with the hue of a colour, under any light."""
    wanted = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)], dtype=np.float64)
    given = pixels.astype(np.float64)
    cosine = given @ wanted / np.maximum(np.linalg.norm(given, axis=-1) * np.linalg.norm(wanted), 1e-9)
    return int(np.count_nonzero(cosine > math.cos(within)))


@pytest.mark.parametrize(("name", "times_s"), [("remote_push", (0.3, 2.5)), ("ur_pick", (0.5, 4.0))])
def test_a_picture_shows_something_that_moves(name: str, times_s: tuple[float, float]) -> None:
    with Picture([shown(name)[2]], size=SMALL) as picture:
        first, second = (picture.image(time_s) for time_s in times_s)
        again = picture.image(times_s[0])
        views = picture.columns[0].views
    assert first.shape == (SMALL[1], SMALL[0], 3)
    assert np.array_equal(first, again), "the same time is the same picture"
    for view in views.values():
        part = (slice(view.top, view.top + view.height), slice(view.left, view.left + view.width))
        assert np.std(first[part]) > 10.0
        assert np.count_nonzero(np.any(first[part] != second[part], axis=-1)) > 100


def test_an_arrow_is_seen_only_while_there_is_a_force() -> None:
    # With the paper's thresholds the device flies further, and the arm leaves the wall.
    run, _, described = shown("remote_push", "safety.preset=paper")
    with Picture([described], size=SMALL) as picture:
        view = picture.columns[0].views["robot"]
        counts = {}
        # Before contact, and after the arrow has left the wall.
        for time_s in (0.3, 3.5):
            image = picture.image(time_s)[view.top : view.top + view.height, view.left : view.left + view.width]
            counts[float(run.signals["environment_force"][round(1000 * time_s)])] = near(
                image, colours.ENVIRONMENT_FORCE, 0.1
            )
    (none, of_none), (some, of_some) = sorted(counts.items())
    assert none == 0.0
    assert some > 1.0
    assert of_none == 0
    assert of_some > 40


@pytest.mark.parametrize("runs", [1, 2, 3])
@pytest.mark.parametrize("size", [(320, 240), (1280, 720), (900, 1200)])
def test_nothing_of_the_layout_overlaps(runs: int, size: tuple[int, int]) -> None:
    taken = np.zeros((size[1], size[0]), dtype=int)
    for column in layout(size, runs):
        for of in (column.head, column.foot, *column.captions.values(), *column.views.values()):
            assert of.width > 0
            assert of.height > 0
            taken[of.top : of.top + of.height, of.left : of.left + of.width] += 1
    assert taken.max() == 1
    assert np.mean(taken) > 0.97


def test_a_click_on_the_time_line_is_a_time() -> None:
    with Picture([shown("remote_push")[2]], size=SMALL) as picture:
        foot = picture.columns[0].foot
        low = foot.top + foot.height - 10
        times = [picture.time_at(x, low) for x in (0, SMALL[0] // 2, SMALL[0] - 1)]
        assert picture.time_at(SMALL[0] // 2, 10) is None
    assert times[0] == 0.0
    assert times[1] == pytest.approx(2.0, abs=0.05)
    assert times[2] == pytest.approx(3.999, abs=1e-3)


def test_a_camera_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=f"must be one of {', '.join(CAMERAS)}"):
        Picture([shown("remote_push")[2]], size=SMALL, camera="below")


def test_a_player_stops_at_the_end_and_begins_anew() -> None:
    player = Player(0.0, 4.0)
    assert not player.advance(1.0)
    player.toggle()
    player.change_speed(1)
    assert player.speed == 2.0
    assert player.advance(1.5)
    assert player.time_s == 3.0
    player.advance(9.0)
    assert (player.time_s, player.is_playing) == (4.0, False)
    player.step(-1)
    assert player.time_s == pytest.approx(3.99)
    player.go(4.0)
    player.toggle()
    assert player.time_s == 0.0
    for _ in range(20):
        player.change_speed(-1)
    assert player.speed == SPEEDS[0]


@pytest.mark.parametrize(
    ("span", "fps", "speed", "count", "last"),
    [
        ((0.0, 1.0), 10.0, 1.0, 11, 1.0),
        ((1.0, 2.0), 10.0, 0.5, 21, 2.0),
        ((0.0, 0.95), 10.0, 2.0, 5, 0.8),
        ((3.0, 3.0), 25.0, 1.0, 1, 3.0),
    ],
)
def test_frames_are_at_their_times(
    span: tuple[float, float], fps: float, speed: float, count: int, last: float
) -> None:
    times_s = frame_times(*span, fps, speed)
    assert len(times_s) == count
    assert times_s[-1] == pytest.approx(last)


def test_a_film_has_its_frames_and_is_its_owners(tmp_path: Path) -> None:
    film = tmp_path / "push.gif"
    options = ["--from-s", "2.6", "--until-s", "2.9", "--fps", "20", "--size", "320x240", "--movie", str(film)]
    assert main(["view", "remote_push", "--compare", "safety.controllers=[]", *options]) == 0
    with Image.open(film) as read:
        assert (read.n_frames, read.size) == (7, (320, 240))  # type: ignore[attr-defined]
    assert stat.S_IMODE(film.stat().st_mode) == 0o600


def test_a_page_holds_what_moves_and_needs_nothing_else() -> None:
    run, _, described = shown("remote_push")
    times_s = [1.0, 2.5, 3.0]
    text = page([described], times_s)
    assert not re.search(r"(?:src|href)\s*=|https?://|import\(", text)
    found = re.search(r"const CONTENT = (\{.*?\});?\n", text)
    assert found is not None
    content = json.loads(found[1])
    (part,) = [part for part in content["runs"][0]["parts"] if part["name"] == "stylus"]
    poses = np.frombuffer(base64.b64decode(part["poses"]), dtype="<f4").reshape(-1, 3, 4)
    assert poses[:, 0, 3] == pytest.approx(run.signals["position"][[1000, 2500, 3000]], abs=1e-6)
    assert content["times"] == times_s
    assert len(content["runs"][0]["status"]) == 3


def test_a_title_cannot_leave_the_script_of_a_page() -> None:
    run, scene, _ = shown("remote_push")
    text = page([describe(run, scene, title="</script><script>alert(1)")], [0.0])
    assert text.count("</script>") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "which run"),
        (["no_such_scene", "--html", "a.html"], "no shipped scene"),
        (["remote_push", "--size", "10x10"], "--size 10x10: must be WxH"),
        (["remote_push", "--fps", "0", "--movie", "a.gif"], "--fps 0: must be 1 to 60"),
        (["remote_push", "--at-s", "9", "--screenshot", "a.png"], "--at-s 9: must be within the run, 0 to 4 s"),
        (["remote_push", "--screenshot", "a.jpg"], "must end in .png"),
        (["remote_push", "--movie", "a.avi"], "must end in .gif or .mp4"),
        (["remote_push", "--html", "a.htm"], "must end in .html"),
        (["remote_push", "--title", "a", "--title", "b", "--html", "a.html"], "--title: given 2 times"),
        (["none.mcap", "--html", "a.html"], "none.mcap: no such file"),
        (["remote_push"], "no display"),
    ],
)
def test_a_request_that_cannot_be_met_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    # A folder in which no side of another test runs.
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert main(["view", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not list((tmp_path / "here").iterdir())


def test_a_film_as_mp4_needs_ffmpeg(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", "")
    assert main(["view", "remote_push", "--movie", str(tmp_path / "a.mp4")]) == 2
    assert "needs ffmpeg on PATH" in capsys.readouterr().err


NO_LIBRARY, NO_DRIVER = "LD_LIBRARY_PATH", "__EGL_VENDOR_LIBRARY_DIRS"


@pytest.mark.parametrize("missing", [NO_LIBRARY, NO_DRIVER])
def test_without_opengl_the_packages_are_named(missing: str, tmp_path: Path) -> None:
    # An invalid file replaces the library; an empty folder replaces the drivers.
    (tmp_path / "libEGL.so.1").touch()
    (tmp_path / "drivers").mkdir()
    folder = tmp_path if missing == NO_LIBRARY else tmp_path / "drivers"
    ended = subprocess.run(
        [sys.executable, "-m", "haptether", "view", "remote_push", "--screenshot", str(tmp_path / "a.png")],
        env={**os.environ, missing: str(folder)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.endswith("on Debian or Ubuntu install libegl1 libegl-mesa0 libgl1-mesa-dri")


def test_keys_and_clicks_steer_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    # The window is never shown, and EGL draws it if there is no screen.
    require_gl()
    monkeypatch.setattr("haptether.view.picture.picture.require_gl", lambda window: None)  # noqa: ARG005
    run, _, described = shown("remote_push")
    window = Playback([described], size=SMALL, camera="front", at_s=2.0)
    trip_s = next(event.time_s for event in run.events if event.kind == "trip")
    for key, time_s, camera in (
        ("Right", 2.01, "front"),
        ("t", trip_s, "front"),
        ("3", trip_s, "top"),
        ("question", trip_s, "top"),
        ("Home", 0.0, "top"),
        ("x", 0.0, "top"),
    ):
        window.press(key)
        assert window.player.time_s == pytest.approx(time_s), key
        assert window.picture.camera == camera, key
    window.click(SMALL[0] // 2, 10)
    assert window.player.time_s == pytest.approx(2.0, abs=0.05)
    window.press("space")
    window.tick()
    assert window.player.is_playing
    assert window.player.time_s > 1.9
    window.picture.close()


def test_a_link_is_not_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "kept").write_text("kept")
    link = tmp_path / "a.png"
    link.symlink_to(tmp_path / "kept")
    assert main(["view", "remote_push", "--screenshot", str(link)]) == 1
    assert "symbolic link" in capsys.readouterr().err
    assert (tmp_path / "kept").read_text() == "kept"


def test_a_minute_opens_at_once() -> None:
    scene = load_scene("remote_push", ["run.duration_s=60"])
    run = simulate("remote_push", overrides=["run.duration_s=60"])
    begun = time.perf_counter()
    with Picture([describe(run, scene)], size=SMALL) as picture:
        picture.image(30.0)
    # On two quiet cores 2.1 s, of which VTK takes 1.5 s to load; a loaded machine may take several times that.
    assert time.perf_counter() - begun < 10.0


def test_what_is_shown_as_json(tmp_path: Path) -> None:
    report = tmp_path / "shown.json"
    assert main(["view", "ur_pick", "--html", str(tmp_path / "a.html"), "--fps", "2", "--json", str(report)]) == 0
    (run,) = json.loads(report.read_text())["runs"]
    assert "gripper" in run["parts"]
    assert [event["kind"] for event in run["events"]].count("grip") == 1


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["--until-s", "4"], 0),
        (["--until-s", "0.3", "--set", "run.duration_s=0.3"], 0),
        (["--until-s", "0.7", "--set", "run.duration_s=0.7", "--set", "record.every=10"], 0),
        (["--from-s", "3.5", "--until-s", "4"], 0),
        (["--until-s", "4.001"], 2),
        (["--until-s", "0.31", "--set", "run.duration_s=0.3"], 2),
    ],
)
def test_a_run_may_be_shown_until_its_last_tick_is_over(arguments: list[str], status: int, tmp_path: Path) -> None:
    assert main(["view", "remote_push", "--fps", "2", "--html", str(tmp_path / "a.html"), *arguments]) == status
