"""`haptether export --foxglove`: the schemas that Foxglove publishes, and our own messages unchanged."""

import json
import shutil
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader
from tests.recording.files import write_recording

from haptether.bridge import load, simulate, write_foxglove
from haptether.bridge.recording.foxglove.write import LAYOUT
from haptether.cli import main
from haptether.view.scene3d.colours import ENVIRONMENT_FORCE

TIME = {"sec", "nsec"}
POSE = {"position": {"x", "y", "z"}, "orientation": {"x", "y", "z", "w"}}
ENTITY = {
    "timestamp", "frame_id", "id", "lifetime", "frame_locked", "metadata", "arrows", "cubes", "spheres", "cylinders",
    "lines", "triangles", "texts", "models",
}  # fmt: skip
ARROW = {"pose", "shaft_length", "shaft_diameter", "head_length", "head_diameter", "color"}
"""Fields that Foxglove's published schemas require."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("peg")
    paths = folder / "master.mcap", folder / "slave.mcap"
    simulate("peg_in_hole", overrides=["run.duration_s=2.4"], record=paths)
    return paths


def messages(path: Path) -> dict[str, list[tuple[str, int, Any]]]:
    """Return schema, time and content of all messages per topic, in the order of the file."""
    found: dict[str, list[tuple[str, int, Any]]] = defaultdict(list)
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            assert channel.message_encoding == "json"
            assert schema.encoding == "jsonschema"
            found[channel.topic].append((schema.name, message.log_time, json.loads(message.data)))
    return found


def conforms(value: Any, schema: dict[str, Any], at: str = "") -> None:  # noqa: ANN401  # any JSON
    """Check a message against the JSON schema of its channel."""
    kind = schema["type"]
    kinds: dict[str, tuple[type, ...]] = {
        "object": (dict,), "array": (list,), "number": (int, float), "integer": (int,), "string": (str,),
        "boolean": (bool,),
    }  # fmt: skip
    assert type(value) in kinds[kind], at
    if kind == "object":
        assert set(schema.get("required", ())) <= set(value), at
        for name, part in value.items():
            conforms(part, schema["properties"][name], f"{at}.{name}")
    elif kind == "array":
        for number, item in enumerate(value):
            conforms(item, schema["items"], f"{at}[{number}]")
    elif kind in {"integer", "number"}:
        assert schema.get("minimum", value) <= value <= schema.get("maximum", value), at


def pointed(quat: dict[str, float]) -> npt.NDArray[np.float64]:
    """Return the direction of the rotated x axis."""
    x, y, z, w = (quat[part] for part in "xyzw")
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])


def test_poses_frames_and_arrows_are_foxgloves(files: tuple[Path, Path], tmp_path: Path) -> None:
    target = tmp_path / "both.mcap"
    write_foxglove(target, *files)
    found = messages(target)
    schemas = {topic: {name for name, _, _ in of} for topic, of in found.items()}
    assert schemas == {
        "/tf": {"foxglove.FrameTransforms"},
        "/master": {"haptether.master"}, "/slave": {"haptether.slave"},
        "/master/pose": {"foxglove.PoseInFrame"}, "/slave/pose": {"foxglove.PoseInFrame"},
        "/master/forces": {"foxglove.SceneUpdate"}, "/slave/forces": {"foxglove.SceneUpdate"},
    }  # fmt: skip
    with target.open("rb") as file:
        reader = make_reader(file)
        texts = {schema.name: json.loads(schema.data) for schema, _, _ in reader.iter_messages() if schema is not None}
    for of in found.values():
        for name, _, content in of:
            if name.startswith("foxglove."):
                conforms(content, texts[name])
    run = load(*files)
    arrows = 0
    for _, at_ns, content in found["/slave/forces"]:
        (entity,) = content["entities"]
        assert set(entity) == ENTITY
        assert set(entity["timestamp"]) == TIME
        assert entity["timestamp"]["sec"] * 10**9 + entity["timestamp"]["nsec"] == at_ns
        tick = int(np.argmin(np.abs(run.signals.slave_time_s - at_ns * 1e-9)))
        force = run.signals.environment_force[tick]
        if np.linalg.norm(force) < 0.05:
            assert entity["arrows"] == []
            continue
        (arrow,) = entity["arrows"]
        arrows += 1
        assert set(arrow) == ARROW
        assert {name: set(part) for name, part in arrow["pose"].items()} == POSE
        assert "#{:02x}{:02x}{:02x}".format(*(round(255 * arrow["color"][part]) for part in "rgb")) == ENVIRONMENT_FORCE
        newtons = (arrow["shaft_length"] + arrow["head_length"]) / 0.01
        np.testing.assert_allclose(newtons * pointed(arrow["pose"]["orientation"]), force, atol=1e-9)
        np.testing.assert_array_equal(list(arrow["pose"]["position"].values()), run.signals.slave_position[tick])
    assert arrows > 20
    for _, at_ns, content in found["/master/pose"]:
        tick = int(np.argmin(np.abs(run.signals.time_s - at_ns * 1e-9)))
        turned = [content["pose"]["orientation"][part] for part in "wxyz"]
        np.testing.assert_array_equal(turned, run.signals.orientation[tick])
        assert content["frame_id"] == "master_base"
    children = {one["child_frame_id"] for _, _, content in found["/tf"] for one in content["transforms"]}
    assert children == {"master_base", "master", "slave_base", "slave"}


def test_our_own_messages_are_copied(files: tuple[Path, Path], tmp_path: Path) -> None:
    target = tmp_path / "both.mcap"
    write_foxglove(target, *files)
    both = messages(target)
    for path, topic in zip(files, ("/master", "/slave"), strict=True):
        assert both[topic] == messages(path)[topic]
    assert target.stat().st_mode & 0o777 == 0o600


def test_a_force_of_one_tick_is_seen(tmp_path: Path) -> None:
    ticks: list[dict[str, Any]] = [{"device_force": [0.0]}] * 57
    ticks[33] = {"device_force": [-6.0]}
    ticks[34] = {"device_force": [0.0]}
    target = tmp_path / "one.mcap"
    write_foxglove(target, write_recording(tmp_path / "m.mcap", "master", ticks))
    arrows = [content["entities"][0]["arrows"] for _, _, content in messages(target)["/master/forces"]]
    assert [len(of_update) for of_update in arrows] == [0, 0, 0, 1, 0, 0]
    np.testing.assert_allclose(pointed(arrows[3][0]["pose"]["orientation"]), [-1.0, 0.0, 0.0], atol=1e-12)


def test_what_has_no_place_is_refused(
    files: tuple[Path, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    joints = write_recording(
        tmp_path / "joints.mcap", "master", [{}], scene={"run": {"seed": 0}, "master": {"kind": "joints"}}
    )
    target = tmp_path / "out.mcap"
    refused: list[tuple[list[Any], str]] = [
        ([joints, "--foxglove", target], "angles have no place in three dimensions"),
        (
            [files[0], shutil.copy(files[0], tmp_path / "copy.mcap"), "--foxglove", target],
            "both are of the master, must be one of each side",
        ),
        ([files[0], "--foxglove", files[0]], "FILE, --foxglove: both name"),
    ]
    for arguments, text in refused:
        assert main(["export", *(str(part) for part in arguments)]) == 2
        error = capfd.readouterr().err
        assert text in error, error
    assert not target.exists()
    assert main(["export", *map(str, files), "--foxglove", str(target)]) == 0
    assert f"written: {target}" in capfd.readouterr().out.replace("\n", "")


def test_only_the_export_needs_the_library_of_the_format(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("haptether.extras.is_installed", lambda _: False)
    for module in [name for name in sys.modules if name.partition(".")[0] == "mcap"]:
        monkeypatch.setitem(sys.modules, module, None)
    assert len(load(*files).signals.time_s) > 1000
    with pytest.raises(ImportError, match=r"mcap is not installed: install haptether\[record\]"):
        write_foxglove(tmp_path / "out.mcap", *files)


def test_the_layout_names_what_is_there(files: tuple[Path, Path], tmp_path: Path) -> None:
    layout = json.loads(LAYOUT.read_text())
    target = tmp_path / "both.mcap"
    write_foxglove(target, *files)
    found = messages(target)
    panels = layout["configById"]
    assert set(panels["3D!haptether"]["topics"]) <= set(found)
    for panel in panels.values():
        for path in panel.get("paths", ()):
            topic, _, signal = path["value"].partition(".")
            assert signal.removesuffix("[0]") in found[topic][0][2], path

    def leaves(node: Any) -> set[str]:  # noqa: ANN401  # any JSON value
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)
