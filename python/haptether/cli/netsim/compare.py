"""`haptether netsim compare`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from haptether.cli.shared.output import FileOptions


@dataclass(frozen=True, kw_only=True)
class Compare(FileOptions):
    """Compare a request to `tc netem` with its effect in netem and in netsim.

    netem is reproduced with its quirks, as by the setting netem of a link. Ours are the settings that fulfil the
    request; --json writes them. The active quirks stand below the table.

    Examples:

    haptether netsim compare "delay 50ms 10ms 25% loss 1% 25%"

    haptether netsim compare "delay 100ms 20ms distribution pareto" --packets 1000000 --json -
    """

    arguments: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ARGUMENTS")]
    """Arguments of `tc netem`, as one word in quotes; with or without the command before them."""
    packets: int = 100_000
    """Number of packets."""
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 1000.0
    """Packets per second."""
    size: Annotated[int, tyro.conf.arg(metavar="BYTES")] = 92
    """Payload of a packet in bytes; by default a frame of one axis."""
    seed: int = 0
    """Seed of all draws."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write figures, quirks and settings as JSON; - for standard output."""

    def run(self) -> int:
        """Send the packets through both."""
        import msgspec

        from haptether.cli.netsim.traffic import check_traffic, figures_table, sending_times
        from haptether.cli.shared.numbers import check_seed
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.netsim import compare_netem

        check_traffic(self.packets, self.rate, self.size)
        check_seed(self.seed)
        check_target(self.json, force=self.force)
        found = compare_netem(self.arguments, sending_times(self.packets, self.rate), seed=self.seed, size=self.size)
        console = screen(self.json)
        columns = {"asked": found.asked, "netem": found.netem, "ours": found.ours}
        console.print(figures_table(f"{self.packets} packets, seed {self.seed}", columns))
        for quirk in found.quirks:
            console.print_item(quirk)
        if found.refused is not None:
            console.print_item(f"no link of ours can: {found.refused}")
        if not found.quirks:
            console.print("no quirk of netem acted")
        report = {
            "arguments": self.arguments,
            "packets": self.packets,
            "rate_hz": self.rate,
            "size": self.size,
            "seed": self.seed,
            **msgspec.to_builtins(found),
        }
        write_report(self.json, report)
        return 0
