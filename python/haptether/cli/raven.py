"""`haptether raven`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from haptether.studies import RavenReport, RavenRow

COLOURS = {"yes": "red", "denies": "yellow", "delays": "yellow", "no": "green"}


@dataclass(frozen=True, kw_only=True)
class Raven(FileOptions):
    """Attack a teleoperation as in the RAVEN II study, and print the effect of each attack.

    Each attack is a scene of its name, as raven_drop. Exit status 1: an attack had an unexpected effect, or something
    moved that should have held.

    Examples:

    haptether raven

    haptether raven --json - | jq '.rows[] | select(.works == "yes") | .scene'

    haptether simulate raven_hijack --plot out/raven
    """

    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also write all rows as JSON; - for standard output."""

    def run(self) -> int:
        """Run every attack (a second or two) and print its effect; return 0, or 1 for an unexpected one."""
        from haptether.cli.shared.output import check_target, write_json
        from haptether.cli.shared.progress import counted
        from haptether.cli.shared.screen import screen
        from haptether.studies import raven_suite

        check_target(self.json, force=self.force)
        with counted("attacks") as progress:
            report = raven_suite(progress=progress)
        self._print(screen(self.json), report)
        if self.json is not None:
            write_json(self.json, report.as_json())
        return 0 if report.is_as_expected else 1

    def _print(self, console: "Console", report: "RavenReport") -> None:
        from rich.text import Text

        from haptether.cli.shared.table import Column, Rows

        numbers = (Column(label, numbers=True) for label in ("astray [mm]", "off [mm]", "extra [N]", "refused"))
        table = Rows("attack", "key", "works", "effect", *numbers, "arm ends in", keys=2, gap=1)
        for row in report.rows:
            table.add(
                _name(row),
                "yes" if row.security == "on" else "no",
                Text(row.works, style=COLOURS[row.works]),
                _effect(row),
                f"{row.astray_mm:.1f}",
                f"{row.lag_mm:.1f}",
                f"{max(row.extra_force_n, 0.0):.1f}",
                str(row.refused),
                row.final_states[1],
            )
        console.print(table)
        for because in dict.fromkeys(row.because for row in report.rows):
            names = dict.fromkeys(_name(row) for row in report.rows if row.because == because)
            console.print(f"{', '.join(names)}: {because}")
        console.print()
        console.print(
            "moved: the arm was led to where the hand was not. pushed: the hand felt what nobody measured. late: the "
            "arm followed, late. stopped: nothing moves until a person presses the clutch; no key makes packets "
            "arrive, so whoever sits on the path can always do that. astray: farthest that the arm was led from where "
            "the hand had been; off: from the run that nobody attacks; extra: force on the hand beyond that run's; "
            "refused: datagrams that changed nothing. Each attack is a scene of its name: haptether simulate "
            "raven_hijack.",
        )


def _name(row: "RavenRow") -> str:
    return row.scene.removeprefix("raven_").replace("_", " ")


def _effect(row: "RavenRow") -> "Text":
    from rich.text import Text

    unexpected = "" if row.effect == row.expected else f", not {row.expected}"
    moved = "" if row.is_safe else ", and moved in hold"
    return Text(f"{row.effect}{unexpected}{moved}", style="red" if unexpected or moved else "")
