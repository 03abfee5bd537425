"""The safety system: modes of the robot and what leads from one to another, and the limits that stop the arm.

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
"""Mode of every joint by mode of the robot; power off (239) in all others."""
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
    """Time is an argument, in s since the controller started.

    Args:
        unlock_after_s: How long a protective stop cannot be unlocked.
        stop: Is called when the arm must stop, with the reason.
        log: Takes lines for the log.
    """

    def __init__(self, unlock_after_s: float, stop: Callable[[str], None], log: Callable[[str], None]) -> None:
        self.mode = SafetyMode.NORMAL
        self.robot_mode = RobotMode.RUNNING
        self.reason = ""
        """Of the last stop."""
        self._unlock_after_s = unlock_after_s
        self._stop = stop
        self._log = log
        self._stopped_at_s = 0.0
        self._next_mode: tuple[float, RobotMode] | None = None

    @property
    def may_move(self) -> bool:
        """Whether the arm may move."""
        return self.mode in MOVING_MODES and self.robot_mode == RobotMode.RUNNING

    def advance(self, now_s: float) -> None:
        """Changes of mode that take time."""
        if self._next_mode is not None and now_s >= self._next_mode[0]:
            self.robot_mode = self._next_mode[1]
            self._next_mode = None

    def protective_stop(self, reason: str, now_s: float) -> None:
        """Stops the arm; it stays powered."""
        if self.mode in MOVING_MODES:
            self._enter_stop(SafetyMode.PROTECTIVE_STOP, reason, now_s)

    def emergency_stop(self, now_s: float) -> None:
        """The button of the robot: stops the arm and takes its power."""
        if self.mode != SafetyMode.ROBOT_EMERGENCY_STOP:
            self._enter_stop(SafetyMode.ROBOT_EMERGENCY_STOP, "emergency stop", now_s)
            self.robot_mode = RobotMode.POWER_OFF
            self._next_mode = None

    def release_emergency_stop(self) -> bool:
        """Releases the button; the arm stays without power. Whether it was pressed."""
        pressed = self.mode == SafetyMode.ROBOT_EMERGENCY_STOP
        if pressed:
            self.mode = SafetyMode.NORMAL
        return pressed

    def fault(self, reason: str, now_s: float) -> None:
        """A fault of the robot, which only `restart` or `reset` clears."""
        self._enter_stop(SafetyMode.FAULT, reason, now_s)

    def reset(self) -> None:
        """Ready to move, without stops and faults."""
        self.mode, self.robot_mode, self.reason, self._next_mode = SafetyMode.NORMAL, RobotMode.RUNNING, "", None

    def unlock(self, now_s: float) -> str:
        """Unlocks a protective stop; returns the dashboard's answer."""
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
        """Restarts the safety system: clears all stops, power is off."""
        self.power_off()
        self.mode = SafetyMode.NORMAL
        self._stop("the safety system restarts")
        self._stopped_at_s = now_s

    def power_on(self, now_s: float) -> None:
        """Powers the arm; its brakes stay closed."""
        if self.robot_mode == RobotMode.POWER_OFF and self.mode in MOVING_MODES:
            self.robot_mode = RobotMode.POWER_ON
            self._next_mode = (now_s + POWER_ON_S, RobotMode.IDLE)

    def release_brakes(self, now_s: float) -> None:
        """Makes the arm ready to move; powers it first where it is off."""
        if self.mode not in MOVING_MODES or self.robot_mode == RobotMode.RUNNING:
            return
        off = self.robot_mode in {RobotMode.POWER_OFF, RobotMode.POWER_ON}
        self.robot_mode = RobotMode.POWER_ON if off else RobotMode.IDLE
        self._next_mode = (now_s + BRAKE_RELEASE_S + (POWER_ON_S if off else 0.0), RobotMode.RUNNING)

    def power_off(self) -> None:
        """Takes the power of the arm."""
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

    Beyond one of them the arm goes into a protective stop. Those of force and speed are the defaults of e-Series arms;
    the vendor does not publish those of deviations and jumps.
    """

    tool_force_n: float = 150.0
    tool_speed: float = 1.5
    """m/s."""
    joint_speed_share: float = 1.05
    """Of the largest speed of a joint."""
    deviation: float = 0.1
    """rad between a joint and its target."""
    jump: float = 0.3
    """rad by which a servoj target may change at once."""

    def violation(self, robot: "Robot") -> str | None:
        """Which limit the arm exceeds, and by what; None if none."""
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
    """RTDE's `safety_status_bits` of a safety mode."""
    return STATUS_BITS[mode] | (0 if mode in MOVING_MODES else STOPPED_DUE_TO_SAFETY)
