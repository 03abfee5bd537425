"""Figures of `haptether paper`: results of this project and of the paper, in SI units."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from haptether.safety import SafetySettings
from haptether.studies.operator import Operator
from haptether.studies.paper.claims import (
    ACTIVE_RELEASE_S,
    ACTIVE_THRESHOLD_J,
    DEPTH,
    MAX_FORCE_N,
    PERIOD_S,
    RAISED_FORCE_THRESHOLD_N,
    STIFFNESS,
    WATCHED,
    Bench,
    as_printed,
)
from haptether.studies.paper.conditions import Conditions
from haptether.studies.paper.report import AGREES, PaperReport, PaperRow
from haptether.view.style.colours import PAPER, SIGNALS, THRESHOLD, controller_look
from haptether.view.style.figure import Columns, PictureFormat, letter, new_figure, styled, write_figure
from haptether.view.style.legend import legend_above, legend_beside
from haptether.view.style.series import chatter

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

READ: dict[str, Any] = {"color": PAPER, "ls": "none", "marker": "x", "ms": 5.0, "mew": 1.2, "zorder": 5.0}
"""Style of values from the paper."""


NAMES = (
    "fig04_ejection", "fig05_mev", "fig06_observers", "fig08_to_11_controllers", "table1_window",
    "fig12_to_15_active_force",
)  # fmt: skip
SENSITIVITY = "sensitivity"


def paper_pictures(folder: Path, form: PictureFormat = "png", *, sensitivity: bool) -> list[Path]:
    """The files that `draw_paper` writes, of a report with or without its sensitivity."""
    return [folder / f"{name}.{form}" for name in (*NAMES, *([SENSITIVITY] if sensitivity else []))]


def draw_paper(report: PaperReport, folder: Path, form: PictureFormat = "png", columns: Columns = 2) -> list[Path]:
    """Draw the figures of a report into `folder`, with its sensitivity if present; return their paths.

    Args:
        report: Report with rows.
        folder: Target folder, created if missing.
        form: File format.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        OSError: The folder cannot be written.
    """
    bench = Bench(Conditions(operator=report.operator, encoder_quantum=report.device["encoder_quantum"]))
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [_ejection, _mev, _observers, _controllers, _window, _active]
    if report.joint_fits:
        drawn.append(_sensitivity)
    paths = paper_pictures(folder, form, sensitivity=bool(report.joint_fits))
    for path, draw in zip(paths, drawn, strict=True):
        with styled():
            figure = draw(bench, report, columns)
        write_figure(figure, path)
    return paths


def _figure(columns: Columns, count: int, title: str) -> tuple["Figure", list["Axes"]]:
    beside = columns == 2 or count == 1
    figure = new_figure(columns, ((2.5 if count < 3 else 2.7) if beside else 2.1 * count) + 0.2, title)
    panels = figure.subplots(1, count) if beside else figure.subplots(count, 1)
    return figure, list(np.atleast_1d(panels))


def _finish(figure: "Figure", panels: "Sequence[Axes]", columns: Columns) -> "Figure":
    beside = len(panels) if columns == 2 else 1
    narrow = beside > 2
    if narrow:
        # A third of a page is too narrow for separate legends.
        legend_beside(figure, panels[0].get_legend_handles_labels()[0])
    for panel in panels[1:] if narrow else panels:
        legend_above(panel, width_in=figure.get_figwidth() / beside - 0.65)
    letter(panels)
    return figure


def _time(operator: Operator, ticks: int) -> np.ndarray:
    return np.arange(ticks) * PERIOD_S - operator.release_at_s


def _value(report: PaperReport, source: str, quantity: str, **of: Any) -> PaperRow:  # noqa: ANN401  # of a row
    """Return the row of a claim."""
    return next(
        row
        for row in report.rows
        if row.source == source
        and row.quantity == quantity
        and all(getattr(row, name) == value for name, value in of.items())
    )


def _ejection(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    trace = bench.press()
    time = _time(bench.operator, len(trace))
    figure, (left, right) = _figure(columns, 2, "Fig. 4: released at t = 0, no controller, K = 200 N/m")
    shown = (time > -0.05) & (time < 0.3)
    left.plot(time[shown], trace.velocity[shown], label="ours", **controller_look("none"))
    # Aligned at 0.2 m/s of our curve, to compare the slopes.
    begin = float(time[np.flatnonzero((time > 0.0) & (trace.velocity >= 0.2))[0]])
    took = _value(report, "Fig. 4a", "time_from_0.2_to_1.2_m_per_s").paper or 0.0
    left.plot([begin, begin + took], [0.2, 1.2], **READ | {"ls": ":"}, label="paper: 0.2 to 1.2 m/s")
    left.set(xlabel="time since release [s]", ylabel="velocity V [m/s]")
    right.plot(time[shown], trace.position[shown], label="ours", **controller_look("none"))
    reached = _value(report, "Fig. 4b", "time_to_0.1_m_outside").paper or 0.0
    right.plot([0.0, reached], [-DEPTH, 0.1], **READ, label="paper: begin, and 0.1 m")
    right.axhline(0.0, color=THRESHOLD, lw=0.8, ls=":", label="wall")
    right.set(xlabel="time since release [s]", ylabel="position z [m]")
    return _finish(figure, (left, right), columns)


def _mev(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    del bench
    figure, panels = _figure(columns, 2, "Fig. 5: maximum ejection velocity (MEV), no controller")
    mass = report.device["mass_kg"]
    for panel, source, key, label in (
        (panels[0], "Fig. 5a", "stiffness", "stiffness K [N/m], pressed to 7.8 N"),
        (panels[1], "Fig. 5b", "depth", "depth D [m], K = 200 N/m"),
    ):
        rows = [row for row in report.rows if row.source == source]
        at = np.array([getattr(row, key) for row in rows])
        ideal = MAX_FORCE_N / np.sqrt(mass * at) if key == "stiffness" else np.sqrt(STIFFNESS / mass) * at
        panel.plot(at, ideal, color=THRESHOLD, ls=":", label="sqrt(K/m) D")
        panel.plot(at, [_known(row.ours) for row in rows], label="ours", marker="o", ms=3.0, **controller_look("none"))
        panel.plot(at, [_known(row.paper) for row in rows], **READ, label="paper")
        panel.set(xlabel=label, ylabel="MEV [m/s]")
    return _finish(figure, panels, columns)


def _known(value: float | None) -> float:
    return np.nan if value is None else value


def _observers(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    trace = bench.press(WATCHED)
    time = _time(bench.operator, len(trace))
    shown = (time > -0.02) & (time < 0.07)
    figure, (left, right) = _figure(columns, 2, f"Fig. 6: observers after the release, D = {DEPTH} m")
    left.plot(time[shown], trace.energy_j[shown], color=SIGNALS["of the hand"], label="SO")
    left.plot(time[shown], trace.windowed_energy_j[shown], label="WSO, w = 100",
              **controller_look("wsc"))  # fmt: skip
    left.axhline(-0.03, color=THRESHOLD, lw=0.8, ls="--", label="delta")
    seen = _value(report, "Fig. 6a", "time_to_see_release", controller="wso").paper
    left.plot([_known(seen)], [-0.03], **READ, label="paper: WSO sees it")
    left.set(xlabel="time since release [s]", ylabel="energy [J]")
    right.semilogy(time[shown], trace.grasp[shown], label="HGO", **controller_look("hsc"))
    right.axhline(1.5, color=THRESHOLD, lw=0.8, ls="--", label="zeta")
    seen = _value(report, "Fig. 6b", "time_to_see_release", controller="hgo").paper
    right.plot([_known(seen)], [1.5], **READ, label="paper: HGO sees it")
    right.set(xlabel="time since release [s]", ylabel="S_h")
    return _finish(figure, (left, right), columns)


CONTROLLERS: dict[str, tuple[str, SafetySettings | None]] = {
    "no controller": ("none", None),
    "VFC, as printed": ("vfc", as_printed("vfc")),
    "VFC, both": ("vfc", as_printed("vfc", vfc_form="both")),
    "HSC": ("hsc", as_printed("hsc")),
    "WSC": ("wsc", as_printed("wsc")),
}

CHATTER = 5
"""Ticks of 1 ms over which a force that switches every few of them is drawn as a mean and a range."""


def _controllers(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    figure, (left, middle, right) = _figure(columns, 3, "Fig. 8 to 11: after the release, with each controller")
    ours = []
    for name, (controller, settings) in CONTROLLERS.items():
        trace = bench.press(settings)
        time = _time(bench.operator, len(trace))
        shown = (time > -0.02) & (time < 0.2)
        look = controller_look(controller) | ({"linestyle": ":"} if name == "VFC, both" else {})
        left.plot(time[shown], trace.velocity[shown], label=name, **look)
        mean, least, most = chatter(trace.device_force[shown], CHATTER)
        middle.fill_between(time[shown], least, most, color=look["color"], alpha=0.18, lw=0.0)
        middle.plot(time[shown], mean, **look)
        ours.append(bench.ejection(trace))
    trip = _value(report, "Fig. 8", "time_to_trip", controller="vfc").paper
    speed = _value(report, "Fig. 8", "speed_at_trip", controller="vfc").paper
    left.plot([_known(trip)], [_known(speed)], **READ, label="paper: VFC trips")
    left.set(xlabel="time since release [s]", ylabel="velocity [m/s]")
    middle.set(xlabel="time since release [s]", ylabel=f"device force [N],\nmean and range of {CHATTER} ms")
    quantity = "max_ejection_velocity"
    vfc = _value(report, "Fig. 8", quantity, controller="vfc").paper
    papers = [
        _value(report, "Fig. 5b", quantity, depth=DEPTH).paper,
        vfc,
        vfc,
        _value(report, "Fig. 9", quantity, controller="hsc").paper,
        _value(report, "Fig. 10", quantity, controller="wsc").paper,
    ]
    colours = [controller_look(controller)["color"] for controller, _ in CONTROLLERS.values()]
    _bars(right, ["none", "VFC\nprinted", "VFC\nboth", "HSC", "WSC"], ours, papers, colours)
    return _finish(figure, (left, middle, right), columns)


def _bars(
    panel: "Axes", names: list[str], ours: Sequence[float | None], papers: Sequence[float | None], colours: list[str]
) -> None:
    """Draw MEV bars, ours in the controller's colour beside the paper's."""
    at = np.arange(len(names))
    panel.bar(at - 0.2, [_known(value) for value in ours], 0.38, color=colours)
    panel.bar(at + 0.2, [_known(value) for value in papers], 0.38, facecolor="white", edgecolor=PAPER, lw=0.8,
              hatch="////", label="paper (hatched)")  # fmt: skip
    panel.set_xticks(at, names)
    panel.set_ylabel("MEV [m/s]")
    panel.grid(visible=False, axis="x")


def _window(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    del bench
    figure, panels = _figure(columns, 1, "Table 1: WSC over its window")
    rows = [row for row in report.rows if row.source == "Table 1"]
    windows = [float(row.window or 0) for row in rows]
    panels[0].semilogx(windows, [_known(row.ours) for row in rows], marker="o", ms=3.0, label="ours",
                       **controller_look("wsc"))  # fmt: skip
    panels[0].semilogx(windows, [_known(row.paper) for row in rows], **READ | {"ls": ":"}, label="paper")
    panels[0].set(xlabel="window w [ticks of 1 ms]", ylabel="MEV [m/s]")
    return _finish(figure, panels, columns)


def _active(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    figure, (left, middle, right) = _figure(columns, 3, "Fig. 12 to 15: force sin(5 t) N, gripped until 1.35 s")
    settings = {
        "none": None,
        "wsc": as_printed("wsc", energy_threshold_j=ACTIVE_THRESHOLD_J),
        "hsc": as_printed("hsc", hsc_force_threshold_n=RAISED_FORCE_THRESHOLD_N),
    }
    names = {"none": "no controller", "wsc": "WSC", "hsc": f"HSC, F_t = {RAISED_FORCE_THRESHOLD_N} N"}
    for controller, of_run in settings.items():
        trace = bench.active(1.0, of_run, ACTIVE_RELEASE_S)
        shown = slice(1200, 1800)
        left.plot(trace.time_s[shown], trace.velocity[shown], label=names[controller], **controller_look(controller))
    left.plot([ACTIVE_RELEASE_S + 0.17], [_known(_value(report, "Fig. 12", "speed_at_0.17_s").paper)], **READ,
              label="paper: free for 0.17 s")  # fmt: skip
    left.set(xlabel="time [s]", ylabel="velocity [m/s]")
    # Colour of the controller, darker with the amplitude.
    for amplitude, shade, dashes in ((1.0, 0.4, ":"), (3.0, 0.7, "--"), (5.0, 1.0, "-")):
        trace = bench.active(amplitude, WATCHED, None)
        middle.plot(trace.time_s, trace.windowed_energy_j, label=f"{amplitude:g} N",
                    color=controller_look("wsc")["color"], alpha=shade, ls=dashes)  # fmt: skip
    middle.axhline(ACTIVE_THRESHOLD_J, color=THRESHOLD, lw=0.8, ls="--", label="delta")
    middle.set(xlabel="time [s]", ylabel="energy of WSO, gripped [J]")
    quantity = "max_ejection_velocity"
    rows = [
        _value(report, "Fig. 12", quantity),
        _value(report, "Fig. 14b", quantity),
        _value(report, "Fig. 15b", quantity, force_threshold_n=RAISED_FORCE_THRESHOLD_N),
    ]
    # For the run without controllers the paper gives only the value at 0.17 s after the release.
    free = _value(report, "Fig. 12", "speed_at_0.17_s")
    ours = [free.ours, *(row.ours for row in rows[1:])]
    papers = [free.paper, *(row.paper for row in rows[1:])]
    colours = [controller_look(name)["color"] for name in ("none", "wsc", "hsc")]
    _bars(right, ["none,\nat 0.17 s", "WSC", "HSC\n(paper: <)"], ours, papers, colours)
    return _finish(figure, (left, middle, right), columns)


NARROWEST, WIDEST = 0.02, 20.0
"""Drawn range of our value divided by the paper's."""


def _sensitivity(bench: Bench, report: PaperReport, columns: Columns) -> "Figure":
    """Draw our value divided by the paper's for each row that has one, as declared and over all factors."""
    del bench
    rows = [
        row
        for row in report.rows
        if row.paper and row.sensitivity is not None and not row.says_nothing and "Eq." not in row.source
    ]
    figure = new_figure(columns, 0.15 * len(rows) + 1.1, "What moves ours over the paper's number")
    panel = figure.subplots()
    panel.axvspan(1.0 - AGREES, 1.0 + AGREES, color=THRESHOLD, alpha=0.25, lw=0.0, label="within 10 %")
    panel.axvline(1.0, color=PAPER, lw=0.8)
    for place, row in enumerate(rows):
        assert row.sensitivity is not None
        by = row.sensitivity.by_factor.get(row.sensitivity.most_by or "")
        whole = (row.sensitivity.least, row.sensitivity.greatest)
        spans = {"all factors": whole, "the one that moves it most": by}
        for (label, span), width in zip(spans.items(), (1.0, 3.5), strict=True):
            if span is not None:
                ends = [_ratio(row, value) for value in span]
                panel.plot(ends, [place, place], color=SIGNALS["of the hand"], lw=width, solid_capstyle="butt",
                           label=None if place else label)  # fmt: skip
        panel.plot([_ratio(row, row.ours)], [place], color=SIGNALS["hand"], marker="o", ms=3.5, ls="none",
                   zorder=5.0, label=None if place else "as declared")  # fmt: skip
    panel.set(xscale="log", xlim=(NARROWEST, WIDEST), ylim=(len(rows) - 0.4, -0.6), xlabel="ours / paper")
    panel.set_yticks(range(len(rows)), [_row_title(row) for row in rows])
    panel.grid(visible=False, axis="y")
    legend_beside(figure, panel.get_legend_handles_labels()[0])
    return figure


def _ratio(row: PaperRow, value: float | None) -> float:
    """Return our value divided by the paper's, clipped to the drawn range.

    A time before the release is at the left edge.
    """
    return float(np.clip(_known(value) / _known(row.paper), NARROWEST, WIDEST))


def _row_title(row: PaperRow) -> str:
    quantity = {
        "max_ejection_velocity": "MEV",
        "time_to_see_release": "sees release",
        "median_grasp_ratio_gripped": "median S_h",
        "least_energy_gripped": "least energy",
        "vfc_over_controller": "MEV of VFC / its",
        "time_from_0.2_to_1.2_m_per_s": "to 1.2 m/s",
        "time_to_0.1_m_outside": "to 0.1 m",
        "speed_at_0.17_s": "V at 0.17 s",
        "speed_at_trip": "V at trip",
    }.get(row.quantity, row.quantity.replace("_", " "))
    of = [] if row.controller in (None, "none") else [row.controller.upper() if row.controller else ""]
    of += [f"w = {row.window}"] if row.window and row.source == "Table 1" else []
    of += [f"K = {row.stiffness:g}"] if row.source == "Fig. 5a" else []
    of += [f"{row.amplitude_n:g} N"] if row.source in {"Fig. 14c", "Fig. 15a", "Fig. 15c"} else []
    of += [f"F_t = {row.force_threshold_n:g}"] if row.force_threshold_n else []
    bound = "" if row.relation == "=" else f" (paper: {row.relation})"
    return f"{row.source} {quantity}{', ' if of else ''}{', '.join(of)}{bound}"
