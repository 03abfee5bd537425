"""What every bench shares: `--json`, where its table goes then, how the JSON is written, and its requirements."""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO


def bench_options(description: str | None, epilog: str) -> argparse.ArgumentParser:
    """Options of a bench, with `--json` for a start."""
    options = argparse.ArgumentParser(
        description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--json", metavar="PATH", help="the same for machines; - for stdout")
    return options


def table_file(json_path: str | None) -> TextIO:
    """Where the table goes: standard output, unless the JSON does."""
    return sys.stderr if json_path == "-" else sys.stdout


def write_json(json_path: str | None, report: object) -> None:
    """Writes `report` to the path of `--json`, if it was given."""
    text = json.dumps(report, indent=2) + "\n"
    if json_path == "-":
        sys.stdout.write(text)
    elif json_path is not None:
        Path(json_path).write_text(text, encoding="utf-8")


def print_requirements(holds: Mapping[str, bool], out: TextIO) -> int:
    """Prints whether each requirement holds; the exit status: 0 where all do, else 1."""
    for requirement, met in holds.items():
        print(f"{requirement}: {'holds' if met else 'DOES NOT HOLD'}", file=out)
    return 0 if all(holds.values()) else 1
