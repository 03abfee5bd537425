"""Safety observers on recordings of normal operation, tick by tick."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Struct, json

from haptether.bridge import (
    LADDER_STATES,
    TRIP_BITS,
    HandError,
    Recording,
    Run,
    Scene,
    held_ticks,
    load,
    read_recording,
    recorded_scene,
    replay,
    scene_json,
)
from haptether.bridge.recording.settings import check_settings
from haptether.bridge.scene.resolve import spec_of

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

NEVER_TRIPPING = (
    "energy_threshold_j=-1e6",
    "velocity_threshold=1e6",
    "grasp_threshold=1e6",
    "hsc_force_threshold_n=1e6",
)
"""Unreachable thresholds: observers are computed and no controller intervenes."""
OBSERVERS = ("vfc", "hsc", "wsc")
"""Controllers with replayed observers."""
READ_BY_OBSERVERS = {
    "wsc": ("energy_threshold_j", "window", "energy_ratio", "wsc_force_threshold_n"),
    "hsc": ("grasp_threshold", "hsc_force_threshold_n", "hsc_velocity_threshold", "grasp_floor_n"),
    "vfc": ("velocity_threshold", "vfc_force_threshold_n", "vfc_form"),
}
"""Fields of `[safety]` used by observers and trip conditions, by controller."""
DEVICE = ("kind", "axes", "mass_kg", "viscous", "coulomb", "encoder_quantum", "measures_velocity", "max_force_n")
"""Fields that identify a device."""
SETTLE_S = 0.3
"""Time in s after a recorded intervention until the hand feels F_v again: the release ramp."""
LET_GO_S = 0.05
"""Smallest unloaded time in s after a release: that of a failing grip (paper section 4.3)."""
LET_GO_SPEED = 0.3
"""Smallest speed in m/s along F_device of a thrown device."""
UNLOADED_SHARE = 0.5
"""Fraction of an intervention without a hand load, above which the hand has released.

Measured in `remote_push` and `sliding_mass` at 100 ms with the default release law: at most 0.32 with a holding hand,
0.65 and more after a release.
"""
UNLOADED_S = 0.5
"""Smallest duration in s of such an intervention; a compliant hand may not load the device in a shorter one."""
NOT_NORMAL = "a hand that lets go is no normal operation, give recordings in which it holds throughout"
ENGAGED = LADDER_STATES.index("engaged")
BLOCK_S = 60.0
"""Longest time in s of a recording that counts as one block; a shorter recording has one hand."""


class TunedField(NamedTuple):
    """Threshold that recordings can tune."""

    controller: str
    field: str
    """Field of `[safety]`."""
    unit: str
    sign: float
    """Sign of the threshold: `sign` times the boundary of a score that rises as safety falls."""
    least: float
    """Lower bound of that boundary."""
    score: str
    """Score that rises as safety falls, in `unit`."""


TUNED_FIELDS = {
    each.field: each
    for each in (
        TunedField("wsc", "energy_threshold_j", "J", -1.0, 0.0, "energy given to the hand in the window, -E_wso"),
        TunedField("hsc", "grasp_threshold", "", 1.0, 1.0, "grasp value, S_h"),
        TunedField("hsc", "hsc_force_threshold_n", "N", 1.0, 0.0, "rendered force, |F_v|"),
        TunedField("vfc", "velocity_threshold", "m/s", 1.0, 0.0, "velocity along the rendered force"),
    )
}
"""Tunable thresholds by field of `[safety]`."""


class NormalOperation(Struct, frozen=True, kw_only=True):
    """Recordings of holding hands as one series of ticks."""

    files: tuple[str, ...]
    scene: Scene
    """Scene of the first recording with the overrides; all share its device, rate and observer settings."""
    period_s: float
    hours: float
    """Time in h of coupled hands without intervention."""
    blocks: int
    """Independent blocks: recordings, and 60 s parts of longer ones."""
    round_trip_s: float
    """Median of the measured round trip while coupled in s; 0 if not measured."""
    interventions: dict[str, tuple[str, ...]]
    """Trips of each controller in the recordings: file and time in s."""
    scores: dict[str, "Scores"]
    """Scores by field of `[safety]`."""


class Scores(NamedTuple):
    """Ticks at which a controller would trip with a threshold below the score; other ticks are omitted."""

    value: Array
    """Score in the unit of the threshold; infinite if it tripped in the recording, which cut the peak."""
    tick: npt.NDArray[np.int64]
    """Tick number; recordings are separated."""
    block: npt.NDArray[np.int64]


def read_normal_operation(
    files: Sequence[str | os.PathLike[str] | Recording], *, fields: Iterable[str], overrides: Iterable[str] = ()
) -> NormalOperation:
    """Read recordings of masters and compute their safety observers without interventions.

    A tick counts while the sides are engaged and no recorded controller intervenes or did within `SETTLE_S`, because
    the hand then felt another force.

    Args:
        files: Files written by `--record` of a master, or results of `read_recording`.
        fields: Thresholds, keys of `TUNED_FIELDS`.
        overrides: Fields of `[safety]` to change first, `safety.key=value`.

    Raises:
        OSError: A file cannot be read.
        ValueError: No file, a duplicate, or not a master's recording; no coupled time; a release; differing devices,
            rates or observer settings.
    """
    fields, overrides = tuple(fields), tuple(overrides)
    if not files:
        message = "which recordings? Name what --record of master wrote, of hands that hold"
        raise ValueError(message)
    seen: set[Path] = set()
    for path in (Path(file).resolve() for file in files if not isinstance(file, Recording)):
        if path in seen:
            message = f"{path}: is there twice, and says no more for it"
            raise ValueError(message)
        seen.add(path)
    first: _Recorded | None = None
    parts: dict[str, list[Scores]] = {field: [] for field in fields}
    interventions: dict[str, list[str]] = {name: [] for name in OBSERVERS}
    round_trips: list[Array] = []
    ticks = blocks = offset = 0
    for file in files:
        one = _recorded(file, overrides)
        if first is None:
            first = one
        _check_alike(first, one)
        blocks_of = np.cumsum(one.counted) * one.period_s // BLOCK_S
        place = np.arange(len(one.counted)) + offset
        for field in fields:
            value = one.score(field)
            kept = value > TUNED_FIELDS[field].least
            parts[field].append(Scores(value[kept], place[kept], blocks_of[kept].astype(np.int64) + blocks))
        for name, onsets in one.onsets.items():
            interventions[name] += [f"{one.name} at {one.time_s[tick]:.3f} s" for tick in np.flatnonzero(onsets)]
        round_trips.append(one.round_trips_s)
        ticks += int(one.counted.sum())
        blocks += int(blocks_of[-1]) + 1
        # Larger than the separation of events.
        offset += len(one.counted) + 10**7
    assert first is not None
    return NormalOperation(
        files=tuple(map(_name, files)),
        scene=first.scene,
        period_s=first.period_s,
        hours=ticks * first.period_s / 3600.0,
        blocks=blocks,
        round_trip_s=float(np.median(measured)) if (measured := np.concatenate(round_trips)).size else 0.0,
        interventions={name: tuple(places) for name, places in interventions.items()},
        scores={
            field: Scores(*(np.concatenate(columns) for columns in zip(*found, strict=True)))
            for field, found in parts.items()
        },
    )


class _Recorded:
    """One recording with replayed observers and a mask of counted ticks."""

    def __init__(self, name: str, run: Run, scene: Scene, replayed: dict[str, Array]) -> None:
        self.name, self.scene, self.replayed = name, scene, replayed
        self.period_s, self.time_s = scene.run.period_s, run.signals["time_s"]
        tripped = _trips(run)
        # A trip during another controller's intervention belongs to that intervention.
        onsets = _onsets(tripped != 0)
        self.onsets = {name: onsets & (tripped & TRIP_BITS[name] != 0) for name in OBSERVERS}
        engaged = run.signals["state"] == ENGAGED
        measured = run.signals["round_trip_s"][engaged] if "round_trip_s" in run.signals else np.zeros(0)
        self.round_trips_s: Array = measured[np.isfinite(measured)]
        after = round(SETTLE_S / self.period_s)
        self.counted = engaged & ~_extended(tripped != 0, after)

    def score(self, field: str) -> Array:
        """Return the value that the threshold must exceed at each tick to avoid a trip, shape `(n_ticks,)`.

        -inf stands for a tick that no threshold trips.

        - `energy_threshold_j`: `-E_wso` (paper Eq. 13), where `F_v.V / |V| > F_w` or F_w is 0.
        - `grasp_threshold`: `S_h` (Eq. 14), where F_v, both current and as late as F_h, exceeds F_t, and `F_v.V /
          |F_v|` exceeds V_s or V_s is 0.
        - `hsc_force_threshold_n`: the smaller of both F_v, where `S_h > zeta` and V_s is exceeded.
        - `velocity_threshold`: form "product" `V.F_v / F_t` (Eq. 1); form "both" `V.F_v / |F_v|` where `|F_v| > F_t`.

        Source: safety/src/controller; the conditions are those of the tick.
        """
        tuned, safety = TUNED_FIELDS[field], spec_of(self.scene)["safety"]
        velocity, force = self.replayed["velocity"], self.replayed["rendered_force"]
        power, pushed, speed = (velocity * force).sum(axis=1), _norm(force), _norm(velocity)
        if tuned.controller == "wsc":
            gate = safety["wsc_force_threshold_n"]
            passes = (power > gate * speed) | (gate == 0.0)
            score = -self.replayed["windowed_energy_j"]
        elif tuned.controller == "hsc":
            grasp = self.replayed["grasp"]
            # S_h = |F_v| / (|F_h| + alpha), with F_v as late as F_h (Eq. 5).
            aligned = grasp * (_norm(self.replayed["grasp_force"]) + safety["grasp_floor_n"])
            least = np.minimum(pushed, aligned)
            slowest = safety["hsc_velocity_threshold"]
            passes = (power > slowest * pushed) | (slowest == 0.0)
            if field == "grasp_threshold":
                passes &= least > safety["hsc_force_threshold_n"]
                score = grasp
            else:
                passes &= grasp > safety["grasp_threshold"]
                score = least
        elif safety["vfc_form"] == "product":
            passes = np.ones(len(power), dtype=bool)
            score = power / safety["vfc_force_threshold_n"]
        else:
            passes = pushed > safety["vfc_force_threshold_n"]
            score = np.divide(power, pushed, out=np.zeros_like(power), where=pushed > 0.0)
        score = np.where(passes & self.counted & np.isfinite(score), score, -np.inf)
        return np.where(self.onsets[tuned.controller], np.inf, score)


def _name(file: str | os.PathLike[str] | Recording) -> str:
    return file.side if isinstance(file, Recording) else str(file)


def _recorded(file: str | os.PathLike[str] | Recording, overrides: tuple[str, ...]) -> _Recorded:
    """Return a recording after a check for normal operation."""
    name = _name(file)
    recording = file if isinstance(file, Recording) else read_recording(file)
    if recording.side != "master":
        message = f"{name}: of the {recording.side}, must be of the master: observers watch the hand"
        raise ValueError(message)
    check_settings(recording.scene, name)
    run = load(recording)
    if not len(run.signals["time_s"]):
        message = f"{name}: has no tick"
        raise ValueError(message)
    if not np.any(run.signals["state"] == ENGAGED):
        message = f"{name}: nobody was coupled: the two sides never engaged ({run.metrics.outcome})"
        raise ValueError(message)
    if run.settings["master"]["kind"] == "joints":
        message = f"{name}: of kind joints, must be linear or pose: it has no force and velocity of one point"
        raise ValueError(message)
    changes = [f"safety.controllers=[{','.join(OBSERVERS)}]", *overrides]
    try:
        replayed = replay(
            recording, overrides=[*changes, *(f"safety.{each}" for each in NEVER_TRIPPING)], hand="measured"
        )
        scene = recorded_scene(recording.scene, overrides)
    except ValueError as error:
        message = f"{name}: {str(error).removeprefix(f'{recording.side}: ')}"
        raise ValueError(message) from None
    device = run.settings["master"]
    _check_held(name, run, recording.signals, device)
    return _Recorded(name, run, scene, dict(replayed.replayed))


def _check_held(name: str, run: Run, recorded: dict[str, Any], device: dict[str, Any]) -> None:
    """Refuse a recording with a release, which is not normal operation."""
    period_s = float(run.settings["run"]["period_s"])
    time_s = run.signals["time_s"]
    operator = run.settings.get("operator") or {}
    engaged_s = float(time_s[np.argmax(run.signals["state"] == ENGAGED)])
    if (release := operator.get("release")) is not None and engaged_s + release["at_s"] < time_s[-1]:
        message = f"{name}: at {engaged_s + release['at_s']:.3f} s the modelled hand lets go: {NOT_NORMAL}"
        raise ValueError(message)
    position, force = recorded["position"], recorded["device_force"]
    try:
        holds = held_ticks(position, force, device, period_s)
    except HandError as error:
        message = f"{name}: {error}"
        raise ValueError(message) from None
    engaged = run.signals["state"] == ENGAGED
    along = (recorded["velocity"] * force).sum(axis=1) / np.maximum(_norm(force), 1e-9)
    releases = [
        (begin, f"nobody bears the force, and the device reaches {speed:.2f} m/s along it")
        for begin, end in _intervals_of(~holds & engaged)
        if (end - begin) * period_s >= LET_GO_S and (speed := along[begin:end].max()) > LET_GO_SPEED
    ]
    releases += [
        (begin, f"an intervention of {(end - begin) * period_s:.2f} s begins that no hand answers")
        for begin, end in _intervals_of((_trips(run) != 0) & engaged)
        if (end - begin) * period_s > UNLOADED_S and np.mean(~holds[begin:end]) > UNLOADED_SHARE
    ]
    if releases:
        begin, what = min(releases)
        message = f"{name}: at {time_s[begin]:.3f} s {what}: {NOT_NORMAL}"
        raise ValueError(message)


def _check_alike(first: _Recorded, one: _Recorded) -> None:
    """Refuse recordings with differing devices, rates or observer settings."""
    check_device(first.scene, one.scene, f"{first.name}, {one.name}")
    for key in ("estimator", *(name for names in READ_BY_OBSERVERS.values() for name in names)):
        ours, theirs = (getattr(each.scene.safety, key) for each in (first, one))
        if ours != theirs:
            message = (
                f"{first.name}, {one.name}: differ in [safety] {key}: {ours} and {theirs}: must be of like observers"
                + ("" if key == "estimator" else f"; --set safety.{key}=... sees all of them with one")
            )
            raise ValueError(message)


def check_device(ours: Scene, theirs: Scene, names: str) -> None:
    """Refuse two scenes with differing devices or rates.

    Raises:
        ValueError: Names the difference.
    """
    # Compare resolved values, because a preset equals its numbers.
    masters = [json.decode(scene_json(each))["master"] for each in (ours, theirs)]
    pairs = [("[run] period_s", ours.run.period_s, theirs.run.period_s)]
    pairs += [(f"[master] {key}", *(each.get(key) for each in masters)) for key in DEVICE]
    for key, one, other in pairs:
        if one != other:
            message = f"{names}: differ in {key}: {one} and {other}: must be of one device at one rate"
            raise ValueError(message)


def _trips(run: Run) -> npt.NDArray[np.int64]:
    """Return the bits of the intervening controllers of all layers at each tick."""
    tripped = np.zeros(len(run.signals["time_s"]), dtype=np.int64)
    for name in ("tripped", "rotation_tripped"):
        if name in run.signals:
            tripped |= run.signals[name].astype(np.int64)
    return tripped


def _norm(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=1)
    return lengths


def _onsets(states: Bools) -> Bools:
    """Return the mask of ticks at which a state begins."""
    onsets: Bools = states & ~np.concatenate([[False], states[:-1]])
    return onsets


def _extended(states: Bools, ticks: int) -> Bools:
    """Return the mask of ticks at which a state holds, or held within the given ticks before."""
    last: npt.NDArray[np.int64] = np.maximum.accumulate(np.where(states, np.arange(len(states)), -ticks - 1))
    within: Bools = np.arange(len(states)) <= last + ticks
    return within


def _intervals_of(states: Bools) -> list[tuple[int, int]]:
    """Return first tick and end of each interval of a state."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], states, [False]])))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
