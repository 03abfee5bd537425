"""The picture of a run that `haptether simulate --plot` draws."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from haptether.bridge import Run

AXIS_NAMES = "xyz"
PANELS = {
    "position [m]": {"position": "hand", "slave_position": "arm"},
    "velocity [m/s]": {"velocity": "hand"},
    "force [N]": {"device_force": "on the hand", "rendered_force": "rendered", "hand_force": "of the hand"},
    "tripped": {"tripped": "tripped"},
}
"""What is drawn below one another: signals and their labels."""
TRIPPED = {1: "VFC", 2: "HSC", 4: "WSC", 8: "PC", 16: "held"}
EVENTS_NAMED = 12


def draw_run(run: "Run", path: Path) -> None:
    """Draws positions, velocity, forces and interventions over time, with the events marked.

    Raises:
        ImportError: matplotlib is not there; it comes with `haptether[analysis]`.
    """
    from matplotlib.figure import Figure

    time_s = run.signals["time_s"]
    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    figure.suptitle(f"{Path(run.scene).stem}, seed {run.seed}")
    panels = figure.subplots(len(PANELS), 1, sharex=True, height_ratios=[3, 3, 3, 1])
    for panel, (label, signals) in zip(panels, PANELS.items(), strict=True):
        for name, described in signals.items():
            if name not in run.signals:
                continue
            if name == "tripped":
                _draw_trips(panel, time_s, run.signals[name])
                continue
            values = np.asarray(run.signals[name])
            for axis, values_of_axis in enumerate(values.reshape(len(values), -1).T):
                along = f", {AXIS_NAMES[axis] if axis < 3 else axis}" if values.ndim > 1 else ""
                panel.plot(time_s, values_of_axis, lw=1.2, label=f"{described}{along}")
            panel.legend(fontsize=8, loc="upper left")
        for event in run.events:
            panel.axvline(event.time_s, color="k", lw=0.6, ls=":")
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    for event in run.events[:EVENTS_NAMED]:
        panels[0].annotate(f"{event.kind} {event.detail}", (event.time_s, panels[0].get_ylim()[1]),
                           fontsize=7, ha="right", va="top", rotation=90)  # fmt: skip
    panels[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=120)


def _draw_trips(panel: "Axes", time_s: npt.NDArray[np.float64], tripped: npt.NDArray[np.uint8]) -> None:
    for row, bit in enumerate(TRIPPED):
        on = (tripped & bit) > 0
        panel.fill_between(time_s, row + 0.1, row + 0.9, where=on, step="post")
    panel.set_yticks(np.arange(len(TRIPPED)) + 0.5, list(TRIPPED.values()), fontsize=7)
    panel.set_ylim(0, len(TRIPPED))
