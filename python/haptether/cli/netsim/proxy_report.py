"""What `haptether netsim proxy` says at its end."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.netsim import DirectionStatistics, ProxyStatistics

COUNTS = (
    "received", "released", "lost", "queue_full", "damaged", "extras", "overtaking", "refused", "oversize", "unsent",
)  # fmt: skip
OVERALL = (
    "flows", "peer_unreachable", "early", "log_lost", "log_failed", "scheduling", "receive_buffer_bytes",
    "send_buffer_bytes",
    "scheduling_error_p50_s", "scheduling_error_p99_s", "scheduling_error_p999_s", "scheduling_error_max_s", "valid",
)  # fmt: skip


def statistics_report(statistics: "ProxyStatistics") -> dict[str, Any]:
    """All counts, for JSON."""
    ways = {"forward": statistics.forward, "backward": statistics.backward}
    return {
        **{way: {**_counts(of), "dropped": _dropped(of)} for way, of in ways.items()},
        **{name: getattr(statistics, name) for name in OVERALL},
        # An error of nothing is none.
        **({} if _released(statistics) else {name: None for name in OVERALL if name.startswith("scheduling_error")}),
    }


def _released(statistics: "ProxyStatistics") -> int:
    return statistics.forward.released + statistics.backward.released


def _counts(of: "DirectionStatistics") -> dict[str, int]:
    return {name: getattr(of, name) for name in COUNTS}


def _dropped(of: "DirectionStatistics") -> dict[str, int]:
    return {cause: count for cause, count in of.dropped.items() if count}


def report(statistics: "ProxyStatistics", max_error_s: float, json: Path | None) -> int:
    """Prints what the proxy did and gives the exit status: a run that was not what was asked for has failed."""
    import msgspec

    from haptether.cli.shared.output import write_json
    from haptether.cli.shared.screen import screen

    console = screen(json)
    _print(console, statistics)
    if statistics.log_failed:
        console.print("INVALID: the log could not be written to its end: is the disk full?", soft_wrap=True)
    elif not statistics.valid:
        early = f", {statistics.early} left early" if statistics.early else ""
        console.print(
            f"INVALID: p99 of the scheduling error is {statistics.scheduling_error_p99_s * 1e3:.3f} ms, "
            f"must be at most {max_error_s * 1e3:g} ms{early}: the delays were not those that were asked for",
            soft_wrap=True,
        )
    if json is not None:
        body = {**statistics_report(statistics), "max_error_s": max_error_s}
        write_json(json, msgspec.json.format(msgspec.json.encode(body), indent=2))
    return 0 if statistics.valid else 1


def _print(console: "Console", statistics: "ProxyStatistics") -> None:
    from rich.table import Table

    table = Table(header_style="bold", pad_edge=False)
    table.add_column("datagrams")
    ways = {"forward": _counts(statistics.forward), "backward": _counts(statistics.backward)}
    for way in ways:
        table.add_column(way, justify="right")
    for name in COUNTS:
        table.add_row(name.replace("_", " "), *(str(counts[name]) for counts in ways.values()))
    console.print(table)

    def say(text: str) -> None:
        console.print(text, soft_wrap=True)

    for way, of in (("forward", statistics.forward), ("backward", statistics.backward)):
        if dropped := _dropped(of):
            say(f"dropped {way}: {', '.join(f'{cause} {count}' for cause, count in dropped.items())}")
    shown = {
        "p50": statistics.scheduling_error_p50_s,
        "p99": statistics.scheduling_error_p99_s,
        "p99.9": statistics.scheduling_error_p999_s,
        "max": statistics.scheduling_error_max_s,
    }
    if _released(statistics):
        say(f"released late by {', '.join(f'{name} {error_s * 1e3:.3f} ms' for name, error_s in shown.items())}")
    say(
        f"{statistics.flows} flows, {statistics.forward.refused + statistics.backward.refused} datagrams refused, "
        f"scheduling class {statistics.scheduling}, socket buffers {statistics.receive_buffer_bytes} bytes for "
        f"receiving and {statistics.send_buffer_bytes} for sending"
    )
    if statistics.peer_unreachable:
        say(f"{statistics.peer_unreachable} times the network said that nobody is where they are forwarded to")
    if statistics.log_lost:
        say(f"the log lacks {statistics.log_lost} records: its writer was behind")
