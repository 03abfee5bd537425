"""Jogging: velocities in the frame of the base, of the tool, or of a feature."""

from dataclasses import dataclass

import numpy as np

from haptether.slave.ur_emulator.robot.kinematics import Array, Six, six
from haptether.slave.ur_pose import matrix_from_rotvec

BASE, TOOL, FEATURE = 0, 1, 2


@dataclass(frozen=True, slots=True)
class JogSpeed:
    """What jogStart asked for."""

    speeds: Six
    feature: int
    acceleration: float
    frame: Six

    def in_base(self, tool: Array) -> Six:
        """Velocity in the frame of the base, given base_from_tool, (4, 4)."""
        if self.feature == BASE:
            return self.speeds
        turn = tool[:3, :3] if self.feature == TOOL else matrix_from_rotvec(self.frame[3:])
        return six((np.array(self.speeds).reshape(2, 3) @ turn.T).ravel())
