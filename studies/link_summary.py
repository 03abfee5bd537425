"""Summary of a live run's loop and link: last lines of `master`, `slave` and `check-link`."""

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from haptether.bridge import LoopReport, MasterTrace, SlaveTrace


class LinkSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One side's view of a run. Times in s; None without arrivals."""

    realtime: str
    """Real-time settings granted to the loop thread."""
    rate_hz: float
    """Ticks per second."""
    late_cycles: int
    """Wakes later than a whole period, after which ticks were skipped."""
    skipped_ticks: int
    overshoot_p50_s: float
    overshoot_p99_s: float
    overshoot_max_s: float
    """Lateness of the loop's wakes."""
    round_trip_p01_s: float | None
    round_trip_p50_s: float | None
    round_trip_p99_s: float | None
    round_trip_max_s: float | None
    """Round trip of the coupling, including the waits of both loops for their next ticks."""
    jitter_s: float | None
    """Standard deviation of the round trip."""
    sent: int
    arrived: int
    lost: int
    """Frames of the peer that never arrived, up to the newest one."""
    loss: float | None
    """Fraction of lost frames."""
    worst_gap_s: float | None
    """Longest time between two arrivals."""
    silence_at_end_s: float | None
    """Time from the latest arrival to the end of the run."""
    interarrival_jitter_s: float | None
    """Interarrival jitter of the peer's frames (RFC 3550)."""
    loss_bursts: int
    longest_burst: int
    """Number of loss bursts, and length of the longest."""
    reordered: int
    """Frames that arrived after a newer one."""
    usual_age_s: float | None
    """Bound on the usual age of the peer's frames; None before any echo."""
    offset_s: float | None
    offset_bound_s: float | None
    """Peer's clock minus own clock, and its error bound; None before it is known."""
    clock_faults: int
    last_clock_fault: str | None
    """Number of exchanges that healthy clocks cannot produce, and the last one."""
    recorded: int | None
    """Records in the recording; None without a recording."""
    unrecorded: int | None
    """Records that were not written to disk."""
    recording_end: str | None
    """Reason of an early end of the recording, or None."""


def summarise_link(trace: MasterTrace | SlaveTrace, report: LoopReport, period_s: float = 1e-3) -> LinkSummary:
    """Summarise the run of a side.

    Args:
        trace: Ticks of the side.
        report: Report of its loop.
        period_s: dT of the loop in s.
    """
    time_s, overshoot_s = trace.time_s, trace.overshoot_s
    fresh = trace.age_s == 0.0
    round_trips = trace.round_trip_s[fresh & np.isfinite(trace.round_trip_s)]
    arrivals = time_s[fresh]
    lasted_s = float(time_s[-1] - time_s[0]) if time_s.size > 1 else 0.0
    link, path, recording = report.link, report.path, report.recording
    arrived = link.fresh + link.late

    def late(share: float) -> float:
        return float(np.quantile(overshoot_s, share)) if overshoot_s.size else 0.0

    def round_trip(share: float) -> float | None:
        return float(np.quantile(round_trips, share)) if round_trips.size else None

    return LinkSummary(
        realtime=report.realtime,
        rate_hz=(time_s.size - 1) / lasted_s if lasted_s > 0.0 else 0.0,
        late_cycles=int(np.count_nonzero(overshoot_s >= period_s)),
        skipped_ticks=report.skipped,
        overshoot_p50_s=late(0.5),
        overshoot_p99_s=late(0.99),
        overshoot_max_s=late(1.0),
        round_trip_p01_s=round_trip(0.01),
        round_trip_p50_s=round_trip(0.5),
        round_trip_p99_s=round_trip(0.99),
        round_trip_max_s=round_trip(1.0),
        jitter_s=float(np.std(round_trips)) if round_trips.size else None,
        sent=link.sent,
        arrived=arrived,
        lost=link.missing,
        loss=link.missing / (arrived + link.missing) if arrived + link.missing else None,
        worst_gap_s=float(np.diff(arrivals).max()) if arrivals.size > 1 else None,
        silence_at_end_s=float(time_s[-1] - arrivals[-1]) if arrivals.size else None,
        interarrival_jitter_s=path.jitter_s if arrived else None,
        loss_bursts=path.bursts,
        longest_burst=path.longest_burst,
        reordered=path.reordered,
        usual_age_s=path.usual_age_s,
        offset_s=path.offset_s,
        offset_bound_s=path.offset_bound_s,
        clock_faults=path.clock_faults,
        last_clock_fault=path.last_clock_fault,
        recorded=None if recording is None else recording.written,
        unrecorded=None if recording is None else recording.dropped,
        recording_end=None if recording is None else recording.end,
    )


class LinkVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Verdict on a link for a coupling."""

    bearable_delay_s: float | None
    """Smallest sum of both delays at which contact with a holding hand oscillates; None if none."""
    stable_delays_s: list[tuple[float, float]]
    """Stable intervals of that sum; empty if not computed."""
    delay_s: float | None
    """Delay of the loop: p99 of the round trip, plus half a period at each holding side."""
    bearable_gap_s: float
    """Longest gap between arrivals without a hold."""
    gap_s: float | None
    """Longest gap of the link."""
    good: bool
    is_between: bool
    """True if the link is valid at a delay above one at which contact oscillates."""
    complaints: list[str]


def judge_link(
    summary: LinkSummary,
    bearable_delay_s: float,
    bearable_gap_s: float,
    period_s: float = 1e-3,
    *,
    stable_delays_s: Sequence[tuple[float, float]] = (),
) -> LinkVerdict:
    """Compare a link with the limits of coupling and ladder.

    Args:
        summary: Summary of the link.
        bearable_delay_s: Result of `largest_delay_s` in s.
        bearable_gap_s: Longest silence in s that the ladder tolerates.
        period_s: dT, the longer period of the two sides in s.
        stable_delays_s: Result of `stable_together`; a link is also valid if its round trips lie in one interval,
            except for the shortest and the longest 1 %.
    """
    complaints = []
    delay_s = None
    is_between = False
    if summary.round_trip_p99_s is None:
        complaints.append("no answer carried an echo")
    else:
        # The round trip runs from the tick that sampled x to the tick that takes the answer, including waits for ticks.
        # At its tick the slave samples F_e and then commands x, so the answer reflects commands up to the previous one.
        # A command is held for dT, which adds dT / 2, and so is the force on the device.
        delay_s = summary.round_trip_p99_s + period_s
        early_s = None if summary.round_trip_p01_s is None else summary.round_trip_p01_s + period_s
        is_later = delay_s >= bearable_delay_s
        is_between = (
            is_later and early_s is not None and any(low < early_s and delay_s < high for low, high in stable_delays_s)
        )
        if is_later and not is_between:
            has = _range(delay_s if early_s is None else early_s, delay_s)
            complaints.append(
                f"contact would oscillate: a delay of {has}, bearable is "
                f"{bearable_text(bearable_delay_s, stable_delays_s)}"
            )
    gap_s = None
    if summary.worst_gap_s is None or summary.silence_at_end_s is None:
        complaints.append("fewer than two answers came")
    else:
        gap_s = max(summary.worst_gap_s, summary.silence_at_end_s)
        if gap_s > bearable_gap_s:
            complaints.append(
                f"the ladder would have held: a gap of {gap_s * 1e3:.1f} ms, bearable is {bearable_gap_s * 1e3:.1f} ms"
            )
    return LinkVerdict(
        bearable_delay_s=bearable_delay_s if math.isfinite(bearable_delay_s) else None,
        stable_delays_s=list(stable_delays_s),
        delay_s=delay_s,
        bearable_gap_s=bearable_gap_s,
        gap_s=gap_s,
        good=not complaints,
        is_between=is_between and not complaints,
        complaints=complaints,
    )


def bearable_text(bearable_delay_s: float | None, stable_delays_s: Sequence[tuple[float, float]]) -> str:
    """Return the tolerated delays in ms as text: up to the first oscillation, and later intervals."""
    if bearable_delay_s is None or math.isinf(bearable_delay_s):
        return "any delay"
    later = [f"{low * 1e3:.1f} to {high * 1e3:.1f} ms" for low, high in stable_delays_s if low >= bearable_delay_s]
    return ", and ".join([f"{bearable_delay_s * 1e3:.1f} ms", *later])


def _range(early_s: float, late_s: float) -> str:
    early, late = f"{early_s * 1e3:.1f}", f"{late_s * 1e3:.1f}"
    return f"{late} ms" if early == late else f"{early} to {late} ms"
