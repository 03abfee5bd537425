"""Command line that repeats a command: for pages, tables and captions."""

import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import tyro

OF_FILES = frozenset(
    {"json", "out", "latex", "plot", "format", "columns", "style", "force", "threads", "resume", "engine", "address"}
)
"""Options that change files or the time of a run, but no result."""


def command_line(name: str, given: Any) -> str:  # noqa: ANN401  # a command's dataclass
    """Return the command line with all options that differ from their defaults and change the result."""
    words, positional = [], []
    hints = get_type_hints(type(given), include_extras=True)
    for field in fields(given):
        value = getattr(given, field.name)
        if field.name in OF_FILES or value == field.default:
            continue
        marks = getattr(hints[field.name], "__metadata__", ())
        option = f"--{field.name.replace('_', '-')}"
        values = [str(one) if isinstance(one, str | Path) else repr(one) for one in _several(value)]
        if tyro.conf.Positional in marks:
            positional += values
        elif tyro.conf.UseAppendAction in marks:
            words += [word for one in values for word in (option, one)]
        else:
            words += [option, *([] if value is True else values)]
    return shlex.join(["haptether", name, *positional, *words])


def _several(value: object) -> tuple[object, ...]:
    return value if isinstance(value, tuple) else (value,)
