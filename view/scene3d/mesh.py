"""Triangle meshes with normals, made from profiles, for renderers and pages."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SIDES = 28
"""Facets of round bodies."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in their own frame."""

    points: Array
    """(n, 3) in m."""
    normals: Array
    """Outward unit normals, (n, 3)."""
    triangles: npt.NDArray[np.int32]
    """Indices of points, (k, 3), counter-clockwise from outside."""


def joined(*meshes: Mesh) -> Mesh:
    """Join meshes."""
    begins = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.triangles + begin for mesh, begin in zip(meshes, begins, strict=False)]).astype(np.int32),
    )


def placed(mesh: Mesh, transform: Array) -> Mesh:
    """Transform a mesh by a rigid transform, (4, 4)."""
    rotation = transform[:3, :3]
    return Mesh(mesh.points @ rotation.T + transform[:3, 3], mesh.normals @ rotation.T, mesh.triangles)


def lathed(profile: Sequence[tuple[float, float]], *, smooth: bool = False) -> Mesh:
    """Body of revolution about z.

    Args:
        profile: Pairs of radius and height in m; the outside is to the right of the path.
        smooth: True to interpolate normals across the corners of the profile.
    """
    way = np.asarray(profile, dtype=np.float64)
    along = np.diff(way, axis=0)
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
    if smooth:
        at = np.concatenate([outward[:1], outward[:-1] + outward[1:], outward[-1:]])
        at /= np.maximum(np.linalg.norm(at, axis=1, keepdims=True), 1e-300)
    angle = np.linspace(0.0, math.tau, SIDES + 1)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points, normals, triangles = [], [], []
    for n in range(len(along)):
        for end in (0, 1):
            radius, height = way[n + end]
            normal = at[n + end] if smooth else outward[n]
            points.append(np.column_stack([radius * turn, np.full(len(turn), height)]))
            normals.append(np.column_stack([normal[0] * turn, np.full(len(turn), normal[1])]))
        low = 2 * n * (SIDES + 1) + np.arange(SIDES)
        high = low + SIDES + 1
        if way[n][0] > 0.0:
            triangles.append(np.column_stack([low, low + 1, high + 1]))
        if way[n + 1][0] > 0.0:
            triangles.append(np.column_stack([low, high + 1, high]))
    return Mesh(np.concatenate(points), np.concatenate(normals), np.concatenate(triangles).astype(np.int32))


def sphere(radius: float) -> Mesh:
    """Sphere about the origin."""
    return lathed(_arc(radius, -math.pi / 2, math.pi / 2, 0.0), smooth=True)


def cylinder(radius: float, low: float, high: float) -> Mesh:
    """Closed cylinder along z."""
    return lathed([(0.0, low), (radius, low), (radius, high), (0.0, high)])


def cone(radius: float, low: float, high: float) -> Mesh:
    """Cone along z with its tip at `high`."""
    return lathed([(0.0, low), (radius, low), (0.0, high)])


def capsule(radius: float, length: float) -> Mesh:
    """Cylinder along z from 0 to its length, with hemispherical ends."""
    low = _arc(radius, -math.pi / 2, 0.0, 0.0)
    return lathed(low + _arc(radius, 0.0, math.pi / 2, length), smooth=True)


def _arc(radius: float, begin: float, end: float, height: float) -> list[tuple[float, float]]:
    angles = np.linspace(begin, end, 9)
    rounded = [(radius * math.cos(angle), height + radius * math.sin(angle)) for angle in angles]
    return [(r if r > 1e-9 * radius else 0.0, z) for r, z in rounded]


def torus(radius: float, thickness: float) -> Mesh:
    """Ring about z in the plane z = 0."""
    angles = np.linspace(-math.pi, math.pi, 13)
    ring = [(radius + thickness * math.cos(angle), thickness * math.sin(angle)) for angle in angles]
    return lathed(ring, smooth=True)


def box(half_extents: Sequence[float] | Array) -> Mesh:
    """Box about the origin, along the axes."""
    points: list[Array] = []
    normals, triangles = [], []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, one] = [-1.0, 1.0, 1.0, -1.0]
            corners[:, other] = [-1.0, -1.0, 1.0, 1.0]
            normal = np.zeros(3)
            normal[axis] = sign
            begin = 4 * len(points)
            order = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
            points.append(corners * np.asarray(half_extents))
            normals.append(np.tile(normal, (4, 1)))
            triangles.append(np.array(order) + begin)
    return Mesh(np.concatenate(points), np.concatenate(normals), np.concatenate(triangles).astype(np.int32))


def holed_block(radius: float, depth: float, chamfer: float, half_width: float) -> Mesh:
    """Material with a round hole along -z from its entrance at the origin, open at the outside."""
    outside = [(0.0, -1.25 * depth), (half_width, -1.25 * depth), (half_width, 0.0)]
    edge = [(radius + chamfer, 0.0), (radius, -chamfer)] if chamfer > 0.0 else [(radius, 0.0)]
    return lathed([*outside, *edge, (radius, -depth), (0.0, -depth)])
