"""The terminal: where strings are text, whoever wrote them."""

from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.status import Status
from rich.table import Table
from rich.text import Text

from haptether.cli.shared.output import table_goes_to_stderr
from haptether.printable import printable

MAX_HEADER_LINES = 4
MIN_HEADER_WIDTH = 10
GAP = 2


class Screen(Console):
    """A console that takes no string for markup or emoji codes, and lets nothing through that a terminal would obey."""

    def __init__(self, **how: Any) -> None:  # noqa: ANN401  # of Console
        super().__init__(**{"highlight": False, "markup": False, "emoji": False, **how})

    def render_str(self, text: str, **how: Any) -> Text:  # noqa: ANN401  # of Console
        """As text, line by line."""
        return super().render_str(_lines(text), **{**how, "markup": False, "emoji": False})

    def status(self, status: RenderableType, **how: Any) -> Status:  # noqa: ANN401  # of Console
        """A line beside a spinner, which would take a string for markup."""
        return super().status(plain(status) if isinstance(status, str) else status, **how)

    def print_columns(self, columns: dict[str, list[str]], keys: int) -> None:
        """Columns of numbers below a blank line each, in as many tables as the width needs; see `tables`."""
        for table in tables(columns, keys, self.width):
            self.print()
            self.print(table)


def screen(json: Path | None = None) -> Screen:
    """Where tables go: standard output, or standard error where the JSON has that."""
    return Screen(stderr=table_goes_to_stderr(json))


def plain(text: str) -> Text:
    """Text without markup, for what takes strings for it."""
    return Text(_lines(text))


def _lines(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))


# ------------------------------------------------------------------------------------------- tables of many columns


def folded(label: str) -> str:
    """A label on at most four lines of at least ten characters, broken behind dots, spaces and underscores."""
    parts: list[str] = []
    for character in label:
        if not parts or parts[-1][-1] in "._ ":
            parts.append("")
        parts[-1] += character
    for width in range(max(MIN_HEADER_WIDTH, *map(len, parts)) if parts else 0, len(label) + 1):
        lines = [""]
        for part in parts:
            if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
                lines.append("")
            lines[-1] += part
        if len(lines) <= MAX_HEADER_LINES:
            return "\n".join(line.rstrip(" ") for line in lines)
    return label


def tables(columns: dict[str, list[str]], keys: int, width: int) -> list[Table]:
    """Columns of numbers as tables of at most `width` characters, none of which is cut.

    The first `keys` columns stand in each of them, or the number of the row where they take more than half.
    """
    columns = {printable(name): list(map(printable, values)) for name, values in columns.items()}
    labels = {name: folded(name) for name in columns}
    widths = {name: max(map(cell_len, [*labels[name].split("\n"), *values])) + GAP for name, values in columns.items()}
    first = list(columns)[:keys]
    if sum(widths[name] for name in first) > width // 2:
        rows = [str(row) for row in range(len(columns[first[0]]))]
        columns, labels = {"row": rows, **columns}, {"row": "row", **labels}
        widths["row"] = max(map(len, ["row", *rows])) + GAP
        first = ["row"]
    blocks = [list(first)]
    for name in columns:
        if name in first:
            continue
        if len(blocks[-1]) > len(first) and sum(widths[of] for of in [*blocks[-1], name]) > width:
            blocks.append(list(first))
        blocks[-1].append(name)
    return [_table({labels[name]: columns[name] for name in block}) for block in blocks]


def _table(columns: dict[str, list[str]]) -> Table:
    # Its gap is the padding and the divider.
    table = Table(box=SIMPLE_HEAD, header_style="bold", show_edge=False, pad_edge=False, padding=(0, GAP - 1, 0, 0))
    for label in columns:
        table.add_column(label, justify="right", no_wrap=True)
    for values in zip(*columns.values(), strict=True):
        table.add_row(*values)
    return table
