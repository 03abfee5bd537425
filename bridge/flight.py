"""Flight recorder files, and the causes a side states for not being coupled."""

from pathlib import Path

import msgspec

from haptether.input_file import read_text

SCHEMA = 1
MAX_BYTES = 1 << 24
"""Largest accepted file; a flight recorder writes about 100 kB."""


def read_flight(path: Path) -> "Flight":
    """Read a flight recorder file.

    Raises:
        ValueError: The file is invalid or has another schema version.
        OSError: The file cannot be read.
    """
    try:
        flight = msgspec.json.decode(read_text(path, MAX_BYTES), type=Flight)
    except ValueError as error:
        message = f"{path}: is no file of a flight recorder ({error}): must be what --flight of master or slave wrote"
        raise ValueError(message) from None
    if flight.schema != SCHEMA:
        message = f"{path}: schema = {flight.schema}, must be {SCHEMA}"
        raise ValueError(message)
    return flight


class Step(msgspec.Struct, frozen=True, kw_only=True):
    """Step required before two sides couple again."""

    at: str
    """"master", "slave" or "link"."""
    remedy: str
    """"acknowledge", "start", "wait", "turn" or "press"."""
    text: str


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """Reason why two sides are not coupled, as one side knows it.

    A subclass adds the time, which is not keyword-only, so that it is encoded first.
    """

    state: str
    """Ladder state of the side that reports the cause."""
    at: str
    """Origin: "master", "slave" or "link"."""
    text: str
    """Description, in the driver's words if it gave any."""
    steps: list[Step]
    """Steps to take, in order."""


class FlightCause(Cause, frozen=True):
    """Cause with the time at which it held."""

    time_s: float


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """Ladder transition."""

    time_s: float
    from_: str = msgspec.field(name="from")
    to: str
    reason: str


class Trip(msgspec.Struct, frozen=True, kw_only=True):
    """Controller that intervened, and the observed value when it tripped."""

    controller: str
    observer: str
    observed: float | None
    threshold: float | None

    def __str__(self) -> str:
        if self.observed is None or self.threshold is None:
            return self.controller
        side = "above" if self.observed > self.threshold else "below"
        return f"{self.controller}: {self.observer} = {self.observed:.4g}, {side} {self.threshold:g}"


class Intervention(msgspec.Struct, frozen=True, kw_only=True):
    """Group of consecutive ticks at which controllers acted."""

    time_s: float
    until_s: float
    layer: str = "translation"
    """"translation", "rotation" or "trigger"; each layer has its own observers and thresholds."""
    trips: list[Trip]

    def __str__(self) -> str:
        what = "; ".join(map(str, self.trips)) or "held on"
        layer = "" if self.layer == "translation" else f"{self.layer}: "
        return f"{self.time_s:.4f} to {self.until_s:.4f} s  {layer}{what}"


class Tick(msgspec.Struct, frozen=True, kw_only=True):
    """One tick of a side; null stands for a value that is not finite."""

    time_s: float
    state: str
    peer: str | None
    age_s: float | None
    clutch: bool
    gain: float | None
    """Gain of the ladder; None in a recorded slave, which does not store it."""
    tripped: list[str] = []
    position: list[float | None]
    command: list[float | None]
    force: list[float | None]


class Flight(msgspec.Struct, frozen=True, kw_only=True):
    """Content of a flight recorder file."""

    schema: int
    side: str
    transitions: list[Transition]
    interventions: list[Intervention] = []
    interventions_seen: int = 0
    causes: list[FlightCause] = []
    at_hold: list[Tick]
    latest: list[Tick]
