"""State of a side from its telemetry."""

import math
from collections import deque
from typing import Any

from msgspec import Struct

from haptether.bridge import (
    OBSERVED_SIGNALS,
    TRIP_BITS,
    TelemetryCause,
    TelemetryChange,
    TelemetryCleared,
    TelemetryEnd,
    TelemetryHello,
    TelemetryInvalid,
    TelemetryLink,
    TelemetryLost,
    TelemetryMessage,
    TelemetrySample,
    coupling_facts,
    trip_thresholds,
    tripped_names,
)

SECOND_NS = 1_000_000_000
MAX_SAMPLES = 120
"""Samples kept for the last second: 60, or more if samples arrive late."""
MAX_EVENTS = 64


class Observer(Struct, frozen=True, kw_only=True):
    """Controller and its observer."""

    controller: str
    symbol: str
    value: float | None
    """Value of the last tick; None if not observed."""
    worst: float | None
    """Value of the last second nearest to, or furthest beyond, the threshold."""
    threshold: float | None
    """Trip threshold; None if the scene is unknown."""
    trips_above: bool
    """True if it trips above its threshold, False if below."""
    tripped: bool
    """True if tripped in any tick of the last second."""

    @property
    def share(self) -> float | None:
        """Return the fraction of `worst` relative to the threshold; above 1 beyond it."""
        if self.worst is None or self.threshold is None:
            return None
        if self.threshold == 0.0:
            # Energy that must not fall below 0.
            return 0.0 if self.worst > 0.0 else 1.0
        return max(0.0, self.worst / self.threshold)


class SideState:
    """Latest values from telemetry messages, and extremes of the last second.

    Args:
        hello: First message.
    """

    def __init__(self, hello: TelemetryHello) -> None:
        self.hello = hello
        self.side = hello.side
        self.kinds = {signal.name: signal.kind for signal in hello.signals}
        self.cause: TelemetryCause | None = None
        """Cause of not being coupled; None if coupled or unknown."""
        self.has_ended = False
        """True if the loop ended normally."""
        self.time_s = 0.0
        """Time of the last sample since the run began."""
        self.lost_ticks = 0
        """Ticks lost because this reader was too slow."""
        self.invalid = 0
        """Number of lines and samples with skipped invalid parts."""
        self.invalid_text = ""
        """Last skipped part and reason."""
        self.dropped = 0
        """Records that did not reach the sender."""
        self.ticks = 0
        """Number of ticks seen."""
        self.events: deque[tuple[float, str]] = deque(maxlen=MAX_EVENTS)
        """Latest ladder transitions and trips, with times in s."""
        self.events_seen = 0
        """Number of events, including dropped ones."""
        self._begun_s: float | None = None
        self._samples: deque[TelemetrySample] = deque(maxlen=MAX_SAMPLES)

    def take(self, message: TelemetryMessage) -> None:
        """Take the next message."""
        match message:
            case TelemetrySample():
                self._take_sample(message)
            case TelemetryChange(signal="state"):
                self._note(message.time_ns, str(message.to))
            case TelemetryChange(signal="tripped", from_=before, to=now):
                new = tripped_names(int(now) & ~int(before))
                if new:
                    self._note(message.time_ns, f"trip {' '.join(new)}")
            case TelemetryCause():
                self.cause = message
                self._note(message.time_ns, f"{message.at}: {message.text}")
            case TelemetryCleared():
                self.cause = None
            case TelemetryLost(ticks=ticks):
                self.lost_ticks += ticks
            case TelemetryInvalid(text=text):
                self._take_invalid(text)
            case TelemetryEnd():
                self.has_ended = True
            case _:
                pass

    def _take_sample(self, message: TelemetrySample) -> None:
        self.time_s = message.time_ns * 1e-9
        if self._begun_s is None:
            self._begun_s = self.time_s
        self.ticks += message.ticks
        self.dropped = message.dropped
        before = self._coupling().get("kind")
        self._samples.append(message)
        if (kind := self._coupling().get("kind")) != before:
            self._note(message.time_ns, f"coupling {kind}")
        while self._samples[0].time_ns < message.time_ns - SECOND_NS:
            self._samples.popleft()

    def _take_invalid(self, text: str) -> None:
        if not self.invalid:
            self._note(round(self.time_s * SECOND_NS), f"invalid telemetry: {text}")
        self.invalid += 1
        self.invalid_text = text

    @property
    def link(self) -> TelemetryLink | None:
        """Return the frame counts since the run began; None before the first sample."""
        return self._samples[-1].link if self._samples else None

    @property
    def watched_s(self) -> float:
        """Return the run time in s from the first to the last sample."""
        return 0.0 if self._begun_s is None else self.time_s - self._begun_s

    def last(self, name: str) -> Any:  # noqa: ANN401  # by the kind of the signal
        """Return the last value of a signal, a list for "axes"; None if unknown."""
        if not self._samples or name not in self._samples[-1].signals:
            return None
        value = self._samples[-1].signals[name]
        match self.kinds[name]:
            case "axes":
                return [axis[2] for axis in value]
            case "number":
                return value[2]
            case "bits":
                return value[1]
            case _:
                return value

    def extremes(self, name: str) -> tuple[float, float] | None:
        """Return the extremes of a number, or over all axes, in the last second; None if unknown."""
        if name not in self.kinds:
            return None
        of = [
            axis
            for sample in self._samples
            if name in sample.signals
            for axis in (sample.signals[name] if self.kinds[name] == "axes" else [sample.signals[name]])
        ]
        low = [axis[0] for axis in of if axis[0] is not None]
        high = [axis[1] for axis in of if axis[1] is not None]
        return (min(low), max(high)) if low and high else None

    def peak(self, name: str) -> float | None:
        """Return the largest magnitude of a number, or of any axis, in the last second."""
        extremes = self.extremes(name)
        return None if extremes is None else max(abs(extremes[0]), abs(extremes[1]))

    def norm(self, name: str) -> float | None:
        """Return the norm of the last values of the axes."""
        values = self.last(name)
        return None if values is None or None in values else math.hypot(*values)

    def observers(self) -> list[Observer]:
        """Return the controllers of the scene, or without a scene those that observe."""
        safety = (self.hello.scene or {}).get("safety") or {}
        thresholds = trip_thresholds(safety)
        armed = safety.get("controllers")
        bits = self._bits("tripped") | self._bits("rotation_tripped")
        found = []
        for name, observed in OBSERVED_SIGNALS.items():
            signal = observed.signal
            extremes = self.extremes(signal)
            if signal not in self.kinds or (extremes is None if armed is None else name not in armed):
                continue
            above = thresholds[name] > 0.0
            found.append(
                Observer(
                    controller=name,
                    symbol=observed.label,
                    value=self.last(signal),
                    worst=None if extremes is None else extremes[1 if above else 0],
                    threshold=thresholds[name] if safety else None,
                    trips_above=above,
                    tripped=bool(bits & TRIP_BITS[name]),
                )
            )
        return found

    def passivity_margin(self) -> float | None:
        """Return B over the least B with which the coupling is passive, at the longest round trip of the last second.

        One period is added to the round trip, as in `check-link`. A pose has the smaller ratio of translation and
        rotation. None without a scene or a round trip, and for a coupling that claims no passivity.
        """
        scene, round_trip_s = self.hello.scene or {}, self.peak("round_trip_s")
        try:
            table, period_s = self._coupling(), max(scene["run"]["period_s"], scene["slave"]["period_s"])
            facts = coupling_facts(
                table["kind"], stiffness=table["stiffness"], damping=table["damping"],
                round_trip_s=round_trip_s + period_s, period_s=period_s,
            )  # fmt: skip
            if facts.least_damping is None or facts.stiffness is None or facts.damping is None:
                return None
            per = facts.least_damping / facts.stiffness
            margin = facts.damping / facts.least_damping
            if scene["master"]["kind"] == "pose":
                square = scene["safety"]["rotation"]["lever_m"] ** 2
                stiffness, damping = table["rotational_stiffness"], table["rotational_damping"]
                stiffness = facts.stiffness * square if stiffness is None else stiffness
                damping = facts.damping * square if damping is None else damping
                margin = min(margin, damping / (stiffness * per))
        except (ArithmeticError, KeyError, TypeError, ValueError):
            # A sender may leave settings out.
            return None
        return margin

    def signal_of(self, controller: str) -> str:
        """Return the signal that a controller observes."""
        return OBSERVED_SIGNALS[controller].signal

    def is_held(self) -> bool:
        """Return True if an intervention was in hold-off or fade-out in the last second."""
        return bool(self._bits("tripped") & TRIP_BITS["held"])

    def loss(self) -> float | None:
        """Return the fraction of peer frames of the last second that have not arrived; None without frames.

        An overtaken frame counts as lost until it arrives.
        """
        if len(self._samples) < 2:
            return None
        first, last = self._samples[0].link, self._samples[-1].link
        arrived = last.fresh + last.late - first.fresh - first.late
        missing = max(0, last.missing - first.missing)
        return missing / (arrived + missing) if arrived + missing > 0 else None

    def _coupling(self) -> dict[str, Any]:
        """Return kind and gains of the coupling in use; gains that the scene lacks are left out. Empty without one."""
        first = (self.hello.scene or {}).get("coupling")
        if not isinstance(first, dict):
            return {}
        kind = self.link.coupling if self.link else ""
        if kind in {"", first.get("kind")}:
            return first
        others = first.get("alternatives")
        found = (other for other in others if isinstance(other, dict)) if isinstance(others, list) else ()
        return next((other for other in found if other.get("kind") == kind), {"kind": kind})

    def _note(self, time_ns: int, text: str) -> None:
        self.events.append((time_ns * 1e-9, text))
        self.events_seen += 1

    def _bits(self, name: str) -> int:
        bits = 0
        for sample in self._samples:
            if name in sample.signals:
                bits |= int(sample.signals[name][0])
        return bits
