"""Figure of a trade-off: missed releases over false trips per hour, one panel per controller."""

from os import PathLike
from typing import TYPE_CHECKING, Any

from haptether.studies.task import WITHIN_S
from haptether.studies.thresholds.law import ThresholdLaw
from haptether.studies.thresholds.trade_off import TradeOff
from haptether.view.style.colours import AXES, CONTROLLERS, HELD, PAPER, THRESHOLD
from haptether.view.style.figure import Columns, letter, new_figure, styled, written
from haptether.view.style.legend import legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_ROUND_TRIPS = 3
"""Largest number of round trips shown: first, middle and last; the JSON has all."""
LINES = ("-", "--", ":")
OURS = (AXES[0], AXES[5], AXES[3])
"""Colours of our first law of a controller, and of further ones."""


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
        height = 3.0 if columns == 2 else 2.2 * len(controllers) + 0.8
        figure = new_figure(columns, height, title)
        shape = (1, len(controllers)) if columns == 2 else (len(controllers), 1)
        panels = figure.subplots(*shape, squeeze=False).ravel().tolist()
        handles: list[Any] = []
        for panel, controller in zip(panels, controllers, strict=True):
            laws = [law for law in found.laws if law.controller == controller]
            handles += _panel(panel, found, laws, [trips[place] for place in shown])
            panel.set_title(controller.upper())
            panel.set_xlabel("false trips per hour held")
            panel.set_ylabel("releases missed [%]")
        for line, place in zip(LINES, shown, strict=False):
            label = f"round trip {trips[place] * 1e3:g} ms"
            handles += panels[0].plot([], [], line, color=THRESHOLD, label=label)
        legend_below(figure, handles)
        letter(panels)
    return written(figure, path)


def _panel(panel: "Axes", found: TradeOff, laws: list[ThresholdLaw], trips: list[float]) -> list[Any]:
    handles, ours = [], 0
    for law in laws:
        colour = PAPER
        if law.source != "paper":
            colour, ours = OURS[ours % len(OURS)], ours + 1
        elif any(each.source == "paper" for each in laws[: laws.index(law)]):
            colour = HELD
        for line, round_trip_s in zip(LINES, trips, strict=False):
            points = [found.over(law.name, value, round_trip_s=round_trip_s) for value in law.values]
            rates = [point.per_hour for point in points]
            missed = [100.0 * point.missed_share for point in points]
            (drawn,) = panel.plot(rates, missed, line, color=colour, marker=".", ms=4.0, clip_on=False,
                                  label=law.name)  # fmt: skip
            if line == LINES[0]:
                handles.append(drawn)
            if law.default in law.values:
                place = law.values.index(law.default)
                panel.plot(rates[place], missed[place], "o", color=colour, mfc="none", ms=6.0)
    panel.set_xscale("symlog", linthresh=1.0 / max(1e-9, _hours(found, laws)))
    panel.set_xlim(left=0.0, right=3e3)
    panel.set_ylim(-3.0, 103.0)
    return handles


def _hours(found: TradeOff, laws: list[ThresholdLaw]) -> float:
    """Return the time in h of one point."""
    return found.over(laws[0].name, laws[0].values[0], round_trip_s=found.round_trips_s[0]).hours
