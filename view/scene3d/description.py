"""A run as a scene in three dimensions: what is where, and what is written, at any time of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from haptether.bridge import Run, Scene
from haptether.view.scene3d.extent import Extent, extents
from haptether.view.scene3d.hand import hand_end
from haptether.view.scene3d.parts import Arrow, Part, Station, Trail
from haptether.view.scene3d.robot import RobotEnd
from haptether.view.scene3d.status import StatusCourse
from haptether.view.scene3d.timeline import Timeline, timeline_of

Array = npt.NDArray[np.float64]

ROBOT_VIEW = np.array([-0.26, -0.6, -0.02]), np.array([0.26, 0.12, 0.54])
"""Of an arm on its table."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """Of one run; nothing of it is a picture yet."""

    title: str
    parts: tuple[Part, ...]
    """Bodies, arrows included."""
    arrows: tuple[Arrow, ...]
    trails: tuple[Trail, ...]
    status: StatusCourse
    timeline: Timeline
    notes: tuple[str, ...]
    """What is not drawn, or drawn where nobody recorded it, and why."""
    figures: str
    """What the run comes to, in a line."""
    views: dict[Station, tuple[Array, Array]]
    """Of each end: lower and upper corner of what is to be seen, (3,) each, in m."""
    flat: bool
    """Whether it all moves along one axis."""

    def part(self, name: str) -> Part:
        """A body by its name.

        Raises:
            KeyError: There is none, with those that there are.
        """
        for part in self.parts:
            if part.name == name:
                return part
        message = f"no part {name!r}: there is {', '.join(part.name for part in self.parts)}"
        raise KeyError(message)


class NothingRecordedError(ValueError):
    """A run without the signals that a picture is made of."""


def describe(run: Run, scene: Scene | None = None, *, title: str = "") -> Description:
    """What is where in a run.

    Args:
        run: With its signals.
        scene: What was run, or what the recording names; without one no objects are drawn.
        title: By default the scene's own.

    Raises:
        NothingRecordedError: It kept no signals.
    """
    return describe_beside([(run, scene, title)])[0]


def describe_beside(of: Sequence[tuple[Run, Scene | None, str]]) -> list[Description]:
    """As `describe`, of runs that are seen side by side: sizes and scales of forces are the same.

    Raises:
        NothingRecordedError: One of them kept no signals.
    """
    for run, _, _ in of:
        if "time_s" not in run.signals or not len(run.signals["time_s"]):
            message = f"{run.scene} has no [record], so there is nothing to see: add --set record.every=1"
            raise NothingRecordedError(message)
    shared = extents([(run, scene) for run, scene, _ in of])
    return [_described(run, scene, title, shared) for run, scene, title in of]


def _described(run: Run, scene: Scene | None, title: str, shared: dict[str, Extent]) -> Description:
    parts, arrows, trails, notes = hand_end(run, scene, shared["hand"])
    robot = RobotEnd(run, scene, shared["robot"])
    all_arrows = [*arrows, *robot.arrows]
    views: dict[Station, tuple[Array, Array]] = {
        "hand": _view_of(shared["hand"], 0.6),
        "robot": _view_of(shared["robot"], robot.above) if robot.postures is None else ROBOT_VIEW,
    }
    return Description(
        title=title or (scene.title if scene is not None and scene.title else run.scene),
        parts=(*parts, *robot.parts, *(part for arrow in all_arrows for part in arrow.parts())),
        arrows=tuple(all_arrows),
        trails=(*trails, *robot.trails),
        status=StatusCourse(run, scene),
        timeline=timeline_of(run),
        notes=(*notes, *robot.notes),
        figures=_figures(run),
        views=views,
        flat=run.signals["position"].ndim == 1,
    )


def _view_of(extent: Extent, above: float) -> tuple[Array, Array]:
    """Corners around what moves and what stands above it, as a share of its size."""
    low = extent.low - np.array([0.15, 0.08, 0.22]) * extent.size
    high = extent.high + np.array([0.15, 0.3, above]) * extent.size
    return low, high


def _figures(run: Run) -> str:
    metrics = run.metrics
    rows = [
        ("largest ejection velocity", metrics.max_ejection_velocity, "m/s"),
        ("largest force on the hand", metrics.peak_device_force, "N"),
        ("position error", None if metrics.position_rmse_m is None else 1e3 * metrics.position_rmse_m, "mm RMS"),
    ]
    return "   ".join(f"{label} {value:.3g} {unit}" for label, value, unit in rows if value is not None)
