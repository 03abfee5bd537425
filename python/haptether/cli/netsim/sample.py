"""`haptether netsim sample`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.netsim.link_options import LinkOptions
from haptether.cli.netsim.traffic import check_traffic, figures_table, sending_times
from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from typing import TextIO

    from haptether.netsim import Verdicts


@dataclass(frozen=True, kw_only=True)
class Sample(LinkOptions, PictureOptions):
    """Send packets at a constant rate through one direction of a link in virtual time, and print the fate of each.

    The table compares the request with the result. With --csv, a row per packet: index, t_in_ns, t_out_ns (empty if it
    does not arrive), cause (empty if it arrives as it was sent); a copy has a row directly after its packet. The same
    seed gives the same bytes.

    Examples:

    haptether netsim sample --delay-s 0.05 --jitter-s 0.005 --packets 100000 --csv delays.csv

    haptether netsim sample --preset lte-driving --direction backward --plot lte.png

    haptether netsim sample --trace recorded.csv --rate 500

    haptether netsim sample remote_push --loss 0.05 --mean-burst 10 --backward.delay-s 0.1 --json -
    """

    scene: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """A shipped scene, a scene file, or a TOML file with only [link.*]; flags take precedence over it."""
    packets: int = 10_000
    """Number of packets."""
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 1000.0
    """Packets per second."""
    size: Annotated[int, tyro.conf.arg(metavar="BYTES")] = 92
    """Payload of a packet in bytes; by default a frame of one axis."""
    direction: Literal["forward", "backward"] = "forward"
    """Direction of the link."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write a row per packet; - for standard output."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the figures as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw the delay of each packet over time, and its distribution, as .png, .pdf or .svg."""

    def run(self) -> int:
        """Judge all packets."""
        from haptether.cli.shared.output import check_target, table_goes_to_stderr, write_report
        from haptether.cli.shared.picture import asked_picture
        from haptether.cli.shared.screen import screen
        from haptether.netsim import asked, judge_all, realised

        self._check()
        check_target(self.csv, self.json, force=self.force)
        picture = asked_picture(self.plot, self)
        links = self.links(self.scene)
        settings = getattr(links, self.direction)
        sent_ns = sending_times(self.packets, self.rate)
        verdicts = judge_all(settings, sent_ns, direction=self.direction, seed=links.seed, sizes=self.size)
        console = screen(self.csv if table_goes_to_stderr(self.csv) else self.json)
        for line in links.unusual:
            if line.startswith(f"link.{self.direction}."):
                console.print(line, soft_wrap=True)
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
        if picture is not None:
            from haptether.netsim import repeats_every_s
            from haptether.view.figures.link import draw_link
            from haptether.view.style.figure import write_figure

            through = self.preset or (Path(self.scene).stem if self.scene else "")
            title = f"{self.packets} packets {self.direction}{f', {through}' if through else ''}, seed {links.seed}"
            packets = verdicts.packets
            every_s = repeats_every_s(settings, self.direction)
            write_figure(draw_link(title, packets.t_in_ns, packets.t_out_ns, every_s, self.page_columns), picture)
            console.print(f"picture: {picture}")
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
