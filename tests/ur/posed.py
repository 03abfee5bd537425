"""A mode of the driver leads the emulated arm along a path of poses, in virtual time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.ur.virtual import START, World

from haptether.slave.ur.kinematics.pose import quat_wxyz_from_rotvec
from haptether.slave.ur.modes import UnreachableError, ur_mode
from haptether.slave.ur.options import ur_options
from haptether.slave.ur.set_point import Attitude, OrientationSetPoint, SetPoint
from haptether.slave.ur.state import UrState
from ur.figures import Path, apart

Array = npt.NDArray[np.float64]

PERIOD_S = 0.002
COMMANDS = {"servoJ": 11, "servoL": 24, "speedL": 10, "speedJ": 9, "directTorque": 66}
"""Commands of the control script, by the call of ur_rtde."""


@dataclass(frozen=True)
class Led:
    """Path of an arm, one row per period."""

    q: Array
    """Joint angles, (n, 6), rad."""
    qd: Array
    """Joint velocities measured by the controller, (n, 6), rad/s."""
    metres: Array
    """Distance of the tool from the command at that time, (n,)."""
    radians: Array
    fault: str
    """Fault of the mode, or why the controller stopped."""


class Orders:
    """Writes calls to the control script, like ur_rtde."""

    def __init__(self, world: World) -> None:
        self._world = world

    def __getattr__(self, name: str) -> Callable[..., bool]:
        def call(first: list[float], *rest: float) -> bool:
            self._world.realtime(COMMANDS[name], [*first, *rest])
            return True

        return call


class Posed:
    """A mode at an emulated arm.

    Args:
        mode: Mode of the options.
        start: Joint angles in rad.
        options: Other options of the driver.
    """

    def __init__(self, mode: str, start: tuple[float, ...] = START, **options: Any) -> None:  # noqa: ANN401
        self.world = World("5.26", start=start)
        self.options = ur_options({"host": "fake", "axes": 3, "mode": mode, "max_angular_speed": 3.0} | options)
        self.mode = ur_mode(self.options, PERIOD_S, (0.0,) * 6)
        of = self.options
        self.point = SetPoint(of.max_speed, of.max_acceleration, PERIOD_S, of.planes)
        self.turning = OrientationSetPoint(of.max_angular_speed, of.max_angular_acceleration, PERIOD_S, of.cone)
        self.home = self.state()

    def state(self, off: tuple[float, ...] = (0.0,) * 3) -> UrState:
        """Return the newest package, of a controller whose tool is `off` away."""
        vector = self.world.vector
        pose = vector("actual_TCP_pose")
        moved = tuple(a + b for a, b in zip(pose[:3], off, strict=True))
        return UrState(
            1.0, vector("target_q"), vector("actual_q"), vector("actual_qd"), (*moved, *pose[3:]),
            vector("actual_TCP_speed"), vector("actual_TCP_force"), 7, 1, 1, 2, 1.0,
        )  # fmt: skip

    def lead(self, path: Path, seconds: float, off: tuple[float, ...] = (0.0,) * 3) -> Led:
        """Lead the arm for a time in s, until the mode refuses or the controller stops."""
        home = self.state(off)
        self.point.begin((home.pose[0], home.pose[1], home.pose[2]))
        self.turning.begin(quat_wxyz_from_rotvec(home.pose[3:]))
        self.mode.begin(home)
        rows, fault, orders = [], "", Orders(self.world)
        for tick in range(round(seconds / PERIOD_S)):
            wanted, state = path(tick * PERIOD_S), self.state(off)
            rows.append((*state.q, *state.qd, *apart(state.pose, wanted)))
            self.point.step(wanted.position, wanted.velocity, PERIOD_S)
            self.turning.step(Attitude(wanted.orientation, wanted.angular_velocity), PERIOD_S)
            point = self.point
            try:
                order = self.mode.order(point.position, point.velocity, state, PERIOD_S, self.turning.attitude)
            except UnreachableError as error:
                fault = str(error)
                break
            order(orders)
            self.world.cycles(1)
            if not self.world.playing:
                fault = self.world.controller.log[-1]
                break
        table = np.array(rows)
        return Led(table[:, :6], table[:, 6:12], table[:, 12], table[:, 13], fault)
