"""`haptether netsim`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from haptether.netsim import ProxyStatistics


@dataclass(frozen=True, kw_only=True)
class Netsim:
    """Impair a live UDP link: forward datagrams between two processes with delay, jitter and loss.

    Datagrams that arrive at --listen go to --forward, and the answers back to whoever spoke first. Jitter is
    uniform and independent per packet, so packets overtake one another. One client at a time is served; another
    is refused until the first has been silent for a second.

    Examples:

    haptether netsim --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.05 --jitter-s 0.01 --loss 0.01

    haptether netsim --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.02 --back-delay-s 0.08
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the master sends to."""
    forward: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the slave listens."""
    delay_s: float = 0.0
    """One-way delay in s."""
    jitter_s: float = 0.0
    """Half-width in s of the uniform jitter around the delay; at most the delay."""
    loss: float = 0.0
    """Share of packets lost, 0 to 1."""
    back_delay_s: float | None = None
    """The same from slave to master; as forward if not given."""
    back_jitter_s: float | None = None
    """The same from slave to master; as forward if not given."""
    back_loss: float | None = None
    """The same from slave to master; as forward if not given."""
    seed: int = 0
    """Seed of jitter and loss: the same seed treats the same packets alike."""
    duration_s: float | None = None
    """End after this time in s; without it, run until Ctrl-C."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the counts as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Forwards until told to stop."""
        from haptether.cli.live import Stopped, wait
        from haptether.cli.options import check_duration, check_seed
        from haptether.cli.output import check_target
        from haptether.netsim import LinkSettings, Proxy

        check_seed(self.seed)
        check_duration("duration_s", self.duration_s)
        check_target(self.json)
        forward = LinkSettings(delay_s=self.delay_s, jitter_s=self.jitter_s, loss=self.loss)
        backward = LinkSettings(
            delay_s=self.delay_s if self.back_delay_s is None else self.back_delay_s,
            jitter_s=self.jitter_s if self.back_jitter_s is None else self.back_jitter_s,
            loss=self.loss if self.back_loss is None else self.back_loss,
        )
        with Stopped() as stopped:
            proxy = Proxy(
                listen=self.listen,
                forward=self.forward,
                forward_link=forward,
                backward_link=backward,
                seed=self.seed,
            )

            def status() -> str:
                now = proxy.statistics()
                return f"forwarded {now.forward.released} there, {now.backward.released} back"

            wait(
                f"netsim listens on {proxy.address}, forwards to {self.forward}",
                status,
                lambda: proxy.finished,
                stopped,
                self.duration_s,
            )
            statistics = proxy.stop()
        self._report(statistics)
        return 0

    def _report(self, statistics: "ProxyStatistics") -> None:
        import msgspec
        from rich.console import Console
        from rich.table import Table

        from haptether.cli.output import table_goes_to_stderr, write_json

        ways = {"forward": statistics.forward, "backward": statistics.backward}
        names = (
            "received",
            "released",
            "lost",
            "queue_full",
            "overtaking",
            "refused",
            "oversize",
            "unsent",
        )
        counts = {way: {name: getattr(of, name) for name in names} for way, of in ways.items()}
        table = Table(header_style="bold", pad_edge=False)
        table.add_column("direction")
        for name in names:
            table.add_column(name.replace("_", " "), justify="right")
        for way, of in counts.items():
            table.add_row(way, *(str(of[name]) for name in names))
        console = Console(stderr=table_goes_to_stderr(self.json))
        console.print(table)
        console.print(
            "released late by "
            f"p50 {statistics.scheduling_error_p50_s * 1e3:.3f} ms, "
            f"p99 {statistics.scheduling_error_p99_s * 1e3:.3f} ms, "
            f"most {statistics.scheduling_error_max_s * 1e3:.3f} ms",
            highlight=False,
        )
        if self.json is not None:
            report = {
                **counts,
                "peer_unreachable": statistics.peer_unreachable,
                "scheduling_error_p50_s": statistics.scheduling_error_p50_s,
                "scheduling_error_p99_s": statistics.scheduling_error_p99_s,
                "scheduling_error_max_s": statistics.scheduling_error_max_s,
            }
            write_json(self.json, msgspec.json.format(msgspec.json.encode(report), indent=2))
