"""Message of a demonstration when one of its processes fails."""

import os
import subprocess
import sys

import pytest

from haptether.studies.processes import Process


def ended(name: str, says: str, status: int) -> Process:
    """Return a process that printed something and has ended."""
    code = f"print({says!r}); raise SystemExit({status})"
    process = Process(name, subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True), "")
    process.process.wait(30.0)
    process.end()
    return process


@pytest.mark.parametrize(
    ("load", "said"), [(0.5, ""), (9.04, "; this machine is busy (load 9.0 on 2 processors): run")]
)
def test_a_failure_has_what_both_sides_said_and_whether_the_machine_is_busy(
    load: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    text = ended("master", "hold: its own loop was late", 1).failure(ended("slave", "nothing is wrong", 0))
    begin = "the master ended with status 1: hold: its own loop was late; nothing is wrong"
    assert text.startswith(begin + said)
    assert (text == begin) == (not said)
