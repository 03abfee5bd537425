"""`make faults`: each fault with its expected and its measured effect. Exit status 1: a row failed."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from tests.faults import (
    clocks,
    coupled,
    drivers,
    grippers,
    hostile,
    machine,
    numbers,
    poses,
    presses,
    processes,
    servos,
    stopping,
    virtual,
)
from tests.faults.rows import Row
from tests.faults.table import print_table

GROUPS: dict[str, Callable[[], list[Callable[[], Row]]]] = {
    "virtual": lambda: [*virtual.rows(), *clocks.rows()],
    "numbers": numbers.rows,
    "drivers": drivers.rows,
    "grippers": grippers.rows,
    "dynamixel": servos.rows,
    "poses": poses.rows,
    "processes": lambda: list(processes.rows().values()),
    "presses": lambda: list(presses.rows().values()),
    "stopping": lambda: list(stopping.rows().values()),
    "machine": lambda: list(machine.rows().values()),
    "hostile": lambda: list(hostile.rows().values()),
    "couplings": lambda: list(coupled.rows().values()),
}
"""Groups of rows, in the order in which they run."""

WIDTH = 200
"""Width of the table without a terminal, in characters."""


def main() -> int:
    """Run the suite with the options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--json", type=Path, help="where the same goes for machines; - for standard output")
    parser.add_argument("--only", choices=list(GROUPS), action="append", help="these rows alone")
    arguments = parser.parse_args()
    console = Console(stderr=str(arguments.json) == "-")
    if not console.is_terminal:
        console.width = WIDTH
    rows: list[Row] = []
    for name in arguments.only or GROUPS:
        for make in GROUPS[name]():
            rows.append(make())
            if rows[-1].how == "processes":
                print(f"{rows[-1].fault}: {rows[-1].verdict}", file=sys.stderr, flush=True)
    print_table(console, rows)
    passed = not any(row.complaints for row in rows)
    if arguments.json is not None:
        text = json.dumps({"passed": passed, "rows": [row.as_json() for row in rows]}, indent=1) + "\n"
        if str(arguments.json) == "-":
            sys.stdout.write(text)
        else:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            arguments.json.write_text(text, encoding="utf-8")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
