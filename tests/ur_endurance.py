"""The real ur_rtde at 500 Hz for a minute a mode: `python -m tests.ur_endurance --seconds 60 --json out/ur.json`.

Every call must be accepted, no state may go back, the arm may meet no stop, and the emulator must lose no time. Run
nothing else meanwhile.
"""

import argparse
import contextlib
import json
import os
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
        stolen_s = steal_s()
        rate_hz = 125.0 if version.startswith("3.") else 500.0
        run = [rate_hz, [mode, *runs(seconds)[mode]]]
        result = client("streams_first", running.host, run, patience_s=seconds + 60.0)[mode]
        status = running.status()
    kept = ("calls", "accepted", "late_p99_s", "late_max_s", "call_p99_s", "call_max_s", "state_gap_max_s")
    figures = {name: result[name] for name in kept}
    figures |= {name: status[name] for name in ("late_cycles", "worst_late_s", "lost_s", "skipped_packages")}
    figures["stolen_s"] = steal_s() - stolen_s
    figures["good"] = (
        result["accepted"] == result["calls"]
        and result["stopped"]
        and result["safety_mode"] == 1
        and result["state_steps_back"] == 0
        and result["state_gap_max_s"] < STALE_S
        and status["lost_s"] == 0.0
    )
    return figures


def steal_s() -> float:
    """Time in s that the host of a virtual machine has taken from it so far; 0 on a real one."""
    with contextlib.suppress(OSError):
        fields = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")
    return 0.0


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
        shown = {name: f"{1e3 * figures[name]:.2f} ms" for name in figures if name.endswith("_s")}
        print(
            f"{mode:7} {'good' if figures['good'] else 'NOT GOOD'}: {figures['accepted']} of {figures['calls']} calls, "
            f"client late p99 {shown['late_p99_s']}, longest call {shown['call_max_s']}, longest gap of states "
            f"{shown['state_gap_max_s']}, {figures['late_cycles']} cycles late, the worst {shown['worst_late_s']}, "
            f"{shown['stolen_s']} stolen by the host",
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
