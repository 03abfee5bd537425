"""The real ur_rtde at 500 Hz for a minute a mode: `python -m tests.ur_endurance --seconds 60 --json out/ur.json`.

Every call must be accepted, no state may go back, the arm may meet no stop, and the emulator must lose no time. Run
nothing else meanwhile.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from tests.ur.emulated import client, emulator

STALE_S = 0.02
"""Age of a state that a bridge takes for a silent peer."""


def runs(seconds: float) -> dict[str, list[Any]]:
    """Arguments of each mode of `tests.ur.clients`."""
    return {
        "servoj": [seconds, 0.1, 0.5],
        "servol": [seconds, 0.01, 0.5],
        "speedl": [seconds, [0.0, 0.0, 0.05, 0.0, 0.0, 0.0], 0.5],
        "force": [seconds, [-10.0, 0.0, 0.0, 0.0, 0.0, 0.0]],
    }


def endured(mode: str, seconds: float, version: str) -> dict[str, Any]:
    """Figures of one mode."""
    with emulator("--scene", "three_axis_box", "--version", version) as running:
        running.do("forget-lateness")
        rate_hz = 125.0 if version.startswith("3.") else 500.0
        run = [rate_hz, [mode, *runs(seconds)[mode]]]
        result = client("streams_first", running.host, run, patience_s=seconds + 60.0)[mode]
        status = running.status()
    kept = ("calls", "accepted", "late_p99_s", "late_max_s", "call_p99_s", "call_max_s", "state_gap_max_s")
    figures = {name: result[name] for name in kept}
    figures |= {name: status[name] for name in ("late_cycles", "worst_late_s", "lost_s", "skipped_packages")}
    figures["good"] = (
        result["accepted"] == result["calls"]
        and result["stopped"]
        and result["safety_mode"] == 1
        and result["state_steps_back"] == 0
        and result["state_gap_max_s"] < STALE_S
        and status["lost_s"] == 0.0
    )
    return figures


def main() -> int:
    """Runs every mode and prints a row for each; 1 if one of them is not good."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--version", default="5.11")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    results = {}
    for mode in runs(0.0):
        results[mode] = figures = endured(mode, asked.seconds, asked.version)
        print(
            f"{mode:7} {figures['accepted']}/{figures['calls']} calls, client late p99 "
            f"{1e3 * figures['late_p99_s']:.2f} ms, longest call {1e3 * figures['call_max_s']:.2f} ms, longest gap of "
            f"states {1e3 * figures['state_gap_max_s']:.1f} ms, cycles late {figures['late_cycles']}, worst "
            f"{1e3 * figures['worst_late_s']:.2f} ms: {'good' if figures['good'] else 'NOT GOOD'}",
            flush=True,
        )
    if asked.json is not None:
        text = json.dumps(results, indent=2)
        if str(asked.json) == "-":
            print(text)
        else:
            asked.json.write_text(text + "\n", encoding="utf-8")
    return 0 if all(figures["good"] for figures in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
