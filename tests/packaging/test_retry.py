"""A failed test of real time is retried once, by itself; all retries are listed with their reasons and bounded."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.retry import MAX_RETRIES

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
LIST = "out/retries.json"
TESTS = """
import pathlib
import pytest
pytestmark = [pytest.mark.live]

def test_passes():
    pass

@pytest.mark.parametrize("number", range({once}))
def test_fails_once(number):
    seen = pathlib.Path(f"seen{{number}}")
    first = not seen.exists()
    seen.touch()
    assert not first, "too early"

@pytest.mark.parametrize("number", range({always}))
def test_fails_always(number):
    raise ValueError("always\\nthe same")
"""
STALLED = """
import pytest
from tests.ur import stalls

pytestmark = [pytest.mark.live]
tries = iter([False, True])

@pytest.fixture
def stalled(monkeypatch):
    monkeypatch.setattr(stalls, "STALL_S", -1.0)

@stalls.anew_after_stalls
def test_meets_a_stall(stalled):
    assert next(tries), "held up"
"""


def run(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    (folder / "test_some.py").write_text(text, "utf-8")
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = live: of real time\n", "utf-8")
    return subprocess.run(
        [sys.executable, "-m", "tests.retry", "-m", "live", "--", "--quiet", "--import-mode=importlib"],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
        timeout=60,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("once", "always", "before", "status"),
    [
        (2, 0, 1, 0),
        (1, 0, MAX_RETRIES, 1),  # one too many in all runs
        (1, 1, 0, 1),
        (0, MAX_RETRIES + 1, 0, 1),
    ],
)
def test_a_failure_counts_when_it_fails_twice(once: int, always: int, before: int, status: int, tmp_path: Path) -> None:
    earlier = [{"test": f"before{n}", "tries": 2, "reason": "late", "passed": True} for n in range(before)]
    (tmp_path / "out").mkdir()
    (tmp_path / LIST).write_text(json.dumps(earlier), "utf-8")
    ended = run(tmp_path, TESTS.format(once=once, always=always))
    assert ended.returncode == status, ended.stdout + ended.stderr
    listed = json.loads((tmp_path / LIST).read_text("utf-8"))[before:]
    if before + once + always > MAX_RETRIES:
        assert listed == []
        assert f"{MAX_RETRIES - before} of {MAX_RETRIES} retries are left: no retry" in ended.stdout
        return
    assert [(entry["tries"], entry["passed"]) for entry in listed] == [(2, True)] * once + [(2, False)] * always
    for entry in listed:
        expected = "AssertionError: too early" if entry["passed"] else "ValueError: always"
        assert entry["reason"].startswith(expected)
        said = "passed" if entry["passed"] else "failed"
        assert f"{entry['test']}: {said} at try 2: {entry['reason']}" in ended.stdout


def test_a_repetition_after_a_stall_is_listed(tmp_path: Path) -> None:
    ended = run(tmp_path, STALLED)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (entry,) = json.loads((tmp_path / LIST).read_text("utf-8"))
    assert (entry["tries"], entry["passed"], entry["stalled"]) == (2, True, True)
    assert "stall of the machine" in entry["reason"]
    assert "held up" in entry["reason"]
