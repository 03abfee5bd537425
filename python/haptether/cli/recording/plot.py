"""`haptether plot`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions


@dataclass(frozen=True, kw_only=True)
class Plot(PictureOptions):
    """Draw a recorded run: positions, forces, what turns, the ladder and trips, with the events marked.

    With the recordings of both sides, both are in the picture, on the master's time as the clocks of the two machines
    have it.

    Examples:

    haptether plot master.mcap

    haptether plot master.mcap slave.mcap --out run.pdf
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """What `--record` of master or slave wrote."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="OTHER")] = None
    """What the other side wrote."""
    slave_begun_s: float | None = None
    """When the slave's run began after the master's in s, where the clocks of two machines differ."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """The picture: .png, .pdf or .svg; by default FILE with .png or --format."""

    def run(self) -> int:
        """Draws the picture.

        Raises:
            ValueError: No recording, or the name of no picture.
        """
        from haptether.cli.recording.files import read_run
        from haptether.cli.shared.picture import picture_file
        from haptether.cli.shared.screen import screen

        picture = picture_file(self.out or self.file.with_suffix(f".{self.format or 'png'}"), self.format)
        run = read_run(self.file, self.other, self.slave_begun_s)
        run.plot(picture, columns=self.page_columns)
        screen().print(f"picture: {picture}")
        return 0
