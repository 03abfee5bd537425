"""File names in overrides are relative to the working folder; those in a scene's file to the folder of that file."""

from pathlib import Path

import pytest

from haptether.bridge import SceneError, load_scene, override_scene, sweep
from haptether.cli.entry import main

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
        assert scene.link.forward is not None
        assert scene.link.forward.trace is not None
        assert scene.link.forward.trace.delay_s == (0.05, 0.06)


def test_a_missing_file_is_named_with_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=str(tmp_path / "none.csv")):
        load_scene("remote_push", ["link.forward.trace.file=none.csv"])


TABLE = "# normal\n" + "\n".join(str(8 * place) for place in range(-512, 512)) + "\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["remote_push", "--distribution", "few.dist"],
        ["remote_push", "--set", "distribution=few.dist"],
        ["remote_push", "--distribution", "normal", "--backward.distribution", "few.dist"],
        ["--set", "trace.file=network.csv"],
        ["--trace", "network.csv"],
    ],
)
def test_netsim_reads_files_of_the_working_folder(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "few.dist").write_text(TABLE)
    (tmp_path / "network.csv").write_text(TRACE)
    of_preset = [] if "network.csv" in arguments[-1] else ["--delay-s", "0.05", "--jitter-s", "0.01"]
    assert main(["netsim", "sample", *arguments, *of_preset, "--packets", "100"]) == 0


def test_a_scene_takes_a_distribution_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "few.dist").write_text(TABLE)
    link = load_scene("remote_push", ["link.forward.distribution=few.dist"]).link
    assert link is not None
    assert link.forward is not None
    assert not isinstance(link.forward.distribution, str)


def test_a_sweep_reads_files_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def delays(*delay_s: float) -> list[float]:
        for number, delay in enumerate(delay_s):
            (tmp_path / f"{number}.csv").write_text(TRACE.replace("0.05", str(delay)).replace("0.06", str(delay)))
        links = [{"trace": {"file": f"{number}.csv"}} for number in range(len(delay_s))]
        found = sweep("remote_push", {"link.forward": links}, overrides=["run.duration_s=2"])
        assert set(found.columns["outcome"]) <= {"complete", "not-released"}
        return list(found.columns["position_rmse_m"])

    near, far = delays(0.02, 0.2)
    assert far > near
    # The names are the same, and the files are read again.
    assert delays(0.2, 0.02) == [far, near]
