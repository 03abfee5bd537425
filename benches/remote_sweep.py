"""What a row of a sweep of remote scenes costs: one that shares link and ladders with others, and one that does not.

Rows that share differ in the stiffness of the hand, the others in the seed of their network as well. Each number of rows is
swept on one thread, least of the repeats; the peer, in the same call, is a row by itself. Rows at equal distances must have
the outcomes that they have by themselves, to the last bit.

Required: at most 80 ns a tick of a row on one axis where link and ladders are shared. Ends with status 1 where that does
not hold, or where a row differs.
"""

import sys
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from _report import bench_options, print_requirements, table_file, write_json
from haptether.bridge import sweep

EXAMPLE = "example: python benches/remote_sweep.py --rows 1 64 --json -"
SCENES = {"1 axis": ("remote_push", 80.0), "3 axes": ("three_axis_box", None)}
"""Scene, and the most that a tick of a row may take in ns."""
COMPARED = 5


def columns(rows: int, is_shared: bool) -> dict[str, npt.NDArray[np.float64]]:
    """What differs from row to row."""
    stiffness = {"operator.stiffness": np.linspace(200.0, 500.0, rows)}
    return stiffness if is_shared else stiffness | {"run.seed": np.arange(1.0, rows + 1.0)}


def measured(name: str, samples: dict[str, npt.NDArray[np.float64]], repeats: int) -> dict[str, Any]:
    """Least time of a sweep in ns a tick of a row, and whether its rows are those that they are by themselves."""
    best_s = alone_s = float("inf")
    for _ in range(repeats):
        begun = time.perf_counter()
        table = sweep(name, samples=samples, threads=1)
        best_s = min(best_s, time.perf_counter() - begun)
    is_same = True
    rows = len(table)
    for row in sorted({int(place) for place in np.linspace(0, rows - 1, min(rows, COMPARED))}):
        begun = time.perf_counter()
        alone = sweep(name, samples={path: values[row : row + 1] for path, values in samples.items()}, threads=1)
        alone_s = min(alone_s, time.perf_counter() - begun)
        is_same &= all(alone[key].tobytes() == table[key][row : row + 1].tobytes() for key in table.columns)
    ticks = float(table["ticks"].sum())
    return {"ns": best_s * 1e9 / ticks, "alone_ns": alone_s * 1e9 * rows / ticks, "is_same": is_same}


def main() -> int:
    """Measures, prints the table, and says whether the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--rows", type=int, nargs="+", default=[1, 8, 64, 512], help="default %(default)s")
    options.add_argument("--repeats", type=int, default=3, help="sweeps of each, 1 to 1000; default 3")
    chosen = options.parse_args()
    if not 1 <= chosen.repeats <= 1000 or min(chosen.rows) < 1:
        options.error("--repeats must be 1 to 1000, --rows 1 or more")
    out = table_file(chosen.json)
    print(
        f"{'':10}{'rows':>7}{'link, ladders':>15}{'ns a tick':>11}{'required':>10}{'one row':>9}{'ratio':>7}", file=out
    )
    found = []
    for axes, (name, limit_ns) in SCENES.items():
        for is_shared in (True, False):
            for rows in chosen.rows:
                one = measured(name, columns(rows, is_shared), chosen.repeats)
                required = limit_ns if is_shared and rows == max(chosen.rows) else None
                found.append({"name": axes, "rows": rows, "is_shared": is_shared, "required_ns": required, **one})
                kind, limit = "shared" if is_shared else "each its own", "" if required is None else f"{required:.0f}"
                times = f"{one['ns']:11.0f}{limit:>10}{one['alone_ns']:9.0f}{one['alone_ns'] / one['ns']:7.2f}"
                print(f"{axes:10}{rows:7}{kind:>15}{times}", file=out)
    holds = {
        "the required time": all(one["required_ns"] is None or one["ns"] <= one["required_ns"] for one in found),
        "each row as by itself": all(one["is_same"] for one in found),
    }
    status = print_requirements(holds, out)
    write_json(chosen.json, {"rows": found, "holds": holds})
    return status


if __name__ == "__main__":
    sys.exit(main())
