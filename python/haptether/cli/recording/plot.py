"""`haptether plot`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from haptether.bridge import Signals

MARGIN_S = 0.5
"""Time in s that is drawn before the first engagement and after the last coupling."""


@dataclass(frozen=True, kw_only=True)
class Plot(PictureOptions):
    """Draw a recorded run: positions, forces, rotations, the ladder and trips, with the events marked.

    With the recordings of both sides, both are in the picture, on the master's time, by the clocks of the two machines.
    The picture shows the part in which the two were engaged; --whole shows all of it.

    Examples:

    haptether plot master.mcap

    haptether plot master.mcap slave.mcap --out run.pdf
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of `--record` of master or slave."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="OTHER")] = None
    """File of the other side."""
    slave_begun_s: float | None = None
    """Time in s from the beginning of the master's run to that of the slave's, if the clocks of two machines differ."""
    whole: bool = False
    """Draw the whole recording, also before the two engaged and after they parted."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """The picture: .png, .pdf or .svg; by default FILE with .png or --format."""

    def run(self) -> int:
        """Draw the picture.

        Raises:
            ValueError: A file that is not a recording, or a path that is not a picture's.
        """
        from msgspec.structs import replace

        from haptether.cli.recording.files import read_run
        from haptether.cli.shared.picture import picture_file
        from haptether.cli.shared.screen import screen

        picture = picture_file(
            self.out or self.file.with_suffix(f".{self.format or 'png'}"), self.format, force=self.force
        )
        run = read_run(self.file, self.other, self.slave_begun_s)
        console = screen()
        span = None if self.whole else coupled_span(run.signals)
        if span is not None:
            console.print(f"drawn: {span[0]:.3f} to {span[1]:.3f} s, while the two were engaged; --whole draws all")
            run = replace(run, signals=run.signals.between(*span))
        run.plot(picture, columns=self.page_columns)
        console.print(f"picture: {picture}")
        return 0


def coupled_span(signals: "Signals") -> tuple[float, float] | None:
    """Return the drawn time span in s: a margin before the first engagement and after the last coupling.

    None if they never engage, or if the span is the whole run.
    """
    import numpy as np

    from haptether.bridge.codes import LADDER_STATES

    coupled = [LADDER_STATES.index(state) for state in ("engaged", "stale", "hold")]
    of_sides = [(signals[signals.time_of(name)], signals[name]) for name in ("state", "slave_state") if name in signals]
    times = np.concatenate([time_s[np.isin(states, coupled)] for time_s, states in of_sides] or [np.empty(0)])
    if not times.size:
        return None
    begin, end = float(times.min()) - MARGIN_S, float(times.max()) + MARGIN_S
    first = min(float(time_s[0]) for time_s, _ in of_sides if len(time_s))
    last = max(float(time_s[-1]) for time_s, _ in of_sides if len(time_s))
    return None if begin <= first and end >= last else (max(begin, first), min(end, last))
