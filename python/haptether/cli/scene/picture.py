"""The picture of a run that `haptether simulate --plot` draws."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from haptether.printable import printable
from haptether.private_file import private_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from haptether.bridge import Run

AXIS_NAMES = "xyz"
PANELS = {
    "position [m]": {"position": "hand", "slave_position": "arm"},
    "velocity [m/s]": {"velocity": "hand"},
    "force [N]": {"device_force": "on the hand", "rendered_force": "rendered", "hand_force": "of the hand"},
    "gripper": {"trigger": "trigger", "gripper_command": "commanded", "gripper": "jaws"},
    "tripped": {"tripped": "tripped"},
}
"""What is drawn below one another: signals and their labels. A panel without any of them is left out."""
HEIGHTS = {"gripper": 2, "tripped": 1}
"""Of panels, beside 3 of the others."""
TRIPPED = {1: "VFC", 2: "HSC", 4: "WSC", 8: "PC", 16: "held"}
EVENTS_NAMED = 16
MIN_GAP = 0.012
"""Share of the width that two names of events stand apart at least."""
SLAVE_SIGNALS = ("slave_", "gripper")
"""How signals begin that have their own times, `slave_time_s`: the slave's period may differ from the master's."""


def draw_run(run: "Run", events: list[tuple[float, str]], path: Path) -> None:
    """Draws positions, velocity, forces and interventions over time, with the events marked.

    Args:
        run: With its signals.
        events: Times in s and what is written there.
        path: Of the PNG file.

    Raises:
        ImportError: matplotlib is not there; it comes with `haptether[analysis]`.
    """
    from matplotlib.figure import Figure

    time_s = run.signals["time_s"]
    # What a scene of one loop renders ticks with its master.
    slave_time_s = run.signals.get("slave_time_s", time_s)
    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    # Names of files and reasons are no formulas.
    figure.suptitle(printable(f"{Path(run.scene).stem}, seed {run.seed}"), parse_math=False)
    drawn = {label: signals for label, signals in PANELS.items() if not signals.keys().isdisjoint(run.signals)}
    panels = figure.subplots(len(drawn), 1, sharex=True, height_ratios=[HEIGHTS.get(label, 3) for label in drawn])
    for panel, (label, signals) in zip(panels, drawn.items(), strict=True):
        for name, described in signals.items():
            if name not in run.signals:
                continue
            if name == "tripped":
                _draw_trips(panel, time_s, run.signals[name])
                continue
            values = np.asarray(run.signals[name])
            times = slave_time_s if name.startswith(SLAVE_SIGNALS) else time_s
            columns = values.reshape(len(values), -1) if values.size else values.reshape(0, 1)
            for axis, values_of_axis in enumerate(columns.T):
                along = f", {AXIS_NAMES[axis] if axis < 3 else axis}" if values.ndim > 1 else ""
                panel.plot(times, values_of_axis, lw=1.2, label=f"{described}{along}")
            panel.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for time_of_event, _ in events:
            panel.axvline(time_of_event, color="k", lw=0.6, ls=":")
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    _name_events(panels[0], events[:EVENTS_NAMED], float(time_s[-1] - time_s[0]))
    panels[-1].set_xlabel("time [s]")
    with private_file(path) as file:
        figure.savefig(file, dpi=120)


def _name_events(panel: "Axes", events: list[tuple[float, str]], width_s: float) -> None:
    """Names above the panel, each right of the one before."""
    place = -np.inf
    for time_s, text in events:
        place = max(time_s, place + MIN_GAP * width_s)
        above = ("data", "axes fraction")
        panel.annotate(printable(text), (time_s, 1.0), (place, 1.03), xycoords=above, textcoords=above,
                       parse_math=False, fontsize=7, ha="center", va="bottom", rotation=90)  # fmt: skip


def _draw_trips(panel: "Axes", time_s: npt.NDArray[np.float64], tripped: npt.NDArray[np.uint8]) -> None:
    step = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 0.0
    for row, bit in enumerate(TRIPPED):
        edges = np.diff(np.concatenate(([0], (tripped & bit) > 0, [0])).astype(np.int8))
        begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
        # A trip of one tick must still be seen.
        bars = [(time_s[a], time_s[b - 1] - time_s[a] + step) for a, b in zip(begins, ends, strict=True)]
        panel.broken_barh(bars, (row + 0.1, 0.8), facecolor=f"C{row}", edgecolor=f"C{row}", lw=0.6)
    panel.set_yticks(np.arange(len(TRIPPED)) + 0.5, list(TRIPPED.values()), fontsize=7)
    panel.set_ylim(0, len(TRIPPED))
