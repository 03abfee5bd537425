"""A written scene reads back as the same scene."""

from pathlib import Path

import pytest

from haptether.bridge import load_scene, save_scene, scene_json, scene_names, scene_toml


@pytest.mark.parametrize("name", scene_names(attacks=True))
def test_a_shipped_scene_reads_as_it_was_written(name: str, tmp_path: Path) -> None:
    scene = load_scene(name)
    written = tmp_path / "scene.toml"
    save_scene(scene, written, "made of\nanother")
    again = load_scene(written)
    assert again == scene
    assert scene_json(again) == scene_json(scene)
    assert written.read_text().startswith("# made of\n# another\n")
    assert written.stat().st_mode & 0o777 == 0o600


def test_text_is_escaped(tmp_path: Path) -> None:
    scene = load_scene("free_motion", ['title="a \\"b\\" \\\\ \\u007f ä"'])
    written = tmp_path / "scene.toml"
    written.write_text(scene_toml(scene), encoding="utf-8")
    assert load_scene(written) == scene


def test_no_link_is_followed(tmp_path: Path) -> None:
    link = tmp_path / "link.toml"
    link.symlink_to(tmp_path / "elsewhere.toml")
    with pytest.raises(OSError, match="link"):
        save_scene(load_scene("free_motion"), link)
