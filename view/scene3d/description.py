"""Description of a run in three dimensions: poses and text at any time."""

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
"""View corners of an arm on its table."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """Description of one run, independent of any picture."""

    title: str
    parts: tuple[Part, ...]
    """Bodies, including arrows."""
    arrows: tuple[Arrow, ...]
    trails: tuple[Trail, ...]
    status: StatusCourse
    timeline: Timeline
    notes: tuple[str, ...]
    """Parts that are not drawn, or drawn at an unrecorded position, with reasons."""
    figures: str
    """Summary of the run in one line."""
    views: dict[Station, tuple[Array, Array]]
    """View of each known end: lower and upper corner, (3,) each, in m."""
    flat: bool
    """True if all motion is along one axis."""

    def at(self, time_s: float) -> "Moment":
        """Return the poses at a time in s."""
        return Moment(
            time_s=time_s,
            poses={part.name: part.pose(time_s) for part in self.parts},
            trails={trail.name: trail.until(time_s) for trail in self.trails},
            status=self.status.at(time_s),
        )

    def part(self, name: str) -> Part:
        """Return a body by name.

        Raises:
            KeyError: The name does not exist; lists the available ones.
        """
        for part in self.parts:
            if part.name == name:
                return part
        message = f"no part {name!r}: there is {', '.join(part.name for part in self.parts)}"
        raise KeyError(message)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """Poses and status at one time."""

    time_s: float
    poses: dict[str, Array | None]
    """base_from_part, (4, 4) in m, of each part by name; None if invisible. The z axis of an arrow shaft is scaled to
    its length.
    """
    trails: dict[str, Array]
    """Points of each trail by name, (n, 3) in m."""
    status: Status


class NothingRecordedError(ValueError):
    """Run without the signals required for a picture."""


def describe(
    run: Run, scene: Scene | None = None, *, title: str = "", arm: str = "", leader: str = ""
) -> Description:  # fmt: skip
    """Describe a run.

    Args:
        run: Run with signals.
        scene: Scene of the run; by default from the settings of the run.
        title: Title; by default that of the scene.
        arm: Slave arm, if the scene does not define it: a UR, or a servo description by name or path.
        leader: Master arm: a servo description.

    Raises:
        NothingRecordedError: The run has no signals.
        ValueError: The arm does not exist.
    """
    return describe_beside([(run, scene, title)], arm=arm, leader=leader)[0]


def describe_beside(
    of: Sequence[tuple[Run, Scene | None, str]], *, arm: str = "", leader: str = ""
) -> list[Description]:  # fmt: skip
    """Describe runs shown side by side, with equal sizes and force scales.

    Args:
        of: Runs, each with its scene, if known, and its title.
        arm: As for `describe`.
        leader: As for `describe`.

    Raises:
        NothingRecordedError: A run has no signals.
        ValueError: The arm does not exist.
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
    """Describe a run at a given size; an end without recording is omitted."""
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
    """Return the corners around the motion, with a margin above as a fraction of its size."""
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
