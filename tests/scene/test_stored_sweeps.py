"""Sweeps stored while they run: killed at any instant and resumed, they give the bytes of an unbroken run."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.bridge import SceneError, StoredSweep, sweep, sweep_to_file
from haptether.bridge.scene.sweeps import store, table_file
from haptether.bridge.scene.sweeps.design import Design, design_of

BRIEF = ("run.duration_s=0.2",)
GRID: dict[str, Any] = {"link.forward.delay_s": [0.0, 0.02, 0.05], "safety.controllers": [[], ["wsc"], ["hsc"]]}
SEEDS = {"run.seed": [1.0, 2.0, 3.0, 4.0]}
TIES = {"link.backward.delay_s": "link.forward.delay_s"}
SUFFIXES = (".csv", ".parquet", ".npz")


def stored(path: Path, **how: Any) -> StoredSweep:  # noqa: ANN401  # arguments of sweep_to_file
    return sweep_to_file("remote_push", path, GRID, SEEDS, ties=TIES, overrides=BRIEF, **how)


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use batches of five rows regardless of a common beginning, and row groups of seven: neither divides the other."""
    monkeypatch.setattr("haptether.bridge.scene.sweeps.design.MOST_SPANNED", 0)
    monkeypatch.setattr(store, "SMALLEST_BATCH", 5)
    monkeypatch.setattr(store, "LARGEST_BATCH", 5)
    monkeypatch.setattr(table_file, "ROW_GROUP", 7)


@given(lengths=st.lists(st.integers(1, 4), min_size=0, max_size=3), samples=st.integers(1, 4), cut=st.integers(0, 300))
def test_a_design_is_every_combination_with_all_samples(lengths: list[int], samples: int, cut: int) -> None:
    from itertools import product

    factors = {f"f{place}": np.arange(length) + 10.0 * place for place, length in enumerate(lengths)}
    design = Design(factors=factors, samples={"s": np.arange(samples) - 7.0}, ties={"t": "s"})
    expected = [(*levels, sample, sample) for *levels, sample in product(*factors.values(), np.arange(samples) - 7.0)]
    assert design.rows == len(expected)
    cut = min(cut, design.rows)
    halves = [design.columns(0, cut), design.columns(cut, design.rows)]
    assert list(halves[0]) == [*factors, "s", "t"]
    found = [row for half in halves for row in zip(*(column.tolist() for column in half.values()), strict=True)]
    assert found == expected


@pytest.mark.usefixtures("small_batches")
def test_a_file_has_the_rows_of_a_sweep_in_memory(tmp_path: Path) -> None:
    design = design_of(GRID, SEEDS, TIES)
    whole = sweep("remote_push", samples=design.columns(0, design.rows), overrides=BRIEF)
    # The jitter of the scene needs a delay above 0: the sweep contains refused rows.
    assert 0 < (whole["outcome"] == "refused").sum() < len(whole)
    seen: list[int] = []
    for suffix in (".csv", ".npz"):
        whole.save(tmp_path / f"whole{suffix}")
        kept = stored(tmp_path / f"stored{suffix}", collect=True, progress=seen.append)
        assert (tmp_path / f"stored{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()
        assert sorted(path.name for path in tmp_path.glob("*.partial")) == []
        assert kept.rows == sum(kept.outcomes.values()) == len(whole)
        assert kept.whole is not None
        assert list(kept.whole.rows()) == list(whole.rows())
        assert list(kept.head.rows()) == list(whole.rows())[: store.HEAD_ROWS]
        assert seen[-1] == len(whole)
        seen.clear()


@pytest.mark.usefixtures("small_batches")
def test_parquet_has_types_nulls_and_where_it_is_from(tmp_path: Path) -> None:
    parquet: Any = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "push.parquet"
    kept = stored(path, collect=True)
    assert kept.whole is not None
    kept.whole.save(tmp_path / "whole.parquet")
    # The rows are equal; a table in memory has no metadata of their origin.
    whole = parquet.read_table(tmp_path / "whole.parquet")
    assert whole.equals(parquet.read_table(path).replace_schema_metadata())
    assert not whole.schema.metadata
    file = parquet.ParquetFile(path)
    assert [file.metadata.row_group(at).num_rows for at in range(file.num_row_groups)] == [7, 7, 7, 7, 7, 1]
    metadata = {key.decode(): value.decode() for key, value in file.schema_arrow.metadata.items()}
    assert json.loads(metadata["haptether.sweep"])["vary"]["safety.controllers"] == GRID["safety.controllers"]
    scene = tmp_path / "again.toml"
    scene.write_text(metadata["haptether.scene"])
    design = design_of(GRID, SEEDS, TIES)
    again = sweep(scene, samples=design.columns(0, design.rows))
    assert file.read().to_pylist() == list(again.rows())
    types = {field.name: str(field.type) for field in file.schema_arrow}
    assert (types["false_trips"], types["ticks"], types["diverged"], types["outcome"], types["force_rmse_n"]) == (
        "int64", "int64", "bool", "string", "double"
    )  # fmt: skip


@pytest.mark.usefixtures("small_batches")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_interrupted_sweep_goes_on(suffix: str, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    reference, path = tmp_path / f"reference{suffix}", tmp_path / f"a{suffix}"
    stored(reference)

    def interrupt(done: int) -> None:
        if done >= 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stored(path, progress=interrupt)
    assert not path.exists()
    with pytest.raises(ValueError, match=r"has 1[05] rows of a sweep that was interrupted: resume it, or remove it"):
        stored(path)
    seen: list[int] = []
    assert stored(path, resume=True, progress=seen.append, threads=1).resumed in {10, 15}
    assert seen[0] in {10, 15}
    assert path.read_bytes() == reference.read_bytes()
    with pytest.raises(ValueError, match="nothing is left to resume"):
        stored(path, resume=True)
    # Resuming a sweep that never began starts it.
    assert stored(tmp_path / f"b{suffix}", resume=True).resumed == 0


@pytest.mark.usefixtures("small_batches")
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"grid": GRID | {"link.forward.delay_s": [0.1]}}, r"vary.link.forward.delay_s was \[0.0, 0.02, 0.05\], is"),
        ({"samples": {"run.seed": [1.0, 2.0, 3.0, 5.0]}}, r"samples.run.seed.values was"),
        ({"ties": {}}, "ties.link.backward.delay_s was .*, is absent"),
        ({"overrides": (*BRIEF, "safety.window=70")}, r"specification.safety.window was \d+, is 70"),
        ({"scene": "paper_wall", "grid": {"safety.window": [10]}, "ties": {}}, 'scene was "remote_push"'),
        ({"version": "9.9"}, 'version was "[^"]*", is "9.9"'),
    ],
)  # fmt: skip
def test_a_resume_of_something_else_is_refused(
    changed: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    with pytest.raises(KeyboardInterrupt):
        stored(path, progress=_interrupted)
    before = sorted((file.name, file.read_bytes()) for file in (tmp_path / "a.csv.partial").iterdir())
    if version := changed.pop("version", None):
        monkeypatch.setattr(store, "__version__", version)
    given_ = {"scene": "remote_push", "grid": GRID, "samples": SEEDS, "ties": TIES, "overrides": BRIEF} | changed
    with pytest.raises(ValueError, match=said):
        sweep_to_file(given_.pop("scene"), path, **given_, resume=True)
    assert sorted((file.name, file.read_bytes()) for file in (tmp_path / "a.csv.partial").iterdir()) == before


def _interrupted(done: int) -> None:
    if done:
        raise KeyboardInterrupt


def test_a_table_without_a_row_that_can_be_built_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"row 0: \[safety\] window = -1: must be 1 to"):
        sweep_to_file("remote_push", tmp_path / "a.csv", {"safety.window": [-1.0, 0.0]})
    with pytest.raises(ValueError, match=r"must end in \.csv, \.parquet or \.npz"):
        sweep_to_file("remote_push", tmp_path / "a.txt", {"safety.window": [1.0]})
    with pytest.raises(ValueError, match="progress = 5: must be a function"):
        sweep_to_file("remote_push", tmp_path / "a.csv", {"safety.window": [1.0]}, progress=5)  # type: ignore[arg-type]
    (tmp_path / "link.csv").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="is a symbolic link"):
        sweep_to_file("remote_push", tmp_path / "link.csv", {"safety.window": [1.0]})


# A child exits without cleanup at its n-th call that opens, renames, creates or removes a file; then the sweep resumes.
# The rows are stand-ins, as this test is not about their content.
KILLED_ANYWHERE = """
import os, sys
from pathlib import Path
import numpy as np
from haptether.bridge.scene.sweeps import store, table_file
store.SMALLEST_BATCH = store.LARGEST_BATCH = 4
def played(base, varied, how):
    rows = len(varied["run.seed"])
    return {"outcome": np.array(["complete"] * rows), "peak_device_force": varied["run.seed"] ** 0.5,
            "ticks": varied["run.seed"].astype(np.uint64), "reason": np.array([""] * rows)}
store.measured = played
folder = Path(sys.argv[1])
def run(path, resume):
    store.sweep_to_file("remote_push", path, {"run.seed": np.arange(1.0, 11.0)}, threads=1, resume=resume)
run(folder / "reference.csv", False)
reference = (folder / "reference.csv").read_bytes()
path = folder / "a.csv"
CALLS = {"open", "os.rename", "os.mkdir", "os.remove", "os.rmdir"}
number = killed = 0
while True:
    number += 1
    child = os.fork()
    if child == 0:
        calls = 0
        def hook(event, arguments):
            global calls
            if event in CALLS and str(arguments[0]).startswith(str(folder)) or event in {"os.remove", "os.rmdir"}:
                calls += 1
                if calls == number:
                    os._exit(9)
        sys.addaudithook(hook)
        run(path, False)
        os._exit(0)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert ended in {0, 9}, ended
    try:
        run(path, True)
    except ValueError as error:
        assert "nothing is left to resume" in str(error), error
    assert path.read_bytes() == reference, number
    assert sorted(file.name for file in folder.iterdir()) == ["a.csv", "reference.csv"], number
    path.unlink()
    if ended == 0:
        break
    killed += 1
print(killed)
"""


def test_a_kill_at_any_call_leaves_what_can_be_resumed(tmp_path: Path) -> None:
    answer = subprocess.run(
        [sys.executable, "-c", KILLED_ANYWHERE, str(tmp_path)], capture_output=True, text=True, timeout=60, check=False
    )
    assert answer.returncode == 0, answer.stderr
    assert int(answer.stdout) > 15


def test_a_process_that_is_ended_keeps_its_rows(tmp_path: Path) -> None:
    path, journal = tmp_path / "a.csv", tmp_path / "a.csv.partial"
    command = [
        sys.executable, "-m", "haptether", "sweep", "remote_push", "--vary", "link.forward.delay_s=0.01,0.02",
        "--samples", "500", "--set", "run.duration_s=0.1", "--threads", "1", "--out", str(path), "--resume",
    ]  # fmt: skip
    kept = 0
    for number, status in ((signal.SIGINT, {130, -signal.SIGINT}), (signal.SIGKILL, {-signal.SIGKILL})):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            until_s = time.monotonic() + 30.0
            while process.poll() is None and _kept(journal) <= kept:
                assert time.monotonic() < until_s
                time.sleep(0.002)
            process.send_signal(number)
            _, said = process.communicate(timeout=20.0)
        finally:
            process.kill()
            process.wait()
        assert process.returncode in status, said
        assert not path.exists()
        before, kept = kept, _kept(journal)
        assert before < kept < 1000
        if number == signal.SIGINT:
            assert f"{kept} of 1000 rows are kept in {path}.partial" in said
            assert "Traceback" not in said
    resumed = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert resumed.returncode == 0, resumed.stderr
    assert f"{kept} kept before" in resumed.stdout.replace("\n", "")
    delays: npt.NDArray[Any] = np.repeat([0.01, 0.02], 500)
    reference = tmp_path / "reference.csv"
    sweep(
        "remote_push", samples={"link.forward.delay_s": delays, "run.seed": np.tile(np.arange(1.0, 501.0), 2)},
        overrides=("run.duration_s=0.1",), threads=1,
    ).save(reference)  # fmt: skip
    assert path.read_bytes() == reference.read_bytes()
    assert path.stat().st_mode & 0o777 == 0o600


def _kept(journal: Path) -> int:
    """Count the rows in the files of a journal by their names."""
    ranges = (file.stem.split("-")[1:] for file in journal.glob("rows-*.npz"))
    return sum(int(end) - int(first) for first, end in ranges)
