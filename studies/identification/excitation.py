"""Small motions of a device, within bounds of force, speed and travel, for identification.

A sinusoidal force acts along one axis after the other, at several frequencies; it grows until a bound of travel or
speed is near. A weak spring and damper return every axis to its start. Several frequencies separate mass, friction and
delay: a delay t of the force acts like viscous friction `m w^2 t`, which grows with the frequency.
"""

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from haptether.bridge.devices.check.form import Kind, Reading, SampleForm
from haptether.bridge.devices.standalone import EndOfRunError, Written

ASKED_S = 2.0
"""Validity of the user's consent."""
GAP_S = 0.02
"""A gap between ticks longer than this ends the motion."""
SPEED_OVER_S = 0.01
"""Time over which speed is computed from positions."""
NEAR = 0.6
"""Fraction of a bound of travel or speed at which the force stops growing and is reduced."""
GROWS_S = 3.0
"""Time for the force of a frequency to grow to its bound."""
HOLD_S, PERIODS = 2.0, 4.0
"""Duration of a frequency after that: in s and in periods, the longer of the two."""
FADE_S = 0.4
"""Time for the force of a frequency to fade out."""
SETTLE_S = 0.3
"""Pause between two frequencies."""
SPRING = 0.2
"""Fraction of the largest force that the spring exerts at the bound of travel."""
FIRST_S, WEIGHT_S = 2.5, 0.5
"""Initial phase that balances an uncompensated weight, and its time constant."""
LATER_S = 3.0
"""Time constant afterwards; motion reveals the part of the weight that friction has hidden."""
FIRST_SPRING = 0.6
"""`SPRING` during that phase."""
WEIGHT = 0.6
"""Largest fraction of the force bound used for the weight."""
DAMPING_S = 0.03
"""Damping over stiffness of the spring; longer than any delay of a usable loop."""
FREQUENCIES_HZ = (1.3, 2.3, 4.1, 7.3, 11.9)
"""Excited frequencies; none is a multiple of another."""
SAMPLES_A_PERIOD = 40.0
"""Frequencies with fewer samples per period are skipped."""


REMEDY = "allow less force, or more travel and speed"
"""Remedy once a bound has been exceeded."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of the motions on each axis."""

    force: float
    """Force in N (N m)."""
    travel: float
    """Travel in m (rad) from the start; the motion ends beyond it."""
    speed: float
    """Speed in m/s (rad/s); the motion ends beyond it."""


DEFAULT_BOUNDS = {"linear": Bounds(1.0, 0.02, 0.3), "joints": Bounds(0.1, 0.3, 3.0)}
LARGEST_BOUNDS = {"linear": Bounds(5.0, 0.1, 1.0), "joints": Bounds(2.0, 1.0, 10.0)}


@dataclass
class Segment:
    """A frequency on an axis: its force grows, holds, and fades."""

    axis: int
    frequency_hz: float
    amplitude: float = 0.0
    begun_s: float | None = None
    held_s: float | None = None
    """Start of the hold."""
    fading_s: float | None = None
    is_over: bool = False
    _recent: deque[tuple[float, float]] = field(default_factory=deque)

    def force(self, at_s: float, x: float, v: float, bounds: Bounds) -> float:
        """Force at a time, for displacement and speed of the axis."""
        if self.begun_s is None:
            self.begun_s = at_s + SETTLE_S
        if at_s < self.begun_s:
            return 0.0
        # Amplitude of the swing through this position and speed.
        swing = math.hypot(x, v / (2.0 * math.pi * self.frequency_hz))
        near = max(swing / bounds.travel, abs(v) / bounds.speed)
        self._recent.append((at_s, near))
        while at_s - self._recent[0][0] > 1.0 / self.frequency_hz:
            self._recent.popleft()
        largest = max(near for _, near in self._recent)
        most = 0.8 * bounds.force
        if near > 1.2 * NEAR:
            self.amplitude *= 0.98
        if self.held_s is None:
            self.amplitude = min(most, most * (at_s - self.begun_s) / GROWS_S)
            if largest > NEAR or self.amplitude >= most:
                self.held_s = at_s
        elif self.fading_s is None and at_s - self.held_s > max(HOLD_S, PERIODS / self.frequency_hz):
            self.fading_s = at_s
        share = 1.0 if self.fading_s is None else 1.0 - (at_s - self.fading_s) / FADE_S
        self.is_over = share <= 0.0
        return self.amplitude * max(0.0, share) * math.sin(2.0 * math.pi * self.frequency_hz * (at_s - self.begun_s))


class Excitation:
    """A lead that writes zero until the user consents, then makes the motions, and ends.

    Args:
        kind: "linear" or "joints".
        bounds: Bounds of the motions.
        period_s: Period of the loop in s; it limits the frequencies.
        axes: Axes to move; by default all.
    """

    def __init__(
        self, kind: Kind, bounds: Bounds, *, period_s: float = 1e-3, axes: Sequence[int] | None = None
    ) -> None:
        self.form = SampleForm("master", kind)
        self.bounds = bounds
        self.ended: str | None = None
        """Reason of an early end; None otherwise."""
        self.is_complete = False
        self.readings: list[Reading | None] = []
        self.spans: dict[int, tuple[float, float]] = {}
        """Start and end of the motion of each axis."""
        self._axes = axes
        self._segments: deque[Segment] = deque()
        self._frequencies = [of for of in FREQUENCIES_HZ if of * period_s * SAMPLES_A_PERIOD <= 1.0]
        self._begin_asked_s: float | None = None
        self._begun_s: float | None = None
        self._from: tuple[float, ...] = ()
        self._last_s = -math.inf
        self._trail: deque[tuple[float, tuple[float, ...]]] = deque()
        self._velocity: list[float] = []
        self._weight: list[float] = []

    @property
    def axis(self) -> int | None:
        """The moving axis."""
        return self._segments[0].axis if self._segments else None

    @property
    def begun_s(self) -> float | None:
        """Start of the motions."""
        return self._begun_s

    def duration_s(self, axes: int) -> float:
        """Longest duration of the motions in s."""
        count = axes if self._axes is None else len(self._axes)
        each = sum(SETTLE_S + GROWS_S + max(HOLD_S, PERIODS / of) + FADE_S for of in self._frequencies)
        return FIRST_S + count * each

    def request(self, at_s: float | None = None) -> None:
        """Take the user's consent to begin, valid for 2 s."""
        self._begin_asked_s = time.monotonic() if at_s is None else at_s

    def step(self, sample: object, at_s: float) -> Written | None:
        """Force after a sample.

        Raises:
            EndOfRunError: All motions are done, or a check failed: zero is written.
        """
        reading = self.form.take(sample)
        self.readings.append(reading)
        if self.form.axes is None:
            return None
        if self._begun_s is None:
            self._may_begin(reading, at_s)
            if self._begun_s is None:
                return self._written((0.0,) * self.form.axes)
        assert reading is not None or self._from
        why = self._wrong(reading, at_s)
        step_s, self._last_s = at_s - self._last_s, at_s
        if why is not None or reading is None:
            self.ended = why
            raise EndOfRunError
        return self._written(self._force(reading, at_s, step_s))

    def _written(self, force: tuple[float, ...]) -> Written:
        return (force, (0.0,) * 3) if self.form.kind == "pose" else (force,)

    def _may_begin(self, reading: Reading | None, at_s: float) -> None:
        asked_s = self._begin_asked_s
        if asked_s is None or reading is None:
            return
        if at_s - asked_s > ASKED_S:
            self.ended = "it was asked for too long ago"
            raise EndOfRunError
        axes = range(len(reading.position)) if self._axes is None else self._axes
        self._segments.extend(Segment(axis, of) for axis in axes for of in self._frequencies)
        self._from, self._begun_s, self._last_s = reading.position, at_s, at_s
        self._velocity = [0.0] * len(reading.position)
        self._weight = [0.0] * len(reading.position)

    def _wrong(self, reading: Reading | None, at_s: float) -> str | None:
        if reading is None:
            return "a sample was refused"
        if reading.fault is not None:
            return f"the device reports: {reading.fault}"
        if at_s - self._last_s > GAP_S:
            return f"a sample came {1e3 * (at_s - self._last_s):.0f} ms after the one before: let nothing else run here"
        self._trail.append((at_s, reading.position))
        while at_s - self._trail[0][0] > 1.5 * SPEED_OVER_S:
            self._trail.popleft()
        then_s, then = self._trail[0]
        span_s = at_s - then_s
        if span_s >= 0.5 * SPEED_OVER_S:
            self._velocity = [(x - old) / span_s for x, old in zip(reading.position, then, strict=True)]
        for axis, (x, begin) in enumerate(zip(reading.position, self._from, strict=True)):
            if not abs(x - begin) <= self.bounds.travel:
                text = f"axis {axis} is {abs(x - begin):.3g} from where it began: at most {self.bounds.travel:g}"
                return f"{text}; {REMEDY}"
            if not abs(self._velocity[axis]) <= self.bounds.speed:
                text = f"axis {axis} moves at {abs(self._velocity[axis]):.3g}: at most {self.bounds.speed:g}"
                return f"{text}; {REMEDY}"
        return None

    def _force(self, reading: Reading, at_s: float, step_s: float) -> tuple[float, ...]:
        bounds, segment = self.bounds, self._segments[0]
        assert self._begun_s is not None
        since_s = at_s - self._begun_s
        stiffness = (FIRST_SPRING if since_s < FIRST_S else SPRING) * bounds.force / bounds.travel
        force = []
        for axis, (x, begin, v) in enumerate(zip(reading.position, self._from, self._velocity, strict=True)):
            most = WEIGHT * bounds.force
            taken = stiffness * (x - begin) * step_s / (WEIGHT_S if since_s < FIRST_S else LATER_S)
            weight = self._weight[axis] - taken
            self._weight[axis] = max(-most, min(most, weight))
            f = self._weight[axis] - stiffness * ((x - begin) + DAMPING_S * v)
            if axis == segment.axis and since_s >= FIRST_S:
                f += segment.force(at_s, x - begin, v, bounds)
            force.append(max(-bounds.force, min(bounds.force, f)))
        # Each motion starts from zero force.
        ramp = min(1.0, since_s / SETTLE_S)
        if since_s >= FIRST_S:
            self.spans[segment.axis] = (self.spans.get(segment.axis, (at_s, at_s))[0], at_s)
        if segment.is_over:
            self._segments.popleft()
            if not self._segments:
                self.is_complete = True
                raise EndOfRunError
        return tuple(ramp * f for f in force)
