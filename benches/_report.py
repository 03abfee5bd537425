"""Shared parts of the benches: options, interleaved timing, tables, JSON, requirements."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import TextIO


def bench_options(description: str | None, epilog: str) -> argparse.ArgumentParser:
    """Return the options of a bench, with `--json`."""
    options = argparse.ArgumentParser(
        description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--json", metavar="PATH", help="the same for machines; - for stdout")
    return options


def add_number(
    options: argparse.ArgumentParser, flag: str, default: float, text: str, *, least: float = 1, most: float = inf
) -> None:
    """Add an option with a number from `least` to `most`, whole if its default is."""

    def number(given: str) -> float:
        value = type(default)(given)
        if not least <= value <= most:
            message = f"{given}: must be at least {least:g}" + ("" if most == inf else f" and at most {most:g}")
            raise argparse.ArgumentTypeError(message)
        return value

    options.add_argument(flag, type=number, default=default, help=f"{text}; default {default}")


def in_turns(
    works: Mapping[str, Callable[[], object]],
    rounds: Iterable[object],
    clock: Callable[[], int] = time.perf_counter_ns,
) -> dict[str, list[int]]:
    """Return the times in ns of each work; the works take turns, so that other loads affect all of them."""
    times: dict[str, list[int]] = {name: [] for name in works}
    for _ in rounds:
        for name, work in works.items():
            begun = clock()
            work()
            times[name].append(clock() - begun)
    return times


def table_file(json_path: str | None) -> TextIO:
    """Return the file for the table: standard output, unless the JSON goes there."""
    return sys.stderr if json_path == "-" else sys.stdout


def print_table(heads: Sequence[str], rows: Iterable[Sequence[object]], out: TextIO) -> None:
    """Print rows below their heads; columns of words and the first are left-aligned, others right. None is a dash."""
    cells = [heads, *([("-" if one is None else str(one)) for one in row] for row in rows)]
    forms = []
    for place, column in enumerate(zip(*cells, strict=True)):
        is_text = place == 0 or all(one[:1].isalpha() or one in {"", "-"} for one in column[1:])
        forms.append(f"{'<' if is_text else '>'}{max(map(len, column))}")
    for row in cells:
        print("  ".join(map(format, row, forms)).rstrip(), file=out)


def write_json(json_path: str | None, report: object) -> None:
    """Write `report` to the path of `--json`, if given."""
    text = json.dumps(report, indent=2) + "\n"
    if json_path == "-":
        sys.stdout.write(text)
    elif json_path is not None:
        Path(json_path).write_text(text, encoding="utf-8")


def print_requirements(holds: Mapping[str, bool], out: TextIO) -> int:
    """Print if each requirement holds; return the exit status: 0 if all do, else 1."""
    for requirement, met in holds.items():
        print(f"{requirement}: {'holds' if met else 'DOES NOT HOLD'}", file=out)
    return 0 if all(holds.values()) else 1
