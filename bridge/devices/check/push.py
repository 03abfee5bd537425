"""What a device is written while it is checked: zero, and on request one small push that ends by itself."""

import math
import time
from dataclasses import dataclass, field

from haptether.bridge.devices.check.form import Reading, SampleForm
from haptether.bridge.devices.standalone import Written

RAMP_S, HOLD_S = 0.5, 0.5
"""Of a push: it rises over the first, stays for the second, and falls over the first again."""
ASKED_S = 2.0
"""A person's word for a push counts for so long."""
GAP_S = 0.02
"""A tick that comes later ends a push."""
SPEED_OVER_S = 0.01
"""Time over which speed is taken from positions."""
MAX_PUSH = {"linear": 1.0, "pose": 1.0, "joints": 0.1}
"""The largest push, in N (N m for joints)."""
MAX_TRAVEL = {"linear": 0.05, "pose": 0.05, "joints": 0.5}
"""m (rad), after which a push ends."""
MAX_SPEED = {"linear": 0.25, "pose": 0.25, "joints": 2.0}
"""m/s (rad/s), at which a push ends."""


@dataclass
class Push:
    """A force along one axis: up a ramp, for a while, and down again; or zero from the moment that something is wrong.

    Args:
        size: In N (N m), positive towards +x.
        axis: Along which.
        kind: Whose bounds of travel and speed hold.
    """

    size: float
    axis: int
    kind: str
    begun_s: float | None = None
    ended: str | None = None
    """Why it is over."""
    travel: float = 0.0
    """How far it is along the axis from where it began, in m (rad)."""
    farthest: float = 0.0
    """The travel of the largest magnitude."""
    _from: tuple[float, ...] = ()
    _last_s: float = 0.0
    _trail: list[tuple[float, tuple[float, ...]]] = field(default_factory=list)

    def force(self, reading: Reading | None, at_s: float) -> float:
        """What to exert after a sample."""
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
        """Why it must end now."""
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
    """Share of a push at a time since its begin."""
    left_s = 2.0 * RAMP_S + HOLD_S - time_s
    return max(0.0, min(1.0, time_s / RAMP_S, left_s / RAMP_S))


@dataclass
class CheckLead:
    """Reads, writes zero to a master, and nothing to an arm, which is thus never moved."""

    form: SampleForm
    readings: list[Reading | None] = field(default_factory=list)
    push: Push | None = None
    _asked_s: float = 0.0
    _wrote: bool = False

    def request(self, push: Push) -> None:
        """A person's word for a push, which begins with the next sample if that comes in time.

        Raises:
            ValueError: Of an arm, or beyond its bound.
        """
        if self.form.side != "master" or not 0.0 < push.size <= MAX_PUSH[push.kind]:
            message = f"a push of {push.size:g}: must be of a master, above 0 and at most {MAX_PUSH[push.kind]:g}"
            raise ValueError(message)
        self._asked_s = time.monotonic()
        self.push = push

    def step(self, sample: object, at_s: float) -> Written | None:
        """Zero, or the push that was requested."""
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
