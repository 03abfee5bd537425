"""The one declared operator behind every row of `haptether paper`."""

from typing import Literal

import msgspec

from haptether.master import Hand


class Operator(msgspec.Struct, frozen=True, kw_only=True):
    """A hand that presses, holds and releases.

    The hand is an impedance towards a target that leads the device to depth D; it transmits at most its grip strength.
    It reaches `first_share` of the depth quickly, creeps to the full depth and holds. Then its strength falls linearly
    to zero; nothing moves until it has fallen to the load.

    The profile was chosen once, from two places of the paper. Table 1 puts a press "made progressively" about six
    seconds before the release, with half of its work in the first second (MEV against w). The curves of the release
    suggest about 50 ms. No row has parameters of its own.

    Source: press, paper section 4.2 and Table 1; impedance, Hogan 1989; grip margin above the load, Johansson
    and Westling 1984.
    """

    stiffness: float = 300.0
    """Stiffness of the hand in N/m."""
    damping: float = 5.0
    """Damping of the hand in N s/m."""
    approach_s: float = 0.2
    """Time in s from `start` to the wall."""
    start: float = 0.005
    """Start of the hand in m in front of the wall."""
    first_share: float = 0.7
    """Fraction of the depth reached quickly."""
    first_s: float = 1.0
    """Time in s to reach it, with minimum jerk."""
    creep_s: float = 4.5
    """Time in s of the remaining press at constant speed."""
    hold_s: float = 0.5
    """Time in s at full depth before the release."""
    grip_margin: float = 1.5
    """Grip strength over the held load."""
    release_s: float = 0.05
    """Time in s over which the grip strength falls to zero."""
    release_kind: Literal["strength", "gain"] = "strength"
    """Quantity that falls: the grip strength, or the whole impedance."""

    @property
    def release_at_s(self) -> float:
        """Start of the release in s."""
        return self.approach_s + self.first_s + self.creep_s + self.hold_s

    def pressing(self, stiffness: float, depth: float) -> Hand:
        """Hand that presses a wall of `stiffness` in N/m to `depth` in m and releases.

        At the depth D the spring of the hand must carry K D, so its target lies K D / K_h deeper.
        """
        load = stiffness * depth

        def target(share: float) -> float:
            return -share * (depth + load / self.stiffness)

        return Hand(
            stiffness=self.stiffness,
            damping=self.damping,
            strength_n=self.grip_margin * load,
            start=self.start,
            legs=[
                (self.approach_s, 0.0, "minimum-jerk"),
                (self.first_s, target(self.first_share), "minimum-jerk"),
                (self.creep_s, target(1.0), "linear"),
            ],
            release=(self.release_at_s, self.release_s),
            release_kind=self.release_kind,
        )

    def gripping(self, load_n: float, release_at_s: float | None) -> Hand:
        """Hand that holds the stylus at the origin against a load of up to `load_n` N."""
        release = None if release_at_s is None else (release_at_s, self.release_s)
        return Hand(
            stiffness=self.stiffness,
            damping=self.damping,
            strength_n=self.grip_margin * load_n,
            start=0.0,
            release=release,
            release_kind=self.release_kind,
        )
