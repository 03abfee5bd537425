"""Cost of a row of a sweep of remote scenes where rows share link and ladders, and where each has its own.

Rows that share differ in the stiffness of the hand and run side by side in lanes. Their peers in the same call are the
same rows one by one, and rows of which each also has a seed of its network. Each number of rows is swept on one thread,
least of the repeats. Rows at equal distances must have the outcomes of single runs, to the last bit.

Required: at most 80 ns a tick of a row on one axis where link and ladders are shared, of the largest number of rows.
Ends with status 1 where that does not hold, or where a row differs.
"""

import sys
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from _report import add_number, bench_options, print_requirements, print_table, table_file, write_json
from haptether.bridge import sweep

EXAMPLE = "example: python benches/remote_sweep.py --rows 1 64 --json -"
SCENES = {"1 axis": ("remote_push", 80.0), "3 axes": ("three_axis_box", None)}
"""Scene, and longest permitted time in ns per tick of a row."""
COMPARED = 5


def columns(rows: int, is_shared: bool) -> dict[str, npt.NDArray[np.float64]]:
    """Return the columns that differ from row to row."""
    stiffness = {"operator.stiffness": np.linspace(200.0, 500.0, rows)}
    return stiffness if is_shared else stiffness | {"run.seed": np.arange(1.0, rows + 1.0)}


def measured(
    name: str, samples: dict[str, npt.NDArray[np.float64]], repeats: int, lanes: bool = True
) -> tuple[float, bool]:
    """Return the least time in ns per tick of a row, and if its rows equal those of single runs."""
    least_s = float("inf")
    for _ in range(repeats):
        begun = time.perf_counter()
        table = sweep(name, samples=samples, threads=1, lanes=lanes)
        least_s = min(least_s, time.perf_counter() - begun)
    is_same, rows = True, len(table)
    for row in sorted({int(place) for place in np.linspace(0, rows - 1, min(rows, COMPARED))}):
        alone = sweep(name, samples={path: values[row : row + 1] for path, values in samples.items()}, threads=1)
        is_same &= all(alone[key].tobytes() == table[key][row : row + 1].tobytes() for key in table.columns)
    return least_s * 1e9 / float(table["ticks"].sum()), is_same


def main() -> int:
    """Measure, print the table, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--rows", type=int, nargs="+", default=[1, 8, 64, 512], help="default %(default)s")
    add_number(options, "--repeats", 3, "sweeps of each", most=1000)
    chosen = options.parse_args()
    if min(chosen.rows) < 1:
        options.error("--rows must be 1 or more")
    out = table_file(chosen.json)
    found: list[dict[str, Any]] = []
    for axes, (name, limit_ns) in SCENES.items():
        for rows in chosen.rows:
            shared_ns, is_same = measured(name, columns(rows, True), chosen.repeats)
            single_ns, is_single_same = measured(name, columns(rows, True), chosen.repeats, lanes=False)
            own_ns, is_own_same = measured(name, columns(rows, False), chosen.repeats)
            required_ns = limit_ns if rows == max(chosen.rows) else None
            times = {"shared_ns": shared_ns, "one_by_one_ns": single_ns, "own_ns": own_ns}
            is_same = is_same and is_single_same and is_own_same
            found.append({"name": axes, "rows": rows, **times, "required_ns": required_ns, "is_same": is_same})
    names = ("shared_ns", "required_ns", "one_by_one_ns", "own_ns")
    print_table(
        ("ns a tick", "rows", "shared", "required", "one by one", "own", "own / shared"),
        (
            (row["name"], row["rows"], *(row[name] and f"{row[name]:.0f}" for name in names),
             f"{row['own_ns'] / row['shared_ns']:.2f}")
            for row in found
        ),
        out,
    )  # fmt: skip
    holds = {
        "the required time": all(row["required_ns"] is None or row["shared_ns"] <= row["required_ns"] for row in found),
        "each row as by itself": all(row["is_same"] for row in found),
    }
    status = print_requirements(holds, out)
    write_json(chosen.json, {"rows": found, "holds": holds})
    return status


if __name__ == "__main__":
    sys.exit(main())
