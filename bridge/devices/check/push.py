"""Output to a device under check: zero, or on request one small push of limited duration."""

import math
import time
from dataclasses import dataclass, field

from haptether.bridge.devices.check.form import Reading, SampleForm
from haptether.bridge.devices.standalone import Written

RAMP_S, HOLD_S = 0.5, 0.5
"""Duration in s of each ramp, and of the plateau between the rising and the falling ramp."""
ASKED_S = 2.0
"""Validity in s of an operator's request for a push."""
GAP_S = 0.02
"""A longer gap in s between ticks ends a push."""
SPEED_OVER_S = 0.01
"""Window in s over which speed is computed from positions."""
MAX_PUSH = {"linear": 1.0, "pose": 1.0, "joints": 0.1}
"""Largest push in N (N m for joints)."""
MAX_TRAVEL = {"linear": 0.05, "pose": 0.05, "joints": 0.5}
"""Travel in m (rad) that ends a push."""
MAX_SPEED = {"linear": 0.25, "pose": 0.25, "joints": 2.0}
"""Speed in m/s (rad/s) that ends a push."""


@dataclass
class Push:
    """Trapezoidal force along one axis; zero after any fault.

    Args:
        size: Force in N (N m), positive towards +x.
        axis: Index of the axis.
        kind: Kind of coordinates, which selects the travel and speed bounds.
    """

    size: float
    axis: int
    kind: str
    begun_s: float | None = None
    ended: str | None = None
    """Reason for the end."""
    travel: float = 0.0
    """Displacement along the axis from the start, in m (rad)."""
    farthest: float = 0.0
    """Displacement of the largest magnitude."""
    _from: tuple[float, ...] = ()
    _last_s: float = 0.0
    _trail: list[tuple[float, tuple[float, ...]]] = field(default_factory=list)

    def force(self, reading: Reading | None, at_s: float) -> float:
        """Return the force to exert after a sample."""
        if self.ended is not None:
            return 0.0
        if reading is None or reading.fault is not None:
            self.ended = "a sample was refused" if reading is None else f"the device reports: {reading.fault}"
            return 0.0
        if self.begun_s is None:
            self.begun_s, self._from, self._last_s = at_s, reading.position, at_s
        self.travel = reading.position[self.axis] - self._from[self.axis]
        self.farthest = max(self.farthest, self.travel, key=abs)
        self._trail = [step for step in self._trail if at_s - step[0] <= 2.0 * SPEED_OVER_S]
        self._trail.append((at_s, reading.position))
        why = self._stopped(reading, at_s)
        self._last_s = at_s
        if why is not None:
            self.ended = why
            return 0.0
        return self.size * profile(at_s - self.begun_s)

    def _stopped(self, reading: Reading, at_s: float) -> str | None:
        """Return the reason to end now, or None."""
        assert self.begun_s is not None
        if at_s - self.begun_s >= 2.0 * RAMP_S + HOLD_S:
            return "ended by itself"
        if at_s - self._last_s > GAP_S:
            return f"a tick came {1e3 * (at_s - self._last_s):.0f} ms after the one before"
        if math.dist(reading.position, self._from) > MAX_TRAVEL[self.kind]:
            return f"it has moved by more than {MAX_TRAVEL[self.kind]:g}"
        old_s, old = self._trail[0]
        if at_s - old_s >= SPEED_OVER_S and math.dist(reading.position, old) > MAX_SPEED[self.kind] * (at_s - old_s):
            return f"it is faster than {MAX_SPEED[self.kind]:g}"
        return None


def profile(time_s: float) -> float:
    """Return the fraction of the push at a time since its start."""
    left_s = 2.0 * RAMP_S + HOLD_S - time_s
    return max(0.0, min(1.0, time_s / RAMP_S, left_s / RAMP_S))


@dataclass
class CheckLead:
    """Read only: write zero to a master and nothing to an arm, which therefore never moves."""

    form: SampleForm
    readings: list[Reading | None] = field(default_factory=list)
    push: Push | None = None
    _asked_s: float = 0.0
    _wrote: bool = False

    def request(self, push: Push) -> None:
        """Request a push at an operator's command; it starts with the next sample unless the request has expired.

        Raises:
            ValueError: The device is an arm, or the push exceeds its bound.
        """
        if self.form.side != "master" or not 0.0 < push.size <= MAX_PUSH[push.kind]:
            message = f"a push of {push.size:g}: must be of a master, above 0 and at most {MAX_PUSH[push.kind]:g}"
            raise ValueError(message)
        self._asked_s = time.monotonic()
        self.push = push

    def step(self, sample: object, at_s: float) -> Written | None:
        """Return zero, or the requested push."""
        reading = self.form.take(sample)
        self.readings.append(reading)
        if self.form.side == "slave" or self.form.axes is None or (reading is None and not self._wrote):
            return None
        self._wrote = True
        force = [0.0] * self.form.axes
        push = self.push
        if push is not None:
            if push.begun_s is None and push.ended is None and at_s - self._asked_s > ASKED_S:
                push.ended = "it was asked for too long ago"
            force[push.axis] = push.force(reading, at_s)
        return (tuple(force), (0.0,) * 3) if self.form.kind == "pose" else (tuple(force),)
