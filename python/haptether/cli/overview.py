"""`haptether --help`: every command with its first line, by purpose."""

import inspect
import textwrap
from collections.abc import Mapping

from haptether.cli.shared.commands import CommandTable

NAME_COLUMNS = 22


def overview(description: str, purposes: Mapping[str, CommandTable], columns: int) -> str:
    """Return the text of `haptether --help`.

    Args:
        description: Text before the commands.
        purposes: Commands by purpose.
        columns: Width of the terminal.
    """
    parts = ["usage: haptether COMMAND ...", description]
    for purpose, commands in purposes.items():
        rows = [_row(name, summary(command), columns) for name, command in commands.items()]
        parts.append("\n".join([f"{purpose}:", *rows]))
    parts.append("`haptether help COMMAND` describes a command and gives examples.")
    return "\n\n".join(parts)


def _row(name: str, text: str, columns: int) -> str:
    head = f"  {name:<{NAME_COLUMNS - 2}}"
    return textwrap.fill(
        text, max(columns, NAME_COLUMNS + 20), initial_indent=head, subsequent_indent=" " * NAME_COLUMNS,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def summary(command: type[object]) -> str:
    """Return the first line of the docstring of a command."""
    return (inspect.getdoc(command) or "").partition("\n")[0]
