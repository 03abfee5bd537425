"""Partly damaged recordings: valid parts are read, and damage is reported with the name of the file."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from haptether import _core
from haptether.bridge import playback_scene, read_recording, replay, simulate
from haptether.cli import main

COMMANDS = ("info", "replay", "explain", "playback", "export")
SLOW_COMMANDS = ("tune", "plot")
SLOW_SCENES = {"{}", "cut 0.5", "null safety", "empty master", "text run"}


@pytest.fixture(scope="module")
def push(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("push")
    path = folder / "master.mcap"
    simulate("remote_push", overrides=["run.duration_s=1.2"], record=(path, folder / "slave.mcap"))
    return path


def changed_scene(scene: str, change: str) -> str:
    whole = json.loads(scene)
    match change.split():
        case ["without", table]:
            del whole[table]
        case ["null", table]:
            whole[table] = None
        case ["text", table]:
            whole[table] = "none"
        case ["empty", table]:
            whole[table] = {}
        case ["cut", share]:
            return scene[: int(float(share) * len(scene))]
        case _:
            return change
    return json.dumps(whole)


TABLES = ("run", "master", "slave", "safety", "coupling")
SCENES = [
    *("{}", "[]", "null", "7", '"scene"', "{", '{"run": 1}', '{"run": {}}', '{"run": {"seed": "x"}}'),
    *("cut 0.5", "cut 0.99"),
    *(f"{how} {table}" for how in ("without", "null", "text", "empty") for table in TABLES),
]


@pytest.mark.parametrize("change", SCENES)
def test_a_scene_that_is_damaged_is_named_with_its_file(
    change: str, push: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    columns = _core.read_recording_columns

    def damaged(path: Path) -> SimpleNamespace:
        read = columns(path)
        same = ("begun_ns", "causes", "columns", "meanings", "whole", "invalid", "damaged")
        about = {**read.about, "scene": changed_scene(read.about["scene"], change)}
        return SimpleNamespace(about=about, **{name: getattr(read, name) for name in same})

    monkeypatch.setattr("haptether.bridge.recording.read.read_recording_columns", damaged)
    monkeypatch.chdir(tmp_path)
    more: dict[str, list[str]] = {"plot": ["--out", "a.png"], "export": ["--csv", "a.csv"]}
    for command in (*COMMANDS, *(SLOW_COMMANDS if change in SLOW_SCENES else ())):
        status = main([command, str(push), *more.get(command, [])])
        said = capfd.readouterr().err
        errors = [line for line in said.splitlines() if line.startswith("haptether: ")]
        assert "Traceback" not in said
        assert len(errors) <= (status != 0), (command, said)
        assert all(push.name in error for error in errors), (command, errors)


BAD_LINES: dict[str, tuple[bytes, bytes]] = {
    "no JSON": (rb'"time_ns":\d+,"position":\[', b"}"),
    "a negative time": (rb'(?<="time_ns":)\d\d+(?=,"position":\[)', b"-"),
    "a text as position": (rb'(?<="position":\[)[\d.]+(?=\],"true_position")', b'"'),
}


@pytest.mark.parametrize("kind", BAD_LINES)
@pytest.mark.parametrize("place", [0.001, 0.5, 0.999])
def test_one_bad_line_costs_itself_alone(
    kind: str, place: float, push: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    whole, (pattern, after) = push.read_bytes(), BAD_LINES[kind]
    places = [found.start() for found in re.finditer(pattern, whole)]
    at = places[int(place * len(places))]
    path = tmp_path / "master.mcap"
    path.write_bytes(whole[:at] + after + whole[at + len(after) :])
    ticks = len(read_recording(push).signals["time_ns"])
    recording = read_recording(path)
    assert len(recording.signals["time_ns"]) == ticks - 1
    assert (recording.whole, recording.problems) == (True, ("1 record is not valid, and left out",))
    assert main(["info", str(path)]) == 0
    assert "1 record is not valid, and left out" in " ".join(capfd.readouterr().out.split())
    main(["replay", str(path)])
    said = " ".join(capfd.readouterr().out.split())
    assert "of the file: 1 record is not valid, and left out" in said
    assert f"all {ticks - 1} ticks" not in said


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_replay_says_that_the_rest_is_missing(
    share: float, push: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    whole = push.read_bytes()
    path = tmp_path / "master.mcap"
    path.write_bytes(whole[: int(share * len(whole))])
    assert main(["replay", str(path)]) == 0
    said = " ".join(capfd.readouterr().out.split())
    assert "what came after its last tick here is not replayed" in said
    assert "forces of all" not in said
    main(["info", str(path)])
    assert "cut off" in capfd.readouterr().out


def test_errors_of_a_scene_name_the_file(push: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording: Any = read_recording(push)
    spec = json.loads(recording.scene)
    spec["master"]["mass_kg"] = [-1.0] * len(spec["master"]["mass_kg"])
    columns = _core.read_recording_columns

    def odd(path: Path) -> SimpleNamespace:
        read = columns(path)
        same = ("begun_ns", "causes", "columns", "meanings", "whole", "invalid", "damaged")
        return SimpleNamespace(
            about={**read.about, "scene": json.dumps(spec)}, **{name: getattr(read, name) for name in same}
        )

    monkeypatch.setattr("haptether.bridge.recording.read.read_recording_columns", odd)
    for run in (replay, playback_scene):
        with pytest.raises(ValueError, match=r"master\.mcap: .*mass_kg"):
            run(push)
