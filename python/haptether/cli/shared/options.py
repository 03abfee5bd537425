"""Options that several commands share, and what they build."""

import secrets
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from haptether.bridge import MasterSettings, SlaveSettings

Controller = Literal["none", "vfc", "hsc", "wsc"]

START_M = 0.02
"""Where hand and arm begin, in m in front of the wall."""
PRESS_S = 1.2
"""Time in s in which the hand reaches its target in the wall."""
HAND_STIFFNESS = 300.0
HAND_DAMPING = 8.0
GRIP_STRENGTH_N = 12.0
RELEASE_DURATION_S = 0.05
STOPS_M = (-0.08, 0.08)
"""Mechanical stops of a PHANTOM Desktop, whose workspace is 0.16 m wide."""
HSC_FORCE_THRESHOLD_N = 1.0
"""F_t of HSC in N on an encoder of 0.023 mm: below it, quantisation decides what S_h is."""
HOLD_OFF_S = 0.1
RELEASE_RAMP_S = 0.2
"""An intervention lasts at least 0.1 s and hands the force back over 0.2 s, not as a step."""
PUSH_RISE_S = 0.5


def new_session() -> int:
    """A session that no other start has."""
    return secrets.randbits(64)


def master_settings(
    controller: Controller,
    *,
    depth: float,
    release_at_s: float | None,
    force_scale: float = 1.0,
    encoder_quantum: float = 2.3e-5,
    clutch: Literal["once", "auto", "never"] = "once",
) -> "MasterSettings":
    """A PHANTOM Desktop in a hand that presses `depth` m deep and lets go at `release_at_s` (never if none).

    Raises:
        ValueError: A parameter out of its bounds.
    """
    from haptether.bridge import MasterSettings
    from haptether.master import Hand, HapticDevice
    from haptether.safety import SafetySettings

    if release_at_s is not None and not release_at_s >= 0.0:
        message = f"release_at_s = {release_at_s:g}: must be at least 0 s"
        raise ValueError(message)
    hand = Hand(
        stiffness=HAND_STIFFNESS,
        damping=HAND_DAMPING,
        strength_n=GRIP_STRENGTH_N,
        start=START_M,
        legs=[(PRESS_S, -depth, "minimum-jerk")],
        release=None if release_at_s is None else (release_at_s, RELEASE_DURATION_S),
    )
    safety = SafetySettings(
        [] if controller == "none" else [controller],
        hsc_force_threshold_n=HSC_FORCE_THRESHOLD_N,
        hold_off_s=HOLD_OFF_S,
        release_ramp_s=RELEASE_RAMP_S,
    )
    device = HapticDevice.phantom_desktop(encoder_quantum=encoder_quantum, stops=STOPS_M)
    return MasterSettings(
        device, hand, safety=safety, force_scale=force_scale, clutch=[] if clutch == "never" else clutch
    )


def slave_settings(
    *, wall_stiffness: float, push_at_s: float | None, push_force_n: float, push_duration_s: float
) -> "SlaveSettings":
    """A position-controlled arm in front of a wall at x = 0 that is shoved at `push_at_s` (never if none).

    Raises:
        ValueError: A parameter out of its bounds.
    """
    from haptether.bridge import SlaveSettings
    from haptether.slave import Arm, Pusher, Wall

    # Also where there is none: what cannot be is refused all the same.
    push = Pusher(at_s=push_at_s or 0.0, force_n=push_force_n, duration_s=push_duration_s, rise_s=PUSH_RISE_S)
    pusher = None if push_at_s is None else push
    return SlaveSettings(Arm(), Wall(stiffness=wall_stiffness), pusher=pusher, position=START_M)


def check_seed(seed: int) -> None:
    """Refuses a seed that is no 64-bit number.

    Raises:
        ValueError: With the bounds.
    """
    if not 0 <= seed < 2**64:
        message = f"seed = {seed}: must be between 0 and 2^64 - 1"
        raise ValueError(message)


def check_duration(key: str, seconds: float | None) -> None:
    """Refuses a time that no run can last.

    Raises:
        ValueError: With the bounds.
    """
    if seconds is not None and not 0.0 <= seconds <= 1e9:
        message = f"{key} = {seconds}: must be between 0 and 1e9 s"
        raise ValueError(message)
