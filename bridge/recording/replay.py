"""Replay of a recorded run with other settings: resulting forces, and the time at which the runs diverge."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from msgspec import Struct, json

from haptether import _core
from haptether.bridge.recording.hand import HandError, HandFit, hand_of
from haptether.bridge.recording.read import Recording, read_recording
from haptether.bridge.recording.settings import check_settings, tables_of
from haptether.bridge.scene.errors import Path as KeyPath
from haptether.bridge.scene.errors import SceneError, shown
from haptether.bridge.scene.load import checked, overridden, path_of

Array = npt.NDArray[Any]

LOST_M = 0.3
"""Largest valid distance in m of a modelled hand from the measured one; beyond it the motion leaves any workspace."""
FORCE_QUANTUM_N = 1e-3
"""Force difference in N that counts as divergence; no device resolves less."""
PASTS = {"kept": 0, "stalled": 1, "acknowledged": 2}
INPUTS = ("received_force", "requested_force", "gain", "missed", "past", "given_fault")
"""Signals that a recording must have beside motion and force."""
COMPARED = ("rendered_force", "safety_force", "device_force", "rendered_torque", "safety_torque", "device_torque")
"""Signals that are bit-identical if the settings are."""
REPLAYED: dict[str, frozenset[str]] = {
    "safety": frozenset({"ladder", "gripper", "signals"}),
    "master": frozenset(
        {"kind", "axes", "position", "velocity", "stops", "buttons", "gripper", "device", "driver", "options"}
    ),
    "coupling": frozenset({
        "kind", "stiffness", "damping", "rotational_stiffness", "rotational_damping", "impedance",
        "start_energy_j", "spread_s", "environment_gain", "grasp_gain", "play_out_s", "alternatives",
        "tool_mass_kg", "tool_damping", "tool_lead_s",
        "position_scale", "rotation_scale", "command_speed", "command_reach", "command_angular_speed",
        "command_turn", "alignment", "reference_point",
    }),
}  # fmt: skip
"""Tables whose keys affect the force on the hand, except the listed keys."""
Level = Literal["as measured", "hand modelled"]


class ReplayFigures(Struct, frozen=True, kw_only=True):
    """Figures of a run."""

    peak_device_force: float
    """Largest |F_device| in N."""
    largest_speed: float
    """Largest speed in m/s towards the push of the remote side, since the engagement."""
    trips: int
    """Number of interventions."""
    intervention_s: float
    """Time under intervention in s."""
    peak_device_torque: float | None = None
    """Largest |tau_device| in N m, for a rotating hand."""


class _About(NamedTuple):
    """Facts about a replay that no signal holds."""

    overrides: tuple[str, ...]
    notes: tuple[str, ...]
    specification: bytes


class Replay(Struct, frozen=True, kw_only=True):
    """Recording, and the result of other settings."""

    level: Level
    """"as measured" keeps the measured motion; "hand modelled" lets a model respond to the difference in force."""
    overrides: tuple[str, ...]
    """Changed settings."""
    time_s: Array
    """Tick times since the run began, shape `(n_ticks,)`."""
    recorded: Mapping[str, Array]
    """Recorded signals by name, shape `(n_ticks, axes)` for signals with axes."""
    replayed: Mapping[str, Array]
    """Signals with the changed settings; `displacement` in m is the distance of the modelled hand from the recorded
    one.
    """
    identical: bool
    """True if all forces and torques are bit-identical."""
    parts_s: float | None
    """Time in s at which |F_device| first differs by more than `FORCE_QUANTUM_N`; None if it never does."""
    ends_s: float | None
    """Time at which the modelled hand is `LOST_M` from the measured one; later ticks are invalid and not counted."""
    before: ReplayFigures
    """Figures of the recording."""
    after: ReplayFigures
    """Figures with the changed settings."""
    largest_displacement: float
    """Largest distance in m between the modelled and the recorded hand; 0 as measured."""
    hand: HandFit | None
    """Model of the hand; None as measured."""
    notes: tuple[str, ...]
    """Parts that are not replayed exactly, with reasons."""
    specification: bytes
    """Scene with the changed settings, as JSON."""


def replay(
    file: str | os.PathLike[str] | Recording,
    *,
    overrides: Iterable[str] = (),
    hand: Literal["measured", "modelled"] | None = None,
) -> Replay:
    """Compute the force of a recorded master with other settings.

    Motion, received force per tick and ladder come from the recording. They pass through estimator, coupling, safety
    layer and limiter again.

    Args:
        file: File written by `--record` of a master, or the result of `read_recording`.
        overrides: Settings of `[safety]`, `[coupling]` and `[master]` to change, `table.key=value` each; without
            changes the forces are bit-identical to the recording.
        hand: "measured" keeps the recorded motion whatever the force. "modelled" lets a model, identified from the
            recording, respond to the difference in force. Default: modelled if settings differ and the hand can be
            identified.

    Raises:
        OSError: The file cannot be read.
        ValueError: Not a master recording with a scene; invalid settings, or settings that are not replayed; "modelled"
            with a hand that cannot be identified.
    """
    given = tuple(overrides)
    recording = file if isinstance(file, Recording) else read_recording(file)
    name = recording.side if isinstance(file, Recording) else str(file)
    _check(recording, name)
    spec, recouples = _settings(recording, given)
    signals, notes = _signals(recording)
    fit: HandFit | None = None
    if hand == "modelled" or (hand is None and given):
        try:
            fit, holds = hand_of(
                signals["position"], signals["device_force"], spec["master"], float(spec["run"]["period_s"])
            )
            signals["grip"] = holds.astype(np.float64)
        except HandError as error:
            if hand == "modelled":
                message = f"{name}: the hand cannot be modelled: {error}"
                raise ValueError(message) from None
            notes.append(f"the hand cannot be modelled, so it moves as it was measured: {error}")
    specification = json.encode(spec)
    try:
        replayed = _core.replay_recording(
            specification,
            signals,
            recording.signals["time_ns"].tolist(),
            recouples=recouples,
            hand=None if fit is None else (fit.mass_kg, fit.damping, fit.stiffness),
        )
    except ValueError as error:
        message = f"{name}: {error}"
        raise SceneError(message) from None
    notes += _said(recording, fit, given)
    return _compared(recording, replayed, fit, _About(given, tuple(notes), specification))


def _check(recording: Recording, name: str) -> None:
    if recording.side != "master":
        message = f"{name}: of the {recording.side}, must be of the master: what is replayed is the force on the hand"
        raise ValueError(message)
    if not recording.scene:
        check_settings(recording.scene, name)
    missing = [signal for signal in INPUTS if signal not in recording.signals]
    if missing:
        message = (
            f"{name}: has no {', '.join(missing)}: it was written by Haptether {recording.version or 'of before'}, "
            "which did not keep what a replay needs"
        )
        raise ValueError(message)
    if not len(recording.signals["time_ns"]):
        message = f"{name}: has no tick"
        raise ValueError(message)
    check_settings(recording.scene, name)


# ------------------------------------------------------------------------------------------------ settings


def _settings(recording: Recording, overrides: tuple[str, ...]) -> tuple[dict[str, Any], bool]:
    """Return the scene with the changed settings, and True if the coupling changes."""
    spec = cast("dict[str, Any]", json.decode(recording.scene))
    if not overrides:
        return spec, False
    raw = tables_of(recording.scene, ("run", "master", "slave", "safety", "coupling"))
    for override in overrides:
        _refuse_unreplayed(path_of(override.partition("=")[0].strip()), override)
        raw = overridden(raw, override)
    changed = json.decode(checked(raw, Path()).json)
    kept = {table: changed[table] for table in REPLAYED}
    recouples = kept["coupling"] != spec["coupling"]
    if recouples and spec["coupling"]["kind"] != "position-force":
        message = (
            f"[coupling]: a replay recomputes the force of the coupling position-force only, not of "
            f"{spec['coupling']['kind']}; the recorded force replays with other settings of [safety] and [master]"
        )
        raise SceneError(message)
    return spec | kept, recouples


def _refuse_unreplayed(path: KeyPath, override: str) -> None:
    table, *rest = path
    if table in REPLAYED and rest and rest[0] not in REPLAYED[str(table)]:
        return
    message = (
        f"{shown(override)}: does not change what is replayed, must be of [safety], [coupling] or [master] and decide "
        "over the force on the hand; network, arm and ladder are those of the recording"
    )
    raise SceneError(message)


# ------------------------------------------------------------------------------------------------ signals


def _signals(recording: Recording) -> tuple[dict[str, Array], list[str]]:
    """Return the signals that Rust reads, and notes on missing ones."""
    recorded = recording.signals
    ticks = len(recorded["time_ns"])
    signals: dict[str, Array] = {
        name: np.ascontiguousarray(values, dtype=np.float64)
        for name, values in recorded.items()
        if values.dtype.kind in "fiub" and name != "time_ns"
    }
    signals["past"] = np.array([PASTS.get(past, 0) for past in recorded["past"]], dtype=np.float64)
    signals["grip"] = np.ones(ticks)
    notes = []
    period_ns = float(json.decode(recording.scene)["run"]["period_s"]) * 1e9
    ahead = np.diff(recorded["time_ns"].astype(np.float64), prepend=0.0) / period_ns
    absent = np.rint(ahead - 1.0) - signals["missed"]
    # A tick may be early and the next late by half a period each; after a stall no past is needed.
    holes = (absent >= 1.0) & (ahead > signals["missed"] + 1.9) & (signals["past"] == 0.0)
    holes[0] = False
    if holes.any():
        signals["missed"] = signals["missed"] + np.where(holes, absent, 0.0)
        first = float(recorded["time_ns"][np.flatnonzero(holes)[0]]) * 1e-9
        notes.append(
            f"{int(absent[holes].sum())} ticks are not in the file, the first before {first:.3f} s: after that, forces "
            "are near those of the run and not the same bit for bit"
        )
    return signals, notes


def _said(recording: Recording, fit: HandFit | None, overrides: tuple[str, ...]) -> list[str]:
    notes = [f"of the file: {problem}" for problem in recording.problems]
    if not recording.whole:
        notes.append("the file was cut off or damaged: what came after its last tick here is not replayed")
    if recording.version != _core.__version__:
        notes.append(f"recorded by Haptether {recording.version or '?'}, replayed by {_core.__version__}")
    if fit is not None:
        notes.append(
            "the hand that answers to the force that differs is a model of it, and what it wants is as recorded; the "
            "arm, what it touches and the network do not answer: they are as recorded, too"
        )
        if "orientation" in recording.signals:
            notes.append("the hand turns as it was measured: no impedance of its rotation is identified")
    elif overrides:
        notes.append("the hand moves as it was measured: under another force it would have moved otherwise")
    return notes


# ------------------------------------------------------------------------------------------------ comparison


def _compared(recording: Recording, replayed: dict[str, Array], fit: HandFit | None, about: "_About") -> Replay:
    recorded = recording.signals
    time_s = recorded["time_ns"].astype(np.float64) * 1e-9
    pairs = [(recorded[name], replayed[name]) for name in COMPARED if name in replayed and name in recorded]
    identical = all(_bits(before) == _bits(after) for before, after in pairs)
    apart = np.linalg.norm(replayed["device_force"] - recorded["device_force"], axis=1) > FORCE_QUANTUM_N
    displacement = np.linalg.norm(replayed["displacement"], axis=1)
    lost = displacement > LOST_M
    end = int(np.argmax(lost)) if lost.any() else len(time_s)
    ends_s = float(time_s[end]) if end < len(time_s) else None
    notes = about.notes
    if ends_s is not None:
        where = f"at {ends_s:.3f} s the modelled hand is {LOST_M:g} m from where the recorded one was"
        notes = (*notes, f"{where}: what follows says nothing")
    towards = _towards(recorded["received_force"])
    engaged = np.maximum.accumulate(recorded["state"] == "engaged")
    velocity = recorded["velocity"]
    faster = velocity + replayed["displacement_rate"]
    until = slice(0, max(end, 1))
    after = {name: values[until] for name, values in replayed.items()}
    return Replay(
        level="as measured" if fit is None else "hand modelled",
        overrides=about.overrides,
        time_s=time_s,
        recorded=recorded,
        replayed=replayed,
        identical=identical,
        parts_s=float(time_s[np.argmax(apart)]) if apart.any() else None,
        ends_s=ends_s,
        before=_figures(time_s, recorded, (velocity * towards).sum(axis=1)[engaged]),
        after=_figures(time_s[until], after, (faster * towards).sum(axis=1)[until][engaged[until]]),
        largest_displacement=float(displacement[until].max()),
        hand=fit,
        notes=notes,
        specification=about.specification,
    )


def _bits(values: Array) -> bytes:
    return np.ascontiguousarray(values, dtype=np.float64).tobytes()


def _towards(force: Array) -> Array:
    """Unit vectors of the remote push direction; without a push, the last direction."""
    length = np.linalg.norm(force, axis=1)
    pushes = length > 0.1
    last = np.maximum.accumulate(np.where(pushes, np.arange(len(force)), -1))
    towards = np.zeros_like(force)
    known = last >= 0
    towards[known] = force[last[known]] / length[last[known], None]
    return towards


def _figures(time_s: Array, signals: Mapping[str, Array], speed: Array) -> ReplayFigures:
    tripped = signals["tripped"] != 0
    if "rotation_tripped" in signals:
        tripped = tripped | (signals["rotation_tripped"] != 0)
    begins = tripped & ~np.concatenate([[False], tripped[:-1]])
    torque = signals.get("device_torque")
    return ReplayFigures(
        peak_device_force=float(np.nanmax(np.linalg.norm(signals["device_force"], axis=1))),
        largest_speed=float(np.nanmax(speed, initial=0.0)),
        trips=int(begins.sum()),
        intervention_s=float(np.diff(time_s, append=time_s[-1:])[tripped].sum()),
        peak_device_torque=None if torque is None else float(np.nanmax(np.linalg.norm(torque, axis=1))),
    )
