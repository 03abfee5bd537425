"""Shared parts of the benches: `--json`, output of table and JSON, requirements."""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO


def bench_options(description: str | None, epilog: str) -> argparse.ArgumentParser:
    """Return the options of a bench, with `--json`."""
    options = argparse.ArgumentParser(
        description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--json", metavar="PATH", help="the same for machines; - for stdout")
    return options


def table_file(json_path: str | None) -> TextIO:
    """Return the file for the table: standard output, unless the JSON goes there."""
    return sys.stderr if json_path == "-" else sys.stdout


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
