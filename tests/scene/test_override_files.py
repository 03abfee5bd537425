"""Files that overrides name are relative to the working folder; those of a scene's file to its folder."""

from pathlib import Path

import pytest

from haptether.bridge import SceneError, load_scene, override_scene

BARE = "link.forward={}"
TRACE = "time_s,delay_s\n0,0.05\n0.1,0.06\n"


@pytest.mark.parametrize(
    "override",
    [
        "link.forward.trace.file=network.csv",
        'link.forward.trace={file="network.csv"}',
        'link.forward={trace.file="network.csv"}',
    ],
)
def test_an_override_names_a_file_of_the_working_folder(
    override: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "network.csv").write_text(TRACE)
    for scene in (
        load_scene("remote_push", [BARE, override]),
        override_scene(load_scene("remote_push", [BARE]), [override]),
    ):
        assert scene.link is not None
        assert scene.link.forward.trace is not None
        assert scene.link.forward.trace.delay_s == (0.05, 0.06)


def test_a_missing_file_is_named_with_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=str(tmp_path / "none.csv")):
        load_scene("remote_push", ["link.forward.trace.file=none.csv"])
