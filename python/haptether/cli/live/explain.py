"""`haptether explain`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.bridge.flight import Flight, Tick
    from haptether.cli.shared.screen import Screen


@dataclass(frozen=True, kw_only=True)
class Explain(FileOptions):
    """Say why a side held or stopped: print the file of `--flight` or `--record` of master or slave.

    Prints the last 32 steps of the ladder with their reasons, and the causes in the words of the side that had them.
    Prints the last 16 interventions of the safety controllers with what tripped them, and the last 10 of the 50 ticks
    that are kept until the last hold and until the end. A recording has all steps and causes of the run.

    Examples:

    haptether master --peer 127.0.0.1:9000 --key arm.key --flight master.flight

    haptether explain master.flight --ticks 50

    haptether explain slave.mcap
    """

    file: Annotated[Path, tyro.conf.Positional]
    """File of `--flight` or `--record`."""
    ticks: int = 10
    """Number of printed ticks until the last hold, and until the end; 50 of each are kept."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the same as JSON; - for standard output."""

    def run(self) -> int:
        """Print the file.

        Raises:
            ValueError: The file is neither a flight recorder's file nor a recording.
        """
        from haptether.bridge import flight_of_file
        from haptether.cli.recording.files import check_files
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen

        check_target(self.json, force=self.force)
        if self.ticks < 0:
            message = f"ticks = {self.ticks}: must be 0 or more"
            raise ValueError(message)
        check_files(self.file, what="what --flight or --record of master or slave wrote")
        flight = flight_of_file(self.file)
        self._print(flight, screen(self.json))
        write_report(self.json, flight)
        return 0

    def _print(self, flight: "Flight", console: "Screen") -> None:
        from haptether.cli.shared.table import Column, Rows, of_numbers

        title = f"{flight.side}: steps of the ladder"
        steps = Rows(Column("time [s]", numbers=True), "from", "to", "because", title=title)
        for step in flight.transitions:
            steps.add(f"{step.time_s:.4f}", step.from_, step.to, step.reason)
        console.print(steps)
        _print_causes(flight, console)
        for line in _intervention_lines(flight):
            console.print_item(line)
        for title, ticks in (("until the last hold", flight.at_hold), ("until the end", flight.latest)):
            shown = ticks[len(ticks) - min(self.ticks, len(ticks)) :]
            if not shown:
                continue
            rest = f", of {len(ticks)} that are kept" if len(shown) < len(ticks) else ""
            console.print(f"\n{flight.side}: {len(shown)} ticks {title}{rest}", style="italic")
            ladder, values = _ladder_columns(flight.side, shown), _value_columns(flight.side, shown)
            if len(of_numbers(ladder | values, 1).blocks(console.width)) == 1:
                console.print_columns(ladder | values, 1)
            else:
                console.print_columns(ladder, 1)
                console.print_columns({TIME: ladder[TIME]} | values, 1)


def _intervention_lines(flight: "Flight") -> list[str]:
    """Return a line for each intervention: controller, time and cause."""
    if not flight.interventions:
        # A slave has no controllers.
        return ["no safety controller intervened"] if flight.side == "master" else []
    lines = [f"interventions of safety controllers: {max(flight.interventions_seen, len(flight.interventions))}"]
    if flight.interventions_seen > len(flight.interventions):
        lines[0] += f", of which {len(flight.interventions)} are kept:"
    return [*lines, *(f"  {one}" for one in flight.interventions)]


TIME = "time [s]"


def _ladder_columns(side: str, ticks: "list[Tick]") -> dict[str, list[str]]:
    columns = {
        TIME: [f"{tick.time_s:.4f}" for tick in ticks],
        "state": [tick.state for tick in ticks],
        "peer": [tick.peer or "-" for tick in ticks],
        "silent [ms]": ["-" if tick.age_s is None else f"{tick.age_s * 1e3:.1f}" for tick in ticks],
        "clutch": ["closed" if tick.clutch else "open" for tick in ticks],
        "gain": ["-" if tick.gain is None else f"{tick.gain:.2f}" for tick in ticks],
    }
    if side == "master":
        columns["trips"] = [" ".join(tick.tripped) or "-" for tick in ticks]
    return columns


def _value_columns(side: str, ticks: "list[Tick]") -> dict[str, list[str]]:
    """Return position, command and force, one column for each axis."""
    columns = {}
    command = "device force [N]" if side == "master" else "command [m]"
    of_axes = {
        "position [m]": [tick.position for tick in ticks],
        command: [tick.command for tick in ticks],
        "force [N]": [tick.force for tick in ticks],
    }
    for name, rows in of_axes.items():
        axes = max(map(len, rows))
        for axis in range(axes):
            label = name if axes == 1 else name.replace(" [", f" {axis + 1} [")
            columns[label] = [_number(row[axis]) if axis < len(row) else "-" for row in rows]
    return columns


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"


def _print_causes(flight: "Flight", console: "Screen") -> None:
    """Print each cause with its remedies."""
    if flight.causes:
        console.print(f"{flight.side}: why the two sides were not coupled", style="italic")
    for cause in flight.causes:
        console.print_item(f"{cause.time_s:.4f} s, {cause.state}: {cause.text}")
        for number, step in enumerate(cause.steps, start=1):
            console.print_item(f"  {number}. {step.text}")
