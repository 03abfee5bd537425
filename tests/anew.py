"""Runs tests of real time, and those that failed once more, one after the other.

They watch loops with a period of 1 ms as processes; tests beside them, or others who use the machine, hold them up for
tens of ms at times and fail them, whoever is right. What fails at the second try, too, has failed, unless a processor
stood still meanwhile for longer than a loop bears: then the third decides. What passes at a later try is named at the
end, so that nobody overlooks a test that needs it often.
"""

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.ur.machine_stalls import machine_stalls
from tests.ur.stalls import STALL_S

CACHE = Path(".pytest_cache/anew")
MAX_TRIES = 3
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
    """All tries; the exit status of the one that decides."""
    parser = argparse.ArgumentParser(prog="python -m tests.anew", description=__doc__)
    parser.add_argument("--most", type=int, required=True, help="of more failures none is tried again")
    parser.add_argument("-m", dest="markers", required=True, help="markers, as of pytest")
    parser.add_argument("options", nargs="*", help="of the first run, after --")
    asked = parser.parse_args(arguments)
    shutil.rmtree(CACHE, ignore_errors=True)
    status = run(asked.options, asked.markers)
    first = failed()
    if status != FAILED or not first or len(first) > asked.most:
        return status
    for tries in range(2, MAX_TRIES + 1):
        print(f"\n{len(failed())} failed; once more, one after the other:", *failed(), sep="\n  ", flush=True)
        with machine_stalls() as stalls:
            # Options of the first run are those of running side by side.
            status = run(["--last-failed", "--last-failed-no-failures", "none"], asked.markers)
        if status == 0:
            at = "the second try" if tries == 2 else f"try 2 to {tries}"
            print(f"{len(first)} passed at {at} only:", *first, sep="\n  ", flush=True)
        worst_s = max((late_s for _, late_s in stalls), default=0.0)
        if status != FAILED or worst_s < STALL_S:
            break
        print(f"a processor of this machine stood still for {1e3 * worst_s:.0f} ms", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
