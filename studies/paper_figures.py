"""The figures of `haptether paper`, in SI units."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from haptether.private_file import private_file
from haptether.safety import (
    HandGraspObserver,
    SafetyObserver,
    SafetySettings,
    WindowedSafetyObserver,
)
from haptether.studies.operator import Operator
from haptether.studies.paper import (
    ACTIVE_RELEASE_S,
    ACTIVE_THRESHOLD_J,
    DEPTH,
    MAX_FORCE_N,
    PERIOD_S,
    STIFFNESS,
    Bench,
    PaperReport,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_paper(report: PaperReport, folder: Path) -> list[Path]:
    """Draws the figures of a report into `folder` and returns their paths.

    Raises:
        ImportError: matplotlib is not there; it comes with `haptether[analysis]`.
        OSError: The folder cannot be written.
    """
    bench = Bench(report.operator, report.device["encoder_quantum"])
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "fig04_ejection": _ejection(bench),
        "fig05_mev": _mev(report),
        "fig06_observers": _observers(bench),
        "fig08_to_11_controllers": _controllers(bench),
        "table1_window": _window(report),
        "fig12_to_15_active_force": _active(bench),
    }
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        with private_file(paths[-1]) as file:
            figure.savefig(file, dpi=130)
    return paths


def _figure(columns: int, title: str) -> tuple["Figure", list["Axes"]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * columns, 3.8), layout="constrained")
    figure.suptitle(title, fontsize=11)
    axes = [figure.add_subplot(1, columns, column + 1) for column in range(columns)]
    for panel in axes:
        panel.grid(alpha=0.3)
    return figure, axes


def _label(panel: "Axes", x: str, y: str, *, legend: bool = True) -> None:
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    if legend:
        panel.legend(fontsize=8)


def _time(operator: Operator, ticks: int) -> np.ndarray:
    return np.arange(ticks) * PERIOD_S - operator.release_at_s


def _ejection(bench: Bench) -> "Figure":
    trace = bench.press()
    time = _time(bench.operator, len(trace))
    figure, (left, right) = _figure(2, "Fig. 4: released at t = 0, no controller (K = 200 N/m)")
    shown = (time > -0.05) & (time < 0.25)
    left.plot(time[shown], trace.velocity[shown], label="velocity V")
    _label(left, "time since release [s]", "velocity [m/s]")
    right.plot(time[shown], trace.position[shown], label="position z")
    right.axhline(0.0, color="k", lw=0.8, ls=":", label="wall surface")
    _label(right, "time since release [s]", "position [m]")
    return figure


def _mev(report: PaperReport) -> "Figure":
    figure, (left, right) = _figure(2, "Fig. 5: maximum ejection velocity, no controller")
    mass = report.device["mass_kg"]
    for panel, source, key, label in (
        (left, "Fig. 5a", "stiffness", "stiffness K [N/m], pressed to 7.8 N"),
        (right, "Fig. 5b", "depth", "depth D [m], K = 200 N/m"),
    ):
        rows = [row for row in report.rows if row.source == source]
        at = np.array([getattr(row, key) for row in rows])
        ideal = MAX_FORCE_N / np.sqrt(mass * at) if key == "stiffness" else np.sqrt(STIFFNESS / mass) * at
        panel.plot(at, [row.ours or np.nan for row in rows], "o-", label="ours")
        panel.plot(at, ideal, "k:", label="sqrt(K/m) D")
        panel.plot(at, [row.paper or np.nan for row in rows], "x", ms=9, label="paper")
        _label(panel, label, "MEV [m/s]")
    return figure


def _observers(bench: Bench) -> "Figure":
    trace = bench.press()
    signals = (trace.velocity, trace.rendered_force, bench.grasp_force(trace))
    time = _time(bench.operator, len(trace))
    shown = (time > -0.02) & (time < 0.07)
    figure, (left, right) = _figure(2, f"Fig. 6: observers after the release (D = {DEPTH} m)")
    left.plot(time[shown], SafetyObserver(bench.model).run(*signals)[shown], label="SO")
    left.plot(time[shown], WindowedSafetyObserver(bench.model).run(*signals)[shown], label="WSO, w = 100")
    left.axhline(-0.03, color="r", lw=0.8, ls="--", label="delta")
    _label(left, "time since release [s]", "energy [J]")
    right.semilogy(time[shown], HandGraspObserver().run(*signals)[shown], label="HGO")
    right.axhline(1.5, color="r", lw=0.8, ls="--", label="zeta")
    _label(right, "time since release [s]", "S_h [1]")
    return figure


CONTROLLERS = {
    "no controller": None,
    "VFC, Eq. 1 as printed": SafetySettings(["vfc"]),
    "VFC, both thresholds": SafetySettings(["vfc"], vfc_form="both"),
    "HSC": SafetySettings(["hsc"]),
    "WSC, w = 100": SafetySettings(["wsc"]),
}


def _controllers(bench: Bench) -> "Figure":
    figure, (left, right) = _figure(2, "Fig. 8 to 11: velocity and device force after the release")
    for name, settings in CONTROLLERS.items():
        trace = bench.press(settings)
        time = _time(bench.operator, len(trace))
        shown = (time > -0.02) & (time < 0.2)
        left.plot(time[shown], trace.velocity[shown], label=name)
        right.plot(time[shown], trace.device_force[shown], label=name)
    _label(left, "time since release [s]", "velocity [m/s]")
    _label(right, "time since release [s]", "device force [N]")
    return figure


def _window(report: PaperReport) -> "Figure":
    figure, (panel,) = _figure(1, "Table 1: WSC over its window")
    rows = [row for row in report.rows if row.source == "Table 1"]
    windows = [row.window for row in rows]
    panel.semilogx(windows, [row.paper for row in rows], "x--", label="paper")
    panel.semilogx(windows, [row.ours for row in rows], "o-", label="ours")
    _label(panel, "window w [ticks of 1 ms]", "MEV [m/s]")
    return figure


def _active(bench: Bench) -> "Figure":
    figure, (left, right) = _figure(2, "Fig. 12 to 15: force sin(5 t) N, gripped until 1.35 s")
    for name, settings in {
        "no controller": None,
        "WSC, delta = -0.005 J": SafetySettings(["wsc"], energy_threshold_j=ACTIVE_THRESHOLD_J),
        "HSC": SafetySettings(["hsc"]),
    }.items():
        trace = bench.active(1.0, settings, ACTIVE_RELEASE_S)
        shown = slice(1200, 1800)
        left.plot(trace.time_s[shown], trace.velocity[shown], label=name)
    _label(left, "time [s]", "velocity [m/s]")
    for amplitude in (1.0, 3.0, 5.0):
        trace = bench.active(amplitude, None, None)
        signals = (trace.velocity, trace.rendered_force, bench.grasp_force(trace))
        energy = WindowedSafetyObserver(bench.model).run(*signals)
        right.plot(trace.time_s, energy, label=f"{amplitude:g} N, gripped")
    _label(right, "time [s]", "energy of WSO [J]")
    return figure
