"""`haptether explain`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import tyro

if TYPE_CHECKING:
    from rich.console import Console


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """A step of the ladder."""

    time_s: float
    from_: str = msgspec.field(name="from")
    to: str
    reason: str


class Tick(msgspec.Struct, frozen=True, kw_only=True):
    """A tick of a side; null stands for what is no finite number."""

    time_s: float
    state: str
    peer: str | None
    age_s: float | None
    clutch: bool
    gain: float
    position: list[float | None]
    command: list[float | None]
    force: list[float | None]


class Flight(msgspec.Struct, frozen=True, kw_only=True):
    """What a flight recorder wrote."""

    schema: int
    side: str
    transitions: list[Transition]
    at_hold: list[Tick]
    latest: list[Tick]


SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Say why a side held or stopped: print what `--flight` of master or slave wrote.

    Examples:

    haptether master --peer 127.0.0.1:9000 --key arm.key --flight master.flight

    haptether explain master.flight
    """

    file: Annotated[Path, tyro.conf.Positional]
    """What `--flight` wrote."""
    ticks: int = 10
    """How many ticks before the last hold, and before the end, are printed; at most 50 are there."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the same as JSON; - for standard output."""

    def run(self) -> int:
        """Prints the file.

        Raises:
            ValueError: The file is none of a flight recorder.
        """
        from rich.console import Console

        from haptether.cli.output import check_target, table_goes_to_stderr, write_json

        check_target(self.json)
        if self.ticks < 0:
            message = f"ticks = {self.ticks}: must be 0 or more"
            raise ValueError(message)
        flight = load_flight(self.file)
        console = Console(stderr=table_goes_to_stderr(self.json))
        self._print(flight, console)
        if self.json is not None:
            write_json(self.json, msgspec.json.format(msgspec.json.encode(flight), indent=2))
        return 0

    def _print(self, flight: Flight, console: "Console") -> None:
        from rich.table import Table

        steps = Table("time [s]", "from", "to", "because", title=f"{flight.side}: steps of the ladder")
        for step in flight.transitions:
            steps.add_row(f"{step.time_s:.4f}", step.from_, step.to, step.reason)
        console.print(steps)
        command = "device force [N]" if flight.side == "master" else "command [m]"
        for title, ticks in (("until the last hold", flight.at_hold), ("until the end", flight.latest)):
            shown = ticks[len(ticks) - min(self.ticks, len(ticks)) :]
            if not shown:
                continue
            columns = (
                "time [s]",
                "state",
                "peer",
                "silent [ms]",
                "clutch",
                "gain",
                "position [m]",
                command,
                "force [N]",
            )
            table = Table(*columns, title=f"{flight.side}: {title}")
            for tick in shown:
                table.add_row(
                    f"{tick.time_s:.4f}",
                    tick.state,
                    tick.peer or "-",
                    "-" if tick.age_s is None else f"{tick.age_s * 1e3:.1f}",
                    "closed" if tick.clutch else "open",
                    f"{tick.gain:.2f}",
                    *(_numbers(values) for values in (tick.position, tick.command, tick.force)),
                )
            console.print(table)


def _numbers(values: list[float | None]) -> str:
    return " ".join("none" if value is None else f"{value:.4g}" for value in values)


def load_flight(path: Path) -> Flight:
    """Reads what a flight recorder wrote.

    Raises:
        ValueError: The file is none, or of another version.
        OSError: It cannot be read.
    """
    try:
        flight = msgspec.json.decode(path.read_bytes(), type=Flight)
    except msgspec.DecodeError as error:
        message = f"{path}: is no file of a flight recorder ({error})"
        raise ValueError(message) from None
    if flight.schema != SCHEMA:
        message = f"{path}: schema = {flight.schema}, must be {SCHEMA}"
        raise ValueError(message)
    return flight
