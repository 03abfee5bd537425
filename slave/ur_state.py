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

EMERGENCY_BITS: Final = 1 << 5 | 1 << 6 | 1 << 7
PROTECTIVE_BIT: Final = 1 << 2
SAFEGUARD_BIT: Final = 1 << 4
BROKEN_BITS: Final = 1 << 8 | 1 << 9
OTHER_BITS: Final = 1 << 3 | 1 << 10

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

    @property
    def finite(self) -> bool:
        """Whether all its numbers are."""
        return all(map(math.isfinite, (*self.q, *self.qd, *self.pose, *self.speed, *self.wrench)))


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
    )


class Safety(NamedTuple):
    """What the safety system or the program says against motion."""

    kind: str
    """"emergency", "protective", "safeguard", "broken", "mode" or "program"."""
    text: str
    """What it is and what to do about it."""


def safety_stop(state: UrState, before: UrState | None = None) -> Safety | None:
    """What forbids motion in a state, the gravest first; none if nothing does.

    Args:
        state: The newest.
        before: The last one in which the arm was allowed to move.
    """
    bits = state.safety_bits
    if bits & EMERGENCY_BITS:
        return Safety(
            "emergency",
            "emergency stop: find its cause, release the button, power the arm on and release its brakes on the pendant,"
            " then acknowledge",
        )
    if bits & BROKEN_BITS:
        return Safety(
            "broken",
            f"safety system: {SAFETY_MODES.get(state.safety_mode, state.safety_mode)}: see the pendant, restart the"
            " safety system there, then acknowledge",
        )
    if bits & PROTECTIVE_BIT:
        return Safety(
            "protective",
            f"protective stop{_last_seen(before)}: find its cause (the pendant's log names it), clear the tool, wait"
            " 5 s, then acknowledge: that unlocks it",
        )
    if bits & SAFEGUARD_BIT:
        return Safety("safeguard", "safeguard stop: close the safeguard and reset it, then acknowledge")
    if bits & OTHER_BITS:
        mode = SAFETY_MODES.get(state.safety_mode, str(state.safety_mode))
        return Safety("safeguard", f"stopped by the safety system ({mode}): see the pendant, then acknowledge")
    if state.robot_mode != RUNNING:
        mode = ROBOT_MODES.get(state.robot_mode, str(state.robot_mode))
        return Safety(
            "mode", f"robot mode {mode}: power the arm on and release its brakes on the pendant, then acknowledge"
        )
    if state.runtime_state != PLAYING:
        return Safety(
            "program",
            f"the control script is {RUNTIME_STATES.get(state.runtime_state, state.runtime_state)} (stopped at the"
            " pendant, by an error, or by its watchdog): see the pendant's log, then acknowledge",
        )
    return None


def _last_seen(before: UrState | None) -> str:
    """What stood out in the last state before a stop: RTDE has no word for its cause."""
    if before is None:
        return ""
    deviation = [abs(target - actual) for target, actual in zip(before.target_q, before.q, strict=True)]
    worst = max(range(len(deviation)), key=deviation.__getitem__)
    return (
        f" (last seen before: {math.hypot(*before.wrench[:3]):.1f} N, {math.hypot(*before.speed[:3]):.3f} m/s, joint"
        f" {worst + 1} {deviation[worst]:.4f} rad from its target)"
    )
