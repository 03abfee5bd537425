"""Objects of a scene's environment (walls, balls, boxes, holes, handles, bodies) and contacts of the tool."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from haptether.bridge import (
    Box,
    HandleTable,
    HoleTable,
    MotionTable,
    ObjectTable,
    Plane,
    RigidBodyTable,
    Scene,
    Signals,
    Sphere,
)
from haptether.view.scene3d import colours
from haptether.view.scene3d.extent import Extent, axes_of, vector_of
from haptether.view.scene3d.mesh import Mesh, box, capsule, cylinder, holed_block, joined, placed, sphere, torus
from haptether.view.scene3d.parts import Course, Part, Pose, still
from haptether.view.scene3d.rotation import matrix_of, rotation_to, transform, turn_about

Array = npt.NDArray[np.float64]
Depth = Callable[[Array, float], float]
"""Depth in m of a point, (3,), in an object at a time; negative outside."""


def moved(motion: MotionTable | None, time_s: float, axes: int) -> Array:
    """Displacement in m, (3,), of a moving object: velocity from `from_s` to `until_s`, plus a sine."""
    if motion is None:
        return np.zeros(3)
    until_s = math.inf if motion.until_s is None else motion.until_s
    lasted_s = min(max(time_s - motion.from_s, 0.0), until_s - motion.from_s)
    sine = math.sin(math.tau * motion.frequency_hz * time_s)
    return vector_of(motion.velocity, axes) * lasted_s + vector_of(motion.amplitude, axes) * sine


class Surroundings:
    """Parts of an environment, and depth of points in them."""

    def __init__(self, scene: Scene, signals: Signals, extent: Extent) -> None:
        self.parts: list[Part] = []
        self.notes: list[str] = []
        """Items not drawn, and why."""
        self.holds_objects = False
        """True if the jaws carry a drawn object."""
        self._depths: list[Depth] = []
        self._axes = axes_of(signals)
        environment = scene.environment
        if environment is None:
            return
        for number, thing in enumerate(environment.objects):
            self._add_object(f"object {number}", thing, extent)
        for number, hole in enumerate(environment.holes):
            self._add_hole(f"hole {number}", hole, extent)
        for number, handle in enumerate(environment.handles):
            self._add_handle(number, handle, signals)
        for number, body in enumerate(environment.bodies):
            self._add_body(number, body, signals)

    def depth(self, point: Array, time_s: float) -> float:
        """Depth in m of a point in the deepest object; negative outside, -inf without objects."""
        return max((of(point, time_s) for of in self._depths), default=-math.inf)

    def _add_object(self, name: str, thing: ObjectTable, extent: Extent) -> None:
        axes, shape = self._axes, thing.shape
        if thing.body is not None:
            self.notes.append(f"{name} slides: where it is is not recorded, faint where it began")
        if isinstance(shape, Plane):
            normal = vector_of(shape.normal if shape.normal is not None else [1.0] + [0.0] * (axes - 1), axes)
            at = transform(vector_of(shape.point, axes), rotation_to(normal))
            at[:3, 3] += _across(normal) @ (extent.centre - at[:3, 3])
            point = vector_of(shape.point, axes)
            mesh, depth = slab(extent, point, normal), _plane_depth(point, normal)
        elif isinstance(shape, Sphere):
            centre = vector_of(shape.centre, axes)
            at, mesh, depth = transform(centre), sphere(shape.radius), _sphere_depth(centre, shape.radius)
        elif isinstance(shape, Box):
            centre, half = vector_of(shape.centre, axes), vector_of(shape.half_extents, axes)
            drawn = np.where(half > 0.0, half, 0.15 * extent.size)
            at, mesh, depth = transform(centre), box(drawn), _box_depth(centre, half, axes)
        else:
            anchor = vector_of(shape.anchor, axes)
            at, mesh, depth = transform(anchor), sphere(0.03 * extent.size), None
        if depth is not None and thing.body is None:
            self._depths.append(_moving(depth, thing.motion, axes))
        self.parts.append(
            Part(
                name=name,
                station="robot",
                mesh=mesh,
                colour=colours.OBJECT,
                opacity=0.3 if thing.body is not None else 0.5 if isinstance(shape, Plane) else 0.75,
                pose=lambda time_s: transform(moved(thing.motion, time_s, axes)) @ at,
            )
        )

    def _add_hole(self, name: str, hole: HoleTable, extent: Extent) -> None:
        at = transform(np.array(hole.entrance), rotation_to(np.array(hole.axis)))
        half_width = max(3.0 * (hole.radius + hole.chamfer_m), 0.45 * extent.size)
        mesh = holed_block(hole.radius, hole.depth, hole.chamfer_m, half_width)
        self._depths.append(_hole_depth(at, hole))
        self.parts.append(
            Part(name=name, station="robot", mesh=mesh, colour=colours.OBJECT, opacity=0.45, pose=still(at))
        )

    def _add_handle(self, number: int, handle: HandleTable, signals: Signals) -> None:
        if "handle_angle" not in signals:
            self.notes.append(f"handle {number} is not drawn: its angle is not recorded, --set record.every=1")
            return
        angle = Course(signals, "handle_angle", lambda angles: angles.reshape(len(angles), -1)[:, number])
        point, axis, grip = np.array(handle.point), np.array(handle.axis), np.array(handle.grip)
        lever = _across(axis) @ (grip - point)
        radius = float(np.linalg.norm(lever))
        frame = rotation_to(axis)
        along = frame[:, 2] * (frame[:, 2] @ (grip - point))
        if radius > 1e-6:
            frame = np.column_stack([lever / radius, np.cross(frame[:, 2], lever / radius), frame[:, 2]])
        wheel_radius = radius if radius > 1e-6 else 0.45 * max(float(np.linalg.norm(along)), handle.reach_m)
        at = transform(point + along, frame)

        def pose(now_s: float) -> Array:
            turned = transform(point, turn_about(axis, float(angle.at(now_s)))) @ transform(-point)
            out: Array = turned @ at
            return out

        mesh = wheel(wheel_radius)
        self.parts.append(Part(name=f"handle {number}", station="robot", mesh=mesh, colour=colours.OBJECT, pose=pose))
        stem = max(float(np.linalg.norm(along)), 0.3 * wheel_radius)
        lower = transform(point + along - stem * frame[:, 2], frame)
        self.parts.append(
            Part(
                name=f"stem {number}",
                station="robot",
                mesh=cylinder(0.1 * wheel_radius, 0.0, stem),
                colour=colours.TOOL,
                pose=still(lower),
            )
        )

    def _add_body(self, number: int, body: RigidBodyTable, signals: Signals) -> None:
        if "body_position" not in signals:
            self.notes.append(f"body {number} is not drawn: where it is is not recorded, --set record.every=1")
            return
        self.holds_objects = True
        position = Course(signals, "body_position", lambda at: at.reshape(len(at), -1, 3)[:, number])
        rotation = Course(signals, "body_orientation", lambda quat: quat.reshape(len(quat), -1, 4)[:, number])
        self.parts.append(
            Part(
                name=f"body {number}",
                station="robot",
                mesh=box(body.half_extents),
                colour=colours.HELD,
                pose=lambda now_s: transform(position.at(now_s), matrix_of(rotation.at(now_s))),
            )
        )


def contacts(
    surroundings: Surroundings,
    points: Array,
    tool: Pose,
    is_touching: Callable[[float], bool],
    radius: float,
) -> Iterator[Part]:
    """Yield a mark at each point of the tool, (n, 3) in its frame, that is in contact while a force acts."""
    for number, point in enumerate(points):

        def pose(time_s: float, point: Array = point) -> Array | None:
            base_from_tool = tool(time_s)
            if base_from_tool is None or not is_touching(time_s):
                return None
            at = base_from_tool[:3, :3] @ point + base_from_tool[:3, 3]
            return transform(at) if surroundings.depth(at, time_s) >= 0.0 else None

        yield Part(name=f"contact {number}", station="robot", mesh=sphere(radius), colour=colours.CONTACT, pose=pose)


def slab(extent: Extent, point: Array, normal: Array) -> Mesh:
    """Material below a plane, with its normal along the mesh's z axis, as wide as the view."""
    unit = normal / np.linalg.norm(normal)
    upright = abs(unit[2]) < 0.5
    # Thick enough to show the tool inside.
    deepest = max(0.0, float(unit @ (point - np.where(unit > 0.0, extent.low, extent.high))))
    thickness = max(0.06 * extent.size, deepest + (0.14 if upright else 0.04) * extent.size)
    side = (0.2 if upright else 0.62) * extent.size
    return placed(box([side, side, 0.5 * thickness]), transform(np.array([0.0, 0.0, -0.5 * thickness])))


def wheel(radius: float) -> Mesh:
    """Hand wheel about z, its rim in the plane z = 0, with a knob on one spoke."""
    rim = torus(radius, 0.09 * radius)
    directions = [np.array([math.cos(a), math.sin(a), 0.0]) for a in (0.0, math.tau / 3.0, 2.0 * math.tau / 3.0)]
    spoke = capsule(0.06 * radius, radius)
    spokes = [placed(spoke, transform(np.zeros(3), rotation_to(direction))) for direction in directions]
    knob = placed(capsule(0.1 * radius, 0.35 * radius), transform(np.array([radius, 0.0, 0.0])))
    return joined(rim, *spokes, knob, cylinder(0.18 * radius, -0.12 * radius, 0.12 * radius))


def _across(normal: Array) -> Array:
    unit = normal / np.linalg.norm(normal)
    return np.asarray(np.eye(3) - np.outer(unit, unit))


def _moving(depth: Depth, motion: MotionTable | None, axes: int) -> Depth:
    return lambda at, time_s: depth(at - moved(motion, time_s, axes), time_s)


def _plane_depth(point: Array, normal: Array) -> Depth:
    unit = normal / np.linalg.norm(normal)
    return lambda at, _: float(unit @ (point - at))


def _sphere_depth(centre: Array, radius: float) -> Depth:
    return lambda at, _: radius - float(np.linalg.norm(at - centre))


def _box_depth(centre: Array, half: Array, axes: int) -> Depth:
    return lambda at, _: float(np.min((half - np.abs(at - centre))[: min(axes, 3)]))


def _hole_depth(base_from_hole: Array, hole: HoleTable) -> Depth:
    """Depth in the material around a hole: below its face, outside its chamfered radius or depth."""

    def depth(at: Array, _: float) -> float:
        x, y, z = base_from_hole[:3, :3].T @ (at - base_from_hole[:3, 3])
        radius = hole.radius + max(0.0, z + hole.chamfer_m)
        return float(max(min(-z, math.hypot(x, y) - radius), -hole.depth - z))

    return depth
