"""Packages of a UR controller that follow from the packages before them."""

import math
from typing import Final

from haptether.slave.ur.kinematics.pose import (
    quat_product,
    quat_wxyz_from_rotvec,
    rotvec_near,
    turn_between,
)
from haptether.slave.ur.options import Three
from haptether.slave.ur.state import Numbers, UrState

MAX_WRONG: Final = 3
"""Largest number of packages in a row that are replaced as wrong."""
MAX_JOINT_RAD_S: Final = 3.0 * math.pi
"""1.5 times the fastest joint of any model."""
MAX_CHANGE: Final = MAX_JOINT_RAD_S / 8.0
"""Largest change of a velocity between two packages: rad/s of a joint and of the tool, m/s of the tool's point at a
lever of 1 m. At 500 Hz this is 20 times the largest commanded acceleration.
"""
PAUSE_S: Final = 0.02
"""Longest time in s between two packages of which the second confirms the first, and of motion that is predicted."""


class PlausibleStates:
    """Plausible states of an arm, from package to package.

    A package follows from another, a time T earlier, if for joints, tool point and tool orientation alike

        |x - x_0 - v_0 T| <= dV T    and    |v - v_0| <= dV

    with dV = `MAX_CHANGE` and T of the controller's clock, from one period to `PAUSE_S`. A package that does not follow
    from the last plausible state is wrong: the path continues with constant velocity instead. After three wrong ones
    in a row the fourth is accepted, and the arm is judged by it.

    Args:
        period_s: Period of the packages in s.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._package: UrState | None = None
        """Newest package."""
        self._state: UrState | None = None
        """Last plausible package."""
        self._wrong = 0
        self.in_a_row = 0
        """Number of packages in a row that each follow from the one before within `PAUSE_S`."""
        self.replaced = 0
        """Number of replaced packages."""

    @property
    def confirmed(self) -> bool:
        """True if a motion may begin: more packages follow from each other than may be wrong."""
        return self.in_a_row > MAX_WRONG

    def restart(self) -> None:
        """Forget all packages; the next one begins the path."""
        self._package = self._state = None
        self._wrong = self.in_a_row = 0

    def take(self, state: UrState) -> UrState:
        """Return a finite package if it is plausible; otherwise the prediction, with its time and status."""
        before, last = self._package, self._state
        self._package = state
        follows = before is not None and self._follows(before, state)
        connected = follows and before is not None and state.timestamp - before.timestamp <= PAUSE_S
        self.in_a_row = self.in_a_row + 1 if connected else 1
        if last is not None and self._wrong < MAX_WRONG:
            on_path = follows if last is before else self._follows(last, state)
            if not on_path:
                self._wrong += 1
                self.replaced += 1
                return self._predicted(last, state)
        self._state, self._wrong = state, 0
        return state

    def _span_s(self, last: UrState, state: UrState) -> float:
        # In this order a time that is not finite counts as one period.
        return min(max(self._period_s, state.timestamp - last.timestamp), PAUSE_S)

    def _follows(self, last: UrState, state: UrState) -> bool:
        span_s = self._span_s(last, state)
        for q, qd, q_0, qd_0 in zip(state.q, state.qd, last.q, last.qd, strict=True):
            if abs(qd - qd_0) > MAX_CHANGE or abs(q - q_0 - qd_0 * span_s) > MAX_CHANGE * span_s:
                return False
        linear, angular = last.speed[:3], last.speed[3:]
        if math.dist(state.speed[:3], linear) > MAX_CHANGE or math.dist(state.speed[3:], angular) > MAX_CHANGE:
            return False
        if math.dist(state.pose[:3], _ahead(last.pose, linear, span_s)) > MAX_CHANGE * span_s:
            return False
        turned = turn_between(quat_wxyz_from_rotvec(last.pose[3:]), quat_wxyz_from_rotvec(state.pose[3:]))
        return math.dist(turned, _scaled(angular, span_s)) <= MAX_CHANGE * span_s

    def _predicted(self, last: UrState, state: UrState) -> UrState:
        """Return the last plausible state, moved on to the time of a package whose status alone is kept."""
        span_s = self._span_s(last, state)
        turned = quat_product(
            quat_wxyz_from_rotvec(_scaled(last.speed[3:], span_s)), quat_wxyz_from_rotvec(last.pose[3:])
        )
        return state._replace(
            target_q=last.target_q,
            q=tuple(q + qd * span_s for q, qd in zip(last.q, last.qd, strict=True)),
            qd=last.qd,
            pose=(*_ahead(last.pose, last.speed, span_s), *rotvec_near(turned, last.pose[3:])),
            speed=last.speed,
            wrench=last.wrench,
        )


def _ahead(position: Numbers, velocity: Numbers, span_s: float) -> Three:
    (x, y, z), (vx, vy, vz) = position[:3], velocity[:3]
    return x + vx * span_s, y + vy * span_s, z + vz * span_s


def _scaled(vector: Numbers, by: float) -> Three:
    x, y, z = vector
    return x * by, y * by, z * by
