"""Force mode: compliant axes move until the tool exerts the commanded wrench."""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from haptether.slave.ur.kinematics.pose import matrix_from_rotvec
from haptether.slave.ur_emulator.robot.kinematics import Array, Six
from haptether.slave.ur_emulator.script.program import ScriptError

MASS_KG: Final = 50.0
"""Virtual mass at a gain scaling of 1."""
INERTIA_KGM2: Final = 2.0
"""Virtual inertia at a gain scaling of 1."""
DAMPING_RATE: Final = 400.0
"""Rate in 1/s at which speed decays at a damping of 1."""
MIN_SPEED: Final = 1e-4
"""Speed in m/s below which a frame of type 3 does not follow the tool."""


@dataclass(slots=True)
class ForceMode:
    """Virtual body that a compliant axis moves as.

    Each compliant axis of the task frame follows `M v' = w + F_e - M d v`. Here w is the wrench that the tool must
    exert, and F_e the wrench of the environment on the tool. The virtual mass is `M = 50 kg / gain scaling` (2 kg m²
    for rotation), the damping `d = 400 1/s damping`. |v| stays within the limit of that axis. Contact then settles at
    `F_e = -w`, and an axis without contact drifts at `w / (M d)`. Axes that are not compliant follow the program.

    The vendor publishes the meaning of damping and gain scaling, not the law. The constants let a wall of up to 10 kN/m
    settle without oscillation at the defaults of ur_rtde (gain scaling 0.5, damping 0.025).

    Source: Universal Robots, script manual, force_mode, force_mode_set_damping, force_mode_set_gain_scaling.
    """

    gain_scaling: float = 1.0
    damping: float = 0.025
    active: bool = False
    frame: Six = (0.0,) * 6
    selection: tuple[bool, ...] = (False,) * 6
    wrench: Six = (0.0,) * 6
    kind: int = 2
    limits: Six = (0.0,) * 6
    _velocity: Six = field(default=(0.0,) * 6)

    def begin(self, frame: Six, selection: tuple[bool, ...], wrench: Six, kind: int, limits: Six) -> None:
        """Begin force mode, or continue with other arguments (force_mode).

        Raises:
            ScriptError: The type is unknown.
        """
        if kind not in {1, 2, 3}:
            message = f"force_mode: type = {kind}: must be 1, 2 or 3"
            raise ScriptError(message)
        if not self.active or selection != self.selection:
            self._velocity = (0.0,) * 6
        self.frame, self.selection, self.wrench, self.kind, self.limits = frame, selection, wrench, kind, limits
        self.active = True

    def set_damping(self, damping: float) -> None:
        """Set the damping, clipped to between 0 and 1 (force_mode_set_damping)."""
        self.damping = min(max(damping, 0.0), 1.0)

    def set_gain_scaling(self, scaling: float) -> None:
        """Set the gain scaling, clipped to between 0 and 2 (force_mode_set_gain_scaling)."""
        self.gain_scaling = min(max(scaling, 0.0), 2.0)

    def reset(self) -> None:
        """End force mode and restore the defaults of gain scaling and damping."""
        self.end()
        self.gain_scaling, self.damping = 1.0, 0.025

    def end(self) -> None:
        """End force mode (end_force_mode)."""
        self.active = False
        self._velocity = (0.0,) * 6

    def velocity(self, commanded: Array, measured: Six, tool: Array, actual: Array, step_s: float) -> Array:
        """Return the tool velocity in the base frame, (6,).

        Args:
            commanded: The program's tool velocity in the base frame.
            measured: F_e in the base frame, in N and N m.
            tool: base_from_tool, (4, 4).
            actual: The tool's velocity in the base frame.
            step_s: Duration of the step in s.
        """
        base_from_task = self._base_from_task(tool, actual)
        force = np.array(measured).reshape(2, 3) @ base_from_task
        follow = commanded.reshape(2, 3) @ base_from_task
        wrench_task = force.ravel().tolist()
        velocity = follow.ravel().tolist()
        rate = DAMPING_RATE * self.damping
        decay = math.exp(-rate * step_s)
        # Velocity gained over the step per unit of acceleration; step_s without damping.
        gain_s = -math.expm1(-rate * step_s) / rate if rate > 0.0 else step_s
        new = []
        for axis, compliant in enumerate(self.selection):
            if not compliant:
                new.append(0.0)
                continue
            mass = (MASS_KG if axis < 3 else INERTIA_KGM2) / max(self.gain_scaling, 1e-3)
            v = decay * self._velocity[axis] + gain_s * (self.wrench[axis] + wrench_task[axis]) / mass
            limit = abs(self.limits[axis])
            velocity[axis] = min(max(v, -limit), limit)
            new.append(velocity[axis])
        self._velocity = tuple(new)
        return (np.array(velocity).reshape(2, 3) @ base_from_task.T).ravel()

    def _base_from_task(self, tool: Array, actual: Array) -> Array:
        frame = matrix_from_rotvec(self.frame[3:])
        if self.kind == 2:
            return frame
        if self.kind == 1:
            # y points from the tool to the origin of the frame.
            direction = np.array(self.frame[:3]) - tool[:3, 3]
            if (length := float(np.linalg.norm(direction))) < 1e-9:
                return frame
            y = direction / length
            x = frame[:, 0] - y * float(y @ frame[:, 0])
            if (size := float(np.linalg.norm(x))) < 1e-9:
                return frame
            x /= size
            return np.column_stack((x, y, np.cross(x, y)))
        # x is the tool velocity, projected on the plane of x and y.
        z = frame[:, 2]
        x = actual[:3] - z * float(z @ actual[:3])
        if (speed := float(np.linalg.norm(x))) < MIN_SPEED:
            return frame
        x /= speed
        return np.column_stack((x, np.cross(z, x), z))
