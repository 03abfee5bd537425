"""Event names above a panel, without overlaps and within the figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from haptether.printable import printable
from haptether.view.style.colours import CONTROLLERS
from haptether.view.style.figure import figure_of, fitted, small_pt, text_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK = "#39434e"
ROW_PT = 8.5
"""Height of a row of names in points."""
MAX_ROWS = 8
LONGEST = 0.55
"""Longest name as a fraction of the panel width; the printed list has the full name."""
GAP_PX = 5.0
"""Gap between two names in figure pixels."""


@dataclass(frozen=True, slots=True)
class EventMark:
    """Event to be named above a panel."""

    time_s: float
    text: str


def name_events(panels: "Sequence[Axes]", events: Sequence[EventMark], above_pt: float) -> int:
    """Mark events in all panels and name them above the first; return the number of unnamed events.

    The figure grows by the height of the names.

    Args:
        panels: Panels below one another with the same time axis.
        events: Events in time order.
        above_pt: Height in points already used above the first panel.
    """
    if not events:
        return 0
    top = panels[0]
    figure = figure_of(top)
    figure.draw_without_rendering()
    begin, end = top.get_window_extent().x0, top.get_window_extent().x1
    for panel in panels:
        for event in events:
            panel.axvline(event.time_s, color=_colour(event.text), lw=0.5, ls=":", zorder=1.5)
    above = ("data", "axes fraction")
    rows: list[list[tuple[float, float]]] = []
    unnamed = 0
    for event in events:
        text = fitted(figure, printable(event.text), LONGEST * (end - begin))
        width = text_width(figure, text)
        at = float(top.transData.transform((event.time_s, 0.0))[0])
        to_left = at + width > end
        left = max(begin, at - width) if to_left else at
        span = (left - GAP_PX, left + width + GAP_PX)
        row = next((n for n, taken in enumerate(rows) if all(span[1] <= a or b <= span[0] for a, b in taken)), None)
        if row is None and len(rows) < MAX_ROWS:
            row = len(rows)
            rows.append([])
        if row is None:
            unnamed += 1
            continue
        rows[row].append((left, left + width))
        shift_pt = (left - at) * 72.0 / figure.dpi
        at_y = above_pt + ROW_PT * row
        # Draw lines below names, so that no name is struck through.
        top.annotate("", (event.time_s, 1.0), (0.0, at_y + 3.0), xycoords=above, textcoords="offset points", zorder=2.0,
                     arrowprops={"arrowstyle": "-", "lw": 0.5, "ls": ":", "color": _colour(event.text),
                                 "shrinkA": 0.0, "shrinkB": 0.0})  # fmt: skip
        top.annotate(text, (event.time_s, 1.0), (shift_pt, at_y), xycoords=above, textcoords="offset points",
                     parse_math=False, fontsize=small_pt(), ha="left", va="bottom", color=_colour(event.text),
                     gid="event", zorder=6.0,
                     bbox={"boxstyle": "square,pad=0.08", "facecolor": "white", "edgecolor": "none"})  # fmt: skip
    figure.set_figheight(figure.get_figheight() + ROW_PT * len(rows) / 72.0)
    return unnamed


def _colour(text: str) -> str:
    words = text.lower().replace(",", " ").split()
    tripped = [word for word in words if word in CONTROLLERS and word != "none"]
    return CONTROLLERS[tripped[0]][0] if "trip" in words[:1] and len(tripped) == 1 else INK
