"""An arm of servos as capsules between joints, from its description, with the torques on its joints."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from haptether.bridge import Signals
from haptether.dynamixel.description import ArmDescription
from haptether.view.scene3d import colours
from haptether.view.scene3d.mesh import box, capsule, cylinder, sphere
from haptether.view.scene3d.parts import Arrow, Course, Part, Pose, Station, Trail, still
from haptether.view.scene3d.rotation import matrix_of, rotation_to, transform

Array = npt.NDArray[np.float64]

LEAST_LINK_M = 1e-4
LEAST_TURN = 0.03
"""Angle in rad of the largest joint deviation below which the commanded arm is not drawn."""
TRAIL_S = 2.0
LEAST_LEVER = 0.03
"""Fraction of the reach below which a lever is too short to determine its force."""
MOST_RESIDUE = 0.15
"""Fraction of the torques that a tip force may leave unexplained."""
CHAIN_ABOVE = 0.12
"""Visible height above the range of motion, as a fraction of its size."""
GHOST_PREFIX = "ghost of the command: "


def angles_of(values: npt.NDArray[np.float64]) -> Array:
    """Angles or torques of joints as (n, joints)."""
    angles = np.asarray(values, dtype=np.float64)
    return angles[:, None] if angles.ndim == 1 else angles


def chain_frames(arm: ArmDescription, q: Array) -> Array:
    """base_from_joint of each joint, rotated by its angle, and base_from_tool, (..., joints + 1, 4, 4).

    `T_i = T_(i-1) Trans(xyz_i) Rot(axis_i, q_i)`.

    Args:
        arm: The arm.
        q: Joint angles, (..., joints) in rad.
    """
    frame = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    frames = []
    for index, joint in enumerate(arm.joints):
        x, y, z = joint.axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = q[..., index, None, None]
        step = np.zeros((*q.shape[:-1], 4, 4))
        step[..., :3, :3] = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
        step[..., :3, 3] = joint.xyz_m
        step[..., 3, 3] = 1.0
        frame = frame @ step
        frames.append(frame)
    tool = transform(np.array(arm.tool.xyz_m), matrix_of(np.array(arm.tool.quat_wxyz)))
    return np.stack([*frames, frame @ tool], axis=-3)


def reach_m(arm: ArmDescription) -> float:
    """Distance from base to tool of the stretched arm."""
    return sum(math.hypot(*joint.xyz_m) for joint in arm.joints) + math.hypot(*arm.tool.xyz_m)


def chain_corners(arm: ArmDescription, angles: Array) -> Array:
    """Lower and upper corner of the range of joints and tool, (2, 3) in m.

    Args:
        arm: The arm.
        angles: (n, joints) in rad; without known angles, the range is that of the reach.
    """
    known = angles[np.isfinite(angles).all(axis=1)]
    if not len(known):
        reach = reach_m(arm)
        return np.array([[-0.6 * reach, -0.6 * reach, 0.0], [0.6 * reach, 0.6 * reach, 0.9 * reach]])
    points = chain_frames(arm, known[:: max(1, len(known) // 60)])[..., :3, 3].reshape(-1, 3)
    return np.stack([np.minimum(points.min(axis=0), 0.0), np.maximum(points.max(axis=0), 0.0)])


def tip_force(arm: ArmDescription, frames: Array, torques: Array) -> Array:
    """Force at the tool point that explains the joint torques, (3,) in N; NaN if none does.

    `tau = J^T F`, by damped least squares. A contact elsewhere on the arm, or a moment on the tool, leaves a residue.

    Args:
        arm: The arm.
        frames: Result of `chain_frames`, (joints + 1, 4, 4).
        torques: (joints,) in N m.
    """
    levers = frames[-1, :3, 3] - frames[:-1, :3, 3]
    axes = np.einsum("nij,nj->ni", frames[:-1, :3, :3], np.array([joint.axis for joint in arm.joints]))
    transposed = np.cross(axes, levers)
    damping = (LEAST_LEVER * reach_m(arm)) ** 2
    force = np.linalg.solve(transposed.T @ transposed + damping * np.eye(3), transposed.T @ torques)
    left = float(np.linalg.norm(transposed @ force - torques))
    # A force can explain any torques of fewer than four joints.
    is_known = len(torques) > 3 and left <= MOST_RESIDUE * float(np.linalg.norm(torques))
    return np.asarray(force if is_known else np.full(3, np.nan))


class ChainEnd:
    """An end that is a chain of servos: cylinders for joints, capsules for links, the tool, and torques.

    Args:
        station: The end.
        arm: The arm.
        signals: Signals of the run.
        place: Name of the signal of joint angles, (n, joints) in rad.
        command: Name of the signal of commanded angles, if recorded.
        torque: Name of the signal of joint torques in N m.
        colour: Colour of its arrows.
        metres_per_newton_metre: Scale of its arrows.
    """

    def __init__(
        self, station: Station, arm: ArmDescription, signals: Signals, *,
        place: str, command: str, torque: str, colour: str, metres_per_newton_metre: float,
    ) -> None:  # fmt: skip
        self.parts: list[Part] = []
        self.arrows: list[Arrow] = []
        self.trails: list[Trail] = []
        self._station: Station = station
        self._arm = arm
        self._radius = 0.045 * reach_m(arm) / 1.6
        self._tip = "tool" if station == "robot" else "handle"
        measured = _Posture(arm, Course(signals, place, angles_of))
        self._add_bodies(measured)
        self._add_trail(f"{self._tip} trail", f"way of the {self._tip}", colours.MEASURED, signals, place)
        if command in signals and station == "robot":
            self._add_ghost(measured, _Posture(arm, Course(signals, command, angles_of)))
            self._add_trail("command trail", "commanded", colours.COMMANDED, signals, command)
        if torque in signals:
            self._add_torques(measured, Course(signals, torque, angles_of), colour, metres_per_newton_metre)

    def _add_bodies(self, posture: "_Posture") -> None:
        station, radius = self._station, self._radius
        self.parts += self._links(posture, "", colours.ARM, 1.0)
        for index, joint in enumerate(self._arm.joints):
            along = transform(np.zeros(3), rotation_to(np.array(joint.axis)))
            self.parts.append(
                Part(
                    name=f"{station} joint {index + 1}", station=station, colour=colours.JOINT,
                    mesh=cylinder(radius, -radius, radius), pose=posture.joint(index, along),
                )
            )  # fmt: skip
        self.parts.append(
            Part(
                name=self._tip, station=station, colour=colours.TOOL, mesh=sphere(0.9 * radius),
                pose=posture.joint(-1, np.eye(4)),
            )
        )  # fmt: skip
        self.parts.append(
            Part(
                name=f"{station} base", station=station, colour=colours.JOINT,
                mesh=cylinder(1.8 * radius, -0.6 * radius, 0.6 * radius), pose=still(np.eye(4)),
            )
        )  # fmt: skip
        wide = 0.35 * reach_m(self._arm)
        self.parts.append(
            Part(
                name=f"{station} floor", station=station, colour=colours.FLOOR, opacity=0.75,
                mesh=box([wide, wide, 0.1 * radius]), pose=still(transform(np.array([0.0, 0.0, -0.7 * radius]))),
            )
        )  # fmt: skip

    def _links(self, posture: "_Posture", prefix: str, colour: str, opacity: float) -> list[Part]:
        parts = []
        ends = [*(np.array(joint.xyz_m) for joint in self._arm.joints), np.array(self._arm.tool.xyz_m)]
        for index, end in enumerate(ends):
            if (length := float(np.linalg.norm(end))) > LEAST_LINK_M:
                local = transform(np.zeros(3), rotation_to(end))
                parts.append(
                    Part(
                        name=f"{prefix}{self._station} link {index}", station=self._station, colour=colour,
                        mesh=capsule(0.6 * self._radius, length), opacity=opacity,
                        pose=posture.link(index, local),
                    )
                )  # fmt: skip
        return parts

    def _add_ghost(self, measured: "_Posture", commanded: "_Posture") -> None:
        """Add the commanded posture, shown while it deviates from the arm."""

        def unless_there(pose: Pose) -> Pose:
            def seen(time_s: float) -> Array | None:
                apart = np.abs(commanded.angles(time_s) - measured.angles(time_s)).max()
                return pose(time_s) if apart > LEAST_TURN else None

            return seen

        links = self._links(commanded, GHOST_PREFIX, colours.GHOST, 0.35)
        tip = Part(
            name=f"{GHOST_PREFIX}{self._tip}", station=self._station, colour=colours.GHOST, opacity=0.35,
            mesh=sphere(0.9 * self._radius), pose=commanded.joint(-1, np.eye(4)),
        )  # fmt: skip
        self.parts += [replace(part, pose=unless_there(part.pose)) for part in (*links, tip)]

    def _add_trail(self, name: str, label: str, colour: str, signals: Signals, of: str) -> None:
        course = Course(signals, of, lambda angles: chain_frames(self._arm, angles_of(angles))[:, -1, :3, 3])
        self.trails.append(
            Trail(
                name=name, label=label, station=self._station, colour=colour, points=course, window_s=TRAIL_S,
                drift=np.zeros(3),
            )
        )  # fmt: skip

    def _add_torques(self, posture: "_Posture", torques: Course, colour: str, metres_per_newton_metre: float) -> None:
        """Add a torque about each servo's axis, and the force at the tip if the torques determine it."""
        axes = [np.array(joint.axis) for joint in self._arm.joints]
        for index, axis in enumerate(axes):

            def vector(time_s: float, index: int = index, axis: Array = axis) -> Array:
                frames = posture.frames(time_s)
                if frames is None:
                    return np.full(3, np.nan)
                return np.asarray(frames[index, :3, :3] @ axis * torques.at(time_s)[index])

            def tail(time_s: float, index: int = index, vector: Callable[[float], Array] = vector) -> Array:
                frames, along = posture.frames(time_s), vector(time_s)
                if frames is None:
                    return along
                return np.asarray(
                    frames[index, :3, 3] + self._radius * along / max(float(np.linalg.norm(along)), 1e-12)
                )

            self.arrows.append(
                Arrow(
                    name=f"{self._station} torque {index + 1}", label="torques", station=self._station,
                    colour=colour, scale=metres_per_newton_metre, thickness_m=0.4 * self._radius, tail=tail,
                    vector=vector, heads=2,
                )
            )  # fmt: skip
        if len(axes) <= 3:
            return

        def force(time_s: float) -> Array:
            frames = posture.frames(time_s)
            return np.full(3, np.nan) if frames is None else tip_force(self._arm, frames, torques.at(time_s))

        def tip(time_s: float) -> Array:
            frames = posture.frames(time_s)
            return np.full(3, np.nan) if frames is None else np.asarray(frames[-1, :3, 3])

        self.arrows.append(
            Arrow(
                name=f"{self._station} tip force", label="at the tip", station=self._station,
                # As long as the torque that it exerts on a servo at the arm's full reach.
                colour=colour,
                scale=metres_per_newton_metre * reach_m(self._arm), thickness_m=0.5 * self._radius, tail=tip,
                vector=force,
            )
        )  # fmt: skip


class _Posture:
    """Joint angles over time."""

    def __init__(self, arm: ArmDescription, course: Course) -> None:
        self._arm = arm
        self._course = course
        self._last: tuple[float, Array | None] | None = None

    def angles(self, time_s: float) -> Array:
        """Angles, (joints,) in rad."""
        return self._course.at(time_s)

    def frames(self, time_s: float) -> Array | None:
        """Result of `chain_frames`; None while the angles are unknown."""
        if self._last is None or self._last[0] != time_s:
            q = self._course.at(time_s)
            self._last = time_s, chain_frames(self._arm, q) if np.isfinite(q).all() else None
        return self._last[1]

    def joint(self, index: int, local: Array) -> Pose:
        """Pose of a part that turns with a joint or with the tool."""

        def pose(time_s: float) -> Array | None:
            frames = self.frames(time_s)
            return None if frames is None else np.asarray(frames[index] @ local)

        return pose

    def link(self, index: int, local: Array) -> Pose:
        """Pose of the link that leads to a joint."""
        return (lambda _: local) if index == 0 else self.joint(index - 1, local)
