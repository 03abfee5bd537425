"""The hand's end: stylus, hand, workspace, and the forces between them."""

import math

import numpy as np
import numpy.typing as npt

from haptether.bridge import Run, Scene, Signals
from haptether.view.scene3d import colours
from haptether.view.scene3d.arms import Arms
from haptether.view.scene3d.chain import ChainEnd, angles_of
from haptether.view.scene3d.extent import Extent, axes_of, chain_of, is_joints, points_of, stops
from haptether.view.scene3d.history import History
from haptether.view.scene3d.mesh import Mesh, box, capsule, cylinder, joined, lathed, placed, sphere
from haptether.view.scene3d.parts import Arrow, Course, Part, Pose, Station, Trail, still
from haptether.view.scene3d.rotation import matrix_of, rotation_to, transform

Array = npt.NDArray[np.float64]

STYLUS_M = 0.62
"""Length of the stylus over the size of its end."""
TILT = np.array([0.0, 0.45, 0.9])
"""Direction in which the stylus leans, away from the viewer."""
TRAIL_S = 2.0


def hand_end(
    run: Run, scene: Scene | None, extent: Extent, arms: Arms
) -> tuple[list[Part], list[Arrow], list[Trail], list[str]]:
    """Parts, arrows, trails, and notes of items not drawn."""
    signals = run.signals
    if is_joints(signals, scene):
        chain = chain_of(signals, "position", arms.master)
        if chain is not None:
            end = ChainEnd(
                "hand", chain, signals, place="position", command="", torque="device_force",
                colour=colours.DEVICE_FORCE, metres_per_newton_metre=extent.metres_per_newton_metre,
            )  # fmt: skip
            return end.parts, end.arrows, end.trails, []
        return dials("hand", signals, "position", extent.size), [], [], []
    size = extent.size
    position = Course(signals, "position", points_of)
    turned = Course(signals, "orientation", matrix_of) if "orientation" in signals else None

    def stylus(now_s: float) -> Array | None:
        at = position.at(now_s)
        if not np.isfinite(at).all():
            return None
        return transform(at, None if turned is None else turned.at(now_s))

    lean = rotation_to(TILT)
    parts = [
        Part(
            name="stylus",
            station="hand",
            colour=colours.DEVICE,
            mesh=placed(stylus_mesh(STYLUS_M * size), transform(np.zeros(3), lean)),
            pose=stylus,
        )
    ]
    grip = lean @ np.array([0.0, 0.0, 0.36 * STYLUS_M * size])
    notes = []
    if scene is not None and scene.operator is None:
        notes.append("nobody holds the device")
    elif "hand_force" in signals:
        released_s = _release_s(run, scene)
        held = Course(signals, "hand_force", lambda force: np.abs(points_of(force)).max(axis=1))
        away = TILT / np.linalg.norm(TILT) * 0.35 * size

        def fingers(now_s: float) -> Array | None:
            at = stylus(now_s)
            if at is None or (now_s > released_s and not bool(held.at(now_s) > 1e-6)):
                return None
            return at @ transform(grip)

        def apart(now_s: float) -> Array | None:
            if not (now_s > released_s and not bool(held.at(now_s) > 1e-6)):
                return None
            where = position.at(released_s)
            return transform(where + grip + away)

        hand = hand_mesh(size)
        parts.append(Part(name="hand", station="hand", colour=colours.HAND, mesh=hand, pose=fingers))
        parts.append(Part(name="hand, open", station="hand", colour=colours.HAND, mesh=hand, pose=apart, opacity=0.35))
    else:
        notes.append("the hand is not drawn: what it does is not recorded, only estimated")
    if axes_of(signals) == 1:
        parts.append(rail("hand", extent))
    if (corners := stops(scene, axes_of(signals))) is not None:
        parts.extend(workspace(corners, size))
    parts.append(floor("hand", extent))
    trail = Trail(
        name="hand trail",
        label="way of the hand",
        station="hand",
        colour=colours.MEASURED,
        points=position,
        window_s=TRAIL_S,
        drift=drift(extent, axes_of(signals)),
    )
    return parts, _arrows(signals, extent, stylus, grip), [trail], notes


def _release_s(run: Run, scene: Scene | None) -> float:
    """Time of the release in s: as recorded, or as in the scene of a modelled hand."""
    release = None if scene is None or scene.operator is None else scene.operator.release
    planned_s = getattr(release, "at_s", None)
    otherwise = math.inf if planned_s is None else float(planned_s)
    return next((event.time_s for event in run.events if event.kind == "release"), otherwise)


def _arrows(signals: Signals, extent: Extent, stylus: Pose, grip: Array) -> list[Arrow]:
    """Forces: the device's at the tip of the stylus, the controllers' above it."""
    size = extent.size
    hand_force = "hand_force" if "hand_force" in signals else "grasp_force"
    of_hand = "of the hand" if hand_force == "hand_force" else "of the hand, estimated"
    rows = [
        ("device_force", "on the hand", colours.DEVICE_FORCE, np.zeros(3), 1),
        (hand_force, of_hand, colours.HAND_FORCE, grip, 1),
        ("safety_force", "of the controllers", colours.SAFETY_FORCE, 0.5 * grip, 1),
        ("device_torque", "torque on the hand", colours.DEVICE_FORCE, np.zeros(3), 2),
        (hand_force.replace("force", "torque"), f"torque {of_hand}", colours.HAND_FORCE, grip, 2),
    ]
    arrows = []
    for name, label, colour, at, heads in rows:
        if not has_force(signals, name):
            continue

        def tail(now_s: float, at: Array = at) -> Array:
            where = stylus(now_s)
            return np.full(3, np.nan) if where is None else np.asarray(where[:3, :3] @ at + where[:3, 3])

        arrows.append(
            Arrow(
                name=name,
                label=label,
                station="hand",
                colour=colour,
                scale=extent.metres_per_newton if heads == 1 else extent.metres_per_newton_metre,
                thickness_m=0.018 * size,
                tail=tail,
                vector=Course(signals, name, points_of).at,
                heads=2 if heads == 2 else 1,
            )
        )
    return arrows


def drift(extent: Extent, axes: int) -> Array:
    """Drift of a one-axis trail, backwards as on a chart recorder; zero for several axes."""
    return np.array([0.0, 0.33 * extent.size / TRAIL_S, 0.0]) if axes == 1 else np.zeros(3)


def stylus_mesh(length: float) -> Mesh:
    """Pen along z with its tip at the origin."""
    radius = 0.055 * length
    barrel = [(0.0, 0.0), (0.25 * radius, 0.02 * length), (radius, 0.2 * length), (radius, 0.92 * length)]
    return lathed([*barrel, (0.7 * radius, 0.98 * length), (0.0, length)])


def hand_mesh(size: float) -> Mesh:
    """Palm and two fingers, about the grip."""
    palm = placed(sphere(0.1 * size), transform(np.array([0.06, 0.1, 0.06]) * size))
    finger = placed(
        capsule(0.032 * size, 0.13 * size),
        transform(np.array([-0.03, -0.03, 0.0]) * size, rotation_to(np.array([0.4, 0.9, 0.35]))),
    )
    thumb = placed(
        capsule(0.032 * size, 0.12 * size),
        transform(np.array([0.035, -0.03, -0.01]) * size, rotation_to(np.array([0.1, 0.9, 0.4]))),
    )
    return joined(palm, finger, thumb)


def rail(station: Station, extent: Extent) -> Part:
    """Rail for motion along one axis."""
    low, high = float(extent.low[0]) - 0.12 * extent.size, float(extent.high[0]) + 0.12 * extent.size
    mesh = placed(
        cylinder(0.012 * extent.size, 0.0, high - low),
        transform(np.array([low, 0.0, 0.0]), rotation_to(np.array([1.0, 0.0, 0.0]))),
    )
    return Part(
        name=f"{station} rail",
        station=station,
        mesh=mesh,
        colour=colours.WORKSPACE,
        pose=still(np.eye(4)),
    )


def floor(station: Station, extent: Extent) -> Part:
    """Ground below the view."""
    lowest = float(extent.low[2]) - 0.2 * extent.size
    middle = extent.centre
    at = np.array([middle[0], middle[1] + 0.1 * extent.size, lowest])
    return Part(
        name=f"{station} floor",
        station=station,
        mesh=box([0.68 * extent.size, 0.42 * extent.size, 0.006 * extent.size]),
        colour=colours.FLOOR,
        opacity=0.75,
        pose=still(transform(at)),
    )


def workspace(corners: Array, size: float) -> list[Part]:
    """Mechanical stops: two end plates for one axis, the edges of a box for more."""
    low, high = corners
    spans = high - low
    if spans[1] == 0.0 and spans[2] == 0.0:
        plate = box([0.012 * size, 0.07 * size, 0.07 * size])
        return [
            Part(
                name=f"stop {number}",
                station="hand",
                mesh=plate,
                colour=colours.WORKSPACE,
                pose=still(transform(np.array([at, 0.0, 0.0]))),
            )
            for number, at in enumerate((low[0] - 0.012 * size, high[0] + 0.012 * size))
        ]
    edges = []
    for axis in range(3):
        if spans[axis] == 0.0:
            continue
        one, other = (axis + 1) % 3, (axis + 2) % 3
        for a in {low[one], high[one]}:
            for b in {low[other], high[other]}:
                begin = np.zeros(3)
                begin[[axis, one, other]] = low[axis], a, b
                direction = np.zeros(3)
                direction[axis] = 1.0
                edge = cylinder(0.004 * size, 0.0, float(spans[axis]))
                edges.append(placed(edge, transform(begin, rotation_to(direction))))
    return [
        Part(name="workspace", station="hand", mesh=joined(*edges), colour=colours.WORKSPACE, pose=still(np.eye(4)))
    ]


def has_force(signals: Signals, name: str) -> bool:
    """True if a force or torque acts at some time, or may act in a live run."""
    return name in signals and (
        isinstance(signals, History) or bool(np.nanmax(np.abs(signals[name]), initial=0.0) > 0.0)
    )


def dials(station: Station, signals: Signals, name: str, size: float) -> list[Part]:
    """Dial with a pointer per joint, for a side of unknown geometry."""
    values = signals[name]
    joints = 1 if values.ndim == 1 else values.shape[1]
    step = 2.0 * size / joints
    face = lathed([(0.0, -0.05 * step), (0.42 * step, -0.05 * step), (0.42 * step, 0.0), (0.0, 0.0)])
    pointer = placed(capsule(0.035 * step, 0.34 * step), transform(np.zeros(3), rotation_to(np.array([0.0, 0.0, 1.0]))))
    towards = rotation_to(np.array([0.0, -1.0, 0.0]))
    parts = []
    for joint in range(joints):
        at = np.array([(joint + 0.5) * step - size, 0.0, 0.0])
        course = Course(signals, name, lambda q, joint=joint: angles_of(q)[:, joint])  # type: ignore[misc]

        def pose(now_s: float, at: Array = at, course: Course = course) -> Array | None:
            angle = float(course.at(now_s))
            if not math.isfinite(angle):
                return None
            c, s = math.cos(angle), math.sin(angle)
            return transform(at - np.array([0.0, 0.02 * step, 0.0]), np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))

        face_at = transform(at, towards)
        parts.append(
            Part(
                name=f"{station} dial {joint + 1}",
                station=station,
                mesh=face,
                colour=colours.FLOOR,
                pose=still(face_at),
            )
        )
        parts.append(
            Part(name=f"{station} joint {joint + 1}", station=station, mesh=pointer, colour=colours.DEVICE, pose=pose)
        )
    return parts
