"""`haptether netsim sample`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.netsim.link_options import LinkOptions
from haptether.cli.netsim.traffic import check_traffic, figures_table, sending_times

if TYPE_CHECKING:
    from typing import TextIO

    from haptether.netsim import Verdicts

MAX_POINTS = 5000
"""Of the picture over time."""


@dataclass(frozen=True, kw_only=True)
class Sample(LinkOptions):
    """Send packets at a constant rate through one direction of a link, in no time, and say what becomes of each.

    The table sets what was asked for beside what came out. With --csv, a row per packet: index, t_in_ns, t_out_ns
    (empty if it does not arrive), cause (empty if it arrives as it was sent); a copy has a row directly after its
    packet. The same seed gives the same bytes.

    Examples:

    haptether netsim sample --delay-s 0.05 --jitter-s 0.005 --packets 100000 --csv delays.csv

    haptether netsim sample --preset lte-driving --direction backward --plot lte.png

    haptether netsim sample --trace recorded.csv --rate 500

    haptether netsim sample remote_push --loss 0.05 --mean-burst 10 --backward.delay-s 0.1 --json -
    """

    scene: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """A shipped scene, a scene file, or a TOML file with only [link.*]; flags count instead of what it says."""
    packets: int = 10_000
    """How many packets."""
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 1000.0
    """Packets per second."""
    size: Annotated[int, tyro.conf.arg(metavar="BYTES")] = 92
    """Payload of a packet in bytes; by default a frame of one axis."""
    direction: Literal["forward", "backward"] = "forward"
    """Which direction of the link."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write a row per packet; - for standard output."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the figures as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PATH.png")] = None
    """Draw delays over time, and how often each occurs."""

    def run(self) -> int:
        """Judges all packets."""
        from haptether.cli.shared.output import check_target, require_matplotlib, table_goes_to_stderr, write_report
        from haptether.cli.shared.screen import screen
        from haptether.netsim import asked, judge_all, realised

        self._check()
        for target in (self.csv, self.json, self.plot):
            check_target(target)
        if self.plot is not None:
            require_matplotlib()
        links = self.links(self.scene)
        settings = getattr(links, self.direction)
        sent_ns = sending_times(self.packets, self.rate)
        verdicts = judge_all(settings, sent_ns, direction=self.direction, seed=links.seed, sizes=self.size)
        console = screen(self.csv if table_goes_to_stderr(self.csv) else self.json)
        figures = {"asked": asked(settings, self.direction), "realised": realised(verdicts)}
        console.print(figures_table(f"{self.packets} packets {self.direction}, seed {links.seed}", figures))
        if self.csv is not None:
            _write_csv(self.csv, verdicts)
        report = {
            "packets": self.packets,
            "rate_hz": self.rate,
            "size": self.size,
            "direction": self.direction,
            "seed": links.seed,
            **figures,
        }
        write_report(self.json, report)
        if self.plot is not None:
            _draw(verdicts, self.plot)
            console.print(f"picture: {self.plot}")
        return 0

    def _check(self) -> None:
        check_traffic(self.packets, self.rate, self.size)
        if [self.csv, self.json].count(Path("-")) > 1:
            message = "csv, json: only one of the two can go to standard output"
            raise ValueError(message)


def _write_csv(target: Path, verdicts: "Verdicts") -> None:
    import contextlib
    import io
    import sys

    from haptether.netsim import VERDICT_CAUSES
    from haptether.private_file import private_file

    rows_at_once = 100_000
    with contextlib.ExitStack() as stack:
        file: TextIO = sys.stdout
        if str(target) != "-":
            binary = stack.enter_context(private_file(target))
            file = stack.enter_context(io.TextIOWrapper(binary, encoding="utf-8", newline=""))
        file.write("index,t_in_ns,t_out_ns,cause\n")
        for start in range(0, len(verdicts), rows_at_once):
            part = slice(start, start + rows_at_once)
            columns = (verdicts.index, verdicts.t_in_ns, verdicts.t_out_ns, verdicts.cause_code)
            rows = zip(*(column[part].tolist() for column in columns), strict=True)
            file.write(
                "".join(
                    f"{index},{t_in},{'' if t_out < 0 else t_out},{VERDICT_CAUSES[cause]}\n"
                    for index, t_in, t_out, cause in rows
                )
            )


def _draw(verdicts: "Verdicts", path: Path) -> None:
    """Delays over time with what was lost, and how often each delay occurs."""
    import numpy as np
    from matplotlib.figure import Figure

    from haptether.private_file import private_file

    packets = verdicts.packets
    arrived = packets.t_out_ns >= 0
    sent_s = packets.t_in_ns * 1e-9
    delay_ms = (packets.t_out_ns - packets.t_in_ns) * 1e-6
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    over_time, often = figure.subplots(1, 2, width_ratios=(2, 1), sharey=True)
    first = slice(0, MAX_POINTS)
    over_time.plot(sent_s[first][arrived[first]], delay_ms[first][arrived[first]], ".", markersize=2)
    top = float(delay_ms[arrived].max()) if arrived.any() else 1.0
    lost = sent_s[first][~arrived[first]]
    over_time.plot(lost, np.full(lost.size, 1.04 * top), "|", color="tab:red", label=f"lost ({(~arrived).mean():.2%})")
    over_time.set(xlabel="sent [s]", ylabel="one-way delay [ms]")
    over_time.legend(loc="center right")
    often.hist(delay_ms[arrived], bins=100, orientation="horizontal")
    often.set(xlabel="packets", xscale="log")
    with private_file(path) as file:
        figure.savefig(file, dpi=120, format=path.suffix[1:] or "png")
