"""Cost of a stored sweep from a thousand rows to a million: rate and memory, against the engine alone.

Each size runs in a process of its own: `sweep_to_file` over delay and seed of `remote_push`, a tenth of a second each.
Before and after it the engine alone runs the same rows (`_core.sweep_scenes`, at most 20000 of them, in memory).
`--study` instead runs the 9300 rows of 4 s of 31 delays, three choices of controllers and 100 seeds, in slices of both
in turn.

Required: in the study, at least 0.9 of the engine's rate. Among the sizes that take a second, rates are within a factor
of 1.5, and the largest size uses at most 1.5 times the memory of the smallest. Ends with status 1 where that does not
hold.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from _report import bench_options, print_requirements, print_table, table_file, write_json

EXAMPLE = "example: python benches/sweep_scale.py --rows 1000 100000 --json -"
MOST_IN_MEMORY = 20_000
CHILD = """
import json, os, resource, sys, time
import numpy as np
import haptether._core as core
from haptether.bridge import load_scene, sweep_to_file
from haptether.bridge.scene.load import Checked
from haptether.bridge.scene.checks import checked_spec
from haptether.bridge.scene.sweep import sweep_columns
rows, threads, in_memory, path = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
scene = load_scene("remote_push", ["run.duration_s=0.1"])
delays, seeds = np.linspace(0.01, 0.3, 10), np.arange(1.0, rows // 10 + 1.0)
count = min(rows, in_memory)
few = {"link.forward.delay_s": np.repeat(delays, count // 10), "run.seed": np.tile(seeds[: count // 10], 10)}
base = Checked(scene, checked_spec(scene))
columns, _ = sweep_columns(base, few)

def engine_alone():
    begun = time.perf_counter()
    core.sweep_scenes([(base.json, columns)], threads, True, None)
    return time.perf_counter() - begun

# Before and after: the machine is shared.
engine_s = 0.5 * engine_alone()
begun = time.perf_counter()
sweep_to_file(scene, path, {"link.forward.delay_s": delays}, {"run.seed": seeds}, threads=threads)
stored_s = time.perf_counter() - begun
peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
engine_s += 0.5 * engine_alone()
size = os.path.getsize(path)
print(json.dumps({"rows": rows, "stored_s": stored_s, "peak_mib": peak_mib, "engine_rows_per_s": count / engine_s,
                  "file_mib": size / 2**20}))
"""

STUDY = """
import json, os, resource, sys, time
import numpy as np
import haptether._core as core
from haptether.bridge import load_scene, sweep_to_file
from haptether.bridge.scene.load import Checked
from haptether.bridge.scene.checks import checked_spec
from haptether.bridge.scene.sweep import sweep_columns
threads, folder = int(sys.argv[1]), sys.argv[2]
delays, choices, slices = np.linspace(0.0, 0.3, 31), [[], ["wsc"], ["hsc"]], 5
stored_s = engine_s = 0.0
for part in range(slices):
    seeds = np.arange(1.0, 101.0)[part::slices]
    path = os.path.join(folder, f"rows{part}.csv")
    begun = time.perf_counter()
    sweep_to_file(
        load_scene("remote_push"), path, {"link.forward.delay_s": delays, "safety.controllers": choices},
        {"run.seed": seeds}, ties={"link.backward.delay_s": "link.forward.delay_s"}, threads=threads,
    )
    stored_s += time.perf_counter() - begun
    delay, seed = np.repeat(delays, len(seeds)), np.tile(seeds, len(delays))
    parts = []
    for choice in choices:
        scene = load_scene("remote_push", [f"safety.controllers=[{','.join(choice)}]"])
        base = Checked(scene, checked_spec(scene))
        varied = {"link.forward.delay_s": delay, "link.backward.delay_s": delay, "run.seed": seed}
        columns, _ = sweep_columns(base, varied)
        parts.append((base.json, columns))
    begun = time.perf_counter()
    core.sweep_scenes(parts, threads, True, None)
    engine_s += time.perf_counter() - begun
rows = 31 * 3 * 100
size = sum(os.path.getsize(os.path.join(folder, f"rows{part}.csv")) for part in range(slices))
print(json.dumps({"rows": rows, "stored_s": stored_s, "engine_rows_per_s": rows / engine_s, "file_mib": size / 2**20,
                  "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}))
"""


def measured(rows: int | None, threads: int) -> dict[str, Any]:
    """Return times in s, rates in rows/s and peak memory in MiB, from its own process: of `rows` rows or the study."""
    with tempfile.TemporaryDirectory() as folder:
        child = [sys.executable, "-c", STUDY, str(threads), folder]
        if rows is not None:
            child = [
                sys.executable,
                "-c",
                CHILD,
                str(rows),
                str(threads),
                str(MOST_IN_MEMORY),
                str(Path(folder, "rows.csv")),
            ]
        printed = subprocess.run(child, check=True, capture_output=True, text=True, timeout=1800).stdout
    found: dict[str, Any] = json.loads(printed)
    found["rows_per_s"] = found["rows"] / found["stored_s"]
    found["share"] = found["rows_per_s"] / found["engine_rows_per_s"]
    return found


def main() -> int:
    """Measure, print the table, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--rows", type=int, nargs="+", default=[1000, 10_000, 100_000], help="default %(default)s")
    options.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)), help="default %(default)s")
    options.add_argument("--study", action="store_true", help="the 9300 rows of 4 s instead")
    chosen = options.parse_args()
    if min(chosen.rows) < 10 or any(rows % 10 for rows in chosen.rows):
        options.error("--rows must be tens, 10 or more")
    found = [measured(rows, chosen.threads) for rows in ([None] if chosen.study else chosen.rows)]
    out = table_file(chosen.json)
    columns = {"rows": "", "stored_s": ".2f", "rows_per_s": ".0f", "engine_rows_per_s": ".0f", "share": ".2f",
               "peak_mib": ".0f", "file_mib": ".1f"}  # fmt: skip
    lines = ([format(row[key], form) for key, form in columns.items()] for row in found)
    print_table(("rows", "s", "rows/s", "engine", "share", "MiB", "file [MiB]"), lines, out)
    rates = [row["rows_per_s"] for row in found if row["stored_s"] > 1.0]
    holds = {"flat memory": found[-1]["peak_mib"] <= 1.5 * found[0]["peak_mib"]}
    if chosen.study:
        holds = {"0.9 of the engine's rate": found[0]["share"] >= 0.9}
    elif rates:
        holds["flat rate"] = min(rates) >= max(rates) / 1.5
    status = print_requirements(holds, out)
    write_json(chosen.json, {"rows": found, "holds": holds})
    return status


if __name__ == "__main__":
    sys.exit(main())
