"""Paths of poses for a UR arm: for the bench of its poses and the tests of its modes."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from haptether.slave.ur.kinematics.pose import (
    Quaternion,
    Vector,
    quat_product,
    quat_wxyz_from_rotvec,
    turn_between,
)

APART_S = 1e-6
"""Time between the two poses whose difference is the twist: accurate to 1e-9."""


class Pose(NamedTuple):
    """Pose and its twist, in the base frame, in m, m/s and rad/s; `quat_wxyz`."""

    position: Vector
    velocity: Vector
    orientation: Quaternion
    angular_velocity: Vector


Path = Callable[[float], Pose]
"""Returns the pose at a time in s."""


def figure(home: Sequence[float], *, amplitude_m: float, angle: float, period_s: float) -> Path:
    """Return a figure of three sines in space around a controller pose, x y z rx ry rz, that turns back and forth.

    Along x, y and z by sines of 1, 2 and 3 times the frequency; `exp(a s_1 e_z) exp(a s_2 e_x / 2)` before the initial
    orientation. Amplitudes rise within 1 s.
    """
    begin = quat_wxyz_from_rotvec(home[3:])

    def at(t: float) -> tuple[Vector, Quaternion]:
        share = 0.5 * (1.0 - math.cos(math.pi * min(max(t, 0.0), 1.0)))
        s1, s2, s3 = (share * math.sin(2.0 * math.pi * n * t / period_s) for n in (1, 2, 3))
        position = home[0] + amplitude_m * s1, home[1] + amplitude_m * s2, home[2] + amplitude_m * s3
        turned = quat_product(
            quat_wxyz_from_rotvec((0.0, 0.0, angle * s1)), quat_wxyz_from_rotvec((0.5 * angle * s2, 0.0, 0.0))
        )
        return position, quat_product(turned, begin)

    return _with_twist(at)


def turn(home: Sequence[float], *, axis: Sequence[float], angle: float, speed: float) -> Path:
    """Return a turn about a unit axis of the base by an angle in rad, at most at `speed` in rad/s.

    The tool's point rests.
    """
    begin = quat_wxyz_from_rotvec(home[3:])
    # The fastest of (1 - cos)/2 is pi/2 times its mean.
    duration_s = 0.5 * math.pi * angle / speed

    def at(t: float) -> tuple[Vector, Quaternion]:
        share = 0.5 * (1.0 - math.cos(math.pi * min(max(t / duration_s, 0.0), 1.0)))
        turned = quat_wxyz_from_rotvec([share * angle * part for part in axis])
        return (home[0], home[1], home[2]), quat_product(turned, begin)

    return _with_twist(at)


def apart(pose: Sequence[float], wanted: Pose) -> tuple[float, float]:
    """Return the distance of a controller pose from another, in m and rad."""
    tool = quat_wxyz_from_rotvec(pose[3:])
    return math.dist(pose[:3], wanted.position), math.hypot(*turn_between(tool, wanted.orientation))


def _with_twist(at: Callable[[float], tuple[Vector, Quaternion]]) -> Path:
    def pose(t: float) -> Pose:
        (before, first), (after, last) = at(t - 0.5 * APART_S), at(t + 0.5 * APART_S)
        vx, vy, vz = ((b - a) / APART_S for a, b in zip(before, after, strict=True))
        wx, wy, wz = (part / APART_S for part in turn_between(first, last))
        position, orientation = at(t)
        return Pose(position, (vx, vy, vz), orientation, (wx, wy, wz))

    return pose
