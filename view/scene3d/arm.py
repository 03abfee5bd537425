"""Links of a UR arm as capsules, from its Denavit-Hartenberg rows."""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from haptether.slave import UrInverse, UrModel
from haptether.view.scene3d import colours
from haptether.view.scene3d.mesh import capsule, cylinder
from haptether.view.scene3d.parts import Course, Part
from haptether.view.scene3d.rotation import rotation_to, transform

Array = npt.NDArray[np.float64]

READY: Final = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
"""Joint angles in rad for a run without a place in the arm's frame; as in `haptether ur-emulator`."""
GRIPPER_M: Final = 0.16
"""Distance from the flange to the point between the jaws of a Robotiq gripper."""
TABLE_M: Final = 0.03
"""Lowest height of the tool above the arm's base, if the place of the arm is chosen."""
LIVE_LOWEST_M: Final = -0.2
"""Assumed descent of a live tool from its start."""
STEP_S: Final = 0.02
"""Period of computed postures; poses in between are interpolated."""


def link_frames(model: UrModel, q: Array) -> Array:
    """base_from_link before the first and after each joint, (7, 4, 4): `Rz(q) Tz(d) Tx(a) Rx(alpha)`."""
    frames = [np.eye(4)]
    for angle, a, d, alpha in zip(q, model.a, model.d, model.alpha, strict=True):
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        step = np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
        frames.append(frames[-1] @ step)
    return np.stack(frames)


class UrPostures:
    """Joint angles of an arm whose tool follows its recorded poses.

    A run in virtual time records positions relative to the tool at engagement. If the arm does not reach the recorded
    poses, it starts in `READY`, and the recorded motion is relative to that. Its height is such that the tool comes
    down to the table.

    Args:
        model: The arm.
        position: Position of the tool, (n, 3) in m.
        rotation: Rotation of the tool, (n, 3, 3); None for a constant orientation.
        tool_m: Distance from the flange to the tool point.
    """

    def __init__(self, model: UrModel, position: Course, rotation: Course | None, tool_m: float) -> None:
        self.model = model
        self.tool = transform(np.array([0.0, 0.0, tool_m]))
        self._inverse = UrInverse(model, tool=self.tool)
        self._position, self._rotation = position, rotation
        self.is_relative = True
        """True if the place of the arm is chosen."""
        self.unreached = 0
        """Number of poses out of reach; the arm then keeps its posture."""
        self._origin, self._turn, self._first = np.zeros(3), np.eye(3), np.eye(3)
        self._last_q = np.array(READY)
        self._last: tuple[float, Array, Array] | None = None
        self._begin()

    def _begin(self) -> None:
        time_s, position = self._position.time_s, self._position.values
        self._place(position[0], None if self._rotation is None else self._rotation.at(float(time_s[0])),
                    float(np.nanmin(position[:, 2]) - position[0, 2]))  # fmt: skip
        self._time_s = np.arange(float(time_s[0]), float(time_s[-1]) + STEP_S, STEP_S)
        self._q = np.stack([self._posture(float(now_s)) for now_s in self._time_s])

    def _place(self, position: Array, rotation: Array | None, lowest: float) -> None:
        """Place the arm by the first pose of its tool and the tool's descent below it in m."""
        ready = np.array(READY)
        home = link_frames(self.model, ready)[-1] @ self.tool
        first = transform(position, home[:3, :3] if rotation is None else rotation)
        self.is_relative = self._inverse.nearest(first, ready) is None
        if self.is_relative:
            lowered = home.copy()
            lowered[2, 3] = TABLE_M - lowest
            found = self._inverse.nearest(lowered, ready)
            home, ready = (home, ready) if found is None else (lowered, np.array(found))
        self._origin = home[:3, 3] - position if self.is_relative else np.zeros(3)
        self._turn = home[:3, :3] if self.is_relative or rotation is None else np.eye(3)
        self._first = np.eye(3) if rotation is None or not self.is_relative else rotation.T
        self._last_q = ready

    def _posture(self, time_s: float) -> Array:
        """Posture nearest to the previous one, (6,) in rad."""
        rotation = None if self._rotation is None else self._rotation.at(time_s)
        found = self._inverse.nearest(self.base_from_tool(self._position.at(time_s), rotation), self._last_q)
        if found is None:
            self.unreached += 1
        else:
            self._last_q = np.array(found)
        return self._last_q

    def base_from_tool(self, position: Array, rotation: Array | None) -> Array:
        """Recorded pose in the frame of the arm's base, (4, 4)."""
        turned = self._turn if rotation is None else rotation @ self._first @ self._turn
        return transform(position + self._origin, turned)

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Joint angles, (6,) in rad, and link frames, (7, 4, 4)."""
        if self._last is None or self._last[0] != time_s:
            q = self._q_at(time_s)
            self._last = time_s, q, link_frames(self.model, q)
        return self._last[1], self._last[2]

    def _q_at(self, time_s: float) -> Array:
        return np.array([np.interp(time_s, self._time_s, of) for of in self._q.T])


class LiveUrPostures(UrPostures):
    """`UrPostures` for a live run: finds each posture on request."""

    def _begin(self) -> None:
        self._has_begun, self._last_q = False, np.array(READY)
        # Place the arm by the oldest sample, so that a new description gives the same place.
        self._q_at(float(self._position.time_s[0]))

    def _q_at(self, time_s: float) -> Array:
        position = self._position.at(time_s)
        if not np.isfinite(position).all():
            return self._last_q
        if not self._has_begun:
            self._has_begun = True
            self._place(position, None if self._rotation is None else self._rotation.at(time_s), LIVE_LOWEST_M)
        return self._posture(time_s)


def arm_parts(postures: UrPostures) -> list[Part]:
    """Capsules from joint to joint: along the offset d, then along the link a."""
    model = postures.model
    size = abs(model.a[1]) + abs(model.a[2])
    upper, lower, wrist = 0.075 * size, 0.062 * size, 0.055 * size
    radii = (0.085 * size, upper, lower, wrist, wrist, wrist * 0.9)
    parts = [
        Part(
            name="arm base",
            station="robot",
            colour=colours.JOINT,
            mesh=cylinder(0.115 * size, 0.0, 0.04 * size),
            pose=lambda _: np.eye(4),
        )
    ]
    # Upper arm and forearm of a UR are offset from the plane of its base by about the shoulder's width.
    shoulder = 0.169 * size
    beside = {1: shoulder, 2: 0.01 * size}
    for joint, radius in enumerate(radii):
        if abs(model.d[joint]) > 1e-6:
            along_d = _link(postures, joint, radius, np.array([0.0, 0.0, model.d[joint]]), np.zeros(3))
            parts.append(along_d)
        if abs(model.a[joint]) > 1e-6:
            offset = np.array([0.0, 0.0, beside[joint]])
            parts.append(_link(postures, joint, radius, np.array([model.a[joint], 0.0, 0.0]), offset, after=True))
            for at, length in ((0.0, beside[joint] if joint == 1 else 0.0), (model.a[joint], beside[joint])):
                if length > 0.0:
                    bar = np.array([0.0, 0.0, length])
                    parts.append(_link(postures, joint, radius * 0.96, bar, np.array([at, 0.0, 0.0]), after=True))
    return parts


def _link(postures: UrPostures, joint: int, radius: float, reach: Array, offset: Array, *, after: bool = False) -> Part:
    """Capsule in the frame that turns with a joint; `after` puts it beyond the offset d."""
    model = postures.model
    lift = transform(np.array([0.0, 0.0, model.d[joint] if after else 0.0]))
    local = lift @ transform(offset, rotation_to(reach))

    def pose(time_s: float) -> Array:
        q, frames = postures.at(time_s)
        c, s = math.cos(q[joint]), math.sin(q[joint])
        turn = np.array([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        frame: Array = frames[joint] @ turn @ local
        return frame

    across = abs(reach[2]) > 0.0
    bar = f" bar {'begin' if offset[0] == 0.0 else 'end'}" if after and across else ""
    return Part(
        name=f"link {joint + 1} {'offset' if across else 'length'}{bar}",
        station="robot",
        colour=colours.JOINT if across else colours.ARM,
        mesh=capsule(radius, float(np.linalg.norm(reach))),
        pose=pose,
    )
