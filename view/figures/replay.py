"""Figure of a replay: recorded and replayed signals, and the point where they diverge."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from haptether.view.style.colours import PAPER, SIGNALS, THRESHOLD
from haptether.view.style.figure import Columns, letter, new_figure, plain_ticks, styled
from haptether.view.style.legend import legend_above

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

RECORDED, REPLAYED = PAPER, SIGNALS["hand"]
PANEL_IN, BARS_IN = 1.15, 0.6


class DrawnReplay(Protocol):
    """Attributes of a replay used here; `haptether.bridge.Replay` has them."""

    @property
    def level(self) -> str:
        """Level of the replay: "as measured", or with a modelled hand."""

    @property
    def overrides(self) -> Sequence[str]:
        """Settings that differ from the recording."""

    @property
    def time_s(self) -> Array:
        """Times, shape (ticks,)."""

    @property
    def recorded(self) -> Mapping[str, Array]:
        """Signals of the recording, shape (ticks, axes) each."""

    @property
    def replayed(self) -> Mapping[str, Array]:
        """Signals of the replay, with the hand's `displacement` in m and `displacement_rate` in m/s."""

    @property
    def parts_s(self) -> float | None:
        """Time from which the device force differs; None if it never does."""

    @property
    def ends_s(self) -> float | None:
        """Time at which the replay ends before the recording; None otherwise."""


def draw_replay(done: DrawnReplay, columns: Columns = 2) -> "Figure":
    """Draw device force, velocity, position and interventions of a replay and its recording.

    Args:
        done: Result of `haptether.replay`.
        columns: Width in columns of a page.

    Raises:
        ImportError: matplotlib is missing.
    """
    settings = ", ".join(done.overrides) or "its own settings"
    with styled():
        figure = new_figure(columns, 3 * PANEL_IN + BARS_IN + 0.9, f"{done.level}: {settings}")
        panels = figure.subplots(4, 1, sharex=True, height_ratios=[PANEL_IN] * 3 + [BARS_IN])
        before, after = done.recorded, done.replayed
        moved = before["position"] - before["position"][:1]
        rows = [
            ("device force", "N", before["device_force"], after["device_force"]),
            ("velocity", "m/s", before["velocity"], before["velocity"] + after["displacement_rate"]),
            ("position", "mm", moved * 1e3, (moved + after["displacement"]) * 1e3),
        ]
        shown = np.ones(len(done.time_s), dtype=bool) if done.ends_s is None else done.time_s < done.ends_s
        for panel, (name, unit, first, second) in zip(panels, rows, strict=False):
            panel.plot(done.time_s, _line(first), color=RECORDED, lw=1.6, label="recorded")
            panel.plot(done.time_s[shown], _line(second)[shown], color=REPLAYED, label="replayed")
            panel.set_ylabel(f"{name} [{unit}]" if first.shape[1] == 1 else f"|{name}| [{unit}]")
            plain_ticks(panel, 5)
        bars = panels[-1]
        for bottom, signals, colour in ((1, before, RECORDED), (0, after, REPLAYED)):
            tripped = (signals["tripped"] != 0) & (shown | (bottom == 1))
            bars.fill_between(done.time_s, bottom + 0.15, bottom + 0.85, where=tripped, color=colour, lw=0)
        bars.set_ylim(0.0, 2.0)
        bars.set_yticks([0.5, 1.5], ["replayed", "recorded"])
        bars.set_ylabel("tripped")
        bars.set_xlabel("time [s]")
        parted = []
        if done.parts_s is not None:
            parted = [panel.axvline(done.parts_s, color=THRESHOLD, lw=0.8, ls=":") for panel in panels]
            parted[0].set_label(f"they part at {done.parts_s:.3f} s")
        legend_above(panels[0])
        letter(panels)
        return figure


def _line(vectors: Array) -> Array:
    """One axis unchanged, or the norm of several."""
    line: Array = vectors[:, 0] if vectors.shape[1] == 1 else np.linalg.norm(vectors, axis=1)
    return line
