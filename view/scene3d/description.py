"""A run as a 3D scene: poses and texts at any time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from haptether.bridge import Run, Scene
from haptether.view.scene3d.arms import Arms, arms_of
from haptether.view.scene3d.chain import CHAIN_ABOVE
from haptether.view.scene3d.extent import Extent, axes_of, chain_of, extents, is_joints
from haptether.view.scene3d.hand import hand_end
from haptether.view.scene3d.parts import Arrow, Part, Station, Trail
from haptether.view.scene3d.robot import RobotEnd
from haptether.view.scene3d.settings import scene_of_settings
from haptether.view.scene3d.status import Status, StatusCourse
from haptether.view.scene3d.timeline import Timeline, timeline_of

Array = npt.NDArray[np.float64]

ROBOT_VIEW = np.array([-0.26, -0.6, -0.02]), np.array([0.26, 0.12, 0.54])
"""View of an arm on its table: lower and upper corner."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """Description of one run, before any drawing."""

    title: str
    parts: tuple[Part, ...]
    """Bodies, arrows included."""
    arrows: tuple[Arrow, ...]
    trails: tuple[Trail, ...]
    status: StatusCourse
    timeline: Timeline
    notes: tuple[str, ...]
    """Items not drawn, or drawn at a place that was not recorded, and why."""
    figures: str
    """Results of the run in one line."""
    views: dict[Station, tuple[Array, Array]]
    """Lower and upper corner of the view of each known end, (3,) each, in m."""
    flat: bool
    """True if everything moves along one axis."""

    def at(self, time_s: float) -> "Moment":
        """Poses, trails and status at a time in s."""
        return Moment(
            time_s=time_s,
            poses={part.name: part.pose(time_s) for part in self.parts},
            trails={trail.name: trail.until(time_s) for trail in self.trails},
            status=self.status.at(time_s),
        )

    def part(self, name: str) -> Part:
        """Body by its name.

        Raises:
            KeyError: There is no such body; the text lists the bodies.
        """
        for part in self.parts:
            if part.name == name:
                return part
        message = f"no part {name!r}: there is {', '.join(part.name for part in self.parts)}"
        raise KeyError(message)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """Poses, trails and status at one time."""

    time_s: float
    poses: dict[str, Array | None]
    """base_from_part, (4, 4) in m, of each part by name; None while hidden. The shaft of an arrow is scaled along z to
    the length of its force.
    """
    trails: dict[str, Array]
    """Recent path of each trail's point by name, (n, 3) in m."""
    status: Status


class NothingRecordedError(ValueError):
    """The run lacks the signals required for a picture."""


def describe(
    run: Run, scene: Scene | None = None, *, title: str = "", arm: str = "", leader: str = ""
) -> Description:  # fmt: skip
    """Describe the poses of all bodies in a run.

    Args:
        run: Run with its signals.
        scene: Scene of the run; by default from the settings of the run.
        title: Title; by default the scene's own.
        arm: Arm of the slave if no scene names it: a UR, or a servo description by name or path.
        leader: Arm of the master: a servo description by name or path.

    Raises:
        NothingRecordedError: The run has no signals.
        ValueError: There is no such arm.
    """
    return describe_beside([(run, scene, title)], arm=arm, leader=leader)[0]


def describe_beside(
    of: Sequence[tuple[Run, Scene | None, str]], *, arm: str = "", leader: str = ""
) -> list[Description]:  # fmt: skip
    """Describe runs shown side by side, with common sizes and scales of forces; otherwise as `describe`.

    Raises:
        NothingRecordedError: A run has no signals.
        ValueError: There is no such arm.
    """
    for run, _, _ in of:
        if not any(len(run.signals[name]) for name in ("time_s", "slave_time_s") if name in run.signals):
            message = f"{run.scene} has no [record], so there is nothing to see: add --set record.every=1"
            raise NothingRecordedError(message)
    known = [(run, scene_of_settings(run.settings) if scene is None else scene, title) for run, scene, title in of]
    arms = [arms_of(scene, arm=arm, leader=leader) for _, scene, _ in known]
    shared = extents([(run, scene) for run, scene, _ in known], arms[0])
    return [
        described(run, scene, title, shared, one) for (run, scene, title), one in zip(known, arms, strict=True)
    ]  # fmt: skip


def described(run: Run, scene: Scene | None, title: str, shared: dict[str, Extent], arms: Arms) -> Description:
    """Describe a run in given extents; an end that was not recorded is left out."""
    parts: list[Part] = []
    arrows: list[Arrow] = []
    trails: list[Trail] = []
    notes: list[str] = []
    views: dict[Station, tuple[Array, Array]] = {}
    if "position" in run.signals:
        parts, arrows, trails, notes = hand_end(run, scene, shared["hand"], arms)
        is_chain = is_joints(run.signals, scene) and chain_of(run.signals, "position", arms.master) is not None
        views["hand"] = _view_of(shared["hand"], CHAIN_ABOVE if is_chain else 0.6)
    else:
        notes.append("the hand is not drawn: nothing of the master was given")
    if "slave_position" not in run.signals and not {"peer_state", "state"}.isdisjoint(run.signals):
        notes.append("the robot is not drawn: nothing of the slave was given")
    else:
        robot = RobotEnd(run, scene, shared["robot"], arms)
        parts.extend(robot.parts)
        arrows.extend(robot.arrows)
        trails.extend(robot.trails)
        notes.extend(robot.notes)
        views["robot"] = _view_of(shared["robot"], robot.above) if robot.postures is None else ROBOT_VIEW
    return Description(
        title=title or (scene.title if scene is not None and scene.title else run.scene),
        parts=(*parts, *(part for arrow in arrows for part in arrow.parts())),
        arrows=tuple(arrows),
        trails=tuple(trails),
        status=StatusCourse(run.signals, run.events, scene),
        timeline=timeline_of(run.signals, run.events),
        notes=tuple(notes),
        figures=_figures(run, joints=is_joints(run.signals, scene)),
        views=views,
        flat=axes_of(run.signals) == 1,
    )


def _view_of(extent: Extent, above: float) -> tuple[Array, Array]:
    """Corners around the range of motion, with room above it as a fraction of its size."""
    low = extent.low - np.array([0.15, 0.08, 0.22]) * extent.size
    high = extent.high + np.array([0.15, 0.3, above]) * extent.size
    return low, high


def _figures(run: Run, *, joints: bool) -> str:
    metrics = run.metrics
    error_mm = None if metrics.position_rmse_m is None else 1e3 * metrics.position_rmse_m
    rows = [
        ("largest ejection velocity", metrics.max_ejection_velocity, "rad/s" if joints else "m/s"),
        ("largest torque on the hand" if joints else "largest force on the hand", metrics.peak_device_force,
         "N m" if joints else "N"),
        ("position error", error_mm, "mrad RMS" if joints else "mm RMS"),
    ]  # fmt: skip
    return "   ".join(f"{label} {value:.3g} {unit}" for label, value, unit in rows if value is not None)
