"""Notebook view of a run: metrics and small charts of motion and force."""

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from msgspec import to_builtins

if TYPE_CHECKING:
    from haptether.bridge.scene.run import Run

CHARTS = {
    "position": "position of the hand [m]",
    "device_force": "force on the hand [N]",
    "device_torque": "torque on the hand [N m]",
    "slave_position": "position of the arm [m]",
    "environment_force": "force on the tool [N]",
}
"""Signals that are drawn if they were recorded."""
WIDTH, HEIGHT = 320, 72
POINTS = 160
"""Columns of a chart; each spans the smallest to the largest value, so that a spike of one tick remains visible."""


def as_html(run: "Run") -> str:
    """Return a self-contained table of metrics with charts."""
    # Imported here, because the labels import the tables of a scene.
    from haptether.bridge.scene.labels import METRICS  # noqa: PLC0415

    metrics = {name: value for name, value in to_builtins(run.metrics).items() if value is not None}
    rows = "".join(
        f"<tr><td style='text-align:left'>{escape(METRICS.get(name, name))}</td><td>{escape(_text(value))}</td></tr>"
        for name, value in metrics.items()
    )
    charts = "".join(
        _chart(label, run.signals[run.signals.time_of(name)], run.signals[name])
        for name, label in CHARTS.items()
        if name in run.signals and len(run.signals[name])
    )
    title = f"{escape(run.scene)}, seed {run.seed}, Haptether {escape(run.version)}"
    return (
        f"<div><div style='font-weight:bold;margin-bottom:.6em'>{title}</div>"
        "<div style='display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start'>"
        f"<table>{rows}</table><div>{charts}</div></div></div>"
    )


def _text(value: Any) -> str:  # noqa: ANN401
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _chart(label: str, time_s: npt.NDArray[np.float64], values: npt.NDArray[Any]) -> str:
    """Draw one signal over time with its range, one line per axis."""
    from haptether.view.style.colours import AXES  # noqa: PLC0415
    from haptether.view.style.figure import plain_span  # noqa: PLC0415

    axes = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    known = axes[np.isfinite(axes)]
    if not len(known):
        return ""
    low, high = float(known.min()), float(known.max())
    bottom, top = plain_span(low, high)
    lines = []
    starts = np.unique(np.linspace(0, len(axes), min(POINTS, len(axes)), endpoint=False).astype(int))
    x = np.linspace(0.0, WIDTH, len(starts))
    for axis, colour in zip(axes.T, AXES, strict=False):
        # A column of NaN only draws nothing.
        small = np.fmin.reduceat(axis, starts)
        large = np.fmax.reduceat(axis, starts)
        points = [
            f"{at:.1f},{HEIGHT * (top - y) / (top - bottom):.1f}"
            for at, pair in zip(x, zip(small, large, strict=True), strict=True)
            for y in pair
            if np.isfinite(y)
        ]
        lines.append(f"<polyline points='{' '.join(points)}' fill='none' stroke='{colour}' stroke-width='1'/>")
    size = f"width='{WIDTH}' height='{HEIGHT}' viewBox='0 -2 {WIDTH} {HEIGHT + 4}'"
    text = f"{escape(label)}: {low:.3g} to {high:.3g}, {time_s[0]:.3g} to {time_s[-1]:.3g} s"
    return f"<figure style='margin:0 0 .5em'><figcaption>{text}</figcaption><svg {size}>{''.join(lines)}</svg></figure>"
