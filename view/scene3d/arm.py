"""The links of a UR arm as capsules, from its Denavit-Hartenberg rows."""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from haptether.bridge import Scene
from haptether.slave import UR_MODELS, UrInverse, UrModel, ur_model
from haptether.view.scene3d import colours
from haptether.view.scene3d.mesh import capsule, cylinder
from haptether.view.scene3d.parts import Part
from haptether.view.scene3d.rotation import rotation_to, transform

Array = npt.NDArray[np.float64]

READY: Final = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
"""Joint angles in rad where a run says no place in the arm's own frame: those of `haptether ur-emulator`."""
GRIPPER_M: Final = 0.16
"""From the flange to between the jaws of a Robotiq gripper."""
TABLE_M: Final = 0.03
"""How far above the arm's base the tool comes down where its place is chosen."""
STEP_S: Final = 0.02
"""Between the postures that are computed; in between they are interpolated."""


def ur_of(scene: Scene | None) -> UrModel | None:
    """The arm that a scene drives, if it is a UR."""
    if scene is None or scene.slave is None or scene.slave.device != "ur":
        return None
    name = str(scene.slave.options.get("model", "ur5e"))
    return ur_model(name) if name in UR_MODELS else None


def link_frames(model: UrModel, q: Array) -> Array:
    """base_from_link after each joint, (7, 4, 4), the first the base's own: `Rz(q) Tz(d) Tx(a) Rx(alpha)`."""
    frames = [np.eye(4)]
    for angle, a, d, alpha in zip(q, model.a, model.d, model.alpha, strict=True):
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        step = np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
        frames.append(frames[-1] @ step)
    return np.stack(frames)


class UrPostures:
    """Joint angles of an arm whose tool goes where it was recorded to be.

    A run in virtual time counts from where the tool stands when the two engage. Where the arm does not reach what was
    recorded, it therefore stands in `READY`, as high as has its tool come down to the table, and what was recorded
    moves it from there.

    Args:
        model: The arm.
        time_s: (n,).
        position: Of the tool, (n, 3) in m.
        rotation: Of the tool, (n, 3, 3); none of a tool that keeps its orientation.
        tool_m: From the flange to the tool point.
    """

    def __init__(self, model: UrModel, time_s: Array, position: Array, rotation: Array | None, tool_m: float) -> None:
        self.model = model
        self.tool = transform(np.array([0.0, 0.0, tool_m]))
        inverse = UrInverse(model, tool=self.tool)
        ready = np.array(READY)
        home = link_frames(model, ready)[-1] @ self.tool
        lowest = float(np.nanmin(position[:, 2]) - position[0, 2])
        first = transform(position[0], home[:3, :3] if rotation is None else rotation[0])
        self.is_relative = inverse.nearest(first, ready) is None
        """Whether the place of the arm is chosen."""
        if self.is_relative:
            lowered = home.copy()
            lowered[2, 3] = TABLE_M - lowest
            found = inverse.nearest(lowered, ready)
            home, ready = (home, ready) if found is None else (lowered, np.array(found))
        self._origin = home[:3, 3] - position[0] if self.is_relative else np.zeros(3)
        self._turn = home[:3, :3] if self.is_relative or rotation is None else np.eye(3)
        self._first = np.eye(3) if rotation is None or not self.is_relative else rotation[0].T
        self._time_s = np.arange(float(time_s[0]), float(time_s[-1]) + STEP_S, STEP_S)
        index = np.clip(np.searchsorted(time_s, self._time_s + 1e-9, side="right") - 1, 0, None)
        postures, q = [], ready
        self.unreached = 0
        """Poses that no posture has: the arm stays where it was."""
        for n in index:
            found = inverse.nearest(self.base_from_tool(position[n], None if rotation is None else rotation[n]), q)
            if found is None:
                self.unreached += 1
            else:
                q = np.array(found)
            postures.append(q)
        self._q = np.stack(postures)
        self._last: tuple[float, Array, Array] | None = None

    def base_from_tool(self, position: Array, rotation: Array | None) -> Array:
        """Where what was recorded is in the frame of the arm's base, (4, 4)."""
        turned = self._turn if rotation is None else rotation @ self._first @ self._turn
        return transform(position + self._origin, turned)

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Joint angles, (6,) in rad, and the frames of the links, (7, 4, 4)."""
        if self._last is None or self._last[0] != time_s:
            q = np.array([np.interp(time_s, self._time_s, of) for of in self._q.T])
            self._last = time_s, q, link_frames(self.model, q)
        return self._last[1], self._last[2]


def arm_parts(postures: UrPostures) -> list[Part]:
    """Capsules from joint to joint: along the offset d first, then along the link a."""
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
    # The upper arm and the forearm of a UR lie beside the plane of its base, by about the width of the shoulder.
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
    """A capsule in the frame that turns with a joint; `after` puts it beyond the offset d."""
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
