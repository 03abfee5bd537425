"""Safety system: robot modes, their transitions, and the limits that stop the arm.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of modes, states and status bits.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from haptether.slave.ur.state import RobotMode, SafetyMode, mode_text

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.robot.robot import Robot


JOINT_MODES: Final = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.BACKDRIVE: 238, RobotMode.BOOTING: 247}
"""Mode of every joint for each robot mode; all others give power off (239)."""
JOINT_POWER_OFF: Final = 239
POWERED_MODES: Final = frozenset({RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING})

STATUS_BITS: Final = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.REDUCED: 1 << 1,
    SafetyMode.PROTECTIVE_STOP: 1 << 2,
    SafetyMode.RECOVERY: 1 << 3,
    SafetyMode.SAFEGUARD_STOP: 1 << 4,
    SafetyMode.SYSTEM_EMERGENCY_STOP: 1 << 5 | 1 << 7,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7,
    SafetyMode.VIOLATION: 1 << 8,
    SafetyMode.FAULT: 1 << 9,
}
STOPPED_DUE_TO_SAFETY: Final = 1 << 10
MOVING_MODES: Final = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})
"""Safety modes in which the arm may move."""

POWER_ON_S: Final = 1.0
BRAKE_RELEASE_S: Final = 1.0


class SafetySystem:
    """Safety modes of the arm; times are arguments, in s since the controller started.

    Args:
        unlock_after_s: Time during which a protective stop cannot be unlocked.
        stop: Called with the reason when the arm must stop.
        log: Receives lines for the log.
    """

    def __init__(self, unlock_after_s: float, stop: Callable[[str], None], log: Callable[[str], None]) -> None:
        self.mode = SafetyMode.NORMAL
        self.robot_mode = RobotMode.RUNNING
        self.reason = ""
        """Reason of the last stop."""
        self._unlock_after_s = unlock_after_s
        self._stop = stop
        self._log = log
        self._stopped_at_s = 0.0
        self._next_mode: tuple[float, RobotMode] | None = None

    @property
    def may_move(self) -> bool:
        """Return True if the arm may move."""
        return self.mode in MOVING_MODES and self.robot_mode == RobotMode.RUNNING

    def advance(self, now_s: float) -> None:
        """Make the changes of mode that take time."""
        if self._next_mode is not None and now_s >= self._next_mode[0]:
            self.robot_mode = self._next_mode[1]
            self._next_mode = None

    def protective_stop(self, reason: str, now_s: float) -> None:
        """Stop the arm; it stays powered."""
        if self.mode in MOVING_MODES:
            self._enter_stop(SafetyMode.PROTECTIVE_STOP, reason, now_s)

    def emergency_stop(self, now_s: float) -> None:
        """Press the robot's button: stop the arm and remove its power."""
        if self.mode != SafetyMode.ROBOT_EMERGENCY_STOP:
            self._enter_stop(SafetyMode.ROBOT_EMERGENCY_STOP, "emergency stop", now_s)
            self.robot_mode = RobotMode.POWER_OFF
            self._next_mode = None

    def release_emergency_stop(self) -> bool:
        """Release the button; the arm stays without power. Return True if it was pressed."""
        pressed = self.mode == SafetyMode.ROBOT_EMERGENCY_STOP
        if pressed:
            self.mode = SafetyMode.NORMAL
        return pressed

    def fault(self, reason: str, now_s: float) -> None:
        """Report a fault of the robot; only `restart` or `reset` clears it."""
        self._enter_stop(SafetyMode.FAULT, reason, now_s)

    def reset(self) -> None:
        """Make the arm ready to move, without stops and faults."""
        self.mode, self.robot_mode, self.reason, self._next_mode = SafetyMode.NORMAL, RobotMode.RUNNING, "", None

    def unlock(self, now_s: float) -> str:
        """Unlock a protective stop; return the dashboard's answer."""
        if self.mode != SafetyMode.PROTECTIVE_STOP:
            return "Protective stop releasing"
        if now_s - self._stopped_at_s < self._unlock_after_s:
            return (
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        self.mode = SafetyMode.NORMAL
        return "Protective stop releasing"

    def restart(self, now_s: float) -> None:
        """Restart the safety system: all stops are cleared, power is off."""
        self.power_off()
        self.mode = SafetyMode.NORMAL
        self._stop("the safety system restarts")
        self._stopped_at_s = now_s

    def power_on(self, now_s: float) -> None:
        """Power the arm; its brakes stay closed."""
        if self.robot_mode == RobotMode.POWER_OFF and self.mode in MOVING_MODES:
            self.robot_mode = RobotMode.POWER_ON
            self._next_mode = (now_s + POWER_ON_S, RobotMode.IDLE)

    def release_brakes(self, now_s: float) -> None:
        """Make the arm ready to move; power it first if it is off."""
        if self.mode not in MOVING_MODES or self.robot_mode == RobotMode.RUNNING:
            return
        off = self.robot_mode in {RobotMode.POWER_OFF, RobotMode.POWER_ON}
        self.robot_mode = RobotMode.POWER_ON if off else RobotMode.IDLE
        self._next_mode = (now_s + BRAKE_RELEASE_S + (POWER_ON_S if off else 0.0), RobotMode.RUNNING)

    def power_off(self) -> None:
        """Remove the arm's power."""
        self.robot_mode = RobotMode.POWER_OFF
        self._next_mode = None
        self._stop("power off")

    def _enter_stop(self, mode: SafetyMode, reason: str, now_s: float) -> None:
        self.mode = mode
        self.reason = reason
        self._stopped_at_s = now_s
        self._log(f"{mode_text(SafetyMode, mode)}: {reason}")
        self._stop(reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits:
    """Limits of the teach pendant's safety settings, and two of the controller's own.

    Beyond one of them the arm enters a protective stop. Force and speed have the defaults of e-Series arms. The vendor
    does not publish the limits of deviations and jumps.
    """

    tool_force_n: float = 150.0
    tool_speed: float = 1.5
    """Tool speed in m/s."""
    joint_speed_share: float = 1.05
    """Share of the largest speed of a joint."""
    deviation: float = 0.1
    """Angle in rad between a joint and its target."""
    jump: float = 0.3
    """Angle in rad by which a servoj target may change at once."""

    def violation(self, robot: "Robot") -> str | None:
        """Return the limit that the arm exceeds and the excess; None if none."""
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


def safety_status_bits(mode: SafetyMode) -> int:
    """Return RTDE's `safety_status_bits` of a safety mode."""
    return STATUS_BITS[mode] | (0 if mode in MOVING_MODES else STOPPED_DUE_TO_SAFETY)
