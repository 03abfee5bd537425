"""Runs tests of real time, and each that failed once more, with no other beside it.

They watch loops with a period of 1 ms as processes; tests beside them, or others who use the machine, hold them up for
tens of ms at times and fail them, whoever is right. What fails at the second try, too, has failed, unless a processor
stood still during that very test, for nearly as long as a loop bears: then the third decides. Where the system grants
no real time nobody can tell, and there is no third. What passes at a later try is named at the end, so that nobody
overlooks a test that needs it often.
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
CACHED = CACHE / "v" / "cache" / "lastfailed"
MAX_TRIES = 3
FAILED = 1
"""What pytest ends with where tests failed; all else is no matter of time."""
SLEEP_S = 0.005
"""Of who watches the processors: seldom enough to be in the way of no loop."""


def failed() -> list[str]:
    """The tests that failed in the last run."""
    return sorted(json.loads(CACHED.read_text("utf-8"))) if CACHED.exists() else []


def run(options: Sequence[str], markers: str) -> int:
    """One run of pytest; its exit status."""
    command = [sys.executable, "-m", "pytest", "-o", f"cache_dir={CACHE}", *options, "-m", markers]
    return subprocess.run(command, check=False).returncode


def again(test: str, markers: str) -> int | None:
    """At which further try one test passes by itself; none where it has failed."""
    for tries in range(2, MAX_TRIES + 1):
        CACHED.write_text(json.dumps({test: True}), "utf-8")
        with machine_stalls(SLEEP_S) as stalls:
            status = run(["--last-failed", "--last-failed-no-failures", "none"], markers)
        if status == 0:
            return tries
        worst_s = max((late_s for _, late_s in stalls), default=0.0)
        if status != FAILED or worst_s < STALL_S:
            break
        print(f"a processor of this machine stood still for {1e3 * worst_s:.0f} ms meanwhile", flush=True)
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """All tries; 0 where every test has passed at one of them."""
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
    print(f"\n{len(first)} failed; once more, one after the other:", *first, sep="\n  ", flush=True)
    ended = {test: again(test, asked.markers) for test in first}
    for tries, name in ((2, "passed at the second try only"), (3, "passed at the third try only"), (None, "failed")):
        if of_these := [test for test, at in ended.items() if at == tries]:
            print(f"{len(of_these)} {name}:", *of_these, sep="\n  ", flush=True)
    return FAILED if None in ended.values() else 0


if __name__ == "__main__":
    sys.exit(main())
