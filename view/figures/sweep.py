"""Figure of a sweep: lines with confidence over one varied number, per choice, or maps over two numbers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from haptether.view.figures.intervals import mean_and_half
from haptether.view.style.colours import AXES, CONTROLLERS, SIGNALS, controller_look
from haptether.view.style.figure import Columns, figure_of, letter, new_figure, plain_ticks, styled
from haptether.view.style.legend import legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

SEED = "run.seed"
CONTROLLER_SETS = "safety.controllers"
METRICS = {
    "max_ejection_velocity": "ejection velocity [m/s]",
    "max_ejection_rate": "ejection rate [rad/s]",
    "peak_device_force": "largest force [N]",
    "peak_device_torque": "largest torque [N m]",
    "time_to_trip_s": "time to trip [s]",
    "intervention_s": "under intervention [s]",
    "false_trips": "false trips",
    "position_rmse_m": "position error [m]",
    "force_rmse_n": "force error [N]",
    "orientation_rmse_rad": "orientation error [rad]",
    "torque_rmse_n_m": "torque error [N m]",
    "passivity_min_j": "least energy [J]",
}
"""Metrics that are drawn if measured: columns and labels."""
MOST = 6
"""Most panels of a figure."""
MOST_AXES = 2
DIVERGED = "#d62839"


def draw_sweep(
    scene: str, columns: Mapping[str, npt.NDArray[Any]], varied: Sequence[str], width: Columns = 2
) -> "Figure":
    """Draw each metric over one varied number as lines, one per choice, or over two numbers as a map.

    If `run.seed` varies too, a line is the mean over seeds with a 95 % confidence band, and a map is the mean.

    Args:
        scene: Name of the scene.
        columns: Varied fields and metrics, one value per row.
        varied: Names of the varied fields.
        width: Width in columns of a page.

    Raises:
        ImportError: matplotlib is missing (`haptether[analysis]`).
        ValueError: As in `check_varied`, or nothing was measured.
    """
    over = check_varied(varied, columns)
    metrics = [name for name in METRICS if name in columns and np.isfinite(columns[name].astype(float)).any()][:MOST]
    if not metrics:
        message = f"{scene}: nothing to draw: no metric was measured in any row"
        raise ValueError(message)
    across = 1 if width == 1 else min(2 if len(over) == 1 else 3, len(metrics))
    down = -(-len(metrics) // across)
    seeds = len(np.unique(columns[SEED])) if SEED in varied and over != [SEED] else 1
    rows = len(next(iter(columns.values())))
    diverged = columns["outcome"] == "diverged" if "outcome" in columns else np.zeros(rows, dtype=bool)
    title = f"{Path(scene).stem or scene}, {rows} run{'s' if rows != 1 else ''}"
    if diverged.any():
        title += f", {np.count_nonzero(diverged)} diverged (X)"
    if seeds > 1:
        title += f": mean of {seeds} seeds" + (", 95 % confidence" if len(over) == 1 else "")
    with styled():
        figure = new_figure(width, (1.75 if len(over) == 1 else 2.1) * down + 0.5, title)
        panels = figure.subplots(down, across, squeeze=False).ravel().tolist()
        for panel in panels[len(metrics) :]:
            panel.remove()
        for panel, metric in zip(panels, metrics, strict=False):
            measured = _Measured(columns[metric].astype(float), diverged, METRICS[metric])
            if any(columns[name].dtype.kind == "U" for name in over):
                _draw_choices(panel, over, columns, measured)
            elif len(over) == 1:
                room_in = figure.get_figwidth() / across - 0.9
                _draw_line(panel, over[0], columns[over[0]], measured, width_in=room_in)
            else:
                _draw_map(panel, over, [columns[name] for name in over], measured)
        letter(panels[: len(metrics)])
    return figure


def check_varied(varied: Sequence[str], columns: Mapping[str, npt.NDArray[Any]]) -> list[str]:
    """Fields on the axes of a picture: the varied ones, without the seed if there are others.

    Args:
        varied: Names of the varied fields.
        columns: Their values, text for a choice; before a run, distinct values suffice.

    Raises:
        ValueError: More than two fields vary, two are choices, or a controller name is unknown.
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


class _Measured(NamedTuple):
    values: Array
    diverged: Bools
    label: str


def _mark_diverged(panel: "Axes", places: Sequence[float] | Array) -> None:
    """Mark diverged rows at the lower edge; their measurements end there."""
    if len(places):
        panel.plot(places, np.zeros(len(places)), "X", color=DIVERGED, ms=4.0, clip_on=False, zorder=5.0,
                   transform=panel.get_xaxis_transform(), gid="diverged")  # fmt: skip


def _draw_line(panel: "Axes", name: str, at: Array, measured: "_Measured", *, width_in: float) -> None:
    values, diverged, label = measured
    places = np.unique(at)
    of_places = [mean_and_half(values[at == place]) for place in places]
    means, halves = np.array([mean for mean, _ in of_places]), np.array([half for _, half in of_places])
    colour = SIGNALS["hand"]
    runs = max(int(np.count_nonzero(at == place)) for place in places)
    panel.plot(places, means, "o-" if len(places) <= 40 else "-", color=colour, ms=3.0,
               label="mean" if runs > 1 else None)  # fmt: skip
    if np.isfinite(halves).any():
        panel.fill_between(places, means - halves, means + halves, color=colour, alpha=0.2, lw=0.0, label="95 %")
    lacking = places[[not np.isfinite(values[at == place]).all() for place in places]]
    if len(lacking):
        panel.plot(lacking, np.zeros(len(lacking)), "x", color="#d62839", ms=4.0, clip_on=False, zorder=5.0,
                   transform=panel.get_xaxis_transform(), label="some not measured")  # fmt: skip
    _mark_diverged(panel, np.unique(at[diverged]))
    panel.set_xlabel(name)
    panel.set_ylabel(label)
    panel.margins(y=0.08)
    # A constant metric must be a flat line, not rounding noise.
    low, high = panel.get_ylim()
    least = 2e-3 * max(abs(low), abs(high))
    if high - low < least:
        panel.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
    plain_ticks(panel, 5)
    legend_above(panel, width_in=width_in)


def _draw_choices(
    panel: "Axes", over: Sequence[str], columns: Mapping[str, npt.NDArray[Any]], measured: "_Measured"
) -> None:
    """Draw a line or a point per choice; mean and 95 % interval where several runs share a place."""
    values, diverged, label = measured
    choice = next(name for name in over if columns[name].dtype.kind == "U")
    names = list(dict.fromkeys(columns[choice].tolist()))
    number = next((name for name in over if name != choice), None)
    for place, name in enumerate(names):
        rows = columns[choice] == name
        at = np.full(int(rows.sum()), float(place)) if number is None else columns[number][rows].astype(float)
        places = np.unique(at)
        of_places = [mean_and_half(values[rows][at == each]) for each in places]
        means, halves = np.array([mean for mean, _ in of_places]), np.array([half for _, half in of_places])
        look = controller_look(name) if choice == CONTROLLER_SETS else {"color": AXES[place % len(AXES)]}
        panel.errorbar(places, means, np.nan_to_num(halves), fmt="o", ms=2.5, elinewidth=0.6, capsize=1.2,
                       color=look["color"])  # fmt: skip
        panel.plot(places, means, label=name, **look)
        _mark_diverged(panel, np.unique(at[diverged[rows]]))
    panel.set_ylabel(label)
    panel.margins(y=0.08)
    plain_ticks(panel, 5)
    if number is None:
        panel.set_xticks(range(len(names)), names, rotation=20 if len(names) > 3 else 0)
        panel.set_xlabel(choice)
    else:
        panel.set_xlabel(number)
        legend_above(panel, width_in=figure_of(panel).get_figwidth() / 2 - 0.9)


def _draw_map(panel: "Axes", names: list[str], at: list[Array], measured: "_Measured") -> None:
    values, diverged, label = measured
    of_x, of_y = np.unique(at[0]), np.unique(at[1])
    means = np.array([[mean_and_half(values[(at[0] == x) & (at[1] == y)])[0] for x in of_x] for y in of_y])
    panel.set_facecolor("#e3e6ea")
    drawn = panel.pcolormesh(
        np.arange(len(of_x) + 1), np.arange(len(of_y) + 1), np.ma.masked_invalid(means), cmap="cividis", shading="flat",
        rasterized=means.size > 2500,
    )  # fmt: skip
    for row, column in zip(*np.nonzero(~np.isfinite(means)), strict=True):
        if means.size <= 400:
            panel.plot(column + 0.5, row + 0.5, "x", color="#7a828c", ms=3.0)
    cells = set(zip(at[0][diverged].tolist(), at[1][diverged].tolist(), strict=True))
    if cells:
        across, up = (np.searchsorted(of, [cell[axis] for cell in cells]) + 0.5 for axis, of in enumerate((of_x, of_y)))
        panel.plot(across, up, "X", color=DIVERGED, ms=4.0, gid="diverged")
    _name_cells(panel, of_x, of_y)
    panel.grid(visible=False)
    panel.set_xlabel(names[0])
    panel.set_ylabel(names[1])
    bar = figure_of(panel).colorbar(drawn, ax=panel)
    bar.set_label(label)
    bar.outline.set_linewidth(0.6)


def _name_cells(panel: "Axes", of_x: Array, of_y: Array) -> None:
    """Label some cells at their centres with their values, whatever the spacing."""
    few = np.unique(np.linspace(0, len(of_x) - 1, min(len(of_x), 3)).astype(int))
    panel.set_xticks(few + 0.5, [f"{of_x[place]:.3g}" for place in few])
    few = np.unique(np.linspace(0, len(of_y) - 1, min(len(of_y), 6)).astype(int))
    panel.set_yticks(few + 0.5, [f"{of_y[place]:.3g}" for place in few])
