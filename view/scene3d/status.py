"""Text beside the picture: ladder, link, interventions, and observers against thresholds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from haptether.bridge import (
    LADDER_STATES,
    OBSERVED_SIGNALS,
    TRIP_BITS,
    Event,
    Scene,
    Signals,
    ladder_state_name,
    trip_thresholds,
)
from haptether.bridge.scene.resolve import spec_of
from haptether.view.scene3d.extent import is_joints
from haptether.view.scene3d.parts import Course

TRIPS = frozenset({"trip"})
INTERVENES = sum(TRIP_BITS.values())
"""All bits of `tripped`."""
LADDER_KINDS = frozenset(LADDER_STATES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauge:
    """Observer value against its threshold."""

    controller: str
    symbol: str
    value: float
    """Value; NaN if not observed."""
    threshold: float
    unit: str
    share: float
    """Fraction of the threshold: 0 at rest, 1 at the threshold, more beyond it."""
    tripped: bool

    @property
    def text(self) -> str:
        """Return the value and its limit."""
        if not math.isfinite(self.value):
            return f"{self.symbol}  not observed"
        sign = "<" if self.threshold > 0.0 else ">"
        return f"{self.symbol} {self.value:.3g}{self.unit}  ({sign} {self.threshold:g})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Status at one time."""

    time_s: float
    master: str
    """Ladder state at the hand; empty without a link."""
    slave: str
    reason: str
    """Reason, as stated by the side that changed last."""
    age_s: float
    """Age of the latest frame at the hand in s; NaN without a link."""
    tripped: tuple[str, ...]
    """Controllers whose observer is beyond its threshold."""
    acting: tuple[str, ...]
    """Controllers with an active intervention, by the trip that started it."""
    intervenes: bool
    """True if a controller acts, including its hold-off."""
    gauges: tuple[Gauge, ...]
    speed: float
    """|V| of the device in m/s, or of its fastest joint in rad/s; NaN if not recorded."""
    device_force: float
    """|F_device| in N, or the largest joint torque in N m."""
    environment_force: float
    """|F_e| in N, or the largest joint torque in N m; NaN without an arm."""
    joints: bool
    """True if the values refer to joints."""

    @property
    def numbers(self) -> tuple[tuple[str, float, str], ...]:
        """Return symbol, value and unit of the known numbers."""
        force, unit, speed = ("T", "N m", "rad/s") if self.joints else ("F", "N", "m/s")
        rows = (
            (f"{force} hand", self.device_force, unit),
            (f"{force} tool", self.environment_force, unit),
            ("V", self.speed, speed),
        )
        return tuple(row for row in rows if math.isfinite(row[1]))


class StatusCourse:
    """Status of a run over time."""

    def __init__(self, signals: Signals, events: Sequence[Event], scene: Scene | None) -> None:
        self._signals = signals
        self._courses = {name: Course(signals, name) for name in signals if name not in {"time_s", "slave_time_s"}}
        self._events = events
        self.joints = is_joints(signals, scene)
        """True if forces are joint torques."""
        self.controllers = _controllers(signals, scene)
        self._thresholds = _thresholds(scene)
        self._largest_energy_j = largest(signals, "energy_j") or 1.0

    def at(self, time_s: float) -> Status:
        """Return the status at a time in s."""
        bits = int(self._value("tripped", time_s, 0.0)) | int(self._value("rotation_tripped", time_s, 0.0))
        told = self._newest(time_s, LADDER_KINDS)
        return Status(
            time_s=time_s,
            master=self._state("state", time_s),
            slave=self._state("slave_state", time_s),
            reason="" if told is None else told.detail,
            age_s=self._value("age_s", time_s, math.nan),
            tripped=tuple(name for name in OBSERVED_SIGNALS if bits & TRIP_BITS[name]),
            acting=tuple(self._last_trip(time_s).split()) if bits & INTERVENES else (),
            intervenes=bits & INTERVENES != 0,
            gauges=tuple(self._gauge(name, bits, time_s) for name in self.controllers),
            speed=self._norm("velocity", time_s),
            device_force=self._norm("device_force", time_s),
            environment_force=self._norm("environment_force", time_s),
            joints=self.joints,
        )

    def _newest(self, time_s: float, kinds: frozenset[str]) -> Event | None:
        events = reversed(self._events)
        return next((event for event in events if event.time_s <= time_s + 1e-9 and event.kind in kinds), None)

    def _last_trip(self, time_s: float) -> str:
        trip = self._newest(time_s, TRIPS)
        return "" if trip is None else trip.detail

    def _gauge(self, controller: str, bits: int, time_s: float) -> Gauge:
        observed = OBSERVED_SIGNALS[controller]
        value, threshold = self._value(observed.signal, time_s, math.nan), self._thresholds[controller]
        # PC trips below 0, so the fraction refers to the largest energy.
        if threshold == 0.0 and math.isfinite(value):
            # The largest energy of a live run is not known beforehand.
            self._largest_energy_j = max(self._largest_energy_j, abs(value))
        share = value / threshold if threshold != 0.0 else -value / self._largest_energy_j
        return Gauge(
            controller=controller,
            symbol=observed.symbol,
            value=value,
            threshold=threshold,
            unit=f" {observed.unit}".rstrip(),
            share=max(0.0, share) if math.isfinite(share) else 0.0,
            tripped=bool(bits & TRIP_BITS[controller]),
        )

    def _value(self, name: str, time_s: float, otherwise: float) -> float:
        if name not in self._courses:
            return otherwise
        value = float(np.atleast_1d(self._courses[name].at(time_s))[0])
        return value if math.isfinite(value) else otherwise

    def _norm(self, name: str, time_s: float) -> float:
        if name not in self._courses:
            return math.nan
        value = np.atleast_1d(self._courses[name].at(time_s))
        return float(np.abs(value).max() if self.joints else np.linalg.norm(value))

    def _state(self, name: str, time_s: float) -> str:
        return ladder_state_name(int(self._value(name, time_s, 0.0))) if name in self._courses else ""


def largest(signals: Signals, name: str) -> float:
    """Return the largest magnitude of a signal; 0 if unknown."""
    values = signals[name] if name in signals else np.zeros(1)
    return float(np.nanmax(np.abs(values), initial=0.0))


def _controllers(signals: Signals, scene: Scene | None) -> tuple[str, ...]:
    if "time_s" not in signals:
        # Controllers are at the hand, which is unknown.
        return ()
    if scene is not None:
        return tuple(name for name in OBSERVED_SIGNALS if name in scene.safety.controllers)
    # Recording without a scene: controllers whose observer was active.
    return tuple(
        name
        for name, (signal, *_) in OBSERVED_SIGNALS.items()
        if signal in signals and np.isfinite(signals[signal]).any()
    )


def _thresholds(scene: Scene | None) -> dict[str, float]:
    """Return the thresholds of the controllers; the paper's without a scene or for a display-only scene."""
    is_shown_only = scene is None or (scene.master.device is None and scene.master.mass_kg is None)
    return trip_thresholds({} if scene is None or is_shown_only else spec_of(scene)["safety"])


def spans(time_s: npt.NDArray[np.float64], on: npt.NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return start and end in s of each interval in which a condition holds."""
    edges = np.diff(np.concatenate([[0], on.astype(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    ends = np.minimum(ends, len(time_s) - 1)
    return [(float(time_s[a]), float(time_s[b])) for a, b in zip(begins, ends, strict=True)]
