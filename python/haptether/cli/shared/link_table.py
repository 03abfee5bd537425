"""The table of a link that `master`, `slave` and `check-link` print."""

from typing import TYPE_CHECKING

from haptether.cli.shared.table import Rows

if TYPE_CHECKING:
    from haptether.studies import LinkSummary


def link_table(of: "LinkSummary") -> Rows:
    """Return the table of rate, late cycles, round trip, jitter, loss, worst gap and recording."""

    def ms(*values: float | None) -> str:
        return " / ".join("-" if value is None else f"{value * 1e3:.3f}" for value in values)

    table = Rows("", "")
    loss = "-" if of.loss is None else f"{of.lost} of {of.arrived + of.lost} ({of.loss:.2%})"
    rows = {
        "real time": of.realtime,
        "rate [Hz]": f"{of.rate_hz:.1f}",
        "late cycles, ticks left out": f"{of.late_cycles}, {of.skipped_ticks}",
        "loop wakes late, p50 / p99 / max [ms]": ms(of.overshoot_p50_s, of.overshoot_p99_s, of.overshoot_max_s),
        "round trip, p50 / p99 / max [ms]": ms(of.round_trip_p50_s, of.round_trip_p99_s, of.round_trip_max_s),
        "jitter of the round trip [ms]": ms(of.jitter_s),
        "lost on the way here": loss,
        "worst gap between arrivals [ms]": ms(of.worst_gap_s),
    }
    if of.loss_bursts:
        rows["runs of lost frames, longest"] = f"{of.loss_bursts}, {of.longest_burst}"
    if of.clock_faults:
        rows["faults of a clock, the last"] = f"{of.clock_faults}, {of.last_clock_fault}"
    if of.recorded is not None:
        rows["recorded, dropped"] = f"{of.recorded}, {of.unrecorded}"
        if of.recording_end is not None:
            rows["recording ended early"] = of.recording_end
    for name, value in rows.items():
        table.add(name, value)
    return table
