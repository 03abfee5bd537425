"""Tables of all commands: within the width of the screen, with no number cut.

Text is broken between words. A table that is still too wide becomes longer: its columns go below one another, each
block with the first ones again. If not even two columns fit, each row becomes lines of its own.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from haptether.printable import printable

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType

MAX_HEADER_LINES = 4
MIN_HEADER_WIDTH = 10
GAP = 2
LEAST = 12
"""Least width of a column of text that has so much text."""
MOST_WHOLE = 28
"""Longest number among text that stays whole."""
NUMBER = re.compile(r"\W*\d[\d.,:e+%/-]*\W*")


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its label, with the unit of the values below it."""

    label: str
    numbers: bool = False
    """True for values that stay on one line, aligned right; otherwise text."""


class Rows:
    """A table that fits the width of its output."""

    def __init__(
        self, *columns: Column | str, keys: int = 1, gap: int = GAP, title: str = "", spaced: bool = False
    ) -> None:
        """Create an empty table.

        Args:
            columns: From the left; a string is a column of text.
            keys: Number of columns at the left that identify a row; they are in each block.
            gap: Blanks between two columns.
            title: Title above the table.
            spaced: True for a blank line between rows.
        """
        self.columns = [Column(of) if isinstance(of, str) else of for of in columns]
        self.columns = [Column(_text(of.label).plain, of.numbers) for of in self.columns]
        self._keys, self._gap, self._title, self._spaced = keys, gap, title, spaced
        self._rows: list[list[Text]] = []

    def add(self, *cells: str | Text) -> None:
        """Add a row, one cell a column."""
        if len(cells) != len(self.columns):
            message = f"{len(cells)} cells for {len(self.columns)} columns"
            raise ValueError(message)
        self._rows.append([_text(cell) for cell in cells])

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> Iterator["RenderableType"]:
        if self._title:
            yield Text(printable(self._title), style="italic")
        for number, block in enumerate(self.blocks(options.max_width)):
            if number:
                yield Text("")
            yield block

    def blocks(self, width: int) -> "list[RenderableType]":
        """Return the parts to print one below the other, at most `width` characters wide except for longer numbers."""
        places = list(range(len(self.columns)))
        if self._needed(places) <= width:
            return [self._table(places, width)]
        keys = places[: self._keys]
        columns, rows = self.columns, self._rows
        if self._needed(keys) > width // 2 and all(columns[key].numbers for key in keys):
            # The keys leave no room for other columns: the number of the row stands for them.
            numbered = Rows(Column("row", numbers=True), *columns, keys=1, gap=self._gap, spaced=self._spaced)
            numbered._rows = [[Text(str(number)), *row] for number, row in enumerate(rows)]
            return numbered.blocks(width)
        blocks = [list(keys)]
        for place in places[self._keys :]:
            if len(blocks[-1]) > len(keys) and self._needed([*blocks[-1], place]) > width:
                blocks.append(list(keys))
            blocks[-1].append(place)
        if any(self._needed(block) > width for block in blocks):
            return list(self._records(width))
        return [self._table(block, width) for block in blocks]

    def _cells(self, place: int) -> list[str]:
        return [line for row in self._rows for line in row[place].plain.split("\n")]

    def _natural(self, place: int) -> int:
        of = self.columns[place]
        label = folded(of.label).split("\n") if of.numbers else [of.label]
        return max(map(cell_len, [*label, *self._cells(place)]), default=0)

    def _least(self, place: int) -> int:
        """Return the width below which a column would cut a number, or break nearly every word."""
        natural = self._natural(place)
        if self.columns[place].numbers:
            return natural
        words = [word for cell in self._cells(place) for word in cell.split()]
        whole = [min(cell_len(word), MOST_WHOLE) for word in words if NUMBER.fullmatch(word)]
        return min(natural, max([LEAST, *whole]))

    def _needed(self, places: Sequence[int]) -> int:
        return sum(map(self._least, places)) + self._gap * (len(places) - 1)

    def _widths(self, places: Sequence[int], width: int) -> dict[int, int]:
        """Return the least widths, with the remaining width in equal parts for columns that need more."""
        widths = {place: self._least(place) for place in places}
        left = width - self._needed(places)
        wanting = [place for place in places if widths[place] < self._natural(place)]
        while left > 0 and wanting:
            for place in list(wanting):
                if left > 0 and widths[place] < self._natural(place):
                    widths[place] += 1
                    left -= 1
            wanting = [place for place in wanting if widths[place] < self._natural(place)]
        return widths

    def _table(self, places: Sequence[int], width: int) -> Table:
        # The gap is the padding and the divider.
        table = Table(
            box=SIMPLE_HEAD, header_style="bold", show_edge=False, pad_edge=False, padding=(0, self._gap - 1, 0, 0),
            leading=1 if self._spaced else 0, show_header=any(self.columns[place].label for place in places),
        )  # fmt: skip
        widths = self._widths(places, width)
        for place in places:
            of = self.columns[place]
            if of.numbers:
                table.add_column(Text(folded(of.label)), justify="right", no_wrap=True, width=widths[place])
            else:
                table.add_column(Text(of.label), overflow="fold", width=widths[place])
        for row in self._rows:
            table.add_row(*(row[place] for place in places))
        return table

    def _records(self, width: int) -> "Iterator[RenderableType]":
        for row in self._rows:
            lines = Text("\n").join(
                Text.assemble((f"{of.label}: " if of.label else "", "bold"), cell)
                if cell_len(of.label) + 2 + cell.cell_len <= width or not of.numbers
                else Text.assemble((f"{of.label}:", "bold"), "\n  ", cell)
                for of, cell in zip(self.columns, row, strict=True)
            )
            lines.overflow = "fold"
            yield lines


def _text(cell: str | Text) -> Text:
    """Return a cell without control characters that a terminal would obey."""
    if isinstance(cell, Text):
        return cell
    return Text("\n".join(map(printable, cell.split("\n"))))


def of_numbers(columns: dict[str, list[str]], keys: int) -> Rows:
    """Return a table of columns of numbers, the first `keys` of which identify a row."""
    rows = Rows(*(Column(name, numbers=True) for name in columns), keys=keys)
    for values in zip(*columns.values(), strict=True):
        rows.add(*values)
    return rows


def folded(label: str) -> str:
    """Break a label behind dots, spaces and underscores into at most four lines of at least ten characters."""
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
