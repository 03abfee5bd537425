"""Findings of a design check, and their units."""

from math import sqrt
from typing import Any, Literal

from msgspec import Struct

Z99 = 2.326
"""99 % quantile of the normal distribution."""
MARGIN = 1.25
"""Ratio to the limit of delay or stiffness below which a margin is small."""

State = Literal["bad", "warning", "not judged", "good", "note"]


class Finding(Struct, frozen=True, kw_only=True):
    """One inequality with its numbers."""

    name: str
    """Subject of the finding."""
    state: State
    """Result: bad, warning (small margin, or at a price), not judged (beyond the method), good, or a note."""
    text: str
    """One sentence with numbers and units."""
    value: float | None = None
    limit: float | None = None
    """Limit of `value`, if it is one number."""
    unit: str = ""
    remedy: str | None = None
    changes: tuple[str, ...] = ()
    """Overrides for `override_scene` that mend the finding and worsen no other; empty if none was found."""


class DesignCheck(Struct, frozen=True, kw_only=True):
    """All findings of a scene."""

    findings: tuple[Finding, ...]

    def of(self, state: State) -> tuple[Finding, ...]:
        """Findings in this state."""
        return tuple(finding for finding in self.findings if finding.state == state)


class Units(Struct, frozen=True, kw_only=True):
    """Units of a device's axes."""

    speed: str
    force: str
    stiffness: str
    damping: str

    @classmethod
    def of(cls, spec: dict[str, Any]) -> "Units":
        """Units of a scene: for joints those of angles and torques."""
        if spec["master"]["kind"] == "joints":
            return cls(speed="rad/s", force="N m", stiffness="N m/rad", damping="N m s/rad")
        return cls(speed="m/s", force="N", stiffness="N/m", damping="N s/m")


def link_delays_s(spec: dict[str, Any]) -> tuple[float, float] | None:
    """Mean and 99 % quantile of the sum of both delays in s, ticks included; None for a recorded delay."""
    delay_s, variance = 2.0 * max(spec["run"]["period_s"], spec["slave"]["period_s"]), 0.0
    for direction in (spec["link"] or {}).values():
        if direction is None or "delay_s" not in direction:
            continue
        if direction["trace"] is not None:
            return None
        delay_s += direction["delay_s"] or 0.0
        variance += (direction["jitter_s"] or 0.0) ** 2
    return delay_s, delay_s + Z99 * sqrt(variance)
