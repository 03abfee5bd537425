"""An arm of servos as capsules from joint to joint, from its description."""

import math

import numpy as np
import numpy.typing as npt

from haptether.dynamixel.description import ArmDescription
from haptether.view.scene3d import colours
from haptether.view.scene3d.mesh import capsule, cylinder, sphere
from haptether.view.scene3d.parts import Course, Part, Station
from haptether.view.scene3d.rotation import matrix_of, rotation_to, transform, turn_about

Array = npt.NDArray[np.float64]

LEAST_LINK_M = 1e-4


def chain_frames(arm: ArmDescription, q: Array) -> Array:
    """base_from_joint, turned by its angle, of each joint, and base_from_tool, (n + 1, 4, 4).

    `T_i = T_(i-1) Trans(xyz_i) Rot(axis_i, q_i)`.
    """
    frames = [np.eye(4)]
    for joint, angle in zip(arm.joints, q, strict=True):
        turn = turn_about(np.array(joint.axis), float(angle))
        frames.append(frames[-1] @ transform(np.array(joint.xyz_m), turn))
    tool = transform(np.array(arm.tool.xyz_m), matrix_of(np.array(arm.tool.quat_wxyz)))
    return np.stack([*frames[1:], frames[-1] @ tool])


def chain_corners(arm: ArmDescription, angles: Array) -> Array:
    """Lower and upper corner of where joints and tool are, (2, 3) in m.

    Args:
        arm: The arm.
        angles: (n, joints) in rad; of what is not known, the arm may be anywhere that it reaches.
    """
    known = angles[np.isfinite(angles).all(axis=1)]
    if not len(known):
        reach = sum(math.hypot(*joint.xyz_m) for joint in arm.joints) + math.hypot(*arm.tool.xyz_m)
        return np.array([[-0.6 * reach, -0.6 * reach, 0.0], [0.6 * reach, 0.6 * reach, 0.9 * reach]])
    some = known[:: max(1, len(known) // 60)]
    points = np.concatenate([chain_frames(arm, q)[:, :3, 3] for q in some] + [np.zeros((1, 3))])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def chain_parts(station: Station, arm: ArmDescription, angles: Course) -> list[Part]:
    """A cylinder for each servo, a capsule for each link, and the tool."""
    lengths = [math.hypot(*joint.xyz_m) for joint in arm.joints]
    radius = 0.045 * (sum(lengths) + math.hypot(*arm.tool.xyz_m)) / 1.6

    def frames(time_s: float) -> Array | None:
        q = angles.at(time_s)
        return chain_frames(arm, q) if np.isfinite(q).all() else None

    parts = []
    ends = [*(np.array(joint.xyz_m) for joint in arm.joints), np.array(arm.tool.xyz_m)]
    for index, (end, length) in enumerate(zip(ends, [*lengths, math.hypot(*arm.tool.xyz_m)], strict=True)):
        if length > LEAST_LINK_M:
            local = transform(np.zeros(3), rotation_to(end))

            def link(time_s: float, index: int = index, local: Array = local) -> Array | None:
                known = frames(time_s)
                if known is None:
                    return None
                return local if index == 0 else np.asarray(known[index - 1] @ local)

            parts.append(
                Part(
                    name=f"{station} link {index}", station=station, colour=colours.ARM,
                    mesh=capsule(0.6 * radius, length), pose=link,
                )
            )  # fmt: skip
    for index, joint in enumerate(arm.joints):
        along = transform(np.zeros(3), rotation_to(np.array(joint.axis)))

        def servo(time_s: float, index: int = index, along: Array = along) -> Array | None:
            known = frames(time_s)
            return None if known is None else np.asarray(known[index] @ along)

        parts.append(
            Part(
                name=f"{station} joint {index + 1}", station=station, colour=colours.JOINT,
                mesh=cylinder(radius, -radius, radius), pose=servo,
            )
        )  # fmt: skip

    def tool(time_s: float) -> Array | None:
        known = frames(time_s)
        return None if known is None else np.asarray(known[-1])

    name = "tool" if station == "robot" else "handle"
    parts.append(
        Part(name=name, station=station, colour=colours.TOOL, mesh=sphere(0.9 * radius), pose=tool)
    )  # fmt: skip
    parts.append(
        Part(
            name=f"{station} base", station=station, colour=colours.JOINT,
            mesh=cylinder(1.8 * radius, -0.6 * radius, 0.6 * radius), pose=lambda _: np.eye(4),
        )
    )  # fmt: skip
    return parts
