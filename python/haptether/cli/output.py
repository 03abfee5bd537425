"""Where results go: a table for people, JSON for machines."""

import sys
from pathlib import Path


def write_json(target: Path, text: bytes) -> None:
    """Writes JSON to a file, or to standard output for `-`."""
    if str(target) == "-":
        sys.stdout.buffer.write(text + b"\n")
        sys.stdout.buffer.flush()
    else:
        target.write_bytes(text + b"\n")


def table_goes_to_stderr(json: Path | None) -> bool:
    """Whether standard output belongs to the JSON."""
    return json is not None and str(json) == "-"
