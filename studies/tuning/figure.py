"""Figure of a tuning: observer values with thresholds, and missed releases over false trips."""

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from haptether.studies.tuning.normal_operation import TUNED_FIELDS
from haptether.studies.tuning.tune import TunedThreshold, Tuning
from haptether.view.style.colours import CONTROLLERS, HELD, PAPER, THRESHOLD
from haptether.view.style.figure import Columns, letter, new_figure, styled, written
from haptether.view.style.legend import legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_tuning(found: Tuning, path: str | PathLike[str] | None = None, columns: Columns = 2) -> "Figure":
    """Draw, for each threshold, events per hour over the observer's values, and below it the ROC curve.

    Args:
        found: Tuning to draw.
        path: Target picture, .png, .pdf or .svg; None writes no file.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The picture has another suffix.
        OSError: The file cannot be written, or is a symbolic link.
    """
    tuned = found.thresholds
    with styled():
        title = f"{len(found.files)} recordings, {found.hours:.3g} h held; {found.hands} hands let go"
        figure = new_figure(columns, 4.6 if columns == 2 else 4.2 * len(tuned) + 0.6, title)
        if columns == 2:
            panels = figure.subplots(2, len(tuned), squeeze=False)
            pairs = list(panels.T)
        else:
            panels = figure.subplots(2 * len(tuned), 1, squeeze=False)
            pairs = list(panels.reshape(-1, 2))
        handles: list[object] = []
        for (above, below), each in zip(pairs, tuned, strict=True):
            drawn = _events(above, each, found)
            _roc(below, each)
            handles = handles or drawn
        legend_below(figure, handles)
        letter(panels.ravel().tolist())
    return written(figure, path)


def _events(panel: "Axes", each: TunedThreshold, found: Tuning) -> list[object]:
    colour = CONTROLLERS[each.controller][0]
    values = np.abs(np.array(each.peaks))
    (events,) = panel.step(values, np.arange(1, len(values) + 1) / found.hours, color=colour, where="post",
                         label="events of normal operation")  # fmt: skip
    chosen = panel.axvline(abs(each.point.threshold), color=PAPER, lw=1.0, label="threshold found")
    recorded = panel.axvline(abs(each.recorded.threshold), color=THRESHOLD, ls="--", lw=1.0, label="as recorded")
    target = panel.axhline(found.per_hour, color=HELD, ls=":", lw=1.0, label="false trips asked for, at most")
    panel.set_xlabel(TUNED_FIELDS[each.field].score)
    panel.set_ylabel("events above it per hour")
    panel.set_title(each.field)
    panel.set_yscale("log")
    return [events, chosen, recorded, target]


def _roc(panel: "Axes", each: TunedThreshold) -> None:
    colour = CONTROLLERS[each.controller][0]
    points = [point for point in each.roc if point.missed_interval is not None]
    rates = np.array([point.false_trips_per_h for point in points])
    missed = np.array([point.missed / point.releases for point in points])
    intervals = np.array([point.false_trips_per_h_interval for point in points]).reshape(-1, 2)
    panel.set_xlabel("false trips per hour")
    panel.set_ylabel("releases missed [%]")
    panel.set_ylim(-3.0, 103.0)
    if not points:
        panel.text(0.5, 0.5, "no release to be missed", ha="center", va="center", transform=panel.transAxes)
        return
    panel.errorbar(rates, 100.0 * missed, xerr=np.abs(intervals - rates[:, None]).T,
                   color=colour, marker=".", ms=4.0, lw=0.8, elinewidth=0.4)  # fmt: skip
    panel.plot(each.point.false_trips_per_h, 100.0 * each.point.missed / each.point.releases, "o", color=PAPER,
               mfc="none", ms=7.0)  # fmt: skip
    least = float(rates[rates > 0.0].min()) if (rates > 0.0).any() else 1.0
    # A power of ten, so that no label of the linear part lies beside the 0.
    panel.set_xscale("symlog", linthresh=10.0 ** np.ceil(np.log10(least)))
    panel.set_xlim(left=0.0)
