"""A test of real time that failed is decided by a second try, alone, or a third where the machine stood still."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests import anew

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
TESTS = """
import pathlib
import pytest
pytestmark = pytest.mark.live

def test_passes():
    pass

@pytest.mark.parametrize("number", range({once}))
def test_fails_once(number):
    seen = pathlib.Path(f"seen{{number}}")
    first = not seen.exists()
    seen.touch()
    assert not first

@pytest.mark.parametrize("number", range({always}))
def test_fails_always(number):
    assert False
"""
TWICE = """
import pathlib
import pytest

@pytest.mark.live
def test_fails_twice():
    seen = pathlib.Path("seen")
    times = len(seen.read_text()) if seen.exists() else 0
    seen.write_text("x" * (times + 1))
    assert times == 2
"""


@pytest.mark.parametrize(
    ("once", "always", "status", "said"),
    [
        (0, 0, 0, "1 passed"),
        (2, 0, 0, "2 passed at the second try only:"),
        (1, 1, 1, "2 failed; once more, one after the other:"),
        (1, 1, 1, "1 passed at the second try only:"),
        (1, 1, 1, "1 failed:"),
        (0, 1, 1, "1 failed; once more, one after the other:"),
        (0, 4, 1, "4 failed, 1 passed"),  # more than are tried anew
    ],
)
def test_a_failure_counts_when_it_fails_twice(once: int, always: int, status: int, said: str, tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(TESTS.format(once=once, always=always), "utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = live: of real time\n", "utf-8")
    ended = subprocess.run(
        [sys.executable, "-m", "tests.anew", "--most", "3", "-m", "live", "--", "--quiet"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
        timeout=60,
    )  # fmt: skip
    assert ended.returncode == status, ended.stdout + ended.stderr
    assert said in ended.stdout
    assert ("once more, one" in ended.stdout) == (0 < once + always <= 3)


@pytest.mark.parametrize(("stalled_s", "status"), [(0.0, 1), (0.1, 0)])
def test_a_third_try_is_for_machines_that_stood_still(
    stalled_s: float, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "test_some.py").write_text(TWICE, "utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = live: of real time\n", "utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(anew, "machine_stalls", lambda _: contextlib.nullcontext([(1.0, stalled_s)]))
    assert anew.main(["--most", "3", "-m", "live", "--", "--quiet"]) == status
    assert ("1 passed at the third try only:" in capfd.readouterr().out) == (status == 0)
