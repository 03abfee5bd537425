"""The robot's end: arm, tool, gripper, commanded pose, environment, and the force on it."""

import math

import numpy as np
import numpy.typing as npt

from haptether.bridge import Plane, Run, Scene, Signals
from haptether.slave import UrModel
from haptether.view.scene3d import colours
from haptether.view.scene3d.arm import GRIPPER_M, LiveUrPostures, UrPostures, arm_parts
from haptether.view.scene3d.arms import Arms
from haptether.view.scene3d.chain import CHAIN_ABOVE, ChainEnd
from haptether.view.scene3d.extent import Extent, axes_of, chain_of, is_joints, points_of
from haptether.view.scene3d.hand import dials, drift, floor, has_force, rail
from haptether.view.scene3d.history import History
from haptether.view.scene3d.mesh import Mesh, box, capsule, cylinder, joined, placed, sphere
from haptether.view.scene3d.objects import Surroundings, contacts
from haptether.view.scene3d.parts import Arrow, Course, Part, Pose, Trail, still
from haptether.view.scene3d.rotation import matrix_of, transform

Array = npt.NDArray[np.float64]

TRAIL_S = 2.0
LEAST_TURN = 0.03
"""Angle in rad below which command and tool coincide."""
DEVICE_NOTE = "no arm: the environment acts on the device itself"


class RobotEnd:
    """Parts, arrows and trails of the robot, and notes of items not drawn."""

    def __init__(self, run: Run, scene: Scene | None, extent: Extent, arms: Arms) -> None:
        self.parts: list[Part] = []
        self.arrows: list[Arrow] = []
        self.trails: list[Trail] = []
        self.notes: list[str] = []
        self.postures: UrPostures | None = None
        """Postures of a UR arm; None without one."""
        self.above = 0.4
        """Height of the tool above its point, as a fraction of the range of motion."""
        signals = run.signals
        self._has_arm = "slave_position" in signals
        self._extent = extent
        name = "slave_position" if self._has_arm else "position"
        if is_joints(signals, scene):
            chain = chain_of(signals, name, arms.slave)
            if chain is not None:
                end = ChainEnd(
                    "robot", chain, signals, place=name, command="slave_command", torque="environment_force",
                    colour=colours.ENVIRONMENT_FORCE,
                    metres_per_newton_metre=extent.metres_per_newton_metre,
                )  # fmt: skip
                self.parts, self.arrows, self.trails = end.parts, end.arrows, end.trails
                self.above = CHAIN_ABOVE
                return
            self.parts = dials("robot", signals, name, extent.size)
            self.notes.append("angles only: a scene says no geometry of joints, --arm and --leader name one")
            return
        if not self._has_arm:
            self.notes.append(DEVICE_NOTE)
        self._axes = axes_of(signals)
        self._position = Course(signals, name, points_of)
        self._rotation = Course(signals, "slave_orientation", matrix_of) if "slave_orientation" in signals else None
        self._jaws = "gripper" in signals
        if isinstance(arms.slave, UrModel) and self._axes == 3:
            postures = LiveUrPostures if isinstance(signals, History) else UrPostures
            self.postures = postures(arms.slave, self._position, self._rotation, GRIPPER_M if self._jaws else 0.0)
            self._add_arm(self.postures)
        self._tool = self._pose_of(self._position, self._rotation)
        self._add_tool(signals, scene)
        self._add_command(signals)
        self._add_surroundings(run, scene)
        self._add_forces(signals)

    def _pose_of(self, place: Course, turned: Course | None) -> Pose:
        """base_from_tool of recorded positions, (n, 3), and rotations, (n, 3, 3)."""

        def pose(time_s: float) -> Array | None:
            at, how = place.at(time_s), None if turned is None else turned.at(time_s)
            if not np.isfinite(at).all() or (how is not None and not np.isfinite(how).all()):
                return None
            return transform(at, how) if self.postures is None else self.postures.base_from_tool(at, how)

        return pose

    def _placed(self, points: Array) -> Array:
        """Recorded positions in the drawn frame."""
        if self.postures is None:
            return points
        return points + self.postures.base_from_tool(np.zeros(3), None)[:3, 3]

    def _add_arm(self, postures: UrPostures) -> None:
        self.parts.extend(arm_parts(postures))
        if postures.is_relative:
            self.notes.append("posture of the arm is chosen: the tool is recorded from where it began")
        elif self._jaws:
            self.notes.append(
                "the tool point is taken to be between the jaws: a recording does not say the controller's own"
            )
        if postures.unreached:
            self.notes.append(f"{postures.unreached} poses that the arm cannot reach: it is drawn where it was")

    def _add_tool(self, signals: Signals, scene: Scene | None) -> None:
        size = self._extent.size
        if self.postures is not None and self._jaws:
            self._add_jaws(signals, along=-1.0, length=GRIPPER_M, width=0.085)
            return
        if self._jaws and self._rotation is not None:
            width = (
                0.085
                if scene is None or scene.slave is None or scene.slave.tool is None
                else scene.slave.tool.jaw_width_m
            )
            self._add_jaws(signals, along=1.0, length=1.6 * width, width=width)
            self.above = 1.8 * width / size
            return
        points = tool_points(scene)
        peg = peg_of(points)
        if peg is not None:
            mesh = joined(
                cylinder(peg[0], 0.0, 1.6 * peg[1]), cylinder(1.7 * peg[0], 1.6 * peg[1], 1.6 * peg[1] + 0.5 * peg[0])
            )
        elif self._axes == 1:
            mesh = slider(size)
        else:
            mesh = probe(size)
            self.above = 0.56
        if not self._has_arm:
            # The tip of the device makes contact.
            mesh = sphere(0.045 * size)
        self.parts.append(Part(name="tool", station="robot", mesh=mesh, colour=colours.TOOL, pose=self._tool))
        if self._axes == 1:
            self.parts.append(rail("robot", self._extent))

    def _add_jaws(self, signals: Signals, *, along: float, length: float, width: float) -> None:
        """Add a body and two fingers; `along` is the direction from the tool point to the gripper on its z axis."""
        closed = Course(signals, "gripper")
        finger_length, thick = 0.42 * length, 0.1 * width
        body = placed(
            cylinder(0.42 * width, 0.0, length - finger_length),
            transform(np.array([0.0, 0.0, finger_length if along > 0 else -length])),
        )
        self.parts.append(Part(name="gripper", station="robot", mesh=body, colour=colours.TOOL, pose=self._tool))
        middle = 0.5 * along * (finger_length - 0.25 * finger_length)
        finger = placed(box([0.5 * thick, 0.14 * width, 0.62 * finger_length]), transform(np.array([0.0, 0.0, middle])))
        for sign in (-1.0, 1.0):

            def pose(time_s: float, sign: float = sign) -> Array | None:
                base_from_tool, share = self._tool(time_s), float(closed.at(time_s))
                if base_from_tool is None or not math.isfinite(share):
                    return None
                return base_from_tool @ transform(np.array([sign * (0.5 * width * (1.0 - share) + 0.5 * thick), 0, 0]))

            self.parts.append(
                Part(
                    name=f"jaw {'left' if sign < 0 else 'right'}",
                    station="robot",
                    mesh=finger,
                    colour=colours.JOINT,
                    pose=pose,
                )
            )
        self._jaw_width = width

    def _add_held(self, signals: Signals) -> None:
        """Add the object held by a model's jaws, also where they took it and left it."""
        if "holds_object" not in signals:
            return
        course = Course(signals, "holds_object", lambda of: np.nan_to_num(of.astype(np.float64)))
        holds = course.values > 0.0
        is_live = isinstance(signals, History)
        if not holds.any() and not is_live:
            return
        taken = int(np.argmax(holds))
        share = 0.5 if is_live else float(signals["gripper"][min(taken + 200, len(holds) - 1)])
        half = 0.5 * self._jaw_width * (1.0 - share)
        mesh = box([max(half, 0.004), 0.75 * max(half, 0.01), 1.1 * max(half, 0.01)])

        def pose(time_s: float) -> Array | None:
            now = course.index(time_s)
            held = np.flatnonzero(course.values[: now + 1] > 0.0)
            if len(held):
                return self._tool(time_s) if held[-1] == now else self._tool(float(course.time_s[held[-1]]))
            return None if is_live else self._tool(float(course.time_s[taken]))

        self.parts.append(Part(name="held object", station="robot", mesh=mesh, colour=colours.HELD, pose=pose))
        self.notes.append("held object: between the grips it is drawn where the jaws took it or left it")

    def _add_command(self, signals: Signals) -> None:
        """Add the ghost of the delayed command, and two trails."""
        size = self._extent.size if self.postures is None else 0.25
        rows = [("tool trail", "way of the tool", colours.MEASURED, "slave_position" if self._has_arm else "position")]
        if "slave_command" in signals and self._has_arm:
            command = Course(signals, "slave_command", points_of)
            turned = None
            if "slave_command_orientation" in signals:
                turned = Course(signals, "slave_command_orientation", matrix_of)
            tool = next((part.mesh for part in self.parts if part.name in {"tool", "gripper"}), sphere(0.05 * size))
            sent = self._pose_of(command, turned)
            least_m = 0.012 * size

            def ghost(time_s: float) -> Array | None:
                at, tool_at = sent(time_s), self._tool(time_s)
                if at is None or tool_at is None:
                    return at
                # Hide a ghost that coincides with the tool: it would only tint it.
                apart_m = float(np.linalg.norm(at[:3, 3] - tool_at[:3, 3]))
                apart_rad = float(np.linalg.norm(at[:3, :3] - tool_at[:3, :3])) / math.sqrt(2.0)
                return at if apart_m > least_m or apart_rad > LEAST_TURN else None

            self.parts.append(
                Part(
                    name="ghost of the command",
                    station="robot",
                    mesh=tool,
                    colour=colours.GHOST,
                    opacity=0.35,
                    pose=ghost,
                )
            )
            rows.append(("command trail", "commanded", colours.COMMANDED, "slave_command"))
        for name, label, colour, of in rows:
            self.trails.append(
                Trail(
                    name=name,
                    label=label,
                    station="robot",
                    colour=colour,
                    points=Course(signals, of, lambda points: self._placed(points_of(points))),
                    window_s=TRAIL_S if self._axes == 1 else 1e9,
                    drift=drift(self._extent, self._axes),
                )
            )

    def _add_surroundings(self, run: Run, scene: Scene | None) -> None:
        if scene is None:
            self.notes.append("objects are not drawn: the recording names no scene that is here")
            return
        if self._jaws:
            self._add_held_unless_body(run.signals, scene)
        if self.postures is not None:
            self.parts.append(self._table())
        elif not is_ground(scene):
            self.parts.append(floor("robot", self._extent))
        if scene.environment is None:
            return
        surroundings = Surroundings(scene, run.signals, self._extent)
        offset = self._placed(np.zeros((1, 3)))[0]
        if np.any(offset != 0.0):
            self.notes.append("objects are drawn from where the tool began")
        self.notes.extend(surroundings.notes)
        shift = transform(offset)
        for part in surroundings.parts:
            self.parts.append(
                Part(
                    name=part.name,
                    station="robot",
                    mesh=part.mesh,
                    colour=part.colour,
                    opacity=part.opacity,
                    pose=lambda time_s, of=part.pose: None if (at := of(time_s)) is None else shift @ at,  # type: ignore[misc]
                )
            )
        if self.postures is not None or "environment_force" not in run.signals:
            return
        force = Course(run.signals, "environment_force", lambda of: np.abs(points_of(of)).max(axis=1))
        points = tool_points(scene)
        radius = (0.035 if len(points) < 4 else 0.016) * self._extent.size
        self.parts.extend(
            contacts(surroundings, points, self._tool, lambda time_s: bool(force.at(time_s) > 1e-6), radius)
        )

    def _add_held_unless_body(self, signals: Signals, scene: Scene) -> None:
        bodies = () if scene.environment is None else scene.environment.bodies
        if not bodies and hasattr(self, "_jaw_width"):
            self._add_held(signals)

    def _table(self) -> Part:
        mesh = box([0.55, 0.6, 0.01])
        return Part(
            name="table",
            station="robot",
            mesh=mesh,
            colour=colours.FLOOR,
            pose=still(transform(np.array([0.0, -0.3, -0.01]))),
        )

    def _add_forces(self, signals: Signals) -> None:
        size = self._extent.size if self.postures is None else 0.3
        scale = size / self._extent.size
        for name, label, per, heads in (
            ("environment_force", "on the tool", self._extent.metres_per_newton, 1),
            ("environment_torque", "torque on the tool", self._extent.metres_per_newton_metre, 2),
        ):
            if name not in signals:
                continue
            if not has_force(signals, name):
                continue
            above = np.array([0.0, 0.0, 0.12 * size]) if self._axes == 1 else np.zeros(3)
            self.arrows.append(
                Arrow(
                    name=name,
                    label=label,
                    station="robot",
                    colour=colours.ENVIRONMENT_FORCE,
                    scale=scale * per,
                    thickness_m=0.018 * size,
                    tail=lambda time_s, above=above: (  # type: ignore[misc]
                        np.full(3, np.nan) if (at := self._tool(time_s)) is None else at[:3, 3] + above
                    ),
                    vector=Course(signals, name, points_of).at,
                    heads=2 if heads == 2 else 1,
                )
            )


def tool_points(scene: Scene | None) -> Array:
    """Contact points of the tool, (n, 3) in m in its frame; by default the tool point."""
    tool = None if scene is None or scene.slave is None else scene.slave.tool
    return np.zeros((1, 3)) if tool is None else np.array(tool.points, dtype=np.float64)


def is_ground(scene: Scene) -> bool:
    """True if the scene has a ground: material with a hole, or a level plane."""
    environment = scene.environment
    if environment is None:
        return False
    normals = [thing.shape.normal for thing in environment.objects if isinstance(thing.shape, Plane)]
    level = [normal for normal in normals if isinstance(normal, tuple) and len(normal) == 3 and normal[2] > 0.5]
    return bool(environment.holes or level)


def peg_of(points: Array) -> tuple[float, float] | None:
    """Radius and height in m of a peg about z with these points; None if they lie on no cylinder."""
    if len(points) < 8:
        return None
    radii = np.hypot(points[:, 0], points[:, 1])
    if np.ptp(radii) > 1e-4 * radii.max() + 1e-6 or np.ptp(points[:, 2]) == 0.0:
        return None
    return float(radii.mean()), float(points[:, 2].max())


def slider(size: float) -> Mesh:
    """Carriage on its rail with a round tip, whose foremost point is the tool point."""
    carriage = placed(box([0.075 * size, 0.055 * size, 0.045 * size]), transform(np.array([0.085 * size, 0.0, 0.0])))
    mast = placed(cylinder(0.022 * size, 0.0, 0.16 * size), transform(np.array([0.085 * size, 0.0, 0.0])))
    tip = placed(sphere(0.032 * size), transform(np.array([0.032 * size, 0.0, 0.0])))
    return joined(carriage, mast, tip)


def probe(size: float) -> Mesh:
    """Rod along z with a round tip at the tool point, below a flange."""
    rod = placed(capsule(0.02 * size, 0.42 * size), transform(np.array([0.0, 0.0, 0.02 * size])))
    flange = cylinder(0.085 * size, 0.44 * size, 0.52 * size)
    return joined(rod, flange)
