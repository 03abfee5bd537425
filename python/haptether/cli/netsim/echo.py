"""`haptether netsim echo`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from haptether.cli.shared.output import FileOptions


@dataclass(frozen=True, kw_only=True)
class Echo(FileOptions):
    """Answer the probes of `haptether netsim record`: the far end of a measurement.

    It answers each probe by one of the same size, and nothing else, so that nobody can be flooded through it.

    Examples:

    haptether netsim echo --listen 0.0.0.0:9200
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address for the probes."""
    duration_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """End after this time in s; without it, run until Ctrl-C."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the counts as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Answer until it is stopped."""
        import msgspec

        from haptether.cli.shared.numbers import check_duration
        from haptether.cli.shared.output import check_target, write_json
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.stop import Stopped, wait
        from haptether.netsim import Echo as LiveEcho

        check_duration("duration_s", self.duration_s)
        check_target(self.json, force=self.force)
        with Stopped() as stopped:
            echo = LiveEcho(listen=self.listen)
            wait(
                f"echo listens on {echo.address}", lambda: "answering", lambda: echo.finished, stopped, self.duration_s
            )
            answered, ignored = echo.stop()
        screen(self.json).print(f"{answered} probes answered, {ignored} other datagrams ignored")
        if self.json is not None:
            write_json(self.json, msgspec.json.encode({"answered": answered, "ignored": ignored}))
        return 0
