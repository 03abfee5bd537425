"""Cost of a tick of a remote scene in virtual time: hand, network of delay, correlated jitter and loss, and arm.

Each scene runs as it is, and with every frame encoded and decoded as on a live link. The second run is the peer of each
row and must give the same signals, events and counts (`bridge/examples/remote_tick.rs`). The time of a tick is that of
a long run less that of a short run, divided by the ticks between them, least of the repeats, on one thread. The time of
a run before its first tick stands beside it.

Required: at most 350 ns a tick on one axis, 1000 on three. Ends with status 1 where that does not hold, or where the
two runs of a scene differ.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from _programs import built
from _report import add_number, bench_options, print_requirements, print_table, table_file, write_json
from haptether.bridge import load_scene, scene_json

EXAMPLE = "example: python benches/remote_tick.py --repeats 20 --json -"
SHORT_S, LONG_S = 2.0, 12.0
NETWORK = ["delay_s=0.05", "jitter_s=0.005", "loss=0.01"]
NONE = ["delay_s=0.0", "jitter_s=0.0", "loss=0.0"]
ROWS = {
    "1 axis, delay, jitter, loss": ("remote_push", NETWORK, 350.0),
    "1 axis, perfect link": ("remote_push", NONE, None),
    "3 axes, delay, jitter, loss": ("three_axis_box", NETWORK, 1000.0),
    "3 axes, perfect link": ("three_axis_box", NONE, None),
}
"""Scene, both directions of its link, and longest permitted time of a tick in ns."""


def write_scene(folder: Path, name: str, link: list[str], duration_s: float) -> Path:
    """Write a scene of `duration_s` without signals, in the example's format."""
    overrides = [f"link.{direction}.{one}" for direction in ("forward", "backward") for one in link]
    scene = json.loads(scene_json(load_scene(name, [*overrides, f"run.duration_s={duration_s}"])))
    scene["record"] = None
    path = folder / f"{name}-{len(list(folder.iterdir()))}.json"
    path.write_text(json.dumps(scene), encoding="utf-8")
    return path


def cost(short: dict[str, Any], long: dict[str, Any], key: str) -> tuple[float, float]:
    """Return ns per tick, and us before the first tick: `(n_l t_l - n_s t_s) / (n_l - n_s)`."""
    ticks, ns = [run["run"][2][0] for run in (short, long)], [run[key] for run in (short, long)]
    per_tick_ns = (ticks[1] * ns[1] - ticks[0] * ns[0]) / (ticks[1] - ticks[0])
    return per_tick_ns, ticks[0] * (ns[0] - per_tick_ns) * 1e-3


def main() -> int:
    """Measure, print the table, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--repeats", 10, "runs of each scene", most=1000)
    chosen = options.parse_args()
    program = built("remote_tick")
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name, (scene, link, limit_ns) in ROWS.items():
            paths = [write_scene(folder, scene, link, duration_s) for duration_s in (SHORT_S, LONG_S)]
            command = [str(program), str(chosen.repeats), *map(str, paths)]
            printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600).stdout
            short, long = map(json.loads, printed.splitlines())
            ns, before_us = cost(short, long, "ns_per_tick")
            encoded_ns, _ = cost(short, long, "encoded_ns_per_tick")
            is_same = short["is_same"] and long["is_same"]
            row = {"name": name, "ns": ns, "encoded_ns": encoded_ns, "before_us": before_us, "required_ns": limit_ns}
            rows.append({**row, "is_same": is_same})
    out = table_file(chosen.json)
    names = ("ns", "required_ns", "encoded_ns", "before_us")
    print_table(
        ("", "ns a tick", "required", "as bytes", "before the first [us]"),
        ((row["name"], *(row[name] and f"{row[name]:.0f}" for name in names)) for row in rows),
        out,
    )
    holds = {
        "the required times": all(row["required_ns"] is None or row["ns"] <= row["required_ns"] for row in rows),
        "the same with frames encoded": all(row["is_same"] for row in rows),
    }
    status = print_requirements(holds, out)
    write_json(chosen.json, {"rows": rows, "holds": holds})
    return status


if __name__ == "__main__":
    sys.exit(main())
