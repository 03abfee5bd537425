"""Figure of a link: delay of every packet, losses, and a histogram of delays."""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from haptether.view.style.colours import SIGNALS
from haptether.view.style.figure import Columns, letter, new_figure, styled
from haptether.view.style.legend import legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Times = npt.NDArray[np.int64]

LOST = "#d62839"
MOST_LOOPS = 40
"""Most repetitions of a recording that are marked; more would be indistinguishable."""


def draw_link(
    title: str, sent_ns: Times, arrived_ns: Times, repeats_every_s: float | None = None, columns: Columns = 2
) -> "Figure":
    """Draw the delay of each packet over its sending time, and a histogram.

    Args:
        title: Traffic and link, for the title.
        sent_ns: (n,) in ns.
        arrived_ns: (n,) in ns; below 0 for a lost packet.
        repeats_every_s: Period in s of a replayed recording; None without one.
        columns: Width in columns of a page.

    Raises:
        ImportError: matplotlib is missing (`haptether[analysis]`).
    """
    arrived = arrived_ns >= 0
    sent_s = sent_ns * 1e-9
    delay_ms = (arrived_ns - sent_ns)[arrived] * 1e-6
    end_s = float(sent_s[-1]) if len(sent_s) else 0.0
    loops = int(end_s // repeats_every_s) if repeats_every_s else 0
    if loops:
        marked = f"{loops} times" if loops > MOST_LOOPS else "at each grey line"
        title += f"\nthe recording of {repeats_every_s:.6g} s begins anew {marked}"
    with styled():
        figure = new_figure(columns, 2.3 if columns == 2 else 3.6, title)
        if columns == 1:
            over_time, often = figure.subplots(2, 1, height_ratios=(3, 2))
        else:
            over_time, often = figure.subplots(1, 2, width_ratios=(5, 2), sharey=True)
        # Rasterize the points of a long record, also in a PDF.
        dots = {"rasterized": len(sent_s) > 5000}
        over_time.plot(sent_s[arrived], delay_ms, ".", ms=1.5 if len(sent_s) > 500 else 3.0, color=SIGNALS["hand"],
                       mew=0.0, label="arrived", **dots)  # fmt: skip
        lost_s = sent_s[~arrived]
        if len(lost_s):
            over_time.plot(lost_s, np.full(len(lost_s), 0.97), "|", color=LOST, ms=5.0, mew=0.6,
                           transform=over_time.get_xaxis_transform(),
                           label=f"lost: {len(lost_s)} of {len(sent_s)} ({len(lost_s) / len(sent_s):.2%})",
                           **dots)  # fmt: skip
        if loops and loops <= MOST_LOOPS and repeats_every_s is not None:
            for loop in range(1, loops + 1):
                over_time.axvline(loop * repeats_every_s, color="#8b939c", lw=0.8, zorder=1.5)
        if len(delay_ms):
            # Leave room for loss marks above all delays.
            least, most = float(delay_ms.min()), float(delay_ms.max())
            room = max(most - least, 1e-3 * max(most, 1e-3))
            over_time.set_ylim(least - 0.05 * room, most + 0.12 * room)
        else:
            over_time.set_ylim(0.0, 1.0)
        over_time.set_xlim(float(sent_s[0]) if len(sent_s) else 0.0, max(end_s, 1e-3))
        over_time.set(xlabel="sent [s]", ylabel="one-way delay [ms]")
        flat = columns == 1
        often.hist(delay_ms, bins=100, orientation="vertical" if flat else "horizontal", color=SIGNALS["hand"])
        if len(delay_ms):
            often.set_yscale("log") if flat else often.set_xscale("log")
        often.set(xlabel="one-way delay [ms]" if flat else "packets", ylabel="packets" if flat else "")
        legend_above(over_time, _listed(over_time), width_in=4.5 if columns == 2 else 2.7)
        letter([over_time, often])
    return figure


def _listed(panel: "Axes") -> list["Line2D"]:
    """Legend entries with larger points; those of a long record are tiny."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=line.get_color(), label=str(line.get_label()), ls="", mew=0.8,
               marker="." if line.get_marker() == "." else "|", ms=5.0)
        for line in panel.get_lines()
        if not str(line.get_label()).startswith("_")
    ]  # fmt: skip
