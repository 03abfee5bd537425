"""`haptether netsim proxy`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.link_options import LinkOptions

if TYPE_CHECKING:
    from haptether.netsim import ProxyStatistics


@dataclass(frozen=True, kw_only=True)
class Proxy(LinkOptions):
    """Impair a live UDP link: forward datagrams between two processes, and do to them what the link says.

    Datagrams that arrive at --listen go to --forward, and the answers back to whoever spoke first. One client at a
    time is served; another is refused until the first has been silent for a second.

    Examples:

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.05 --jitter-s 0.005 --loss 0.01

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.02 --backward.delay-s 0.08

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --scene remote_push
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the master sends to."""
    forward: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the slave listens."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """A shipped scene, a scene file, or a TOML file with only [link.*]; flags count instead of what it says."""
    duration_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """End after this time in s; without it, run until Ctrl-C."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the counts as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Forwards until told to stop."""
        from haptether.cli.live import Stopped, wait
        from haptether.cli.options import check_duration
        from haptether.cli.output import check_target
        from haptether.netsim import Proxy as LiveProxy

        check_duration("duration_s", self.duration_s)
        check_target(self.json)
        links = self.links(self.scene)
        with Stopped() as stopped:
            proxy = LiveProxy(
                listen=self.listen,
                forward=self.forward,
                forward_link=links.forward,
                backward_link=links.backward,
                seed=links.seed,
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
