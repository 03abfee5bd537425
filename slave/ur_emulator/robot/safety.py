"""Modes of robot and safety system, and what leads from one to another."""

from collections.abc import Callable
from typing import Final

from haptether.slave.ur_emulator.robot_state import MOVES, RobotMode, SafetyMode

POWER_ON_S: Final = 1.0
BRAKE_RELEASE_S: Final = 1.0


class SafetySystem:
    """Time is an argument, in s since the controller started.

    Args:
        unlock_after_s: How long after a protective stop nobody can unlock it.
        stop: Is told when the arm must stop; its argument says why.
        tell: Takes lines for the log.
    """

    def __init__(self, unlock_after_s: float, stop: Callable[[str], None], tell: Callable[[str], None]) -> None:
        self.mode = SafetyMode.NORMAL
        self.robot_mode = RobotMode.RUNNING
        self.reason = ""
        """Of the last stop."""
        self._unlock_after_s = unlock_after_s
        self._stop = stop
        self._tell = tell
        self._stopped_at_s = 0.0
        self._next_mode: tuple[float, RobotMode] | None = None

    @property
    def may_move(self) -> bool:
        """Whether the arm may move."""
        return self.mode in MOVES and self.robot_mode == RobotMode.RUNNING

    def advance(self, now_s: float) -> None:
        """Goes on with what takes time."""
        if self._next_mode is not None and now_s >= self._next_mode[0]:
            self.robot_mode = self._next_mode[1]
            self._next_mode = None

    def protective_stop(self, reason: str, now_s: float) -> None:
        """Stops the arm; it stays powered."""
        if self.mode in MOVES:
            self._stopped(SafetyMode.PROTECTIVE_STOP, reason, now_s)

    def emergency_stop(self, now_s: float) -> None:
        """The button of the robot: stops the arm and takes its power."""
        if self.mode != SafetyMode.ROBOT_EMERGENCY_STOP:
            self._stopped(SafetyMode.ROBOT_EMERGENCY_STOP, "emergency stop", now_s)
            self.robot_mode = RobotMode.POWER_OFF
            self._next_mode = None

    def release_emergency_stop(self) -> bool:
        """Turns the button back; the arm stays without power. Whether it was pressed."""
        pressed = self.mode == SafetyMode.ROBOT_EMERGENCY_STOP
        if pressed:
            self.mode = SafetyMode.NORMAL
        return pressed

    def fault(self, reason: str, now_s: float) -> None:
        """Something of the robot is broken: only `restart` helps."""
        self._stopped(SafetyMode.FAULT, reason, now_s)

    def reset(self) -> None:
        """As at the begin: ready to move."""
        self.mode, self.robot_mode, self.reason, self._next_mode = SafetyMode.NORMAL, RobotMode.RUNNING, "", None

    def unlock(self, now_s: float) -> str:
        """Unlocks a protective stop: the dashboard's answer."""
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
        """Restarts the safety system: all stops are gone, and the power is off."""
        self.power_off()
        self.mode = SafetyMode.NORMAL
        self._stop("the safety system restarts")
        self._stopped_at_s = now_s

    def power_on(self, now_s: float) -> None:
        """Powers the arm; its brakes stay closed."""
        if self.robot_mode == RobotMode.POWER_OFF and self.mode in MOVES:
            self.robot_mode = RobotMode.POWER_ON
            self._next_mode = (now_s + POWER_ON_S, RobotMode.IDLE)

    def release_brakes(self, now_s: float) -> None:
        """Makes the arm ready to move; powers it first, if need be."""
        if self.mode not in MOVES or self.robot_mode == RobotMode.RUNNING:
            return
        off = self.robot_mode in {RobotMode.POWER_OFF, RobotMode.POWER_ON}
        self.robot_mode = RobotMode.POWER_ON if off else RobotMode.IDLE
        self._next_mode = (now_s + BRAKE_RELEASE_S + (POWER_ON_S if off else 0.0), RobotMode.RUNNING)

    def power_off(self) -> None:
        """Takes the power of the arm."""
        self.robot_mode = RobotMode.POWER_OFF
        self._next_mode = None
        self._stop("power off")

    def _stopped(self, mode: SafetyMode, reason: str, now_s: float) -> None:
        self.mode = mode
        self.reason = reason
        self._stopped_at_s = now_s
        self._tell(f"{mode.name.lower().replace('_', ' ')}: {reason}")
        self._stop(reason)
