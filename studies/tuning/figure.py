"""Figure of a tuning: observer values with thresholds, and missed releases over false trips."""

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from haptether.bridge.scene.labels import label_of
from haptether.studies.tuning.normal_operation import TUNED_FIELDS
from haptether.studies.tuning.tune import TunedThreshold, Tuning
from haptether.view.style.colours import CONTROLLERS, FOUND, THRESHOLD
from haptether.view.style.figure import Columns, letter, new_figure, styled, written
from haptether.view.style.labels import AxisLabel, wrapped
from haptether.view.style.legend import legend_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

BESIDE = 0.15
"""Room left of 0, so that a line at 0 is beside the axis, as a fraction of the linear part."""


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
        handles: dict[str, object] = {}
        for (above, below), each in zip(pairs, tuned, strict=True):
            drawn = [*_events(above, each, found, columns), *_roc(below, each)]
            handles |= {str(handle.get_label()): handle for handle in drawn}
        legend_beside(figure, list(handles.values()))
        letter(panels.ravel().tolist())
    return written(figure, path)


def _events(panel: "Axes", each: TunedThreshold, found: Tuning, columns: Columns) -> "list[Line2D]":
    of = TUNED_FIELDS[each.field]
    peaks = np.abs(np.array(each.peaks))
    text, factor = AxisLabel(of.score, of.unit).sized([*peaks, each.point.threshold])
    values = peaks * factor
    panel.step(values, np.arange(1, len(values) + 1) / found.hours, color=CONTROLLERS[each.controller][0],
               where="post")  # fmt: skip
    chosen = panel.axvline(factor * abs(each.point.threshold), color=FOUND, lw=1.4, label="threshold found")
    recorded = panel.axvline(factor * abs(each.recorded.threshold), color=THRESHOLD, ls="--", lw=1.0,
                             label="threshold as recorded")  # fmt: skip
    target = panel.axhline(found.per_hour, color=THRESHOLD, ls=":", lw=1.0, label="false trips asked for, at most")
    # Characters that fit below a panel.
    panel.set_xlabel(wrapped(text, 84 // len(found.thresholds) if columns == 2 else 40))
    panel.set_ylabel("events above it per hour")
    kind, words = each.controller.upper(), label_of(f"safety.{each.field}").words
    panel.set_title(words if words.startswith(kind) else f"{kind}: {words}")
    panel.set_yscale("log")
    return [chosen, recorded, target]


def _roc(panel: "Axes", each: TunedThreshold) -> "list[Line2D]":
    """Draw missed releases over false trips of all thresholds, with the interval of the found one."""
    points = [point for point in each.roc if point.missed_interval is not None]
    rates = np.array([point.false_trips_per_h for point in points])
    missed = [100.0 * point.missed / point.releases for point in points]
    panel.set_xlabel("false trips per hour")
    panel.set_ylabel("releases missed [%]")
    panel.set_ylim(-3.0, 103.0)
    if each.point.missed_interval is None:
        panel.text(0.5, 0.5, "no release to be missed", ha="center", va="center", transform=panel.transAxes)
        return []
    panel.plot(rates, missed, color=CONTROLLERS[each.controller][0], marker=".", clip_on=False)
    at, share = each.point.false_trips_per_h, 100.0 * each.point.missed / each.point.releases
    of_rate, of_share = np.array(each.point.false_trips_per_h_interval), 100.0 * np.array(each.point.missed_interval)
    panel.errorbar(at, share, xerr=np.abs(of_rate - at)[:, None], yerr=np.abs(of_share - share)[:, None], fmt="none",
                   ecolor=FOUND, elinewidth=0.8, capsize=2.0, clip_on=False)  # fmt: skip
    drawn = panel.plot(at, share, "o", color=FOUND, mfc="none", ms=7.0, clip_on=False,
                       label="threshold found, its interval")  # fmt: skip
    least = float(rates[rates > 0.0].min()) if (rates > 0.0).any() else 1.0
    # A power of ten, so that no label of the linear part lies beside the 0.
    linear = 10.0 ** np.ceil(np.log10(least))
    panel.set_xscale("symlog", linthresh=linear)
    panel.set_xlim(left=-BESIDE * linear)
    return list(drawn)
