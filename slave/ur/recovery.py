"""From a fault of a UR arm back to where it may be engaged: what a person's acknowledgement sets off."""

import time
from typing import Final

from haptether.slave.ur.checks import (
    NO_DASHBOARD_SINCE,
    REMOTE_SINCE,
    Checklist,
    check_after,
    check_remote,
    check_state,
)
from haptether.slave.ur.connection import LinkError, UrLink
from haptether.slave.ur.dashboard import unlock_protective_stop
from haptether.slave.ur.options import UrOptions
from haptether.slave.ur.probe import Probe, probe
from haptether.slave.ur.state import PLAYING, PROTECTIVE_BIT, UrState

UNLOCK_AFTER_S: Final = 5.0
"""The controller refuses before."""
UNLOCKED_WITHIN_S: Final = 3.0
ENDED_WITHIN_S: Final = 0.5
"""More than the watchdog's longest period."""


def recover(options: UrOptions, link: UrLink, stopped_at_s: float) -> UrState:
    """Unlocks a protective stop, connects again and uploads the script again, as far as each is needed.

    It powers nothing on and leaves emergency and safeguard stops to people beside the arm. The force sensor stays as it
    is: the tool may touch something.

    Args:
        options: Of the driver.
        link: Its connections, in whatever state.
        stopped_at_s: When the fault was seen, on the monotonic clock.

    Raises:
        Exception: What still stands against it; the arm stays where it is.
    """
    seen = _unlocked(options.host, probe(options.host), stopped_at_s)
    checklist = Checklist(options.host)
    check_state(seen, checklist)
    if REMOTE_SINCE <= seen.version[:2] < NO_DASHBOARD_SINCE:
        check_remote(options.host, checklist)
    checklist.finish()
    end_s = time.monotonic() + ENDED_WITHIN_S
    while link.control is None and seen.runtime_state == PLAYING and time.monotonic() < end_s:
        # Ours may just be ending.
        seen = probe(options.host)
    if link.control is None and seen.runtime_state == PLAYING:
        # Ours has ended with its interface: to connect would stop what somebody has started meanwhile.
        message = "a program plays that is not ours: stop it on the pendant, then acknowledge again"
        raise LinkError(message)
    link.connect()
    return check_after(options, link, checklist, sensor=False)


def _unlocked(host: str, seen: Probe, stopped_at_s: float) -> Probe:
    if not seen.safety_bits & PROTECTIVE_BIT:
        return seen
    left_s = UNLOCK_AFTER_S - (time.monotonic() - stopped_at_s)
    if left_s > 0.0:
        message = f"protective stop: can be unlocked in {left_s:.1f} s: inspect its cause, then acknowledge again"
        raise LinkError(message)
    if seen.version[:2] >= NO_DASHBOARD_SINCE:
        message = "protective stop: this software has no dashboard: unlock it on the pendant, then acknowledge again"
        raise LinkError(message)
    unlock_protective_stop(host)
    end_s = time.monotonic() + UNLOCKED_WITHIN_S
    while seen.safety_bits & PROTECTIVE_BIT:
        if time.monotonic() > end_s:
            message = f"protective stop: still there {UNLOCKED_WITHIN_S:g} s after it was unlocked: see the pendant"
            raise LinkError(message)
        seen = probe(host)
    return seen
