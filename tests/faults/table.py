"""The table of rows for people."""

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tests.faults.rows import Row

COLOURS = {"ok": "green", "FAILED": "red", "n/a": "yellow"}


def print_table(console: Console, rows: Sequence[Row]) -> None:
    """Print all rows, and the complaints below them."""
    table = Table(header_style="bold", pad_edge=False, padding=(0, 1, 0, 0), box=SIMPLE_HEAD)
    for name in ("fault", "coupling", "how", "expected"):
        table.add_column(name)
    for name in ("took\nms", "at most\nms", "moved\nmm", "force\nN"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("measured")
    table.add_column("", no_wrap=True)
    for row in rows:
        table.add_row(
            escape(row.fault),
            row.coupling,
            row.how,
            escape(row.expected),
            _number(row.reaction_s, 1e3, 1),
            _number(row.limit_s, 1e3, 1),
            _number(row.moved_m, 1e3, 3),
            _number(row.force_n, 1.0, 2),
            escape(row.measured),
            f"[{COLOURS[row.verdict]}]{row.verdict}[/]",
        )
    console.print(table)
    for row in rows:
        for complaint in row.complaints:
            console.print(f"[red]{escape(row.fault)}[/], {row.coupling}: {escape(complaint)}", highlight=False)
    counts = {verdict: sum(row.verdict == verdict for row in rows) for verdict in COLOURS}
    console.print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()), highlight=False)


def _number(value: float | None, scale: float, digits: int) -> str:
    return "-" if value is None else f"{value * scale:.{digits}f}"
