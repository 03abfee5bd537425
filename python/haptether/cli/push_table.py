"""The table of runs that `master` and `demo` print."""

from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from haptether.studies import PushResult

ROWS: "dict[str, Callable[[PushResult], str]]" = {
    "peak hand speed away from the wall [m/s]": lambda of: f"{of.peak_hand_speed:.3f}",
    "peak force on the hand [N]": lambda of: f"{of.peak_force_n:.2f}",
    "force on the hand when it lets go [N]": lambda of: (
        "-" if of.force_at_release_n is None else f"{of.force_at_release_n:.2f}"
    ),
    "time to trip after the release [ms]": lambda of: (
        "-" if of.time_to_trip_s is None else f"{of.time_to_trip_s * 1e3:.0f}"
    ),
    "interventions before the release": lambda of: str(of.trips_before_release),
    "time under intervention [s]": lambda of: f"{of.intervention_s:.2f}",
    "packets sent": lambda of: str(of.sent),
    "packets lost on the way here": lambda of: str(of.lost),
    "frames travel": lambda of: "in a secure session" if of.security == "secure" else "in the clear: INSECURE",
    "packets refused": lambda of: str(of.refused),
    "packets overtaken, not used": lambda of: str(of.late),
    "newest round trip [ms]": lambda of: f"{of.round_trip_s * 1e3:.1f}",
    "loop wakes late, p50 [ms]": lambda of: f"{of.overshoot_p50_s * 1e3:.3f}",
    "loop wakes late, p99 [ms]": lambda of: f"{of.overshoot_p99_s * 1e3:.3f}",
    "holds (slave silent > 20 ms)": lambda of: str(of.holds),
    "state at the end": lambda of: of.final_state if of.fault is None else f"{of.final_state}: {of.fault}",
}


def push_table(results: "Sequence[PushResult]") -> Table:
    """One column per run."""
    table = Table(header_style="bold", pad_edge=False)
    table.add_column("controller")
    for result in results:
        table.add_column(result.controller, justify="right")
    for name, show in ROWS.items():
        table.add_row(name.replace("[", "\\["), *(show(result) for result in results))
    return table
