"""Recorded run in the form that `simulate` returns."""

import math
import os
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from haptether.bridge.codes import LADDER_STATES, tripped_names
from haptether.bridge.recording.read import Recording, read_recording
from haptether.bridge.scene.run import Event, Metrics, Run, Signals

Array = npt.NDArray[Any]

STATES = {state: code for code, state in enumerate(LADDER_STATES)}
"""Code of each ladder state by name."""
CODES = {"tripped", "rotation_tripped", "acted", "rotation_acted", "limited"}
"""Bit sets that fit one byte."""
MODELLED = {"hand_force", "hand_torque"}
"""Signals known only for a modelled hand, and 0 for a real one."""
MEASURED = {"trigger", "measured_velocity", "measured_angular_velocity"}
"""Signals that not every device measures; omitted if always unknown."""
GRIPPER = {"gripper", "gripper_command", "gripper_force", "holds_object"}
"""Signals of a slave's gripper; omitted if `gripper` is always unknown."""
EXERTED = "exerted_force"
"""F_c of an arm that takes forces; omitted if always unknown."""
SHARED = ("environment_", "exerted_", "gripper", "holds_object")
"""Prefixes of slave signals without a master signal of the same name."""


def load(
    file: str | os.PathLike[str] | Recording,
    other: str | os.PathLike[str] | Recording | None = None,
    *,
    slave_begun_s: float | None = None,
) -> Run:
    """Return the run recorded by one or both sides, with names, shapes and codes of a run in virtual time.

    `position` and `orientation` are true values of a modelled device, otherwise measured values. Absent signals are
    omitted, for example the force of a real hand, or a gripper. Metrics that need true model values are None.

    Args:
        file: MCAP file of master or slave, or the result of `read_recording`.
        other: File of the other side, to get the whole run on the master's time; by default one side.
        slave_begun_s: Start of the slave's run after the master's in s; by default from the wall clocks of both
            machines.

    Raises:
        OSError: A file cannot be read.
        ValueError: A file is not a Haptether recording, both are of the same side, or they do not overlap in time.
    """
    recordings = {}
    for one in (file, *(() if other is None else (other,))):
        recording = one if isinstance(one, Recording) else read_recording(one)
        if recording.side in recordings:
            message = f"{_name(file)}, {_name(one)}: both are of the {recording.side}, must be one of each side"
            raise ValueError(message)
        recordings[recording.side] = recording
    master, slave = recordings.get("master"), recordings.get("slave")
    begun_s = 0.0
    if master is not None and slave is not None:
        if slave_begun_s is not None and not math.isfinite(slave_begun_s):
            message = f"slave_begun_s = {slave_begun_s}: must be finite"
            raise ValueError(message)
        if slave_begun_s is None:
            begun_s = (slave.begun_ns - master.begun_ns) * 1e-9
            _check_overlap(master, slave, begun_s)
        else:
            begun_s = slave_begun_s
    elif slave_begun_s is not None:
        message = f"slave_begun_s = {slave_begun_s}: only {_name(file)} was given, must be with those of both sides"
        raise ValueError(message)
    signals: dict[str, Array] = {}
    events: list[Event] = []
    if master is not None:
        signals |= _master_signals(master)
        events += _events(master, 0.0)
    if slave is not None:
        signals |= _slave_signals(slave, begun_s)
        events += _events(slave, begun_s)
    (first, *_) = recordings.values() if master is None else (master,)
    return Run(
        scene=_name(file),
        seed=_seed(first),
        version=first.version,
        signals=Signals(signals),
        events=tuple(sorted(events, key=attrgetter("time_s"))),
        metrics=_metrics(first, signals),
        specification=first.scene,
    )


def _name(file: str | os.PathLike[str] | Recording) -> str:
    return file.side if isinstance(file, Recording) else Path(file).stem


def _seed(recording: Recording) -> int:
    from msgspec import json  # noqa: PLC0415

    return int(json.decode(recording.scene)["run"]["seed"]) if recording.scene else 0


def _check_overlap(master: Recording, slave: Recording, begun_s: float) -> None:
    master_s, slave_s = _time_s(master), _time_s(slave) + begun_s
    if len(master_s) and len(slave_s) and (slave_s[0] > master_s[-1] or slave_s[-1] < master_s[0]):
        message = (
            f"the slave's recording is from {slave_s[0]:.3f} to {slave_s[-1]:.3f} s of the master's time, whose own "
            f"ends at {master_s[-1]:.3f} s: two runs, or clocks that differ; give slave_begun_s for the latter"
        )
        raise ValueError(message)


def _time_s(recording: Recording) -> npt.NDArray[np.float64]:
    time_s: npt.NDArray[np.float64] = recording.signals["time_ns"].astype(np.float64) * 1e-9
    return time_s


def _master_signals(recording: Recording) -> dict[str, Array]:
    kept = {"time_s": _time_s(recording)}
    recorded = recording.signals
    for name, values in recorded.items():
        if name in {"time_ns", "security"} or name.startswith("true_"):
            continue
        if f"true_{name}" in recorded:
            kept[name] = _shaped(name, recorded[f"true_{name}"])
            kept[f"measured_{name}"] = _shaped(name, values)
        elif not (name in MODELLED and not values.any()) and not (name in MEASURED and _is_unknown(values)):
            kept[name] = _shaped(name, values)
    return kept


def _slave_signals(recording: Recording, begun_s: float) -> dict[str, Array]:
    kept = {"slave_time_s": _time_s(recording) + begun_s}
    has_gripper = not _is_unknown(recording.signals["gripper"])
    for name, values in recording.signals.items():
        if name in {"time_ns", "security"} or (name in GRIPPER and not has_gripper):
            continue
        if name == EXERTED and _is_unknown(values):
            continue
        kept[name if name.startswith(SHARED) else f"slave_{name}"] = _shaped(name, values)
    return kept


def _is_unknown(values: Array) -> bool:
    return bool(np.isnan(values.astype(np.float64)).all())


def _shaped(name: str, values: Array) -> Array:
    """Convert to the form of virtual time: state codes, one byte of bits, and no axis dimension for one axis."""
    if name in {"state", "peer_state"}:
        # A state lasts for thousands of ticks, so convert changes only.
        at = np.array(_changes(values), dtype=np.intp)
        codes = np.array([STATES.get(str(state), 255) for state in values[at]], dtype=np.uint8)
        return np.repeat(codes, np.diff(at, append=len(values)))
    if name in CODES:
        return values.astype(np.uint8)
    if values.ndim == 2 and values.shape[1] == 1:
        return values[:, 0]
    return values


def _events(recording: Recording, begun_s: float) -> Iterator[Event]:
    signals, side = recording.signals, recording.side
    time_s = _time_s(recording) + begun_s
    states, reasons = signals["state"], signals["reason"]
    before = "disengaged"
    for at in _changes(states):
        if states[at] != before:
            yield Event(float(time_s[at]), str(states[at]), f"{side}: {reasons[at]}" if reasons[at] else side)
        before = states[at]
    for layer, names in (("", ("tripped", "rotation_tripped")), ("trigger", ("trigger_tripped",))):
        there = [np.nan_to_num(signals[name]).astype(np.uint8) for name in names if name in signals]
        yield from _trips(time_s, np.bitwise_or.reduce(there), layer) if there else ()
    if "holds_object" in signals:
        held = signals["holds_object"].astype(bool)
        for at in _changes(held):
            if held[at] or at:
                yield Event(float(time_s[at]), "grip" if held[at] else "drop", "")
    for cause in recording.causes:
        yield Event(cause.time_ns * 1e-9 + begun_s, "cause", f"{cause.at}: {cause.text}")


def _trips(time_s: Array, tripped: Array, layer: str) -> Iterator[Event]:
    before = 0
    for at in _changes(tripped):
        now = int(tripped[at])
        if now and not before:
            names = tripped_names(now)
            yield Event(float(time_s[at]), "trip", " ".join((layer, *names) if layer else names))
        elif before and not now:
            yield Event(float(time_s[at]), "recover", layer)
        before = now


def _changes(values: Array) -> list[int]:
    """Return the indices at which a value differs from its predecessor, and the first index."""
    if not len(values):
        return []
    return [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist()]


def _metrics(first: Recording, signals: dict[str, Array]) -> Metrics:
    states = first.signals["state"]
    outcome = "never-engaged"
    if "engaged" in states:
        # Coupled at the last tick: the operator ended the run.
        outcome = "complete" if states[-1] == "engaged" else str(states[-1])
    if first.side == "slave":
        return Metrics(outcome=outcome, ticks=len(states))
    time_s = signals["time_s"]
    tripped = np.zeros(len(time_s), dtype=bool)
    for name in ("tripped", "rotation_tripped"):
        tripped |= signals.get(name, np.zeros(len(time_s))) != 0
    return Metrics(
        outcome=outcome,
        peak_device_force=_peak(signals["device_force"]),
        peak_device_torque=_peak(signals["device_torque"]) if "device_torque" in signals else None,
        intervention_s=float(np.diff(time_s, append=time_s[-1:])[tripped].sum()),
        ticks=len(states),
    )


def _peak(vectors: Array) -> float | None:
    lengths = np.abs(vectors) if vectors.ndim == 1 else np.linalg.norm(vectors, axis=1)
    return float(np.nanmax(lengths)) if np.isfinite(lengths).any() else None
