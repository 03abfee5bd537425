"""Runs tests of real time, and those that failed once more, one after the other.

They watch loops with a period of 1 ms as processes; tests beside them, or others who use the machine, hold them up for
tens of ms at times and fail them, whoever is right. What fails at the second try, too, has failed. What passes then is
named at the end, so that nobody overlooks a test that needs it often.
"""

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

CACHE = Path(".pytest_cache/anew")
FAILED = 1
"""What pytest ends with where tests failed; all else is no matter of time."""


def failed() -> list[str]:
    """The tests that failed in the last run."""
    path = CACHE / "v" / "cache" / "lastfailed"
    return sorted(json.loads(path.read_text("utf-8"))) if path.exists() else []


def run(options: Sequence[str], markers: str) -> int:
    """One run of pytest; its exit status."""
    command = [sys.executable, "-m", "pytest", "-o", f"cache_dir={CACHE}", *options, "-m", markers]
    return subprocess.run(command, check=False).returncode


def main(arguments: Sequence[str] | None = None) -> int:
    """Both runs; the exit status of the one that decides."""
    parser = argparse.ArgumentParser(prog="python -m tests.anew", description=__doc__)
    parser.add_argument("--most", type=int, required=True, help="of more failures none is tried again")
    parser.add_argument("-m", dest="markers", required=True, help="markers, as of pytest")
    parser.add_argument("options", nargs="*", help="of the first run, after --")
    asked = parser.parse_args(arguments)
    shutil.rmtree(CACHE, ignore_errors=True)
    status = run(asked.options, asked.markers)
    again = failed()
    if status != FAILED or not again or len(again) > asked.most:
        return status
    print(f"\n{len(again)} failed; once more, one after the other:", *again, sep="\n  ", flush=True)
    # Options of the first run are those of running side by side.
    status = run(["--last-failed", "--last-failed-no-failures", "none"], asked.markers)
    if status == 0:
        print(f"{len(again)} passed at the second try only:", *again, sep="\n  ", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
