"""Why two sides are not coupled, as a side states it, and the file of its flight recorder."""

from pathlib import Path

import msgspec

from haptether.input_file import read_text

SCHEMA = 1
MAX_BYTES = 1 << 24
"""Largest file; a flight recorder writes some 100 kB."""


def read_flight(path: Path) -> "Flight":
    """Reads what a flight recorder wrote.

    Raises:
        ValueError: The file is none, or of another version.
        OSError: It cannot be read.
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
    """Something to be done before two sides couple again."""

    at: str
    """"master", "slave" or "link"."""
    remedy: str
    """"acknowledge", "start", "wait", "turn" or "press"."""
    text: str


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """Why two sides are not coupled, as one of them knows it.

    A subclass adds the time, which is not keyword-only: so it comes first where it is encoded.
    """

    state: str
    """Of the ladder of the side that knows it."""
    at: str
    """Where it happened: "master", "slave" or "link"."""
    text: str
    """What, in the driver's own words where there are any."""
    steps: list[Step]
    """What to do, in this order."""


class FlightCause(Cause, frozen=True):
    """Why two sides were not coupled at a time of a flight."""

    time_s: float


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """A step of the ladder."""

    time_s: float
    from_: str = msgspec.field(name="from")
    to: str
    reason: str


class Trip(msgspec.Struct, frozen=True, kw_only=True):
    """A controller that intervened, and what its observer saw when it tripped."""

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
    """Ticks that lie together at which controllers acted."""

    time_s: float
    until_s: float
    layer: str = "translation"
    """"translation", "rotation" or "trigger": each has observers and thresholds of its own."""
    trips: list[Trip]

    def __str__(self) -> str:
        what = "; ".join(map(str, self.trips)) or "held on"
        layer = "" if self.layer == "translation" else f"{self.layer}: "
        return f"{self.time_s:.4f} to {self.until_s:.4f} s  {layer}{what}"


class Tick(msgspec.Struct, frozen=True, kw_only=True):
    """A tick of a side; null stands for what is no finite number."""

    time_s: float
    state: str
    peer: str | None
    age_s: float | None
    clutch: bool
    gain: float | None
    """The ladder's share; none of a recorded slave, which does not keep it."""
    tripped: list[str] = []
    position: list[float | None]
    command: list[float | None]
    force: list[float | None]


class Flight(msgspec.Struct, frozen=True, kw_only=True):
    """What a flight recorder wrote."""

    schema: int
    side: str
    transitions: list[Transition]
    interventions: list[Intervention] = []
    interventions_seen: int = 0
    causes: list[FlightCause] = []
    at_hold: list[Tick]
    latest: list[Tick]
