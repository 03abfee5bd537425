"""Findings of a design check, and their units."""

from collections.abc import Callable
from math import ceil, floor, log10, sqrt
from typing import Any, Literal

from msgspec import Struct

Z99 = 2.326
"""99 % quantile of the normal distribution."""
MARGIN = 1.25
"""Ratio of delay or stiffness margin below which it counts as small."""

SHOWN_DELAY_S = 0.5
"""Largest delay in s that is examined, unless twice the link's delay is larger."""
Intervals = tuple[tuple[float, float], ...]
"""Intervals of a delay in s."""
State = Literal["bad", "warning", "not judged", "good", "note"]


class Finding(Struct, frozen=True, kw_only=True):
    """Inequality with its numbers."""

    name: str
    """Subject."""
    state: State
    """Result: bad, warning (small margin, or with a drawback), not judged (the criterion does not cover the scene),
    good, or a note.
    """
    text: str
    """One sentence with numbers and units."""
    value: float | None = None
    limit: float | None = None
    """Limit of `value`, if it is a single number."""
    unit: str = ""
    remedy: str | None = None
    changes: tuple[str, ...] = ()
    """Overrides for `override_scene` that fix the finding: verified to improve or remove it without making another one
    worse. Empty if none was found.
    """


class DesignCheck(Struct, frozen=True, kw_only=True):
    """All findings of a scene."""

    findings: tuple[Finding, ...]

    def of(self, state: State) -> tuple[Finding, ...]:
        """Return the findings in a state."""
        return tuple(finding for finding in self.findings if finding.state == state)


class Units(Struct, frozen=True, kw_only=True):
    """Units of a device's axes."""

    speed: str
    force: str
    stiffness: str
    damping: str

    @classmethod
    def of(cls, spec: dict[str, Any]) -> "Units":
        """Return the units for a scene's numbers; joints use angles and torques."""
        if spec["master"]["kind"] == "joints":
            return cls(speed="rad/s", force="N m", stiffness="N m/rad", damping="N m s/rad")
        return cls(speed="m/s", force="N", stiffness="N/m", damping="N s/m")


def link_delays_s(spec: dict[str, Any]) -> tuple[float, float] | None:
    """Return mean and 99th percentile of the sum of both delays in s, including ticks; None for a recorded delay."""
    delay_s, variance = 2.0 * max(spec["run"]["period_s"], spec["slave"]["period_s"]), 0.0
    for direction in (spec["link"] or {}).values():
        if direction is None or "delay_s" not in direction:
            continue
        if direction["trace"] is not None:
            return None
        delay_s += direction["delay_s"] or 0.0
        variance += (direction["jitter_s"] or 0.0) ** 2
    return delay_s, delay_s + Z99 * sqrt(variance)


def shown_delay_s(spec: dict[str, Any]) -> float:
    """Return the largest delay in s that is examined."""
    delays = link_delays_s(spec)
    return SHOWN_DELAY_S if delays is None else max(SHOWN_DELAY_S, 2.0 * delays[1])


def intervals_text(stable: Intervals, up_to_s: float) -> str:
    """Return the stable intervals of a delay in s as text, in ms."""
    if not stable:
        return f"stable at no round trip up to {up_to_s * 1e3:.0f} ms"
    parts = []
    for low, high in stable:
        to = "beyond" if high >= up_to_s else f"{high * 1e3:.1f} ms"
        parts.append(f"to {to}" if low == 0.0 else f"from {low * 1e3:.1f} ms to {to}")
    last = stable[-1][1]
    if stable == ((0.0, up_to_s),):
        return f"stable at every round trip up to {up_to_s * 1e3:.0f} ms"
    rest = "" if last >= up_to_s else ", unstable beyond"
    return f"stable {', again '.join(parts)}{rest}"


def rounded_down(value: float) -> float:
    """Round down to two digits, so that the printed value is not above the found one."""
    return _rounded(value, floor)


def rounded_up(value: float) -> float:
    """Round up to two digits, so that the printed value is not below the found one."""
    return _rounded(value, ceil)


def _rounded(value: float, whole: Callable[[float], int]) -> float:
    digits = 1 - floor(log10(value))
    # Avoids a step down for values like 0.3 that are stored as 0.29999999999999999.
    return float(f"{whole(round(value * 10.0**digits, 9)) / 10.0**digits:.12g}")
