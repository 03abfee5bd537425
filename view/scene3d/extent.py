"""Sizes of drawings, from the range of motion of one or more runs side by side."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from haptether.bridge import Box, Run, Scene, Signals, Sphere
from haptether.dynamixel.description import ArmDescription
from haptether.view.scene3d.arms import Arms
from haptether.view.scene3d.chain import angles_of, chain_corners
from haptether.view.scene3d.history import History

Array = npt.NDArray[np.float64]

LEAST_M = 0.04
"""Size of a run with almost no motion."""
ARROW_SHARE = 0.62
"""Length of the largest force arrow over the size of its end."""
JOINT_SHARE = 0.3
"""The same for the torque of a joint; there are several."""
FORCES = {
    "hand": ("device_force", "hand_force", "grasp_force", "safety_force"),
    "robot": ("environment_force",),
}
TORQUES = {
    "hand": ("device_torque", "hand_torque", "grasp_torque", "safety_torque"),
    "robot": ("environment_torque",),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extent:
    """Extent and scales of one end."""

    low: Array
    """Lower corner of the range of motion and contact, (3,) in m."""
    high: Array
    size: float
    """Largest side in m."""
    metres_per_newton: float
    metres_per_newton_metre: float

    @property
    def centre(self) -> Array:
        """Centre, (3,) in m."""
        return 0.5 * (self.low + self.high)


def points_of(values: npt.NDArray[np.float64]) -> Array:
    """Positions or forces of 1 to 3 axes as (n, 3); missing axes are 0."""
    columns = np.asarray(values, dtype=np.float64)
    columns = columns[:, None] if columns.ndim == 1 else columns[:, :3]
    # Called many times per frame; np.pad takes ten times as long.
    points = np.zeros((len(columns), 3))
    points[:, : columns.shape[1]] = columns
    return points


def vector_of(value: float | Sequence[float] | None, axes: int) -> Array:
    """Number for every axis, or one per axis, of a scene as (3,)."""
    given = np.zeros(axes) if value is None else np.broadcast_to(np.asarray(value, dtype=np.float64), axes)
    return np.pad(given[:3], (0, max(0, 3 - axes)))


def axes_of(signals: Signals) -> int:
    """Number of recorded axes."""
    position = signals["position" if "position" in signals else "slave_position"]
    return 1 if position.ndim == 1 else int(position.shape[1])


def extents(of: Sequence[tuple[Run, Scene | None]], arms: Arms) -> dict[str, Extent]:
    """Extents of both ends, common to runs shown side by side."""
    return {
        "hand": _extent("hand", [_hand_points(run.signals, scene, arms) for run, scene in of], of),
        "robot": _extent("robot", [_robot_points(run.signals, scene, arms) for run, scene in of], of),
    }


def chain_of(signals: Signals, name: str, arm: object) -> ArmDescription | None:
    """Chain of servos if it has as many joints as the signal; otherwise None."""
    values = signals[name]
    joints = 1 if values.ndim == 1 else values.shape[1]
    return arm if isinstance(arm, ArmDescription) and len(arm.joints) == joints else None


def is_joints(signals: Signals, scene: Scene | None) -> bool:
    """True if the recorded positions are joint angles."""
    return axes_of(signals) > 3 or (scene is not None and scene.master.kind == "joints")


def _joints(signals: Signals, name: str, arm: object) -> Array:
    chain = chain_of(signals, name, arm)
    if chain is not None:
        # A live arm may still move anywhere.
        angles = angles_of(signals[name])
        return chain_corners(chain, angles[:0] if isinstance(signals, History) else angles)
    return np.array([[-LEAST_M, 0.0, -LEAST_M], [LEAST_M, 0.0, LEAST_M]])


def _hand_points(signals: Signals, scene: Scene | None, arms: Arms) -> Array:
    if "position" not in signals:
        return np.zeros((1, 3))
    if is_joints(signals, scene):
        return _joints(signals, "position", arms.master)
    points = [points_of(signals["position"])]
    if (corners := stops(scene, axes_of(signals))) is not None:
        points.append(corners)
    return np.concatenate(points)


def _robot_points(signals: Signals, scene: Scene | None, arms: Arms) -> Array:
    if is_joints(signals, scene):
        return _joints(signals, "slave_position" if "slave_position" in signals else "position", arms.slave)
    # Without an arm the device itself makes contact.
    points = [points_of(signals[name]) for name in ("slave_position", "slave_command") if name in signals]
    points = points or [points_of(signals["position"])]
    environment = None if scene is None else scene.environment
    axes = axes_of(signals)
    for thing in () if environment is None else environment.objects:
        if isinstance(thing.shape, Sphere | Box):
            half = vector_of(thing.shape.radius if isinstance(thing.shape, Sphere) else thing.shape.half_extents, axes)
            centre = vector_of(thing.shape.centre, axes)
            points.append(np.stack([centre - half, centre + half]))
    for hole in () if environment is None else environment.holes:
        at = np.array(hole.entrance)
        points.append(np.stack([at - hole.depth, at + 3.0 * hole.radius]))
    for handle in () if environment is None else environment.handles:
        points.append(np.array([handle.point, handle.grip]))
    for body in () if environment is None else environment.bodies:
        points.append(np.array(body.position) + np.array([-1.0, 1.0])[:, None] * np.array(body.half_extents))
    return np.concatenate(points)


def stops(scene: Scene | None, axes: int) -> Array | None:
    """Corners of the device's workspace, (2, 3) in m; None without mechanical stops."""
    if scene is None or scene.master.stops is None:
        return None
    pairs = np.broadcast_to(np.asarray(scene.master.stops, dtype=np.float64), (axes, 2))[:3]
    return np.pad(pairs, ((0, 3 - len(pairs)), (0, 0))).T


def _extent(end: str, points: Sequence[Array], of: Sequence[tuple[Run, Scene | None]]) -> Extent:
    all_points = np.concatenate(points)
    known = all_points[np.isfinite(all_points).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else (np.zeros(3), np.zeros(3))
    size = max(LEAST_M, float((high - low).max()))
    signals = [run.signals for run, _ in of]
    if any(is_joints(run.signals, scene) for run, scene in of):
        # The force signals hold joint torques.
        per = JOINT_SHARE * size / _peak(signals, FORCES[end], largest_of)
        return Extent(low=low, high=high, size=size, metres_per_newton=per, metres_per_newton_metre=per)
    return Extent(
        low=low,
        high=high,
        size=size,
        metres_per_newton=ARROW_SHARE * size / _peak(signals, FORCES[end], norms_of),
        metres_per_newton_metre=ARROW_SHARE * size / _peak(signals, TORQUES[end], norms_of),
    )


def norms_of(vectors: Array) -> Array:
    """Norms, (n,), of vectors of 1 to 3 axes, (n, ...)."""
    return np.asarray(np.linalg.norm(points_of(vectors), axis=1))


def largest_of(torques: Array) -> Array:
    """Largest joint torque of each sample, (n,)."""
    return np.asarray(np.abs(angles_of(torques)).max(axis=1))


def _peak(signals: Sequence[Signals], names: Sequence[str], by: Callable[[Array], Array]) -> float:
    """Largest value in the signals, rounded up to 1, 2, 3 or 5 times a power of ten."""
    norms = [by(of[name]) for of in signals for name in names if name in of]
    known = [float(np.nanmax(norm)) for norm in norms if np.isfinite(norm).any()]
    largest = max(known, default=0.0)
    return nice_above(largest) if largest > 1e-9 else 1.0


def nice_above(value: float) -> float:
    """Smallest of 1, 2, 3, 5, 10, ... not below a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 3.0, 5.0, 10.0) if value <= step * power * (1.0 + 1e-9))
