"""Speed, distance and trip after each release of the hand and each push, from the telemetry of every pair."""

import math
import threading
from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import asdict

from haptether.bridge import TRIP_BITS, TelemetryChange, TelemetryHello, TelemetryMessage, TelemetrySample

WATCHED_NS = 1_500_000_000
"""Time in ns after a release in which its speed is measured."""
COUPLED = {"engaged", "stale"}
CONTROLLERS = ~TRIP_BITS["held"]
MAX_SHOWN = 50


class Measured(Struct, kw_only=True):
    """Result of a bridge after a release or a push."""

    controllers: list[str]
    force_n: float
    """Norm of the force on the hand just before, in N."""
    peak_speed: float = 0.0
    """Largest speed of the device in m/s; with several axes an upper bound from the extremes of 1/60 s."""
    distance: float = 0.0
    """Largest distance in m from the first position."""
    trip_s: float | None = None
    """Time in s to the first trip of a controller; 0 if it had tripped before; None without one."""
    is_complete: bool = False


class Pending(Struct, kw_only=True):
    """Measurement of a bridge that has not ended."""

    begun_ns: int
    position: list[float]
    measured: Measured


class PairWatch:
    """Telemetry of a master, and its running measurement."""

    def __init__(self) -> None:
        self.hello: TelemetryHello | None = None
        self.sample: TelemetrySample | None = None
        self.tripped = 0
        self.pending: Pending | None = None

    def begin(self, ticks: int | None) -> Measured | None:
        """Begin a measurement at a tick, by default at the newest; None if the pair is not coupled."""
        sample, hello = self.sample, self.hello
        if sample is None or hello is None or sample.signals.get("state") not in COUPLED:
            return None
        scene = hello.scene or {}
        begun_ns = sample.time_ns if ticks is None else round(ticks * float(scene["run"]["period_s"]) * 1e9)
        measured = Measured(
            controllers=list(scene["safety"]["controllers"]),
            force_n=_norm(sample, "device_force", 2),
            trip_s=0.0 if self.tripped else None,
        )
        position = [axis[2] or 0.0 for axis in sample.signals["position"]]
        self.pending = Pending(begun_ns=begun_ns, position=position, measured=measured)
        return measured

    def take(self, message: TelemetryMessage) -> bool:
        """Take a message; return True if it completes the measurement."""
        pending = self.pending
        if isinstance(message, TelemetryChange) and message.signal == "tripped":
            self.tripped = int(message.to) & CONTROLLERS
            if pending is not None and self.tripped and pending.measured.trip_s is None:
                pending.measured.trip_s = max(0.0, (message.time_ns - pending.begun_ns) * 1e-9)
        if not isinstance(message, TelemetrySample):
            return False
        self.sample = message
        if pending is None or message.time_ns <= pending.begun_ns:
            return False
        measured = pending.measured
        measured.peak_speed = max(measured.peak_speed, _furthest(message, "velocity", [0.0] * len(pending.position)))
        measured.distance = max(measured.distance, _furthest(message, "position", pending.position))
        measured.is_complete = message.time_ns >= pending.begun_ns + WATCHED_NS
        if measured.is_complete:
            self.pending = None
        return measured.is_complete


class Releases:
    """Measurements of all pairs; messages and requests come from different threads.

    Args:
        pairs: Names of the pairs.
    """

    def __init__(self, pairs: tuple[str, ...]) -> None:
        self._watches = {pair: PairWatch() for pair in pairs}
        self._lock = threading.Lock()
        self._rows: list[dict[str, Any]] = []
        self._count = 0
        self.rows: list[dict[str, Any]] = []
        """Rows for the page, the newest last; the list is replaced on every change."""

    def take(self, pair: str, hello: TelemetryHello, message: TelemetryMessage | None) -> None:
        """Take a message of a side, or the start of its run."""
        if hello.side != "master":
            return
        with self._lock:
            if message is None:
                watch = self._watches[pair] = PairWatch()
                watch.hello = hello
            elif self._watches[pair].take(message):
                self._publish()

    def begin(self, kind: str, ticks: Mapping[str, int | None], network: Mapping[str, float]) -> None:
        """Begin to measure the pairs that are coupled, at these ticks of their masters or at the newest."""
        with self._lock:
            found = {pair: self._watches[pair].begin(at) for pair, at in ticks.items()}
            measured = {pair: one for pair, one in found.items() if one is not None}
            if measured:
                self._count += 1
                self._rows.append({"number": self._count, "kind": kind, "network": dict(network), "pairs": measured})
                del self._rows[:-MAX_SHOWN]
                self._publish()

    def _publish(self) -> None:
        self.rows = [{**row, "pairs": {pair: asdict(one) for pair, one in row["pairs"].items()}} for row in self._rows]


def _furthest(sample: TelemetrySample, name: str, of: list[float]) -> float:
    """Return the largest distance of a vector from `of` in a sample, bounded by the extremes of its axes."""
    axes = zip(sample.signals[name], of, strict=True)
    return math.hypot(*(max(abs((low or 0.0) - at), abs((high or 0.0) - at)) for (low, high, _), at in axes))


def _norm(sample: TelemetrySample, name: str, index: int) -> float:
    return math.hypot(*(axis[index] or 0.0 for axis in sample.signals[name]))
