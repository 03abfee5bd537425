"""`haptether paper`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

STIFFNESS, DEPTH = 200.0, 0.039
"""K in N/m and D in m of most rows: not repeated in each."""

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import PaperReport, PaperRow


@dataclass(frozen=True, kw_only=True)
class Paper(PictureOptions):
    """Print every quantitative claim of the paper's section 4 beside what this project computes.

    Examples:

    haptether paper

    haptether paper --json - | jq '.rows[] | select(.source == "Table 1")'

    haptether paper --plot out/paper --encoder-quantum 2.3e-5
    """

    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also write the operator and all rows as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Draw the figures into this folder, ours beside what the paper says."""
    encoder_quantum: float = 0.0
    """Resolution of the device in m; 0 measures position and velocity exactly, a PHANTOM Desktop has 2.3e-5."""

    def run(self) -> int:
        """Runs the experiments (under a second) and prints them."""
        from haptether.cli.shared.output import check_target, make_folder, require_matplotlib, write_json
        from haptether.cli.shared.screen import screen
        from haptether.studies import draw_paper, reproduce_paper

        check_target(self.json)
        if self.plot is not None:
            require_matplotlib()
            make_folder(self.plot)
        report = reproduce_paper(encoder_quantum=self.encoder_quantum)
        console = screen(self.json)
        self._print(console, report)
        if self.json is not None:
            write_json(self.json, report.as_json())
        if self.plot is not None:
            for path in draw_paper(report, self.plot, self.format or "png", self.columns):
                console.print(f"drawn: {path}")
        return 0

    def _print(self, console: "Console", report: "PaperReport") -> None:
        from msgspec import to_builtins
        from rich.box import SIMPLE_HEAD
        from rich.table import Table
        from rich.text import Text

        console.print("One operator for all rows (haptether.studies.Operator):", style="bold")
        values = to_builtins(report.operator) | report.device
        console.print("  " + ", ".join(f"{key} = {value:g}" for key, value in values.items()))
        console.print("  The force limits of the device stay on: 7.9 N, 1000 N/s when loading, 20 W.\n")
        table = Table(header_style="bold", box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        for name in ("source", "quantity", "of"):
            table.add_column(name, overflow="fold")
        for name in ("paper", "ours"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("verdict", overflow="fold")
        for row in report.rows:
            sign = "" if row.relation == "=" else f"{row.relation} "
            unit = "" if row.unit == "1" else f" [{row.unit}]"
            table.add_row(
                row.source,
                f"{row.quantity.replace('_', ' ')}{unit}",
                _conditions(row),
                "" if row.paper is None else f"{sign}{row.paper:.3g}",
                "not seen" if row.ours is None else f"{row.ours:.3g}",
                Text(row.verdict, style=_colour(row.verdict)),
            )
        console.print(table)
        notes = {
            f"{row.source}, {row.controller}: {row.note}"
            for row in report.rows
            if row.note and row.verdict.startswith("differs")
        }
        for note in sorted(notes):
            console.print(f"  {note}")
        console.print(
            f"K = {STIFFNESS:g} N/m and D = {DEPTH:g} m unless said; w in ticks of 1 ms; a in N. "
            "Rows without a verdict: the paper plots a curve and prints no number."
        )


def _conditions(row: "PaperRow") -> str:
    numbers = {"w": row.window, "K": row.stiffness, "D": row.depth, "a": row.amplitude_n}
    common = {"K": STIFFNESS, "D": DEPTH}
    parts = [row.controller or ""]
    for key, value in numbers.items():
        if value is not None and value != common.get(key):
            parts.append(f"{key}={value:.5g}")
    return ", ".join(part for part in parts if part)


def _colour(verdict: str) -> str:
    return "yellow" if verdict.startswith("differs") else "green"
