"""Figure of an evaluation: map of verdicts, and the underlying numbers over the round trip."""

from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from haptether.studies.evaluation.result import MOST_HANDS, Evaluation, EvaluationCell, Verdict, totals
from haptether.view.style.colours import THRESHOLD, controller_look, controller_title, layered
from haptether.view.style.figure import Columns, figure_of, letter, new_figure, small_pt, styled, text_width, written
from haptether.view.style.legend import legend_beside

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VERDICT_COLOURS: dict[Verdict, str] = {
    "safe": "#a8dcc8",
    "trips": "#f6dfa4",
    "uncoupled": "#c9d6e4",
    "not-measured": "#f3f0f8",
    "not-engaged": "#dddddd",
    "thrown": "#f2b48c",
    "diverged": "#d98fb8",
}
"""Pale colours, because numbers are printed on them; each verdict also has a word."""
MIN_RATE_PER_H = 100.0
VERDICT_WORDS: dict[Verdict, str] = {
    "safe": "safe",
    "trips": "false trips",
    "uncoupled": "uncoupled",
    "not-measured": "not measured",
    "not-engaged": "not engaged",
    "thrown": "thrown",
    "diverged": "diverged",
}


HATCH = "//////"
"""Hatch of a safe but unconfirmed cell."""


def words_of(found: Evaluation, cells: "Sequence[EvaluationCell]") -> str:
    """Return a verdict as text, with the number of hands required to confirm it."""
    verdict = found.verdict(cells)
    if verdict != "safe" or found.is_confirmed(cells):
        return VERDICT_WORDS[verdict]
    needed = found.hands_needed(cells)
    return f"safe? {'over ' if needed == MOST_HANDS else ''}{needed} hands"


def trip_words(found: Evaluation, round_trip_s: float) -> list[str]:
    """Return a round trip as text, with the networks that have it as their own."""
    own = [network.name for network in found.networks if network.round_trip_s == round_trip_s]
    return [f"{round_trip_s * 1e3:g} ms", *own]


def draw_evaluation(found: Evaluation, path: str | PathLike[str] | None = None, columns: Columns = 2) -> "Figure":
    """Draw verdicts over controllers and round trips, and speeds, throws and false trips over the round trip.

    All tasks are combined: the worst verdict, the largest speed, and counts of the worst network with 95 % intervals. A
    safe but unconfirmed cell is hatched and shows the required number of hands.

    Args:
        found: Evaluation to draw.
        path: Target picture, .png, .pdf or .svg; None writes no file.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The picture has another suffix.
        OSError: The file cannot be written, or is a symbolic link.
    """
    with styled():
        several = f"{len(found.tasks)} tasks" if len(found.tasks) > 1 else found.tasks[0]
        networks = f"{len(found.networks)} networks" if len(found.networks) > 1 else f"network {found.networks[0].name}"
        title = f"{several}, {networks}, {found.hands} hands each"
        rows = 0.3 * len(found.controllers) + 0.5
        height = rows + (2.3 if columns == 2 else 6.0)
        figure = new_figure(columns, height + 0.5, title)
        below = ["speeds", "thrown", "trips"]
        mosaic: list[Any] = [["verdicts"] * 3, below] if columns == 2 else [["verdicts"], *([name] for name in below)]
        heights = [rows, *([(height - rows) / (len(mosaic) - 1)] * (len(mosaic) - 1))]
        panels = figure.subplot_mosaic(mosaic, height_ratios=heights)
        _verdicts(panels["verdicts"], found)
        _speeds(panels["speeds"], found)
        _thrown(panels["thrown"], found)
        _false_trips(panels["trips"], found)
        for name in below:
            panels[name].set_xlabel("round trip [ms]")
            panels[name].set_xlim(-0.5, len(found.round_trips_s) - 0.5)
            trips = [f"{trip_s * 1e3:.4g}" for trip_s in found.round_trips_s]
            room = (figure.bbox.width / (3 if columns == 2 else 1) - figure.dpi) / len(trips)
            crowded = max(text_width(figure, trip) for trip in trips) > 0.9 * room
            panels[name].set_xticks(_over_trips(found), trips, rotation=90 if crowded else 0)
        limit = panels["speeds"].plot([], [], color=THRESHOLD, lw=0.8, ls=":", label="limit")
        legend_beside(figure, [*panels["speeds"].get_legend_handles_labels()[0][: len(found.controllers)], *limit])
        letter([panels[name] for name in ("verdicts", *below)])
    return written(figure, path)


def _verdicts(panel: "Axes", found: Evaluation) -> None:
    from matplotlib.patches import Rectangle

    panel.grid(visible=False)
    figure = figure_of(panel)
    room = (figure.get_figwidth() - 1.4) / len(found.round_trips_s) * figure.dpi
    printed = {
        (row, column): words_of(found, found.of(controllers=controllers, round_trip_s=round_trip_s))
        for row, controllers in enumerate(found.controllers)
        for column, round_trip_s in enumerate(found.round_trips_s)
    }
    lines = set(printed.values())
    if max(text_width(figure, line) for line in lines) > room:
        printed = {cell: words.replace(" ", "\n", 1) for cell, words in printed.items()}
        lines = {line for words in printed.values() for line in words.split("\n")}
    size = small_pt() * min(1.0, 0.95 * room / max(text_width(figure, line) for line in lines))
    for (row, column), words in printed.items():
        cells = found.of(controllers=found.controllers[row], round_trip_s=found.round_trips_s[column])
        hatch, fill = HATCH if words.startswith("safe?") else None, VERDICT_COLOURS[found.verdict(cells)]
        panel.add_patch(Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, fc=fill, ec="white", hatch=hatch))
        panel.text(column, row, words, ha="center", va="center", fontsize=size,
                   bbox={"boxstyle": "square,pad=0.1", "fc": fill, "ec": "none"} if hatch else None)  # fmt: skip
    panel.set_xlim(-0.5, len(found.round_trips_s) - 0.5)
    panel.set_ylim(len(found.controllers) - 0.5, -0.5)
    trips = ["\n".join(trip_words(found, trip_s)).replace(" ms", "") for trip_s in found.round_trips_s]
    panel.set_xticks(range(len(found.round_trips_s)), trips)
    panel.set_yticks(range(len(found.controllers)), [controller_title(name) for name in found.controllers])
    panel.tick_params(length=0.0)
    panel.set_xlabel("round trip [ms]")


DODGE = 0.7
"""Width of all controllers at one round trip, beside each other, in steps from one to the next."""


def _over_trips(found: Evaluation) -> range:
    """Return the places of the round trips, at equal distances as in the map, because they may lie close together."""
    return range(len(found.round_trips_s))


def _speeds(panel: "Axes", found: Evaluation) -> None:
    for number, controllers in enumerate(found.controllers):
        most = [totals(found.of(controllers=controllers, round_trip_s=trip)).max_speed for trip in found.round_trips_s]
        speeds = [np.nan if speed is None else speed for speed in most]
        panel.plot(_over_trips(found), speeds, marker="o", label=controller_title(controllers),
                   **controller_look(controllers), **layered(number, len(found.controllers)))  # fmt: skip
    panel.axhline(found.limits.speed, color=THRESHOLD, lw=0.8, ls=":")
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    panel.set_ylabel("largest speed\nafter a release [m/s]")


def _thrown(panel: "Axes", found: Evaluation) -> None:
    for number, controllers in enumerate(found.controllers):
        shares = [
            totals(found.of(controllers=controllers, round_trip_s=trip)).thrown_share for trip in found.round_trips_s
        ]
        _with_intervals(panel, found, number, [share and tuple(100.0 * part for part in share) for share in shares])
    panel.set_ylim(-3.0, 103.0)
    panel.set_ylabel(f"releases above\n{found.limits.speed:g} m/s [%]")


def _false_trips(panel: "Axes", found: Evaluation) -> None:
    for number, controllers in enumerate(found.controllers):
        rates = [
            totals(found.of(controllers=controllers, round_trip_s=trip)).false_trips_per_h
            for trip in found.round_trips_s
        ]
        _with_intervals(panel, found, number, rates)
    panel.axhline(found.limits.false_trips_per_h, color=THRESHOLD, lw=0.8, ls=":")
    # Linear in the range of single trips.
    panel.set_yscale("symlog", linthresh=MIN_RATE_PER_H)
    panel.set_ylim(bottom=-0.1 * MIN_RATE_PER_H)
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.set_ylabel("false trips per hour held")


def _with_intervals(
    panel: "Axes",
    found: Evaluation,
    number: int,
    values: "Sequence[tuple[float, ...] | None]",
) -> None:
    """Draw points with 95 % intervals, slightly offset, joined by a line."""
    known = [(trip, value) for trip, value in zip(_over_trips(found), values, strict=True) if value is not None]
    if not known:
        return
    step = DODGE / len(found.controllers)
    at = [trip + step * (number - 0.5 * (len(found.controllers) - 1)) for trip, _ in known]
    middle, low, high = (np.array([value[part] for _, value in known]) for part in range(3))
    look = controller_look(found.controllers[number])
    panel.errorbar(at, middle, [np.maximum(middle - low, 0.0), np.maximum(high - middle, 0.0)], fmt=".",
                   ms=4.0, color=look["color"], elinewidth=0.8, capsize=1.2)  # fmt: skip
    panel.plot(at, middle, lw=0.7, **look)
