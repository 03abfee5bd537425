"""Figure of a sweep: lines with confidence over one varied field, one line per choice, maps over two fields."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from haptether.view.figures.intervals import mean_and_half
from haptether.view.style.colours import (
    CHOICES,
    CONTROLLERS,
    MISSING,
    NEUTRAL,
    controller_look,
    controller_title,
    layered,
)
from haptether.view.style.figure import Columns, figure_of, letter, new_figure, plain_span, plain_ticks, styled
from haptether.view.style.labels import AxisLabel, wrapped
from haptether.view.style.legend import legend_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

SEED = "run.seed"
CONTROLLER_SETS = "safety.controllers"
METRICS = (
    "max_ejection_velocity", "max_ejection_rate", "peak_device_force", "peak_device_torque", "time_to_trip_s",
    "intervention_s", "false_trips", "position_rmse_m", "force_rmse_n", "orientation_rmse_rad", "torque_rmse_n_m",
    "passivity_min_j",
)  # fmt: skip
"""Columns that are drawn if measured."""
MOST = 6
"""Largest number of panels."""
MOST_AXES = 2
DIVERGED = "#d62839"
"""Colour of diverged rows."""


def draw_sweep(
    scene: str,
    columns: Mapping[str, npt.NDArray[Any]],
    varied: Sequence[str],
    width: Columns = 2,
    labels: Mapping[str, AxisLabel] | None = None,
) -> "Figure":
    """Draw each metric over one number as a line, over two as a map, and for a choice as one line each.

    If `run.seed` also varies, a line is the mean over seeds with a 95 % confidence band, and a map is the mean.

    Args:
        scene: Name of the scene.
        columns: Varied values and metrics, one value per row.
        varied: Varied paths.
        width: Width in page columns.
        labels: Labels of columns, as `haptether.bridge.scene.labels.label_of`; by default their names.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: Same as for `check_varied`, or nothing was measured.
    """
    over = check_varied(varied, columns)
    metrics = [name for name in METRICS if name in columns and np.isfinite(columns[name].astype(float)).any()][:MOST]
    if not metrics:
        message = f"{scene}: nothing to draw: no metric was measured in any row"
        raise ValueError(message)
    chosen = any(columns[name].dtype.kind == "U" for name in over)
    lines = len(over) == 1 or chosen
    across = 1 if width == 1 and not lines else min(2 if width == 1 or len(over) == 1 else 3, len(metrics))
    down = -(-len(metrics) // across)
    seeds = len(np.unique(columns[SEED])) if SEED in varied and over != [SEED] else 1
    rows = len(next(iter(columns.values())))
    diverged = columns["outcome"] == "diverged" if "outcome" in columns else np.zeros(rows, dtype=bool)
    title = f"{Path(scene).stem or scene}, {rows} run{'s' if rows != 1 else ''}"
    if diverged.any():
        title += f", {np.count_nonzero(diverged)} diverged"
    if seeds > 1:
        title += f": mean of {seeds} seeds" + (", 95 % confidence" if lines else "")
    of = {name: (labels or {}).get(name, AxisLabel(name)) for name in (*over, *metrics)}
    axes = [_Axis(name, *_sized(of[name], columns[name])) for name in over]
    with styled():
        figure = new_figure(width, (1.55 if lines else 2.0) * down + 0.6, title)
        panels = figure.subplots(down, across, squeeze=False).ravel().tolist()
        for panel in panels[len(metrics) :]:
            panel.remove()
        handles: dict[str, Any] = {}
        for place, (panel, metric) in enumerate(zip(panels, metrics, strict=False)):
            label, values = _sized(of[metric], columns[metric].astype(float))
            measured = _Measured(values, diverged, label)
            if chosen:
                drawn = _draw_choices(panel, axes, measured)
            elif len(over) == 1:
                drawn = _draw_line(panel, axes[0], measured)
            else:
                drawn = _draw_map(panel, axes, measured)
            handles |= {str(each.get_label()): each for each in drawn}
            if place + across < len(metrics):
                panel.set_xlabel("")
        if handles:
            legend_beside(figure, list(handles.values()))
        letter(panels[: len(metrics)])
        figure.align_ylabels(panels[: len(metrics)])
    return figure


def check_varied(varied: Sequence[str], columns: Mapping[str, npt.NDArray[Any]]) -> list[str]:
    """Return the varied paths on the axes of a picture, without the seed if others vary.

    Args:
        varied: Varied paths.
        columns: Values of the paths; text for a choice. Before a run, distinct values suffice.

    Raises:
        ValueError: More than two paths vary, two are choices, or a set of controllers contains an unknown name.
    """
    over = [name for name in varied if name != SEED] or list(varied)
    if len(over) > MOST_AXES:
        message = f"{', '.join(over)} vary: a picture has at most {MOST_AXES} beside run.seed; use --out for all"
        raise ValueError(message)
    choices = [name for name in over if columns[name].dtype.kind == "U"]
    if len(choices) > 1:
        message = f"{', '.join(over)}: a picture has one choice, over at most one number; use --out for all"
        raise ValueError(message)
    if CONTROLLER_SETS in choices:
        names = {name for names in columns[CONTROLLER_SETS].tolist() for name in names.split("+")}
        if unknown := sorted(names - CONTROLLERS.keys()):
            message = (
                f"{CONTROLLER_SETS}: {unknown[0]!r} is none of {', '.join(CONTROLLERS)}: a picture has no line for it"
            )
            raise ValueError(message)
    return over


class _Axis(NamedTuple):
    """Varied field of all rows."""

    name: str
    label: str
    values: npt.NDArray[Any]


class _Measured(NamedTuple):
    """Metric of all rows."""

    values: Array
    diverged: Bools
    label: str


def _sized(label: AxisLabel, values: npt.NDArray[Any]) -> tuple[str, npt.NDArray[Any]]:
    """Return the text of a label, and the values in its unit."""
    if values.dtype.kind == "U":
        return label.words, values
    text, factor = label.sized(values)
    return text, values * factor


def _mark(panel: "Axes", places: Sequence[float] | Array, marker: str, colour: str, label: str) -> list[Any]:
    """Mark rows at the lower edge, because their measurements end there or are missing."""
    if not len(places):
        return []
    return panel.plot(places, np.zeros(len(places)), marker, color=colour, ms=4.0, clip_on=False, zorder=5.0,
                      transform=panel.get_xaxis_transform(), label=label, gid=label)  # fmt: skip


def _mark_rows(panel: "Axes", at: Array, measured: "_Measured") -> list[Any]:
    values, diverged, _ = measured
    lacking = [place for place in np.unique(at) if not np.isfinite(values[(at == place) & ~diverged]).all()]
    return [
        *_mark(panel, lacking, "x", MISSING, "not measured in some runs"),
        *_mark(panel, np.unique(at[diverged]), "X", DIVERGED, "diverged"),
    ]


def _finish(panel: "Axes", measured: "_Measured", label: str) -> None:
    panel.set_xlabel(label)
    panel.set_ylabel(wrapped(measured.label))
    panel.margins(y=0.08)
    plain_ticks(panel, 5)
    if (np.rint(measured.values) == measured.values)[np.isfinite(measured.values)].all():
        panel.locator_params(axis="y", integer=True)


def _of_places(at: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return the positions, the mean at each, and half of its confidence interval."""
    places = np.unique(at)
    means, halves = np.array([mean_and_half(values[at == place]) for place in places]).reshape(-1, 2).T
    return places, means, halves


def _draw_line(panel: "Axes", over: _Axis, measured: "_Measured") -> list[Any]:
    values = measured.values
    places, means, halves = _of_places(over.values, values)
    runs = max(int(np.count_nonzero(over.values == place)) for place in places)
    handles: list[Any] = panel.plot(
        places, means, "o-" if len(places) <= 40 else "-", color=NEUTRAL, ms=3.0, label="mean"
    )
    if np.isfinite(halves).any():
        handles += [panel.fill_between(places, means - halves, means + halves, color=NEUTRAL, alpha=0.2, lw=0.0,
                                       label="95 % confidence of the mean")]  # fmt: skip
    marks = _mark_rows(panel, over.values, measured)
    _finish(panel, measured, over.label)
    return [*(handles if runs > 1 else []), *marks]


def _draw_choices(panel: "Axes", over: Sequence[_Axis], measured: "_Measured") -> list[Any]:
    """Draw one line or point per choice; means with 95 % confidence where several runs share a position."""
    choice = next(axis for axis in over if axis.values.dtype.kind == "U")
    number = next((axis for axis in over if axis is not choice), None)
    names = list(dict.fromkeys(choice.values.tolist()))
    of_controllers = choice.name == CONTROLLER_SETS
    titles = [controller_title(name) if of_controllers else name for name in names]
    handles, marks = [], []
    for place, (name, title) in enumerate(zip(names, titles, strict=True)):
        rows = choice.values == name
        at = np.full(int(rows.sum()), float(place)) if number is None else number.values[rows].astype(float)
        places, means, halves = _of_places(at, measured.values[rows])
        colour, marker = CHOICES[place % len(CHOICES)]
        look: dict[str, Any] = {"color": colour, "marker": marker}
        if of_controllers:
            look = controller_look(name) | {"marker": "o"}
        look |= layered(place, len(names)) if number is not None else {"ms": 4.0}
        panel.errorbar(places, means, np.nan_to_num(halves), fmt="none", elinewidth=0.6, capsize=1.2,
                       ecolor=look["color"])  # fmt: skip
        handles += panel.plot(places, means, label=title, **look)
        marks += _mark_rows(panel, at, _Measured(measured.values[rows], measured.diverged[rows], ""))
    _finish(panel, measured, choice.label if number is None else number.label)
    if number is None:
        panel.set_xlim(-0.5, len(names) - 0.5)
        panel.set_xticks(range(len(names)), [wrapped(title, 12) for title in titles],
                         rotation=20 if len(names) > 3 else 0)  # fmt: skip
    return [*(handles if number is not None else []), *marks]


def _draw_map(panel: "Axes", over: Sequence[_Axis], measured: "_Measured") -> list[Any]:
    values, diverged, label = measured
    at = [axis.values for axis in over]
    of_x, of_y = np.unique(at[0]), np.unique(at[1])
    means = np.array([[mean_and_half(values[(at[0] == x) & (at[1] == y)])[0] for x in of_x] for y in of_y])
    panel.set_facecolor("#e3e6ea")
    low, high = plain_span(float(np.nanmin(means)), float(np.nanmax(means)))
    drawn = panel.pcolormesh(
        np.arange(len(of_x) + 1), np.arange(len(of_y) + 1), np.ma.masked_invalid(means), cmap="cividis", shading="flat",
        rasterized=means.size > 2500, vmin=low, vmax=high,
    )  # fmt: skip
    marks = []
    rows, columns = np.nonzero(~np.isfinite(means))
    if len(rows) and means.size <= 400:
        marks += panel.plot(columns + 0.5, rows + 0.5, "x", color=MISSING, ms=3.0, label="not measured")
    cells = set(zip(at[0][diverged].tolist(), at[1][diverged].tolist(), strict=True))
    if cells:
        across, up = (np.searchsorted(of, [cell[axis] for cell in cells]) + 0.5 for axis, of in enumerate((of_x, of_y)))
        marks += panel.plot(across, up, "X", color=DIVERGED, ms=4.0, label="diverged", gid="diverged")
    _name_cells(panel, of_x, of_y)
    panel.grid(visible=False)
    panel.set_xlabel(over[0].label)
    panel.set_ylabel(over[1].label)
    bar = figure_of(panel).colorbar(drawn, ax=panel)
    bar.ax.locator_params(axis="y", nbins=5)
    bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value:.6g}".replace("-", "\N{MINUS SIGN}"))
    bar.set_label(wrapped(label))
    bar.outline.set_linewidth(0.6)
    return marks


def _name_cells(panel: "Axes", of_x: Array, of_y: Array) -> None:
    """Label cells with their values for any spacing; for many cells, only some."""
    few = np.unique(np.linspace(0, len(of_x) - 1, min(len(of_x), 3)).astype(int))
    panel.set_xticks(few + 0.5, [f"{of_x[place]:.3g}" for place in few])
    few = np.unique(np.linspace(0, len(of_y) - 1, min(len(of_y), 6)).astype(int))
    panel.set_yticks(few + 0.5, [f"{of_y[place]:.3g}" for place in few])
