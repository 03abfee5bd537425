"""When the safety system stops the arm."""

import math
from dataclasses import dataclass

from haptether.slave.ur_emulator.robot.robot import Robot


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits:
    """Limits like those that a person sets on the teach pendant, and two of the controller's own.

    Beyond one of them the arm goes into a protective stop. Those of force and speed are what e-Series arms are
    delivered with; what the controller bears of deviations and jumps the vendor does not publish.
    """

    tool_force_n: float = 150.0
    tool_speed: float = 1.5
    """m/s."""
    joint_speed_share: float = 1.05
    """Of the largest speed of a joint."""
    deviation: float = 0.1
    """rad that a joint may be away from its target."""
    jump: float = 0.3
    """rad that a target may jump by."""

    def broken(self, robot: Robot) -> str | None:
        """Which limit the arm is beyond, and by what; None if it keeps all of them."""
        measured = robot.measured
        force = math.hypot(*measured.force[:3])
        if force > self.tool_force_n:
            return f"tool force {force:.1f} N: above {self.tool_force_n:g} N"
        speed = math.hypot(*measured.velocity[:3])
        if speed > self.tool_speed:
            return f"tool speed {speed:.3f} m/s: above {self.tool_speed:g} m/s"
        model = robot.model
        for joint in range(6):
            if abs(measured.qd[joint]) > self.joint_speed_share * model.max_speed[joint]:
                return f"speed of joint {joint + 1} {measured.qd[joint]:.3f} rad/s: above {model.max_speed[joint]:.3f}"
            if not model.position_min[joint] <= robot.target.q[joint] <= model.position_max[joint]:
                return f"position of joint {joint + 1} {robot.target.q[joint]:.3f} rad: beyond its limit"
            if abs(robot.loop.deflection[joint]) > self.deviation:
                return f"joint {joint + 1} is {robot.loop.deflection[joint]:.3f} rad away from its path"
        return None
