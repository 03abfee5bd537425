"""The picture of a replay: recorded and replayed above one another."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from haptether.bridge import Replay

RECORDED, REPLAYED = "0.45", "#c1440e"


def draw_replay(done: "Replay", picture: Path) -> None:
    """Draws device force, speed and position of a replay as a PNG, PDF or SVG."""
    from matplotlib.figure import Figure

    from haptether.private_file import private_file

    figure = Figure(figsize=(7.0, 6.4), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    time_s = done.time_s
    position = done.recorded["position"] - done.recorded["position"][:1]
    rows = [
        ("device force [N]", done.recorded["device_force"], done.replayed["device_force"]),
        (
            "velocity [m/s]",
            done.recorded["velocity"],
            done.recorded["velocity"] + done.replayed["displacement_rate"],
        ),
        ("position [mm]", position * 1e3, (position + done.replayed["displacement"]) * 1e3),
    ]
    for panel, (label, before, after) in zip(panels, rows, strict=True):
        # An axis shows what it does; several are one norm, as none is above the other.
        panel.plot(time_s, _line(before), color=RECORDED, lw=1.6, label="recorded")
        panel.plot(time_s, _line(after), color=REPLAYED, lw=1.0, label="replayed")
        panel.set_ylabel(label if before.shape[1] == 1 else f"|{label.replace(' [', '| [')}")
        for tripped, color in ((done.recorded["tripped"], RECORDED), (done.replayed["tripped"], REPLAYED)):
            bottom = 0.0 if color == RECORDED else 0.94
            panel.fill_between(
                time_s, bottom, bottom + 0.06, where=np.asarray(tripped) != 0, color=color, lw=0,
                transform=panel.get_xaxis_transform(),
            )  # fmt: skip
        if done.parts_s is not None:
            panel.axvline(done.parts_s, color="0.2", lw=0.8, ls=":")
    panels[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    settings = ", ".join(done.overrides) or "its own settings"
    panels[-1].set_xlabel(f"time [s]    ({done.level}; {settings}; bars: interventions, recorded below)")
    with private_file(picture) as file:
        figure.savefig(file, format=picture.suffix[1:].lower(), dpi=150)


def _line(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    line: npt.NDArray[np.float64] = vectors[:, 0] if vectors.shape[1] == 1 else np.linalg.norm(vectors, axis=1)
    return line
