"""Attacks of the RAVEN II study as shipped scenes, with their effects.

Source: T. Bonaci, J. Herron, T. Yusuf, J. Yan, T. Kohno, H. J. Chizeck, "To make a robot secure: an experimental
analysis of cyber security threats against teleoperated surgical robotics", arXiv 1504.04339, 2015.
"""

from typing import Literal, TypeAlias

import msgspec

Security: TypeAlias = Literal["off", "on"]
"""Authentication of frames."""
Effect: TypeAlias = Literal["moved", "pushed", "late", "stopped", "none"]
"""`moved`: the arm moved where the hand did not lead it. `pushed`: the hand felt a force that was not measured. `late`:
the arm followed late. `stopped`: the sides decoupled and held. `none`: no more than chance.
"""


class RavenAttack(msgspec.Struct, frozen=True, kw_only=True):
    """Attack and its effect."""

    scene: str
    """Name of the shipped scene."""
    kind: str
    """Class in the study."""
    without: Effect
    """Effect on unencrypted frames."""
    protected: Effect
    """Effect on authenticated frames."""
    because: str
    """Reason why the effect is not larger."""


RAVEN_ATTACKS = (
    RavenAttack(
        scene="raven_drop", kind="intent modification", without="stopped", protected="stopped",
        because="no key makes a packet arrive; silence holds the arm",
    ),
    RavenAttack(
        scene="raven_delay", kind="intent modification", without="stopped", protected="stopped",
        because="no key makes a packet arrive in time; silence holds the arm",
    ),
    RavenAttack(
        scene="raven_creeping_delay", kind="intent modification", without="stopped", protected="stopped",
        because="no key makes a packet arrive in time; old news holds the arm",
    ),
    RavenAttack(
        scene="raven_reorder", kind="intent modification", without="none", protected="none",
        because="absolute poses, and the newest counts",
    ),
    RavenAttack(
        scene="raven_invert", kind="intent manipulation", without="moved", protected="stopped",
        because="altered frames are refused; silence holds the arm",
    ),
    RavenAttack(
        scene="raven_scale", kind="intent manipulation", without="moved", protected="stopped",
        because="altered frames are refused; silence holds the arm",
    ),
    RavenAttack(
        scene="raven_pose", kind="intent manipulation", without="moved", protected="stopped",
        because="altered frames are refused; silence holds the arm",
    ),
    RavenAttack(
        scene="raven_feedback", kind="intent manipulation", without="pushed", protected="stopped",
        because="altered frames are refused; silence takes the force away",
    ),
    RavenAttack(
        scene="raven_hijack", kind="hijacking", without="moved", protected="none",
        because="frames of somebody else are refused; the hand's go on",
    ),
    RavenAttack(
        scene="raven_replay", kind="hijacking", without="none", protected="none",
        because="a sequence never goes back within a session",
    ),
    RavenAttack(
        scene="raven_limits", kind="abuse of the emergency stop", without="none", protected="none",
        because="clamped where it arrives; the network cannot trip a stop",
    ),
    RavenAttack(
        scene="raven_nan", kind="abuse of the emergency stop", without="none", protected="none",
        because="refused at the door, before the sequence counts",
    ),
)  # fmt: skip
"""Attacks of `haptether raven`."""
