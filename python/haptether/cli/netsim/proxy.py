"""`haptether netsim proxy`."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.netsim.link_options import LinkOptions, Links

if TYPE_CHECKING:
    from haptether.cli.shared.stop import Stopped
    from haptether.netsim import ControlSocket
    from haptether.netsim import Proxy as LiveProxy


@dataclass(frozen=True, kw_only=True)
class Proxy(LinkOptions):
    """Impair a live UDP link: forward datagrams between two processes, and do to them what the link says.

    Datagrams that arrive at --listen go to --forward, and the answers back to whoever sent them. Clients of this
    machine are served, and those that --allow names, up to 64 at a time. It never releases a datagram early; at the
    end it says how late it was, and a run in which p99 of that is above --max-error-s is INVALID: status 1.

    Examples:

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.05 --jitter-s 0.005 --loss 0.01

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --delay-s 0.02 --backward.delay-s 0.08

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --scene remote_push --log out.parquet

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --trace recorded.csv

    haptether netsim proxy --listen 0.0.0.0:9001 --forward 127.0.0.1:9000 --allow 192.0.2.7 --control ./netsim.sock
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the master sends to."""
    forward: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the slave listens."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """A shipped scene, a scene file, or a TOML file with only [link.*]; flags count instead of what it says."""
    allow: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="IP[:PORT]")] = ()
    """Also serve this source; may be given often. Those of this machine are served anyway."""
    control: Annotated[str | None, tyro.conf.arg(metavar="PATH|127.0.0.1:PORT")] = None
    """Where `haptether netsim set` changes the link while it runs: a Unix socket, or TCP of this machine only."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="PATH.csv|PATH.parquet")] = None
    """Write what became of each datagram, a row each: when it came, was due and left, or why it did not."""
    no_realtime: bool = False
    """Do not ask for real-time scheduling."""
    max_error_s: Annotated[float, tyro.conf.arg(metavar="S")] = 1e-3
    """Largest p99 in s of its own scheduling error with which the run is valid."""
    duration_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """End after this time in s; without it, run until Ctrl-C."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the counts as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Forwards until told to stop."""
        from haptether.cli.netsim.log import Log
        from haptether.cli.netsim.proxy_report import report
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
        check_target(self.json)
        links = self.links(self.scene)
        log = None if self.log is None else Log.checked(self.log)
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
        from haptether.cli.netsim.proxy_report import statistics_report
        from haptether.cli.shared.stop import wait
        from haptether.netsim import Controlled

        headline = f"netsim listens on {proxy.address}, forwards to {self.forward}"
        if control is not None:
            control.serve(Controlled(proxy, links.forward, links.backward, statistics_report))
            headline = f"{headline}, controlled by {control.address}"

        def status() -> str:
            now = proxy.statistics()
            return f"forwarded {now.forward.released} there, {now.backward.released} back"

        wait(headline, status, lambda: proxy.finished, stopped, self.duration_s)
