"""`haptether netsim list`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.netsim import Preset


@dataclass(frozen=True, kw_only=True)
class List(FileOptions):
    """List the presets with their numbers and sources.

    Examples:

    haptether netsim list

    haptether netsim list --json -
    """

    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the presets with all their settings as JSON; - for standard output."""

    def run(self) -> int:
        """Print a row per preset."""
        import msgspec

        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.table import Column, Rows
        from haptether.netsim import PRESETS

        check_target(self.json, force=self.force)
        table = Rows("preset", "round trip", Column("loss", numbers=True), "source", spaced=True)
        for name, preset in PRESETS.items():
            table.add(f"{name}\n{preset.title}", *_figures(preset), preset.source)
        screen(self.json).print(table)
        write_report(self.json, {name: msgspec.to_builtins(preset) for name, preset in PRESETS.items()})
        return 0


def _figures(preset: "Preset") -> tuple[str, str]:
    claimed = {figure.quantity: figure.value for figure in preset.figures}
    times = [
        f"{quantity.removeprefix('round-trip-')} {value * 1e3:g} ms"
        for quantity, value in claimed.items()
        if quantity.startswith("round-trip-")
    ]
    return "\n".join(times), f"{claimed['loss']:.3g}" if "loss" in claimed else "-"
