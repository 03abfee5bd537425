"""The picture of a replay: recorded and replayed above one another."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from haptether.printable import printable
from haptether.private_file import private_file

if TYPE_CHECKING:
    from haptether.bridge import Replay

RECORDED, REPLAYED = "0.45", "#c1440e"
MARGIN = 0.05
"""Share of the height that a line keeps to the edge."""


def draw_replay(done: "Replay", picture: Path) -> None:
    """Draws device force, speed, position and interventions of a replay as a PNG, PDF or SVG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.6), layout="constrained")
    settings = ", ".join(done.overrides) or "its own settings"
    figure.suptitle(printable(f"{done.level}: {settings}"), parse_math=False, fontsize=10, wrap=True)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=[3, 3, 3, 0.8])
    before, after = done.recorded, done.replayed
    moved = before["position"] - before["position"][:1]
    rows = [
        ("device force [N]", before["device_force"], after["device_force"]),
        ("velocity [m/s]", before["velocity"], before["velocity"] + after["displacement_rate"]),
        ("position [mm]", moved * 1e3, (moved + after["displacement"]) * 1e3),
    ]
    shown = np.ones(len(done.time_s), dtype=bool) if done.ends_s is None else done.time_s < done.ends_s
    for panel, (label, first, second) in zip(panels, rows, strict=False):
        panel.plot(done.time_s, _line(first), color=RECORDED, lw=1.8, label="recorded")
        panel.plot(done.time_s[shown], _line(second)[shown], color=REPLAYED, lw=1.0, label="replayed")
        name, unit = label.split(" [")
        panel.set_ylabel(label if first.shape[1] == 1 else f"|{name}| [{unit}")
        panel.margins(y=MARGIN)
        panel.grid(alpha=0.3)
    panels[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    bars = panels[-1]
    for bottom, signals, colour in ((1, before, RECORDED), (0, after, REPLAYED)):
        tripped = (signals["tripped"] != 0) & (shown | (bottom == 1))
        bars.fill_between(done.time_s, bottom + 0.15, bottom + 0.85, where=tripped, color=colour, lw=0)
    bars.set_ylim(0.0, 2.0)
    bars.set_yticks([0.5, 1.5], ["replayed", "recorded"], fontsize=7)
    bars.set_ylabel("tripped", fontsize=8)
    bars.set_xlabel("time [s]")
    if done.parts_s is not None:
        for panel in panels:
            panel.axvline(done.parts_s, color="0.2", lw=0.8, ls=":")
    with private_file(picture) as file:
        figure.savefig(file, format=picture.suffix[1:].lower(), dpi=150)


def _line(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """One axis as it is; of several the norm, as none is above the other."""
    line: npt.NDArray[np.float64] = vectors[:, 0] if vectors.shape[1] == 1 else np.linalg.norm(vectors, axis=1)
    return line
