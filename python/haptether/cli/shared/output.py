"""Where results go: a table for people, JSON for machines."""

import importlib.util
import os
import sys
from json import dumps as _dumps
from pathlib import Path

from haptether.private_file import is_stream, refuse_link, write_private


def write_json(target: Path, text: bytes) -> None:
    """Writes JSON to a file, or to standard output for `-`."""
    if str(target) == "-":
        sys.stdout.buffer.write(_inert(text) + b"\n")
        sys.stdout.buffer.flush()
    else:
        write_private(target, _inert(text) + b"\n")


def _inert(json: bytes) -> bytes:
    """The same JSON with what no screen shows escaped: it may go to a terminal."""
    if json.isascii():
        return json
    shown = (c if c.isprintable() or c == "\n" else _dumps(c)[1:-1] for c in json.decode())
    return "".join(shown).encode()


def table_goes_to_stderr(json: Path | None) -> bool:
    """Whether standard output belongs to the JSON."""
    return json is not None and str(json) == "-"


def require_matplotlib() -> None:
    """Refuses early where pictures cannot be drawn.

    Raises:
        ImportError: With what to install.
    """
    if importlib.util.find_spec("matplotlib") is None:
        message = "pictures need matplotlib: install haptether[analysis]"
        raise ImportError(message)


def check_target(target: Path | None) -> None:
    """Refuses a file that cannot be written, before the run rather than after it.

    Raises:
        OSError: With the path and what is in the way.
        ValueError: A symbolic link: whoever may make one would choose what is overwritten.
    """
    if target is None or str(target) == "-":
        return
    if target.is_dir():
        message = f"{target}: is a folder, must be a file"
        raise OSError(message)
    refuse_link(target)
    # A file that is there is replaced.
    if not os.access(target if is_stream(target) else target.parent, os.W_OK):
        message = f"{target}: cannot be written: is the folder there, and yours?"
        raise OSError(message)


def check_distinct(**files: Path | None) -> None:
    """Refuses options that name one file twice: what is written last would destroy the other, be it a key.

    Raises:
        ValueError: With both options.
    """
    seen: dict[Path, str] = {}
    for name, path in files.items():
        if path is None or str(path) == "-":
            continue
        option = f"--{name.replace('_', '-')}"
        other = seen.setdefault(path.resolve(), option)
        if other != option:
            message = f"{other}, {option}: both name {path}: give two files"
            raise ValueError(message)


def make_folder(folder: Path) -> None:
    """Makes a folder for pictures, before the run rather than after it.

    Raises:
        OSError: With the path and what is in the way.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"{folder}: cannot be made: {error.strerror}; give another folder"
        raise OSError(message) from None
    if not os.access(folder, os.W_OK):
        message = f"{folder}: cannot be written into; give another folder"
        raise OSError(message)
