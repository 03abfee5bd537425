"""`haptether paper`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

STIFFNESS, DEPTH = 200.0, 0.039
"""K in N/m and D in m of most rows, which are not repeated in each."""

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import PaperReport, PaperRow


@dataclass(frozen=True, kw_only=True)
class Paper(PictureOptions):
    """Print every quantitative claim of the paper's section 4 beside the result of this project.

    Examples:

    haptether paper

    haptether paper --json - | jq '.rows[] | select(.source == "Table 1")'

    haptether paper --plot out/paper --encoder-quantum 2.3e-5

    haptether paper --sensitivity --json paper.json
    """

    sensitivity: bool = False
    """Also vary what the paper does not state, one factor at a time and several at once (under a minute): the range of
    each row, its strongest factor, and the explanation of the paper's number."""

    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also write the operator and all rows as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Draw the figures into this folder, ours beside the paper's."""
    encoder_quantum: float = 0.0
    """Resolution of the device in m; 0 measures position and velocity exactly, a PHANTOM Desktop has 2.3e-5."""

    def run(self) -> int:
        """Run the experiments (about a second) and print them."""
        from haptether.cli.shared.output import check_target, make_folder, require_matplotlib, write_json
        from haptether.cli.shared.picture import check_picture_options
        from haptether.cli.shared.progress import counted
        from haptether.cli.shared.screen import screen
        from haptether.studies import draw_paper, paper_sensitivity, reproduce_paper
        from haptether.studies.paper.figures import paper_pictures

        check_target(self.json, force=self.force)
        check_picture_options(self.plot, self)
        if self.plot is not None:
            require_matplotlib()
            make_folder(self.plot)
            pictures = paper_pictures(self.plot, self.format or "png", sensitivity=self.sensitivity)
            check_target(*pictures, force=self.force)
        with counted("experiments") as progress:
            report = reproduce_paper(encoder_quantum=self.encoder_quantum, progress=progress)
        if self.sensitivity:
            with counted("sensitivity") as progress:
                report = paper_sensitivity(report, progress=progress)
        console = screen(self.json)
        self._print(console, report)
        if self.json is not None:
            write_json(self.json, report.as_json())
        if self.plot is not None:
            for path in draw_paper(report, self.plot, self.format or "png", self.page_columns):
                console.print(f"drawn: {path}")
        return 0

    def _print(self, console: "Console", report: "PaperReport") -> None:
        from msgspec import to_builtins
        from rich.padding import Padding
        from rich.text import Text

        from haptether.cli.shared.table import Column, Rows

        console.print("One operator for all rows (haptether.studies.Operator):", style="bold")
        values = to_builtins(report.operator) | report.device
        text = ", ".join(
            f"{key} = {value if isinstance(value, str) else f'{value:g}'}" for key, value in values.items()
        )
        console.print(Padding(text, (0, 0, 0, 2)))
        console.print(Padding("The force limits of the device stay on: 7.9 N, 1000 N/s when loading, 20 W.",
                              (0, 0, 1, 2)))  # fmt: skip
        ranges = bool(report.joint_fits)
        numbers = (Column(label, numbers=True) for label in ("paper", "ours"))
        extents: list[Column | str] = (
            [Column("least", numbers=True), Column("greatest", numbers=True), "moved most by", "inside"]
            if ranges
            else []
        )
        table = Rows("source", "quantity", "of", *numbers, *extents, "verdict", keys=3, gap=1)
        reasons: dict[str, int] = {}
        for row in report.rows:
            sign = "" if row.relation == "=" else f"{row.relation} "
            table.add(
                row.source,
                QUANTITIES.get(row.quantity, row.quantity),
                _conditions(row),
                "" if row.paper is None else f"{sign}{row.paper:.3g}",
                "not seen" if row.ours is None else f"{row.ours:.3g}",
                *(_range(row) if ranges else ()),
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
        if ranges:
            console.print("\nNumbers of one experiment that one run meets at once:", style="bold")
            fits = Rows("experiment", *(Column(label, numbers=True) for label in ("numbers", "declared", "met")), "by")
            for fit in report.joint_fits:
                fits.add(fit.experiment, f"{fit.rows}", f"{fit.declared}", f"{fit.met}", fit.text)
            console.print(fits)
        console.print(
            f"\nK = {STIFFNESS:g} N/m and D = {DEPTH:g} m unless said; w in ticks of 1 ms; a and F_t in N. MEV: the "
            "largest ejection velocity. Rows without a verdict: the paper plots a curve and prints no number."
            + (" inside: the paper's number is within the range." if ranges else RANGES_HINT)
        )


RANGES_HINT = " --sensitivity: what explains those that differ."

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
"""Labels of the quantities in the table, with units; --json has the long names."""

FACTOR_TITLES = {
    "release_s": "release time",
    "release_kind": "release kind",
    "grip_margin": "grip margin",
    "hand_gain": "hand gain",
    "hold_s": "hold",
    "estimator": "estimator",
    "coulomb": "friction",
    "device_delay": "late force",
    "first_s": "press time",
    "hsc_force_threshold_n": "F_t of HSC",
    "mev_within_s": "time of MEV",
    "clock": "clock",
    "mass_kg": "mass",
}
"""Labels of the factors in the table; --json has the long names."""


def _conditions(row: "PaperRow") -> str:
    numbers = {"w": row.window, "K": row.stiffness, "D": row.depth, "a": row.amplitude_n, "F_t": row.force_threshold_n}
    common = {"K": STIFFNESS, "D": DEPTH}
    changed = [f"{key}={value:.3g}" if key == "D" else f"{key}={value:g}"
               for key, value in numbers.items() if value is not None and value != common.get(key)]  # fmt: skip
    # Beside a condition, "none" as controller adds nothing.
    named = [] if row.controller == "none" and changed else [row.controller or ""]
    return " ".join(part for part in [*named, *changed] if part)


def _range(row: "PaperRow") -> tuple[str, str, str, str]:
    """Return least and greatest of a row, its strongest factor, and if the paper's number is between them."""
    if (of := row.sensitivity) is None or of.least is None or of.greatest is None:
        return "", "", "", ""
    inside = {True: "yes", False: "no", None: ""}[row.paper_inside]
    most = FACTOR_TITLES.get(of.most_by or "", of.most_by or "nothing")
    return f"{of.least:.3g}", f"{of.greatest:.3g}", most, inside


def _verdict(row: "PaperRow", reasons: dict[str, int]) -> str:
    """Return the verdict in a word or two, with the number of its reason, which is added to `reasons`."""
    head, _, rest = row.verdict.partition(": ")
    if head in {"agrees", "holds", ""}:
        return row.verdict.replace(": ", " ")
    short = {"bound not kept": "not kept", "not seen": "not seen"}.get(rest, f"{head} {rest}")
    why = [row.note] if row.note else []
    if (of := row.sensitivity) is not None and not row.says_nothing:
        short = head.partition(" by ")[0]
        why = [f"{each.text}: {each.ours:.3g}" for each in of.explanations[:3]] or [rest, *why]
    elif row.says_nothing:
        short = head
        why = [rest, *why]
    if not why:
        return short
    number = reasons.setdefault(f"{row.source}, {row.controller}: {'; '.join(why)}", len(reasons) + 1)
    return f"{short} ({number})"


def _colour(verdict: str) -> str:
    return "green" if verdict.startswith(("agrees", "holds", "explained")) else "yellow"
