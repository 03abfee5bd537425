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
from _report import bench_options, print_requirements, table_file, write_json
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
    options.add_argument("--rounds", type=int, default=5, help="turns of each, 1 to 100; default 5")
    options.add_argument("--seconds", type=float, default=10.0, help="of each turn, 1 to 120; default 10")
    chosen = options.parse_args()
    if not (1 <= chosen.rounds <= 100 and 1.0 <= chosen.seconds <= 120.0):
        options.error("--rounds must be 1 to 100, --seconds 1 to 120")
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
    print(f"{'':12}{'p50 [us]':>10}{'p99 [us]':>10}{'added [ns]':>12}{'p99, times':>12}", file=out)
    print(f"{'none':12}{median('none', 'p50_ns') / 1e3:10.2f}{median('none', 'p99_ns') / 1e3:10.2f}", file=out)
    for case in CASES:
        print(
            f"{case:12}{median(case, 'p50_ns') / 1e3:10.2f}{median(case, 'p99_ns') / 1e3:10.2f}"
            f"{median(case, 'added_ns'):12.0f}{median(case, 'p99_times'):12.3f}",
            file=out,
        )
    p99_late = {case: statistics.median(one[case][1] / one["none"][1] for one in late) for case in LATE}
    print("\nwakes late [us]     p50     p99   p99, times", file=out)
    for case in LATE:
        p50, p99 = (statistics.median(one[case][place] for one in late) for place in (0, 1))
        print(f"{case:14}{p50:9.1f}{p99:8.1f}{p99_late[case]:13.3f}", file=out)
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
