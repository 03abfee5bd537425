"""`haptether raven`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import RavenReport, RavenRow


@dataclass(frozen=True, kw_only=True)
class Raven:
    """Attack a teleoperation as the RAVEN II study did, and say what each attack does.

    Each attack is a scene that comes with Haptether, raven_drop and the others of `haptether simulate --list`. Exit
    status 1 says that one did what it is not known to do, or that something moved which should have held.

    Examples:

    haptether raven

    haptether raven --json - | jq '.rows[] | select(.succeeded) | .scene'

    haptether simulate raven_hijack --plot out/raven
    """

    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also write all rows as JSON; - for standard output."""

    def run(self) -> int:
        """Runs every attack (a second or two) and prints what it did; 0, or 1 if that is not what is expected."""
        from rich.console import Console

        from haptether.cli.output import check_target, table_goes_to_stderr, write_json
        from haptether.studies import raven_suite

        check_target(self.json)
        report = raven_suite()
        self._print(Console(stderr=table_goes_to_stderr(self.json)), report)
        if self.json is not None:
            write_json(self.json, report.as_json())
        return 0 if report.is_as_expected else 1

    def _print(self, console: "Console", report: "RavenReport") -> None:
        from rich.table import Table

        table = Table(header_style="bold", pad_edge=False)
        for name in ("attack", "security", "works", "effect"):
            table.add_column(name)
        for name in ("astray\n[mm]", "late\n[mm]", "extra\n[N]", "ends in"):
            table.add_column(name, justify="left" if name == "ends in" else "right", no_wrap=True)
        table.add_column("because")
        for row in report.rows:
            table.add_row(
                row.scene.removeprefix("raven_").replace("_", " "),
                row.security,
                f"[{'red' if row.succeeded else 'green'}]{'yes' if row.succeeded else 'no'}[/]",
                _effect(row),
                f"{row.astray_mm:.1f}",
                f"{row.lag_mm:.1f}",
                f"{max(row.extra_force_n, 0.0):.1f}",
                row.final_states[1],
                row.because,
            )
        console.print(table)
        console.print(
            "moved: the arm was led to where the hand was not. pushed: the hand felt what nobody measured.\n"
            "late: the arm followed, late. stopped: both sides hold, nothing moves until a person presses the clutch.\n"
            "none: no more than without the attack. Denial of service ends in `stopped`: no key prevents it.",
            highlight=False,
        )


def _effect(row: "RavenRow") -> str:
    effect: str = row.effect
    if row.effect != row.expected:
        effect = f"[red]{effect}, not {row.expected}[/]"
    return effect if row.is_safe else f"[red]{effect}, and moved in hold[/]"
