"""Runs pytest on tests of real time and retries each failed test once, by itself.

Other programs on the machine can delay a loop of 1 ms by tens of ms, so one failure is no proof. Every retry is printed
with the reason of the failure and written to out/retries.json. A run of `make test` allows MAX_RETRIES retries in
total; more failures fail the run without a retry. Delete out/retries.json to start a new count.

A test with `anew_after_stalls` repeats within itself after a stall of the machine (`tests/ur/stalls.py`). These
repetitions are listed, too, but not counted: the machine is their cause.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import pytest

LIST = Path("out/retries.json")
MAX_RETRIES = 6
"""Limit for about 1800 tests. A virtual machine may halt for half a second, and several tests then fail."""
REPEATED = "repeated after a stall of the machine"
"""First words of the line that a test prints when it repeats within itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Retry:
    """One test that did not pass at its first try."""

    test: str
    tries: int
    reason: str
    passed: bool
    stalled: bool = False
    """The machine stalled during each failed try."""

    def __str__(self) -> str:
        return f"{self.test}: {'passed' if self.passed else 'failed'} at try {self.tries}: {self.reason}"


@dataclass(slots=True, eq=False)
class Outcomes:
    """Pytest plugin: the reason of each failed test, and the repetitions after stalls."""

    failed: dict[str, str] = field(default_factory=dict)
    repeated: list[Retry] = field(default_factory=list)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.setdefault(report.nodeid, reason(report))
        if report.when == "call" and report.passed:
            said = [line for line in report.capstdout.splitlines() if line.startswith(REPEATED)]
            if said:
                tries = len(said) + 1
                self.repeated.append(Retry(test=report.nodeid, tries=tries, reason=said[-1], passed=True, stalled=True))


def reason(report: pytest.TestReport) -> str:
    """The line that pytest's summary gives a failed test; the last line of a crash without one."""
    crash = getattr(report.longrepr, "reprcrash", None)
    lines = (crash.message if crash else report.longreprtext.strip()).splitlines() or ["no reason given"]
    return str(lines[0 if crash else -1])


def passes(test: str) -> bool:
    """Run one test in a process of its own."""
    return subprocess.run([sys.executable, "-m", "pytest", test], check=False).returncode == 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Pytest's exit status, 0 where every failed test passed its retry."""
    parser = argparse.ArgumentParser(prog="python -m tests.retry", description=__doc__)
    parser.add_argument("-m", dest="markers", required=True, help="markers, as for pytest")
    parser.add_argument("options", nargs="*", help="of pytest, after --")
    asked = parser.parse_args(arguments)
    retries = [Retry(**entry) for entry in json.loads(LIST.read_text("utf-8"))] if LIST.exists() else []
    outcomes = Outcomes()
    status = int(pytest.main([*asked.options, "-m", asked.markers], plugins=[outcomes]))
    found = outcomes.repeated
    if status == pytest.ExitCode.TESTS_FAILED:
        left = MAX_RETRIES - sum(not retry.stalled for retry in retries)
        if len(outcomes.failed) > left:
            print(f"\n{len(outcomes.failed)} tests failed and {left} of {MAX_RETRIES} retries are left: no retry")
        else:
            print("\nretries, one test at a time:", *outcomes.failed, sep="\n  ", flush=True)
            retried = [
                Retry(test=test, tries=2, reason=said, passed=passes(test)) for test, said in outcomes.failed.items()
            ]
            status = 0 if all(retry.passed for retry in retried) else status
            found = found + retried
    if found:
        print(f"\n{len(found)} tests were tried more than once ({LIST}):", *found, sep="\n  ", flush=True)
    LIST.parent.mkdir(exist_ok=True)
    LIST.write_text(json.dumps([asdict(retry) for retry in retries + found], indent=1) + "\n", "utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
