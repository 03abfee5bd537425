"""What state a controller is in: the numbers that RTDE carries and the words of the dashboard.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of modes, states and status bits.
"""

from enum import IntEnum


class RuntimeState(IntEnum):
    """What the program does."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class RobotMode(IntEnum):
    """What the arm is ready for."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(IntEnum):
    """What the safety system has come to."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


JOINT_MODES = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.BACKDRIVE: 238, RobotMode.BOOTING: 247}
"""Mode of every joint in a mode of the robot; power off (239) in all others."""
JOINT_POWER_OFF = 239

STOPPED_BITS = {
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
STOPPED_DUE_TO_SAFETY = 1 << 10
MOVES = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})
"""Safety modes in which the arm may move."""


def safety_status_bits(mode: SafetyMode) -> int:
    """The bits that a safety mode sets."""
    return STOPPED_BITS[mode] | (0 if mode in MOVES else STOPPED_DUE_TO_SAFETY)


def robot_status_bits(*, powered: bool, playing: bool, freedrive: bool) -> int:
    """Power on, program running, teach button, power button."""
    return powered << 0 | playing << 1 | freedrive << 2 | powered << 3
