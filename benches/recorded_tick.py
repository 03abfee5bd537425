"""Cost of telemetry and of a recording in a live tick, against the same tick without them, in one run.

Four loops of a master of three axes tick one after the other in one thread at 1 kHz, in another order each time
(`bridge/examples/recorded_tick.rs`): with neither, with telemetry that a reader takes, with a recording, with both.
Then the lateness of the live loop is measured with neither, with telemetry, and with both, in turn. It shows how much
processor time their threads take.

Required: telemetry adds at most 100 ns to a tick, by the median of the differences of the same period. With telemetry,
p99 of a tick and of the lateness are at most 1.05 times those without, by the median over rounds.
"""

import json
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from _programs import built
from _report import add_number, bench_options, print_requirements, print_table, table_file, write_json
from haptether.bridge import LiveMaster, TelemetryReader, load_scene, scene_json

EXAMPLE = "example: python benches/recorded_tick.py --rounds 10 --json -"
CASES = ("telemetry", "recording", "both")
LATE = ("none", "telemetry", "both")
REQUIRED_NS, REQUIRED = 100.0, 1.05


def read_all(path: Path) -> None:
    """Read telemetry to its end."""
    with TelemetryReader(path) as telemetry:
        for _ in telemetry:
            pass


def lateness_us(seconds: float, case: str, folder: Path) -> tuple[float, float]:
    """Return p50 and p99 of a live loop's lateness in us; with telemetry and a reader, or with a recording as well."""
    outputs: dict[str, Any] = {} if case == "none" else {"telemetry": folder / "master.sock"}
    if case == "both":
        outputs |= {"record": folder / "master.mcap", "min_free_bytes": 0}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        master = LiveMaster(
            scene_json(load_scene("three_axis_box")),
            peer=f"127.0.0.1:{sink.getsockname()[1]}",
            run_id=1,
            insecure=True,
            patience_s=seconds,
            **outputs,
        )
        reader = threading.Thread(target=read_all, args=(outputs["telemetry"],)) if outputs else None
        if reader is not None:
            reader.start()
        while not master.finished:
            time.sleep(0.1)
        trace, report = master.finish()
        if reader is not None:
            reader.join()
    assert report.dropped_records == 0
    return float(np.percentile(trace.overshoot_s, 50)) * 1e6, float(np.percentile(trace.overshoot_s, 99)) * 1e6


def main() -> int:
    """Measure, print both tables, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--rounds", 5, "turns of each", most=100)
    add_number(options, "--seconds", 10.0, "of each turn", most=120.0)
    chosen = options.parse_args()
    program = built("recorded_tick")
    rounds: list[dict[str, dict[str, float]]] = []
    late: list[dict[str, tuple[float, float]]] = []
    for number in range(chosen.rounds):
        command = [str(program), str(round(1000 * chosen.seconds))]
        printed = subprocess.run(command, check=True, capture_output=True, timeout=300).stdout
        taken = {case: np.array(values, dtype=np.float64) for case, values in json.loads(printed).items()}
        one = {"none": {"p50_ns": float(np.median(taken["none"])), "p99_ns": float(np.percentile(taken["none"], 99))}}
        for case in CASES:
            p99 = float(np.percentile(taken[case], 99))
            one[case] = {
                "p50_ns": float(np.median(taken[case])),
                "p99_ns": p99,
                "added_ns": float(np.median(taken[case] - taken["none"])),
                "p99_times": p99 / one["none"]["p99_ns"],
            }
        rounds.append(one)
        with tempfile.TemporaryDirectory() as folder:
            late.append({case: lateness_us(chosen.seconds, case, Path(folder)) for case in LATE})
        print(f"round {number + 1} of {chosen.rounds}", file=sys.stderr)

    def median(case: str, key: str) -> float:
        return statistics.median(one[case][key] for one in rounds)

    out = table_file(chosen.json)
    print(f"a tick of three axes, medians of {chosen.rounds} rounds of {chosen.seconds:g} s", file=out)
    ticks = [
        (case, *(f"{median(case, key) / 1e3:.2f}" for key in ("p50_ns", "p99_ns")),
         *((None, None) if case == "none" else
           (f"{median(case, 'added_ns'):.0f}", f"{median(case, 'p99_times'):.3f}")))
        for case in ("none", *CASES)
    ]  # fmt: skip
    print_table(("", "p50 [us]", "p99 [us]", "added [ns]", "p99, times"), ticks, out)
    p99_late = {case: statistics.median(one[case][1] / one["none"][1] for one in late) for case in LATE}
    print(file=out)
    wakes = [
        (case, *(f"{statistics.median(one[case][at] for one in late):.1f}" for at in (0, 1)), f"{p99_late[case]:.3f}")
        for case in LATE
    ]
    print_table(("wakes late [us]", "p50", "p99", "p99, times"), wakes, out)
    holds = {
        "telemetry adds at most 100 ns": median("telemetry", "added_ns") <= REQUIRED_NS,
        "p99 of a tick within 5 %": median("telemetry", "p99_times") <= REQUIRED,
        "p99 of the lateness within 5 %": p99_late["telemetry"] <= REQUIRED,
    }
    status = print_requirements(holds, out)
    write_json(chosen.json, {"rounds": rounds, "late_us": late, "holds": holds})
    return status


if __name__ == "__main__":
    sys.exit(main())
