"""What a UR controller says about itself and its arm, and what of that ends motion.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of modes, states and status bits.
"""

import math
from typing import Any, Final, NamedTuple

ROBOT_MODES: Final = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle",
    6: "backdrive",
    7: "running",
    8: "updating firmware",
}
RUNNING: Final = 7
RUNTIME_STATES: Final = {0: "stopping", 1: "stopped", 2: "playing", 3: "pausing", 4: "paused", 5: "resuming"}
PLAYING: Final = 2
SAFETY_MODES: Final = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "system emergency stop",
    7: "robot emergency stop",
    8: "violation",
    9: "fault",
    10: "validate joint id",
    11: "undefined",
    12: "automatic mode safeguard stop",
    13: "three position enabling stop",
}
NORMAL, REDUCED, PROTECTIVE_STOP = 1, 2, 3
FULL_SPEED: Final = 0.99
"""Of the speed slider. Below it a command that is to take 2 ms takes longer, and of those that follow some are lost."""
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
    """Age of the controller in s."""
    target_q: Numbers
    """rad."""
    q: Numbers
    """rad."""
    qd: Numbers
    """rad/s."""
    pose: Numbers
    """Of the tool, x y z rx ry rz in m and rad."""
    speed: Numbers
    """Of the tool in m/s and rad/s, in the frame of the base."""
    wrench: Numbers
    """On the tool in N and N m: as the controller has it, or the raw one of the sensor."""
    robot_mode: int
    safety_mode: int
    safety_bits: int
    runtime_state: int
    speed_fraction: float
    """Where the speed slider stands, 0 to 1."""

    @property
    def finite(self) -> bool:
        """Whether all its numbers are."""
        numbers = (*self.q, *self.qd, *self.pose, *self.speed, *self.wrench, self.speed_fraction)
        return all(map(math.isfinite, numbers))


def read_state(receive: Any, *, raw_wrench: bool) -> UrState:  # noqa: ANN401  # rtde_receive.RTDEReceiveInterface
    """The newest package that has come; the library does not say how old it is."""
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
    """What forbids motion in a state, the gravest first, and what to do about it; none if nothing does.

    Args:
        state: The newest.
        before: The last one in which the arm was allowed to move.
    """
    bits, mode = state.safety_bits, SAFETY_MODES.get(state.safety_mode, str(state.safety_mode))
    for mask, text in (
        (EMERGENCY_BITS, EMERGENCY),
        (BROKEN_BITS, f"safety system: {mode}: see the pendant, restart the safety system there, then acknowledge"),
        (PROTECTIVE_BIT, PROTECTIVE),
        (SAFEGUARD_BIT, "safeguard stop: close the safeguard and reset it, then acknowledge"),
        (OTHER_BITS, f"stopped by the safety system ({mode}): see the pendant, then acknowledge"),
    ):
        if bits & mask:
            return text.format(seen=_last_seen([state] if before is None else [before, state]))
    if state.robot_mode != RUNNING:
        robot_mode = ROBOT_MODES.get(state.robot_mode, str(state.robot_mode))
        return f"robot mode {robot_mode}: power the arm on and release its brakes on the pendant, then acknowledge"
    if state.runtime_state != PLAYING:
        does = RUNTIME_STATES.get(state.runtime_state, str(state.runtime_state))
        return (
            f"the control script is {does} (at the pendant, by an error, or by its watchdog): see the pendant's log,"
            " then acknowledge"
        )
    if state.speed_fraction < FULL_SPEED:
        return f"speed slider at {100.0 * state.speed_fraction:.0f} %: {SLIDER}, then acknowledge"
    return None


def _last_seen(states: list[UrState]) -> str:
    """What stood out around a stop: RTDE does not name its cause."""
    deviation, joint = max(
        (abs(target - actual), joint)
        for state in states
        for joint, (target, actual) in enumerate(zip(state.target_q, state.q, strict=True))
    )
    force = max(math.hypot(*state.wrench[:3]) for state in states)
    speed = max(math.hypot(*state.speed[:3]) for state in states)
    return f"{force:.1f} N, {speed:.3f} m/s, joint {joint + 1} {deviation:.4f} rad from its target"
