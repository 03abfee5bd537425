"""`haptether netsim proxy`."""

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import tyro

from haptether.cli.netsim.link_options import LinkOptions, Links
from haptether.cli.shared.output import FileOptions
from haptether.extras import require

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.cli.shared.stop import Stopped
    from haptether.netsim import ControlSocket, DirectionStatistics, ProxyStatistics
    from haptether.netsim import Proxy as LiveProxy


@dataclass(frozen=True, kw_only=True)
class Proxy(LinkOptions, FileOptions):
    """Impair a live UDP link: forward datagrams between two processes under the settings of the link.

    Datagrams that arrive at --listen go to --forward, and the answers back to their senders. It serves clients of this
    machine and those of --allow, up to 64 at a time. It never releases a datagram early. At the end it reports its
    lateness; a run whose p99 exceeds --max-error-s is INVALID: status 1.

    Examples:

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.05 --jitter-s 0.005 --loss 0.01

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.02 --backward.delay-s 0.08

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --scene remote_push --log out.parquet

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --trace recorded.csv

    haptether netsim proxy --listen 0.0.0.0:9001 --forward 127.0.0.1:9000 --allow 192.0.2.7 --control ./netsim.sock
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address to which the master sends."""
    forward: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address of the slave."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """A shipped scene, a scene file, or a TOML file with only [link.*]; flags take precedence over it."""
    allow: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="IP[:PORT]")] = ()
    """Also serve this source; may be given often. Sources on this machine are always served."""
    control: Annotated[str | None, tyro.conf.arg(metavar="PATH|127.0.0.1:PORT")] = None
    """Address at which `haptether netsim set` changes the link while it runs: a Unix socket, or TCP of this machine
    only."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="PATH.csv|PATH.parquet")] = None
    """Write a row for each datagram: when it came, was due and left, or why it did not."""
    no_realtime: bool = False
    """Do not ask for real-time scheduling."""
    max_error_s: Annotated[float, tyro.conf.arg(metavar="S")] = 1e-3
    """Largest p99 in s of its own scheduling error with which the run is valid."""
    duration_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """End after this time in s; without it, run until Ctrl-C."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the counts as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Forward until it is stopped."""
        from haptether.cli.shared.numbers import check_duration
        from haptether.cli.shared.output import check_target
        from haptether.cli.shared.stop import Stopped
        from haptether.netsim import ControlSocket
        from haptether.netsim import Proxy as LiveProxy
        from haptether.private_file import begin_private

        check_duration("duration_s", self.duration_s)
        if not 0.0 < self.max_error_s <= 1.0:
            message = f"max_error_s = {self.max_error_s:g}: must be above 0 and at most 1 s"
            raise ValueError(message)
        check_target(self.json, force=self.force)
        links = self.links(self.scene)
        for line in links.unusual:
            print(line, file=sys.stderr, flush=True)
        log = None if self.log is None else Log.checked(self.log, force=self.force)
        if log is not None:
            begin_private(log.csv)
        with Stopped() as stopped, contextlib.ExitStack() as stack:
            control = None if self.control is None else stack.enter_context(ControlSocket(self.control))
            proxy = LiveProxy(
                listen=self.listen,
                forward=self.forward,
                forward_link=links.forward,
                backward_link=links.backward,
                seed=links.seed,
                allow=self.allow,
                realtime=not self.no_realtime,
                max_error_s=self.max_error_s,
                log=None if log is None else log.csv,
            )
            self._wait(proxy, control, links, stopped)
        try:
            statistics = proxy.stop()
        finally:
            if log is not None:
                log.end()
        return report(statistics, self.max_error_s, self.json)

    def _wait(self, proxy: "LiveProxy", control: "ControlSocket | None", links: Links, stopped: "Stopped") -> None:
        from haptether.cli.shared.stop import wait
        from haptether.netsim import Controlled

        headline = f"netsim listens on {proxy.address}, forwards to {proxy.forward}"
        if control is not None:
            control.serve(Controlled(proxy, links.forward, links.backward, statistics_report))
            headline = f"{headline}, controlled by {control.address}"

        def status() -> str:
            now = proxy.statistics()
            return f"forwarded {now.forward.released} there, {now.backward.released} back"

        wait(headline, status, lambda: proxy.finished, stopped, self.duration_s)


@dataclass(frozen=True)
class Log:
    """Ground truth of a run: CSV, or Parquet that is converted from it at the end."""

    target: Path
    """Target path of the user."""
    csv: Path
    """CSV file that the proxy writes while it runs: the target, or for Parquet a file beside it."""

    @classmethod
    def checked(cls, target: Path, *, force: bool) -> Self:
        """Refuse early a log that could not be written after the run.

        Raises:
            ValueError: Neither .csv nor .parquet.
            ImportError: Parquet without polars.
            OSError: The file cannot be written.
        """
        from haptether.cli.shared.output import check_target

        if target.suffix not in {".csv", ".parquet"}:
            message = f"log = {target}: must end in .csv or .parquet"
            raise ValueError(message)
        if target.suffix == ".csv":
            check_target(target, force=force)
            return cls(target, target)
        require(f"log = {target}", "polars")
        check_target(target, force=force)
        csv = target.with_name(f"{target.name}.csv")
        if csv.exists():
            message = f"{csv}: is there already; the log is written there until it is converted"
            raise OSError(message)
        return cls(target, csv)

    def end(self) -> None:
        """Convert the CSV in slices, and leave only the target.

        Raises:
            OSError: The target cannot be written; the CSV stays.
        """
        if self.csv == self.target:
            return
        import polars as pl

        from haptether.private_file import begin_private

        # Column types are given, because a column that is empty at the top would be read as text.
        numbers = dict.fromkeys(("index", "t_in_ns", "t_due_ns", "t_out_ns", "error_ns", "size"), pl.Int64)
        texts = dict.fromkeys(("direction", "kind", "cause"), pl.String)
        try:
            begin_private(self.target)
            rows = pl.scan_csv(self.csv, schema_overrides={**numbers, **texts})
            rows.with_columns(pl.col(*texts).fill_null("")).sink_parquet(self.target)
        except (OSError, ValueError, pl.exceptions.PolarsError) as error:
            message = f"{self.target}: cannot be written: {error}; the log is in {self.csv}"
            raise OSError(message) from None
        self.csv.unlink()


COUNTS = (
    "received", "released", "lost", "queue_full", "damaged", "extras", "overtaking", "refused", "oversize", "unsent",
)  # fmt: skip
OVERALL = (
    "flows", "peer_unreachable", "early", "log_lost", "log_failed", "scheduling", "receive_buffer_bytes",
    "send_buffer_bytes",
    "scheduling_error_p50_s", "scheduling_error_p99_s", "scheduling_error_p999_s", "scheduling_error_max_s", "valid",
)  # fmt: skip


def statistics_report(statistics: "ProxyStatistics") -> dict[str, Any]:
    """Return all counts, as in JSON."""
    directions = {"forward": statistics.forward, "backward": statistics.backward}
    return {
        **{direction: {**_counts(of), "dropped": _dropped(of)} for direction, of in directions.items()},
        **{name: getattr(statistics, name) for name in OVERALL},
        # Without a released datagram there is no scheduling error.
        **({} if _released(statistics) else {name: None for name in OVERALL if name.startswith("scheduling_error")}),
    }


def _released(statistics: "ProxyStatistics") -> int:
    return statistics.forward.released + statistics.backward.released


def _counts(of: "DirectionStatistics") -> dict[str, int]:
    return {name: getattr(of, name) for name in COUNTS}


def _dropped(of: "DirectionStatistics") -> dict[str, int]:
    return {cause: count for cause, count in of.dropped.items() if count}


def report(statistics: "ProxyStatistics", max_error_s: float, json: Path | None) -> int:
    """Print what the proxy did and return the exit status: an invalid run has failed."""
    from haptether.cli.shared.output import write_report
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
    write_report(json, {**statistics_report(statistics), "max_error_s": max_error_s})
    return 0 if statistics.valid else 1


def _print(console: "Console", statistics: "ProxyStatistics") -> None:
    from haptether.cli.shared.table import Column, Rows

    directions = {"forward": _counts(statistics.forward), "backward": _counts(statistics.backward)}
    table = Rows("datagrams", *(Column(direction, numbers=True) for direction in directions))
    for name in COUNTS:
        table.add(name.replace("_", " "), *(str(counts[name]) for counts in directions.values()))
    console.print(table)

    def say(text: str) -> None:
        console.print(text, soft_wrap=True)

    for direction, of in (("forward", statistics.forward), ("backward", statistics.backward)):
        if dropped := _dropped(of):
            say(f"dropped {direction}: {', '.join(f'{cause} {count}' for cause, count in dropped.items())}")
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
