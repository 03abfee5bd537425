"""State of a UR controller and its arm, and the conditions that end motion.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of modes, states and status bits.
"""

import math
from enum import IntEnum
from typing import Any, Final, NamedTuple


class RobotMode(IntEnum):
    """Power and brakes of the arm."""

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
    """State of the safety system."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    VALIDATE_JOINT_ID = 10
    UNDEFINED = 11
    AUTOMATIC_MODE_SAFEGUARD_STOP = 12
    THREE_POSITION_ENABLING_STOP = 13


class RuntimeState(IntEnum):
    """State of the program."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


def mode_text(kind: type[IntEnum], number: int) -> str:
    """Return a mode as text, or its number if unknown."""
    try:
        return kind(number).name.lower().replace("_", " ")
    except ValueError:
        return str(number)


FULL_SPEED: Final = 0.99
"""Threshold of the speed slider. Below it a 2 ms command takes longer, and some of the following ones are lost."""
SLIDER: Final = "set it to 100 % on the pendant, max_speed bounds the tool"

EMERGENCY_BITS: Final = 1 << 5 | 1 << 6 | 1 << 7
PROTECTIVE_BIT: Final = 1 << 2
SAFEGUARD_BIT: Final = 1 << 4
BROKEN_BITS: Final = 1 << 8 | 1 << 9
OTHER_BITS: Final = 1 << 3 | 1 << 10

EMERGENCY: Final = (
    "emergency stop: find its cause, release the button, power the arm on and release its brakes on the pendant, then"
    " acknowledge"
)
PROTECTIVE: Final = (
    "protective stop (seen: {seen}): find its cause (the pendant's log names it), clear the tool, wait 5 s, then"
    " acknowledge: that unlocks it"
)

Numbers = tuple[float, ...]

VARIABLES: Final = (
    "timestamp",
    "target_q",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "robot_mode",
    "safety_mode",
    "safety_status_bits",
    "runtime_state",
    "target_speed_fraction",
)
RAW_WRENCH: Final = "ft_raw_wrench"


class UrState(NamedTuple):
    """One package of the controller."""

    timestamp: float
    """Uptime of the controller in s."""
    target_q: Numbers
    """Target joint angles in rad."""
    q: Numbers
    """Joint angles in rad."""
    qd: Numbers
    """Joint speeds in rad/s."""
    pose: Numbers
    """Tool pose, x y z rx ry rz in m and rad."""
    speed: Numbers
    """Tool velocity in m/s and rad/s in the base frame."""
    wrench: Numbers
    """Wrench on the tool in N and N m: the controller's, or the raw sensor's."""
    robot_mode: int
    safety_mode: int
    safety_bits: int
    runtime_state: int
    speed_fraction: float
    """Position of the speed slider, 0 to 1."""

    @property
    def finite(self) -> bool:
        """True if all numbers are finite."""
        numbers = (*self.q, *self.qd, *self.pose, *self.speed, *self.wrench, self.speed_fraction)
        return all(map(math.isfinite, numbers))


def read_state(receive: Any, *, raw_wrench: bool) -> UrState:  # noqa: ANN401  # rtde_receive.RTDEReceiveInterface
    """Return the latest received package; the library does not report its age."""
    return UrState(
        receive.getTimestamp(),
        tuple(receive.getTargetQ()),
        tuple(receive.getActualQ()),
        tuple(receive.getActualQd()),
        tuple(receive.getActualTCPPose()),
        tuple(receive.getActualTCPSpeed()),
        tuple(receive.getFtRawWrench() if raw_wrench else receive.getActualTCPForce()),
        receive.getRobotMode(),
        receive.getSafetyMode(),
        receive.getSafetyStatusBits(),
        receive.getRuntimeState(),
        receive.getTargetSpeedFraction(),
    )


def safety_stop(state: UrState, before: UrState | None = None) -> str | None:
    """Return the most serious reason that forbids motion, with a remedy, or None.

    Args:
        state: Latest state.
        before: Last state in which the arm was allowed to move.
    """
    bits, mode = state.safety_bits, mode_text(SafetyMode, state.safety_mode)
    for mask, text in (
        (EMERGENCY_BITS, EMERGENCY),
        (BROKEN_BITS, f"safety system: {mode}: see the pendant, restart the safety system there, then acknowledge"),
        (PROTECTIVE_BIT, PROTECTIVE),
        (SAFEGUARD_BIT, "safeguard stop: close the safeguard and reset it, then acknowledge"),
        (OTHER_BITS, f"stopped by the safety system ({mode}): see the pendant, then acknowledge"),
    ):
        if bits & mask:
            return text.format(seen=_last_seen([state] if before is None else [before, state]))
    if state.robot_mode != RobotMode.RUNNING:
        robot_mode = mode_text(RobotMode, state.robot_mode)
        return f"robot mode {robot_mode}: power the arm on and release its brakes on the pendant, then acknowledge"
    if state.runtime_state != RuntimeState.PLAYING:
        does = mode_text(RuntimeState, state.runtime_state)
        return (
            f"the control script is {does} (at the pendant, by an error, or by its watchdog): see the pendant's log,"
            " then acknowledge"
        )
    if state.speed_fraction < FULL_SPEED:
        return f"speed slider at {100.0 * state.speed_fraction:.0f} %: {SLIDER}, then acknowledge"
    return None


def _last_seen(states: list[UrState]) -> str:
    """Return notable values around a stop, because RTDE does not name its cause."""
    deviation, joint = max(
        (abs(target - actual), joint)
        for state in states
        for joint, (target, actual) in enumerate(zip(state.target_q, state.q, strict=True))
    )
    force = max(math.hypot(*state.wrench[:3]) for state in states)
    speed = max(math.hypot(*state.speed[:3]) for state in states)
    return f"{force:.1f} N, {speed:.3f} m/s, joint {joint + 1} {deviation:.4f} rad from its target"
