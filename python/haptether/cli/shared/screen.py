"""The terminal: all strings are plain text."""

from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.status import Status
from rich.text import Text

from haptether.cli.shared.output import table_goes_to_stderr
from haptether.cli.shared.table import of_numbers
from haptether.printable import printable

HANGING = "    "
"""Indent of the continuation lines of an item."""
MIN_ITEM_WIDTH = 10


class Screen(Console):
    """A console that takes strings as plain text, without markup, emoji codes or terminal control characters."""

    def __init__(self, **how: Any) -> None:  # noqa: ANN401  # of Console
        super().__init__(**{"highlight": False, "markup": False, "emoji": False, **how})

    def render_str(self, text: str, **how: Any) -> Text:  # noqa: ANN401  # of Console
        """Return the string as text, line by line."""
        return super().render_str(_lines(text), **{**how, "markup": False, "emoji": False})

    def status(self, status: RenderableType, **how: Any) -> Status:  # noqa: ANN401  # of Console
        """Return a line beside a spinner; a string is not taken for markup."""
        return super().status(plain(status) if isinstance(status, str) else status, **how)

    def on_broken_pipe(self) -> None:
        """Leave the exit status to the command.

        Raises:
            BrokenPipeError: Always.
        """
        self.quiet = True
        raise BrokenPipeError

    def print_item(self, text: str) -> None:
        """Print a text with indented continuation lines; a word longer than a line is broken."""
        said = text.lstrip(" ")
        before = " " * (len(text) - len(said))
        width = max(MIN_ITEM_WIDTH, self.width - len(before) - len(HANGING))
        for number, line in enumerate(plain(said).wrap(self, width)):
            line.rstrip()
            self.print(Text(before + (HANGING if number else "")) + line, soft_wrap=True)

    def print_columns(self, columns: dict[str, list[str]], keys: int) -> None:
        """Print columns of numbers below a blank line, in as many tables as the width needs; see `Rows`."""
        self.print()
        self.print(of_numbers(columns, keys))


def screen(json: Path | None = None) -> Screen:
    """Return the screen for tables: standard output, or standard error if the JSON uses standard output."""
    return Screen(stderr=table_goes_to_stderr(json))


def plain(text: str) -> Text:
    """Return text without markup, for functions that would parse a string."""
    return Text(_lines(text))


def _lines(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))
