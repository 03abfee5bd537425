"""What every bench shares: `--json`, where its table goes then, and how the JSON is written."""

import argparse
import json
import sys
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
