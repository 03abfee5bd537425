"""Stored rows of a sweep: damaged batches are computed again, and a file is replaced on request only."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haptether.bridge import sweep, sweep_to_file
from haptether.bridge.scene.sweeps import store
from haptether.cli import main

GRID: dict[str, list[Any]] = {"link.forward.delay_s": [0.01, 0.02], "run.seed": [1, 2, 3, 4, 5, 6]}
SHORT = ["run.duration_s=0.2"]


def kept(path: Path, *, rows: int, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the batches of an interrupted sweep."""
    monkeypatch.setattr(store, "SMALLEST_BATCH", 2)
    monkeypatch.setattr(store, "LARGEST_BATCH", 2)

    def interrupt(done: int) -> None:
        if done >= rows:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1, progress=interrupt)
    return sorted(path.with_name(f"{path.name}.partial").glob("rows-*.npz"))


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "no archive": lambda content: b"\x00" * len(content),
    "cut off": lambda content: content[: len(content) // 2],
    "empty": lambda _: b"",
    "text": lambda _: b"rows\n",
    "a byte in the middle": lambda content: content[:200] + bytes([content[200] ^ 255]) + content[201:],
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("which", [0, -1])
def test_a_damaged_batch_is_computed_again_before_the_rest(
    damage: str, which: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference, path = tmp_path / "reference.csv", tmp_path / "a.csv"
    sweep_to_file("remote_push", reference, GRID, overrides=SHORT, threads=1)
    batches = kept(path, rows=8, monkeypatch=monkeypatch)
    batches[which].write_bytes(DAMAGE[damage](batches[which].read_bytes()))
    seen: list[int] = []
    stored = sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1, resume=True, progress=seen.append)
    # The progress includes stored rows from the first call on.
    assert seen[0] == stored.resumed == 2 * (len(batches) - 1)
    assert path.read_bytes() == reference.read_bytes()


def test_a_damaged_request_is_said_without_advice_about_pickles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    kept(path, rows=4, monkeypatch=monkeypatch)
    for content in (b"", b"[]", b"\xff", b'{"version'):
        (tmp_path / "a.csv.partial" / "sweep.json").write_bytes(content)
        with pytest.raises(ValueError, match=r"sweep\.json: is damaged") as raised:
            sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1, resume=True)
        assert "pickle" not in str(raised.value)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_a_file_that_is_there_is_replaced_on_request_only(suffix: str, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = tmp_path / f"a{suffix}"
    path.write_text("no sweep\n")
    with pytest.raises(FileExistsError, match="is there already: --force replaces it"):
        sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1)
    assert path.read_text() == "no sweep\n"
    assert not list(tmp_path.glob("*.partial"))
    sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1, replace=True)
    before = path.read_bytes()
    with pytest.raises(FileExistsError):
        sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1)
    sweep_to_file("remote_push", path, GRID, overrides=SHORT, threads=1, replace=True)
    # The same sweep gives the same bytes.
    assert path.read_bytes() == before


def test_a_sweep_that_replaces_a_file_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    kept(path, rows=4, monkeypatch=monkeypatch)
    path.write_text("before\n")
    arguments = ["sweep", "remote_push", "--set", *SHORT, "--out", str(path), "--threads", "1"]
    for field, values in GRID.items():
        arguments += ["--vary", f"{field}={','.join(map(str, values))}"]
    assert main(arguments) == 1
    assert path.read_text() == "before\n"
    assert main([*arguments, "--resume"]) == 0
    assert path.read_text() != "before\n"


FAULTS: list[dict[str, list[float]]] = [
    {"safety.window": [0.0], "link.forward.loss": [2.0]},
    {"link.forward.loss": [2.0], "safety.window": [0.0]},
    {"operator.stiffness": [-1.0], "link.forward.delay_s": [-1.0], "master.mass_kg": [-1.0]},
    {"run.duration_s": [-1.0], "run.seed": [-1.0]},
    {"coupling.position_scale": [-5.0], "safety.limiter.max_force_n": [-3.0]},
    {"link.forward.jitter_s": [0.5], "link.forward.delay_s": [-0.1], "run.seed": [-1.0]},
]


@pytest.mark.parametrize("fields", FAULTS, ids=", ".join)
def test_a_row_with_several_faults_names_the_one_that_a_run_names(
    fields: dict[str, list[float]], capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [f"{path}={values[0]:g}" for path, values in fields.items()]
    assert main(["simulate", "remote_push", "--set", *settings]) == 2
    of_run = capsys.readouterr().err.strip()
    good = {
        "run.duration_s": 0.1,
        "safety.window": 20.0,
        "run.seed": 1.0,
        "link.forward.loss": 0.0,
        "link.forward.jitter_s": 0.0,
    }
    rows = {path: np.array([values[0], good.get(path, 1.0)]) for path, values in fields.items()}
    refused = sweep("remote_push", samples=rows, overrides=[] if "run.duration_s" in fields else ["run.duration_s=0.1"])
    reason = str(refused["reason"][0])
    assert refused["outcome"][0] == "refused"
    assert of_run.endswith(reason), (of_run, reason)
