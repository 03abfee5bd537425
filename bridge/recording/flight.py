"""Flight recorder data derived from a recording."""

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import json

from haptether.bridge.codes import LADDER_STATES, OBSERVED_SIGNALS, TRIP_BITS, trip_thresholds, tripped_names
from haptether.bridge.flight import SCHEMA, Flight, FlightCause, Intervention, Tick, Transition, Trip, read_flight
from haptether.bridge.recording.read import Recording, read_recording

MAGIC = b"\x89MCAP"
"""First bytes of a recording."""
KEPT_TICKS = 50
KEPT_INTERVENTIONS = 16
LAYERS = {"translation": "tripped", "rotation": "rotation_tripped", "trigger": "trigger_tripped"}
"""Signal that holds the trip bits of each safety layer of a hand."""
LEFT = ("hold", "stop", "fault")
"""States in which the two sides are not coupled."""


def flight_of_file(path: str | os.PathLike[str]) -> Flight:
    """Read a flight recorder file, or derive the same data from a recording.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is neither, has another version, or has no tick.
    """
    is_recording = False
    # The reader reports a file that cannot be read.
    with contextlib.suppress(OSError):
        is_recording = Path(path).is_file() and _begins_with(Path(path), MAGIC)
    return flight_of(read_recording(path)) if is_recording else read_flight(Path(path))


def _begins_with(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def flight_of(recording: Recording) -> Flight:
    """Return ladder transitions, interventions, causes and the last ticks of a recorded side.

    The observed values of rotation and trigger layers are not recorded, so their trips have no value.

    Raises:
        ValueError: The recording has no tick.
    """
    signals = recording.signals
    time_s = signals["time_ns"].astype(np.float64) * 1e-9
    if not len(time_s):
        message = f"{recording.side}: has no tick: the run was ended before its first, or killed before it was written"
        raise ValueError(message)
    states = signals["state"]
    steps = _changes(states)
    interventions = sorted(_interventions(recording, time_s), key=lambda one: one.time_s)
    before = "disengaged"
    transitions = []
    for at in steps:
        if states[at] != before:
            to = str(states[at])
            transitions.append(
                Transition(time_s=float(time_s[at]), from_=before, to=to, reason=str(signals["reason"][at]))
            )
            before = to
    left = [at for at in steps if at and states[at] in LEFT and states[at - 1] not in LEFT]
    return Flight(
        schema=SCHEMA,
        side=recording.side,
        transitions=transitions,
        interventions=interventions[-KEPT_INTERVENTIONS:],
        interventions_seen=len(interventions),
        causes=[
            FlightCause(cause.time_ns * 1e-9, state=cause.state, at=cause.at, text=cause.text, steps=cause.steps)
            for cause in recording.causes
        ],
        at_hold=_ticks(recording, time_s, left[-1] + 1) if left else [],
        latest=_ticks(recording, time_s, len(time_s)),
    )


def _changes(values: npt.NDArray[Any]) -> list[int]:
    """Return the indices at which a value differs from its predecessor, and the first index."""
    return [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist()]


def _interventions(recording: Recording, time_s: npt.NDArray[np.float64]) -> Iterator[Intervention]:
    thresholds = _thresholds(recording)
    for layer, name in LAYERS.items():
        if name not in recording.signals:
            continue
        bits = np.nan_to_num(recording.signals[name]).astype(np.uint8)
        edges = np.diff(np.concatenate([[0], (bits != 0).astype(np.int8), [0]]))
        for begin, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            trips = []
            for controller, observed in OBSERVED_SIGNALS.items():
                tripped = np.flatnonzero(bits[begin:end] & TRIP_BITS[controller])
                if not len(tripped):
                    continue
                values = recording.signals.get(observed.signal) if layer == "translation" else None
                seen = math.nan if values is None else float(values[begin + tripped[0]])
                trips.append(
                    Trip(
                        controller=controller,
                        observer=observed.label,
                        observed=seen if math.isfinite(seen) else None,
                        # Thresholds differ between layers; only those of the translation layer equal the scene's.
                        threshold=thresholds.get(controller) if layer == "translation" else None,
                    )
                )
            yield Intervention(time_s=float(time_s[begin]), until_s=float(time_s[end - 1]), layer=layer, trips=trips)


def _thresholds(recording: Recording) -> dict[str, float]:
    """Return the trip threshold of each controller; empty without a scene."""
    if not recording.scene:
        return {}
    return trip_thresholds(json.decode(recording.scene).get("safety") or {})


def _ticks(recording: Recording, time_s: npt.NDArray[np.float64], end: int) -> list[Tick]:
    signals = recording.signals
    command, force = (
        ("device_force", "rendered_force") if recording.side == "master" else ("command", "environment_force")
    )
    gain = signals.get("gain")
    ticks = []
    for at in range(max(0, end - KEPT_TICKS), end):
        tripped = [
            name if layer == "translation" else f"{layer}:{name}"
            for layer, bits in LAYERS.items()
            if bits in signals
            for name in tripped_names(int(np.nan_to_num(signals[bits][at])))
        ]
        peer = str(signals["peer_state"][at])
        ticks.append(
            Tick(
                time_s=float(time_s[at]),
                state=str(signals["state"][at]),
                peer=peer if peer in LADDER_STATES else None,
                age_s=_finite(signals["age_s"][at]),
                clutch=bool(signals["clutch"][at]),
                gain=None if gain is None else float(gain[at]),
                tripped=tripped,
                position=[_finite(value) for value in np.atleast_1d(signals["position"][at])],
                command=[_finite(value) for value in np.atleast_1d(signals[command][at])],
                force=[_finite(value) for value in np.atleast_1d(signals[force][at])],
            )
        )
    return ticks


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
