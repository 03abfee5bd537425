"""Figure of a trade-off: missed releases over false trips per hour, one panel per controller and round trip."""

from os import PathLike
from typing import TYPE_CHECKING, Any

from haptether.studies.task import WITHIN_S
from haptether.studies.thresholds.law import ThresholdLaw
from haptether.studies.thresholds.trade_off import TradeOff
from haptether.view.style.colours import CHOICES, CONTROLLERS, NEUTRAL, layered
from haptether.view.style.figure import Columns, letter, new_figure, small_pt, styled, written
from haptether.view.style.legend import legend_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_ROUND_TRIPS = 3
"""Largest number of round trips shown: first, middle and last; the JSON has all."""
DEFAULT = "default threshold"
LINE_BREAK = "\n"
PAPERS = "--"
"""Dashes of the laws of the paper."""


def draw_trade_off(found: TradeOff, path: str | PathLike[str] | None = None, columns: Columns = 2) -> "Figure":
    """Draw each law as a line over its thresholds, all tasks combined; a ring marks the default threshold.

    Args:
        found: Trade-off to draw.
        path: Target picture, .png, .pdf or .svg; None writes no file.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The picture has another suffix.
        OSError: The file cannot be written, or is a symbolic link.
    """
    controllers = [name for name in CONTROLLERS if any(law.controller == name for law in found.laws)]
    trips = found.round_trips_s
    shown = sorted({0, len(trips) // 2, len(trips) - 1})[:SHOWN_ROUND_TRIPS]
    with styled():
        title = (
            f"{len(found.tasks)} tasks, {found.hands} hands each; missed: faster than {found.missed_speed:g} m/s within"
            f" {WITHIN_S:g} s of a release"
        )
        figure = new_figure(columns, (1.75 if columns == 2 else 2.1) * len(controllers) + 0.6, title)
        panels: list[Axes] = []
        parts = figure.subfigures(len(controllers), 1, squeeze=False)[:, 0]
        for part, controller in zip(parts, controllers, strict=True):
            laws = [law for law in found.laws if law.controller == controller]
            row = part.subplots(1, len(shown), sharey=True, squeeze=False)[0]
            for panel, place in zip(row, shown, strict=True):
                handles = _panel(panel, found, laws, trips[place])
                title = f"round trip{' ' if columns == 2 else LINE_BREAK}{trips[place] * 1e3:g} ms"
                panel.set_title(title, fontsize=small_pt(), pad=2.0)
            legend_beside(part, handles, "outside upper center")
            row[0].set_ylabel(f"{controller.upper()}:\nreleases missed [%]")
            panels += row.tolist()
        figure.supxlabel("false trips per hour held", fontsize=small_pt() + 1.0)
        letter(panels)
    return written(figure, path)


def _panel(panel: "Axes", found: TradeOff, laws: list[ThresholdLaw], round_trip_s: float) -> list[Any]:
    handles = []
    for place, (law, (colour, marker)) in enumerate(zip(laws, CHOICES, strict=False)):
        points = [found.over(law.name, value, round_trip_s=round_trip_s) for value in law.values]
        rates = [point.per_hour for point in points]
        missed = [100.0 * point.missed_share for point in points]
        handles += panel.plot(rates, missed, color=colour, marker=marker, clip_on=False, label=law.name,
                              ls=PAPERS if law.source == "paper" else "-", **layered(place, len(laws)))  # fmt: skip
        if law.default in law.values:
            of = law.values.index(law.default)
            rings = panel.plot(rates[of], missed[of], "o", color=NEUTRAL, mfc="none", ms=9.0, mew=0.7, clip_on=False,
                               zorder=5.0, label=DEFAULT)  # fmt: skip
            handles += rings
    linear = 1.0 / max(1e-9, _hours(found, laws))
    panel.set_xscale("symlog", linthresh=linear)
    panel.set_xlim(-0.3 * linear, 3e3)
    panel.set_ylim(-6.0, 106.0)
    handles.sort(key=lambda handle: handle.get_label() == DEFAULT)
    return list({str(handle.get_label()): handle for handle in handles}.values())


def _hours(found: TradeOff, laws: list[ThresholdLaw]) -> float:
    """Return the time in h of one point."""
    return found.over(laws[0].name, laws[0].values[0], round_trip_s=found.round_trips_s[0]).hours
