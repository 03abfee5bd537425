"""From a set-point of the tool to joint angles, orientation kept, within the limits of the joints."""

from typing import TYPE_CHECKING, Final

import numpy as np

from haptether.slave.ur.options import Three, UrOptions
from haptether.slave.ur.setpoint import SetPoint
from haptether.slave.ur.state import UrState
from haptether.slave.ur_pose import rotvec_from_matrix

if TYPE_CHECKING:
    from haptether.slave.ur_kinematics import UrKinematics

CLOSING_PERIODS: Final = 4.0
"""Periods in which the joints close in on the set-point."""
MAX_BEHIND_M: Final = 0.02
"""How far the joints may stay behind it: what more there is would be made up for at once, somewhere else."""
JOINT_ACCELERATION: Final = 25.0
"""rad/s² at most: what the bounds of the tool ask for over the shortest lever, not what makes it smooth."""
JOINT_SPEED_SHARE: Final = 0.9
"""Of the largest speed of a joint: what is commanded stays this far below."""


class UnreachableError(ValueError):
    """The arm cannot go on to where it is sent."""


class Joints:
    """From a set-point of the tool to joint angles, orientation kept, within the limits of the joints.

    Each period the joint velocities are those that follow `v_set + (x_set - x)/T` best within the limits
    (`UrStreaming`): near a singularity, or at the end of a joint, the tool stays behind instead of a joint
    going faster than it may.

    The unit's chain is only nearly that of its model, so motion is counted from where both have the tool at the begin:
    what they differ by stays where it was, and the first command is exactly where the joints are.

    Args:
        kinematics: The arm with its tool.
        options: Of the driver.
        period_s: Between two commands, in s.
    """

    def __init__(self, kinematics: "UrKinematics", options: UrOptions, period_s: float) -> None:
        from haptether.slave.streaming_limits import StreamingLimits  # noqa: PLC0415  # with CasADi
        from haptether.slave.ur_streaming import UrStreaming  # noqa: PLC0415

        model = kinematics.model
        speeds = [JOINT_SPEED_SHARE * most for most in model.max_speed]
        limits = StreamingLimits(
            position_min=model.position_min,
            position_max=model.position_max,
            max_speed=(speeds[0], speeds[1], speeds[2], speeds[3], speeds[4], speeds[5]),
            max_acceleration=(JOINT_ACCELERATION,) * 6,
        )
        self._kinematics = kinematics
        self._streaming = UrStreaming(kinematics, limits, period_s=period_s)
        self._period_s = period_s
        self._rate_hz = 1.0 / (CLOSING_PERIODS * period_s)
        self._longest_m = max(options.max_jump, MAX_BEHIND_M)
        self._turn = np.eye(3)
        self._twist = np.zeros(6)
        self.offset = np.zeros(3)
        """From the controller's tool to that of the model, in m."""
        self.q = np.zeros(6)
        self.qd = np.zeros(6)

    def begin(self, state: UrState) -> None:
        """Motion begins where the arm is."""
        transform = self._kinematics.forward(state.q)
        self._turn = np.array(transform[:3, :3])
        self.offset = transform[:3, 3] - np.array(state.pose[:3])
        self.q, self.qd = np.array(state.q), np.zeros(6)

    def follow(self, point: SetPoint, elapsed_s: float) -> None:
        """Goes on for a time in s, in whole periods.

        Raises:
            UnreachableError: The tool stays far behind.
        """
        target = np.array(point.position) + self.offset
        velocity = np.array(point.velocity)
        for _ in range(max(1, round(elapsed_s / self._period_s))):
            transform = self._kinematics.forward(self.q)
            behind = target - transform[:3, 3]
            # As in `SetPoint`: from where the target was a period ago.
            self._twist[:3] = velocity + (behind - velocity * self._period_s) * self._rate_hz
            self._twist[3:] = rotvec_from_matrix(self._turn @ transform[:3, :3].T)
            self._twist[3:] *= self._rate_hz
            self.qd = np.array(self._streaming.velocity(self.q, self.qd, self._twist))
            self.q = self.q + self.qd * self._period_s
        away = float(np.linalg.norm(behind))
        if away > self._longest_m:
            why = self._streaming.reason or "its joints are at their limits, or the arm is near a singularity"
            message = f"the tool cannot follow: {1e3 * away:.0f} mm behind {_text(point.position)} m: {why}"
            raise UnreachableError(message)


def _text(position: Three) -> str:
    return ", ".join(f"{part:.4f}" for part in position)
