"""Components of a 3D scene: bodies, arrows and trails, with their poses over time."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from haptether.bridge import Signals
from haptether.view.scene3d.mesh import Mesh, cone, cylinder
from haptether.view.scene3d.rotation import rotation_to, transform

Array = npt.NDArray[np.float64]
Station = Literal["hand", "robot"]
"""The two ends, drawn in separate windows because their sizes differ by an order of magnitude."""
Pose = Callable[[float], Array | None]
"""base_from_part, (4, 4), at a time in s; None while hidden."""


class Course:
    """A signal over time: the last sample at or before each time. The signals may grow.

    Args:
        signals: Signals of a recorded or live run.
        name: Name of the signal.
        by: Conversion of samples, (n, ...), row by row; by default none.
    """

    def __init__(self, signals: Signals, name: str, by: Callable[[Array], Array] = np.asarray) -> None:
        self._signals = signals
        self._name = name
        self._by = by

    @property
    def time_s(self) -> Array:
        """Times, (n,)."""
        times: Array = self._signals[self._signals.time_of(self._name)]
        return times

    @property
    def values(self) -> Array:
        """Converted samples, (n, ...)."""
        return self._by(self._signals[self._name])

    def index(self, time_s: float) -> int:
        """Index of the sample at a time; 0 before the first."""
        return max(0, int(np.searchsorted(self.time_s, time_s + 1e-9, side="right")) - 1)

    def at(self, time_s: float) -> Array:
        """Sample at a time."""
        index = self.index(time_s)
        return np.asarray(self._by(self._signals[self._name][index : index + 1])[0])

    def between(self, begin_s: float, end_s: float, most: int) -> tuple[Array, Array]:
        """Times, (k,), and samples, (k, ...), up to and including `end_s`, evenly thinned to about `most`."""
        first, last = np.searchsorted(self.time_s, [begin_s, end_s + 1e-9])
        # Keep the same samples as the line grows; otherwise it would tremble.
        step = 1 << max(0, math.ceil(math.log2(max(1, last - first) / most)))
        kept = np.union1d(np.arange(first - first % -step, last, step), np.arange(last - 1, last)[: last - first])
        return self.time_s[kept], self._by(self._signals[self._name][kept])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A body with its mesh and pose."""

    name: str
    station: Station
    mesh: Mesh
    colour: str
    """Colour as #rrggbb."""
    pose: Pose
    opacity: float = 1.0


def still(at: Array) -> Pose:
    """Constant pose."""
    return lambda _: at


HEAD_LENGTH, HEAD_RADIUS, SHAFT_RADIUS = 4.2, 1.75, 0.7
"""Dimensions of an arrow, as multiples of its thickness."""
MOST_TRAIL_POINTS = 500
"""Most points of a trail shown at once."""
LEAST_LENGTH = 0.25
"""Length below which an arrow is hidden, as a multiple of its thickness."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arrow:
    """A force, or with two heads a torque, with `length = scale |F|` from tail to tip."""

    name: str
    label: str
    station: Station
    colour: str
    scale: float
    """Scale in m per N, or per N m; constant."""
    thickness_m: float
    tail: Callable[[float], Array]
    """Position of its tail, (3,) in m."""
    vector: Callable[[float], Array]
    """Force or torque, (3,) in N or N m."""
    heads: Literal[1, 2] = 1

    def length(self, time_s: float) -> float:
        """Length in m; 0 while unknown."""
        length = self.scale * float(np.linalg.norm(self.vector(time_s)))
        return length if np.isfinite(length) else 0.0

    def parts(self) -> list[Part]:
        """Shaft and heads."""
        head_m = HEAD_LENGTH * self.thickness_m
        shaft = Part(
            name=f"{self.name} shaft",
            station=self.station,
            colour=self.colour,
            mesh=cylinder(SHAFT_RADIUS * self.thickness_m, 0.0, 1.0),
            pose=lambda time_s: self._shaft(time_s, head_m),
        )
        heads = [
            Part(
                name=f"{self.name} head {number}",
                station=self.station,
                colour=self.colour,
                mesh=cone(HEAD_RADIUS * self.thickness_m, -head_m, 0.0),
                pose=lambda time_s, number=number: self._head(time_s, head_m, number),  # type: ignore[misc]
            )
            for number in range(self.heads)
        ]
        return [shaft, *heads]

    def _frame(self, time_s: float) -> Array | None:
        if self.length(time_s) < LEAST_LENGTH * self.thickness_m:
            return None
        return transform(self.tail(time_s), rotation_to(self.vector(time_s)))

    def _shaft(self, time_s: float, head_m: float) -> Array | None:
        frame, length = self._frame(time_s), self.length(time_s)
        return None if frame is None or length <= head_m else frame @ np.diag([1.0, 1.0, length - head_m, 1.0])

    def _head(self, time_s: float, head_m: float, number: int) -> Array | None:
        frame, length = self._frame(time_s), self.length(time_s)
        if frame is None:
            return None
        size = min(1.0, length / head_m)
        tip = np.eye(4)
        tip[2, 3] = length - 0.75 * number * size * head_m
        return frame @ tip @ np.diag([size, size, size, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trail:
    """Recent path of a point."""

    name: str
    label: str
    station: Station
    colour: str
    points: Course
    """Recorded points, (n, 3) in m."""
    window_s: float
    """Time in s for which a point stays visible."""
    drift: Array
    """Velocity in m/s, (3,), at which drawn points move away; without it a one-axis trail would hide itself."""

    def until(self, time_s: float) -> Array:
        """Visible points at a time, (k, 3)."""
        times_s, points = self.points.between(time_s - self.window_s, time_s, MOST_TRAIL_POINTS)
        seen = points + (time_s - times_s)[:, None] * self.drift
        known: Array = seen[np.isfinite(seen).all(axis=1)]
        return known
