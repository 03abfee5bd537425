"""Poses between two poses."""

import math
from dataclasses import dataclass, field

from haptether.slave.ur_pose import (
    Quaternion,
    quat_wxyz_from_rotvec,
    rotvec_from_quat_wxyz,
)

Six = tuple[float, ...]


def quat_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton's product of two quaternions, `quat_wxyz`."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


@dataclass(slots=True)
class PosePath:
    """From one pose straight to another, turning about a fixed axis of the first one's frame."""

    start: Six
    end: Six
    _first: Quaternion = field(init=False)
    _turn: tuple[float, float, float] = field(init=False)

    def __post_init__(self) -> None:
        w, x, y, z = self._first = quat_wxyz_from_rotvec(self.start[3:])
        self._turn = rotvec_from_quat_wxyz(quat_product((w, -x, -y, -z), quat_wxyz_from_rotvec(self.end[3:])))

    @property
    def length(self) -> float:
        """Its length in m, or its angle in rad where that is more."""
        return max(math.dist(self.start[:3], self.end[:3]), math.hypot(*self._turn))

    def at(self, share: float) -> Six:
        """The pose at a share of the way."""
        place = tuple(a + share * (b - a) for a, b in zip(self.start[:3], self.end[:3], strict=True))
        turned = quat_product(self._first, quat_wxyz_from_rotvec([share * angle for angle in self._turn]))
        return (*place, *rotvec_from_quat_wxyz(turned))
