"""The table of runs that `master` and `demo` print."""

from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from haptether.cli.shared.screen import Screen
    from haptether.studies import PushResult


def _figure(value: float | None, digits: int, scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:.{digits}f}"


ROWS: "dict[str, Callable[[PushResult], str]]" = {
    "peak hand speed away from the wall [m/s]": lambda of: _figure(of.peak_hand_speed, 3),
    "peak force on the hand [N]": lambda of: _figure(of.peak_force_n, 2),
    "force on the hand when it lets go [N]": lambda of: _figure(of.force_at_release_n, 2),
    "time to trip after the release [ms]": lambda of: _figure(of.time_to_trip_s, 0, 1e3),
    "interventions before the release": lambda of: _figure(of.trips_before_release, 0),
    "time under intervention [s]": lambda of: _figure(of.intervention_s, 2),
    "packets sent": lambda of: str(of.sent),
    "packets lost on the way here": lambda of: str(of.lost),
    "session": lambda of: "secure" if of.security == "secure" else "INSECURE",
    "packets refused": lambda of: str(of.refused),
    "packets overtaken, not used": lambda of: str(of.late),
    "newest round trip [ms]": lambda of: _figure(of.round_trip_s, 1, 1e3),
    "loop wakes late, p50 [ms]": lambda of: f"{of.overshoot_p50_s * 1e3:.3f}",
    "loop wakes late, p99 [ms]": lambda of: f"{of.overshoot_p99_s * 1e3:.3f}",
    "holds (slave silent > 20 ms)": lambda of: str(of.holds),
    "state at the end": lambda of: of.final_state,
}


def push_table(results: "Sequence[PushResult]") -> Table:
    """One column per run."""
    table = Table(header_style="bold", pad_edge=False)
    table.add_column("controller")
    for result in results:
        table.add_column(result.controller, justify="right", no_wrap=True)
    for name, show in ROWS.items():
        table.add_row(name, *(show(result) for result in results))
    return table


def print_push(console: "Screen", results: "Sequence[PushResult]") -> None:
    """The table, and below it faults in their words, which fit no column."""
    console.print(push_table(results))
    for result in results:
        if result.fault is not None:
            console.print(f"fault, {result.controller}: {result.fault}", soft_wrap=True)
