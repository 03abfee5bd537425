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
        from rich.padding import Padding
        from rich.text import Text

        from haptether.cli.shared.table import Column, Rows

        console.print("One operator for all rows (haptether.studies.Operator):", style="bold")
        values = to_builtins(report.operator) | report.device
        console.print(Padding(", ".join(f"{key} = {value:g}" for key, value in values.items()), (0, 0, 0, 2)))
        console.print(Padding("The force limits of the device stay on: 7.9 N, 1000 N/s when loading, 20 W.",
                              (0, 0, 1, 2)))  # fmt: skip
        numbers = (Column(label, numbers=True) for label in ("paper", "ours"))
        table = Rows("source", "quantity", "of", *numbers, "verdict", keys=3, gap=1)
        reasons: dict[str, int] = {}
        for row in report.rows:
            sign = "" if row.relation == "=" else f"{row.relation} "
            table.add(
                row.source,
                QUANTITIES.get(row.quantity, row.quantity),
                _conditions(row),
                "" if row.paper is None else f"{sign}{row.paper:.3g}",
                "not seen" if row.ours is None else f"{row.ours:.3g}",
                Text(_verdict(row, reasons), style=_colour(row.verdict)),
            )
        console.print(table)
        if reasons:
            console.print("\nWhy they differ:", style="bold")
        width = len(f"{len(reasons)}") + 2
        listed = Rows(Column("", numbers=True), "", gap=1)
        for text, number in reasons.items():
            listed.add(f"{number:>{width - 2}})", text)
        if reasons:
            console.print(listed)
        console.print(
            f"\nK = {STIFFNESS:g} N/m and D = {DEPTH:g} m unless said; w in ticks of 1 ms; a in N. MEV: the largest "
            "ejection velocity. Rows without a verdict: the paper plots a curve and prints no number."
        )


QUANTITIES = {
    "time_from_0.2_to_1.2_m_per_s": "to 1.2 m/s [s]",
    "time_to_0.1_m_outside": "to 0.1 m [s]",
    "max_ejection_velocity": "MEV [m/s]",
    "speed_at_trip": "V at trip [m/s]",
    "time_to_see_release": "sees release [s]",
    "trips_during_press": "trips in press",
    "time_to_trip": "time to trip [s]",
    "vfc_over_controller": "MEV of VFC / its",
    "speed_at_0.17_s": "V at 0.17 s [m/s]",
    "time_of_trip": "time of trip [s]",
    "least_energy_gripped": "least energy [J]",
    "median_grasp_ratio_gripped": "median S_h",
}
"""What the table calls each quantity, with its unit; --json has the long names."""


def _conditions(row: "PaperRow") -> str:
    numbers = {"w": row.window, "K": row.stiffness, "D": row.depth, "a": row.amplitude_n}
    common = {"K": STIFFNESS, "D": DEPTH}
    changed = [f"{key}={value:.3g}" if key == "D" else f"{key}={value:g}"
               for key, value in numbers.items() if value is not None and value != common.get(key)]  # fmt: skip
    # Beside a condition, the name of no controller says nothing more.
    named = [] if row.controller == "none" and changed else [row.controller or ""]
    return " ".join(part for part in [*named, *changed] if part)


def _verdict(row: "PaperRow", reasons: dict[str, int]) -> str:
    """The verdict in a word or two, with the number of its reason, which is added to `reasons`."""
    verdict = row.verdict.replace("differs: bound not kept", "not kept").replace("differs: not seen", "not seen")
    verdict = verdict.replace(": ", " ")
    if not row.verdict.startswith("differs") or not row.note:
        return verdict
    number = reasons.setdefault(f"{row.source}, {row.controller}: {row.note}", len(reasons) + 1)
    return f"{verdict} ({number})"


def _colour(verdict: str) -> str:
    return "yellow" if verdict.startswith("differs") else "green"
