"""What a design check finds, and in which units."""

from math import sqrt
from typing import Any, Literal

from msgspec import Struct

Z99 = 2.326
"""Quantile of a normal law that 1 % exceed."""
MARGIN = 1.25
"""Of delay and stiffness, below which a margin is small."""

State = Literal["bad", "warning", "not judged", "good", "note"]


class Finding(Struct, frozen=True, kw_only=True):
    """One inequality with its numbers."""

    name: str
    """What it is about."""
    state: State
    """Whether it holds: bad, warning (little room, or with a price), not judged (what it would be judged by does not
    cover the scene), good, or a note."""
    text: str
    """In one sentence, with numbers and units."""
    value: float | None = None
    limit: float | None = None
    """What `value` is held against, where it is one number."""
    unit: str = ""
    remedy: str | None = None
    """What would mend it."""
    changes: tuple[str, ...] = ()
    """Fields of the scene that mend it, as `override_scene` takes them: applied, the finding was better or gone, and no
    other worse. None where no field was found that does."""


class DesignCheck(Struct, frozen=True, kw_only=True):
    """All findings of a scene."""

    findings: tuple[Finding, ...]

    def of(self, state: State) -> tuple[Finding, ...]:
        """The findings in that state."""
        return tuple(finding for finding in self.findings if finding.state == state)


class Units(Struct, frozen=True, kw_only=True):
    """Those of a device's axes."""

    speed: str
    force: str
    stiffness: str
    damping: str

    @classmethod
    def of(cls, spec: dict[str, Any]) -> "Units":
        """Of a scene's numbers: of joints angles and torques."""
        if spec["master"]["kind"] == "joints":
            return cls(speed="rad/s", force="N m", stiffness="N m/rad", damping="N m s/rad")
        return cls(speed="m/s", force="N", stiffness="N/m", damping="N s/m")


def link_delays_s(spec: dict[str, Any]) -> tuple[float, float] | None:
    """Mean of both delays together and what 1 % exceed, in s, ticks included; none where a recording has them."""
    delay_s, variance = 2.0 * max(spec["run"]["period_s"], spec["slave"]["period_s"]), 0.0
    for direction in (spec["link"] or {}).values():
        if direction is None or "delay_s" not in direction:
            continue
        if direction["trace"] is not None:
            return None
        delay_s += direction["delay_s"] or 0.0
        variance += (direction["jitter_s"] or 0.0) ** 2
    return delay_s, delay_s + Z99 * sqrt(variance)
