"""Runs as one HTML file that draws a `scene3d` description with WebGL."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from haptether.private_file import refuse_link, write_private
from haptether.view.page.geometry import geometry, packed
from haptether.view.picture.cameras import CAMERAS
from haptether.view.scene3d import colours
from haptether.view.scene3d.description import Description
from haptether.view.scene3d.parts import Part, Trail
from haptether.view.scene3d.timeline import Timeline

HERE = Path(__file__).parent
TRAIL_POINTS = 1500


def write_page(
    path: Path, described: Sequence[Description], times_s: Sequence[float], *,
    camera: str = "front", progress: Callable[[int], None] = lambda _: None,
) -> None:  # fmt: skip
    """Write a page with mode 0600.

    Args:
        path: Path of the file.
        described: Runs, side by side.
        times_s: Times at which poses are stored.
        camera: Initial view, one of `CAMERAS`.
        progress: Called with the number of finished times.

    Raises:
        OSError: The file cannot be written, or is a symbolic link.
    """
    refuse_link(path)
    write_private(path, page(described, times_s, camera=camera, progress=progress).encode())


def page(
    described: Sequence[Description], times_s: Sequence[float], *,
    camera: str = "front", progress: Callable[[int], None] = lambda _: None,
) -> str:  # fmt: skip
    """Text of the page."""
    frames = [_Frames(one) for one in described]
    for number, time_s in enumerate(times_s, start=1):
        for of in frames:
            of.take(time_s)
        progress(number)
    content = {
        "times": [round(time_s, 6) for time_s in times_s],
        "camera": CAMERAS[camera],
        "cameras": CAMERAS,
        "ladder": colours.LADDER,
        "runs": [of.content() for of in frames],
    }
    # A title is free text; it must not close the script element.
    text = json.dumps(content, allow_nan=False).replace("<", "\\u003c").replace("\u2028", " ").replace("\u2029", " ")
    whole = (HERE / "page.html").read_text(encoding="utf-8")
    scripts = "\n".join((HERE / name).read_text(encoding="utf-8") for name in ("renderer.js", "player.js"))
    return whole.replace("/*PLAYER*/", scripts).replace("/*CONTENT*/null", text)


class _Frames:
    """Poses and status of a run, gathered time by time."""

    def __init__(self, described: Description) -> None:
        self._described = described
        self._poses: list[list[npt.NDArray[np.float64]]] = [[] for _ in described.parts]
        self._status: list[dict[str, Any]] = []

    def take(self, time_s: float) -> None:
        for part, poses in zip(self._described.parts, self._poses, strict=True):
            at = part.pose(time_s)
            poses.append(np.full(12, np.nan) if at is None else at[:3].ravel())
        status = self._described.status.at(time_s)
        self._status.append(
            {
                "master": status.master,
                "slave": status.slave,
                "acting": "+".join(status.acting).upper(),
                "numbers": [f"{name} {value:.2f} {unit}" for name, value, unit in status.numbers],
                "gauges": [[gauge.controller.upper(), round(gauge.share, 3), gauge.text] for gauge in status.gauges],
            }
        )

    def content(self) -> dict[str, Any]:
        one = self._described
        return {
            "title": one.title,
            "figures": one.figures,
            "notes": one.notes,
            "views": {station: [low.tolist(), high.tolist()] for station, (low, high) in one.views.items()},
            "parts": [_part(part, np.stack(poses)) for part, poses in zip(one.parts, self._poses, strict=True)],
            "trails": [_trail(trail) for trail in one.trails],
            "legend": list(
                dict.fromkeys(
                    [(arrow.station, arrow.label, arrow.colour) for arrow in one.arrows]
                    + [(trail.station, trail.label, trail.colour) for trail in one.trails]
                )
            ),
            "status": self._status,
            "line": _line(one.timeline),
        }


def _part(part: Part, poses: npt.NDArray[np.float64]) -> dict[str, Any]:
    is_still = bool(np.all(poses == poses[0]))
    return {**geometry(part), "poses": packed(poses[:1] if is_still else poses)}


def _trail(trail: Trail) -> dict[str, Any]:
    points = trail.points.values
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    kept = known[:: max(1, math.ceil(len(known) / TRAIL_POINTS))]
    return {
        "station": trail.station,
        "colour": trail.colour,
        "times": packed(trail.points.time_s[kept]),
        "points": packed(points[kept]),
        "window": trail.window_s,
        "drift": trail.drift.tolist(),
    }


def _line(line: Timeline) -> dict[str, Any]:
    step = max(1, len(line.force_n) // 600)
    return {
        "begin": line.begin_s,
        "end": line.end_s,
        "marks": [[mark.time_s, mark.text, mark.named] for mark in line.marks],
        "ladder": line.ladder,
        "trips": line.trips,
        "forceTimes": np.round(line.force_time_s[::step], 4).tolist(),
        "force": np.round(line.force_n[::step], 4).tolist(),
    }
