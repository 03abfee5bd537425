"""Thresholds from recordings of normal operation, with the simulated releases that they miss."""

import math
import os
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import Recording, Scene, load_scene
from haptether.studies.intervals import binomial_interval
from haptether.studies.task import MAX_ROUND_TRIP_S, HandBounds, Task
from haptether.studies.thresholds.law import ThresholdLaw
from haptether.studies.thresholds.trade_off import MISSED_SPEED, TaskRuns
from haptether.studies.tuning.exceedances import Boundary, Exceedances, hours_for
from haptether.studies.tuning.normal_operation import (
    READ_BY_OBSERVERS,
    TUNED_FIELDS,
    NormalOperation,
    check_device,
    read_normal_operation,
)

FIELD_OF = {"wsc": "energy_threshold_j", "hsc": "grasp_threshold", "vfc": "velocity_threshold"}
"""Threshold of each controller tuned by default: that of the paper's section 5."""
BEYOND = (1.25, 1.6, 2.5)
"""Multiples of the largest observed value at which releases are also simulated."""
MOST_POINTS = 12
"""Largest number of ROC points below the largest observed value."""


class RocPoint(Struct, frozen=True, kw_only=True):
    """Threshold with false trips per hour and missed releases."""

    threshold: float
    """Threshold as in `[safety]`."""
    false_trips_per_h: float
    false_trips_per_h_interval: tuple[float, float]
    """Interval at the confidence of the tuning."""
    releases: int
    """Simulated releases that exceed `missed_speed` without controllers; 0 without a scene."""
    missed: int
    """Releases that still exceed it."""
    missed_interval: tuple[float, float] | None
    """Exact interval (Clopper and Pearson 1934) of the missed fraction; None without a release."""
    mev: float | None
    """MEV: largest speed in m/s after these releases."""


class TunedThreshold(Struct, frozen=True, kw_only=True):
    """Tuned threshold of `[safety]` with rates and intervals."""

    controller: str
    field: str
    unit: str
    point: RocPoint
    """Resulting threshold."""
    order: int
    """Order of the event in the recordings; 0 if there is none, and the recorded threshold is kept."""
    grouping: float
    """Mean number of events per hand and group, weighted by events."""
    most_per_h: float
    """One-sided upper bound of the false trip rate in 1/h at the confidence."""
    reached: bool
    """True if that bound is at most `Tuning.per_hour`."""
    needed_hours: float
    """Held time in h required to support the rate, if hands hold as here."""
    interventions: tuple[str, ...]
    """Trips of this controller, file and time in s. They cut the observer's peak, so each counts as above every
    threshold.
    """
    recorded: RocPoint
    """Threshold of the recordings, for comparison."""
    roc: tuple[RocPoint, ...]
    """Other thresholds, most sensitive first."""
    peaks: tuple[float, ...]
    """Largest events in falling order as thresholds, at most 1000."""

    @property
    def none_missed(self) -> RocPoint | None:
        """Return the least sensitive threshold of the curve that, with all more sensitive ones, misses no release."""
        best = None
        for point in self.roc:
            if point.missed:
                break
            best = point if point.releases else None
        return best


class Tuning(Struct, frozen=True, kw_only=True):
    """Thresholds found by `tune`, with their recordings and options."""

    files: tuple[str, ...]
    hours: float
    """Time in h in which hands held without intervention."""
    blocks: int
    """Number of recordings, and 60 s parts of longer ones."""
    per_hour: float
    """Largest allowed false trip rate of each controller in 1/h."""
    confidence: float
    round_trip_s: float
    missed_speed: float
    """Speed in m/s."""
    hands: int
    seed: int
    thresholds: tuple[TunedThreshold, ...]
    safety: dict[str, float | int | str]
    """Other fields of `[safety]` used by the observers."""
    notes: tuple[str, ...]
    """Omitted steps with reasons."""

    @property
    def reached(self) -> bool:
        """True if every threshold keeps the false trip rate."""
        return all(each.reached for each in self.thresholds)

    def toml(self) -> str:
        """Return a table `[safety]` with the thresholds, and rates, intervals and MEV as comments."""
        names = dict.fromkeys(each.controller for each in self.thresholds)
        lines = ["[safety]", f"controllers = [{', '.join(map(_toml, names))}]"]
        for each in self.thresholds:
            lines += [*(f"# {text}" for text in _expected(each, self)), f"{each.field} = {_toml(each.point.threshold)}"]
        lines += [f"{name} = {_toml(value)}" for name, value in self.safety.items()]
        return "\n".join(lines) + "\n"


def tune(
    files: Sequence[str | os.PathLike[str] | Recording],
    *,
    scene: Scene | str | os.PathLike[str] | None = None,
    fields: Sequence[str] | None = None,
    false_trips_per_h: float = 60.0,
    confidence: float = 0.95,
    round_trip_s: float | None = None,
    hands: int = 8,
    releases: int = 4,
    seed: int = 1,
    bounds: HandBounds | None = None,
    overrides: Iterable[str] = (),
    threads: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Find the boundary of each observer in normal operation, and the releases that it misses.

    Selects the most sensitive threshold whose false trip rate is below a limit with a confidence (`Boundary`); it is an
    event of the recordings. Many hands release in a scene under their pressing force or a push. Each releases within 50
    ms, and counts if the device without controllers exceeds 0.5 m/s within 0.5 s.

    Args:
        files: Recordings of masters with holding hands: paths, or results of `read_recording`.
        scene: Scene of the releases; by default that of the first recording.
        fields: Thresholds, keys of `TUNED_FIELDS`; by default those of the recorded controllers, or all.
        false_trips_per_h: Largest rate of each controller in 1/h.
        confidence: Confidence of the rate and of all intervals.
        round_trip_s: Round trip of the releases in s; by default the median of the recordings.
        hands: Number of releasing hands, 1 or more; each releases once.
        releases: Number of release times.
        seed: Seed of hands and links.
        bounds: Bounds of the hands; by default `HandBounds()`.
        overrides: Fields of `[safety]` used by observers to change first, `safety.key=value`.
        threads: Number of threads; by default the number of processors.
        progress: If given, called with a description of the current step.

    Raises:
        OSError: A file cannot be read.
        ValueError: A recording is not of normal operation, too few complete events, or invalid options.
        SceneError: The scene is invalid.

    Source: paper section 5 (boundary values in normal operation, then abnormal ones); `Boundary`.
    """
    _check(false_trips_per_h, confidence, round_trip_s, hands, releases)
    overrides, report = tuple(overrides), progress or (lambda _: None)
    _check_overrides(overrides)
    chosen = _check_fields(fields)
    report(f"{len(files)} recordings")
    seen = read_normal_operation(files, fields=chosen or TUNED_FIELDS, overrides=overrides)
    if chosen is None:
        watching = [name for name in FIELD_OF if name in seen.scene.safety.controllers]
        chosen = tuple(FIELD_OF[name] for name in watching or FIELD_OF)
    release_trip_s = seen.round_trip_s if round_trip_s is None else round_trip_s
    conditions = (release_trip_s, hands, releases, seed)
    runs, notes = _release_runs(seen, scene, conditions, bounds or HandBounds(), threads)
    if seen.scene.master.rotation is not None:
        notes.append("of kind pose: thresholds of [safety.rotation], for torques, are not tuned")
    tuned = []
    for field in chosen:
        report(f"{field}: releases")
        tuned.append(_tuned(seen, field, runs, false_trips_per_h, confidence))
    watched = {each.controller for each in tuned}
    own = {each.field for each in tuned}
    return Tuning(
        files=seen.files,
        hours=seen.hours,
        blocks=seen.blocks,
        per_hour=false_trips_per_h,
        confidence=confidence,
        round_trip_s=release_trip_s,
        missed_speed=MISSED_SPEED,
        hands=hands,
        seed=seed,
        thresholds=tuple(tuned),
        safety={
            name: getattr(seen.scene.safety, name)
            for controller, names in READ_BY_OBSERVERS.items()
            if controller in watched
            for name in names
            if name not in own
        },
        notes=tuple(notes),
    )


def _check(per_hour: float, confidence: float, round_trip_s: float | None, hands: int, releases: int) -> None:
    if not 0.0 < per_hour < math.inf:
        message = f"false_trips_per_h = {per_hour}: must be a number above 0"
        raise ValueError(message)
    if not 0.5 <= confidence <= 0.9999:
        message = f"confidence = {confidence}: must be 0.5 to 0.9999"
        raise ValueError(message)
    if round_trip_s is not None and not 0.0 <= round_trip_s <= MAX_ROUND_TRIP_S:
        message = f"round_trip_s = {round_trip_s}: must be 0 to {MAX_ROUND_TRIP_S:g}"
        raise ValueError(message)
    for name, value in (("hands", hands), ("releases", releases)):
        if value < 1:
            message = f"{name} = {value}: must be 1 or more"
            raise ValueError(message)


def _check_overrides(overrides: tuple[str, ...]) -> None:
    allowed = sorted({name for names in READ_BY_OBSERVERS.values() for name in names})
    for override in overrides:
        key = override.partition("=")[0].strip()
        if key.removeprefix("safety.") not in allowed or not key.startswith("safety."):
            message = f"{override}: must be a setting of the observers, safety. and one of {', '.join(allowed)}"
            raise ValueError(message)


def _check_fields(fields: Sequence[str] | None) -> tuple[str, ...] | None:
    if fields is None:
        return None
    if unknown := [field for field in fields if field not in TUNED_FIELDS]:
        message = f"fields = {unknown[0]}: must be of {', '.join(TUNED_FIELDS)}"
        raise ValueError(message)
    controllers = [TUNED_FIELDS[field].controller for field in fields]
    if not fields or len(set(controllers)) < len(controllers):
        message = f"fields = {', '.join(fields)}: must be one or more, one of a controller: the other one is then held"
        raise ValueError(message)
    return tuple(fields)


def _release_runs(
    seen: NormalOperation,
    scene: Scene | str | os.PathLike[str] | None,
    how: tuple[float, int, int, int],
    bounds: HandBounds,
    threads: int | None,
) -> tuple[TaskRuns | None, list[str]]:
    """Create releasing hands in the scene, with device, estimator and observers of the recordings."""
    round_trip_s, hands, releases, seed = how
    if scene is None:
        task_scene = seen.scene
    else:
        task_scene = scene if isinstance(scene, Scene) else load_scene(scene)
        check_device(seen.scene, task_scene, str(scene) if not isinstance(scene, Scene) else scene.title)
    if task_scene.operator is None:
        note = "the recordings do not say how a hand presses: give a scene, for releases that are missed"
        return None, [note]
    names = ("estimator", *(name for names in READ_BY_OBSERVERS.values() for name in names))
    safety = replace(task_scene.safety, **{name: getattr(seen.scene.safety, name) for name in names})
    task = Task(replace(task_scene, safety=safety), round_trip_s)
    runs = TaskRuns(task, task.lasting(bounds), task.hands(hands, seed, bounds), releases, threads)
    notes = [] if task.selection is None else [task.selection]
    if not runs.thrown.any():
        notes.append(f"no release in the scene exceeds {MISSED_SPEED:g} m/s where nobody watches: none can be missed")
    return runs, notes


def _tuned(
    seen: NormalOperation, field: str, runs: TaskRuns | None, per_hour: float, confidence: float
) -> TunedThreshold:
    about = TUNED_FIELDS[field]
    events = Exceedances(seen.scores[field], seen.hours, seen.period_s)
    largest = events.boundary(1)
    found = events.at_most(per_hour, confidence)
    recorded = float(getattr(seen.scene.safety, field))
    boundary = found or largest
    tripped = seen.interventions[about.controller]
    if boundary is not None and math.isinf(boundary.value):
        message = (
            f"{field}: {about.controller} tripped {len(tripped)} times in {seen.hours * 3600.0:.0f} s of the "
            f"recordings, more than {per_hour:g} times per hour with confidence, and how high its observer would have "
            f"gone was not seen: record with duller thresholds, or ask for less; first {tripped[0]}"
        )
        raise ValueError(message)
    orders = _orders(found)
    boundaries = [each for order in orders if (each := events.boundary(order)) and math.isfinite(each.value)]
    values = {
        _rounded_outward(about.sign * each.value): (each.per_hour, each.interval_per_hour(confidence))
        for each in boundaries
    }
    if largest is not None and math.isfinite(largest.value):
        for beyond in BEYOND:
            most = largest.interval_per_hour(confidence)[1]
            values.setdefault(_rounded_outward(about.sign * beyond * largest.value), (0.0, (0.0, most)))
    values.setdefault(recorded, events.rate_of(about.sign * recorded, confidence))
    points = _points(about.field, about.controller, values, runs, confidence)
    point = points[recorded if boundary is None else _rounded_outward(about.sign * boundary.value)]
    most_per_h = hours_for(1.0, confidence) / seen.hours if boundary is None else boundary.quantile_per_hour(confidence)
    first = most_per_h if largest is None else largest.quantile_per_hour(confidence)
    return TunedThreshold(
        controller=about.controller,
        field=field,
        unit=about.unit,
        point=point,
        order=0 if boundary is None else boundary.order,
        grouping=1.0 if boundary is None else boundary.grouping,
        most_per_h=most_per_h,
        reached=most_per_h <= per_hour,
        needed_hours=seen.hours * first / per_hour,
        interventions=tripped,
        recorded=points[recorded],
        roc=tuple(points.values()),
        peaks=tuple(about.sign * value for value in events.peaks(1000) if math.isfinite(value)),
    )


def _orders(found: Boundary | None) -> list[int]:
    """Return the orders of a ROC curve: 1, 2, 3, 4, 6, 8, ... to a multiple of the found order, and that order."""
    last = max(64, 4 * (found.order if found else 0))
    orders = np.unique(np.round(np.geomspace(1.0, last, MOST_POINTS)).astype(int)).tolist()
    return sorted({*orders, *([found.order] if found else [])})


def _points(
    field: str,
    controller: str,
    values: dict[float, tuple[float, tuple[float, float]]],
    runs: TaskRuns | None,
    confidence: float,
) -> dict[float, RocPoint]:
    """Return the points by threshold, most sensitive first."""
    ordered = sorted(values, key=abs)
    law = ThresholdLaw(
        name=field, controller=controller, source="ours", threshold=field, unit="", values=tuple(ordered)
    )
    released = [(0, 0, np.zeros(0))] * len(ordered) if runs is None else runs.released(law)
    points = {}
    for value, (count, missed, speeds) in zip(ordered, released, strict=True):
        rate, interval = values[value]
        points[value] = RocPoint(
            threshold=value,
            false_trips_per_h=rate,
            false_trips_per_h_interval=interval,
            releases=count,
            missed=missed,
            missed_interval=binomial_interval(missed, count, confidence) if count else None,
            mev=float(speeds.max()) if speeds.size else None,
        )
    return points


def _rounded_outward(threshold: float) -> float:
    """Round a threshold to four digits away from 0, so that it is not below its event."""
    if threshold == 0.0:
        return threshold
    scale = 10.0 ** (math.floor(math.log10(abs(threshold))) - 3)
    return float(f"{math.copysign(math.ceil(abs(threshold) / scale - 1e-9) * scale, threshold):.4g}")


def _toml(value: float | str) -> str:
    return f'"{value}"' if isinstance(value, str) else f"{value:.6g}"


def _expected(each: TunedThreshold, found: Tuning) -> list[str]:
    point = each.point
    low, high = point.false_trips_per_h_interval
    share = f"{100.0 * found.confidence:g} %"
    rate = f"{point.false_trips_per_h:.3g} false trips per hour ({share}: {low:.3g} to {high:.3g})"
    lines = [rate if each.order else f"nothing came near: kept. {rate}"]
    if point.missed_interval is not None:
        low, high = point.missed_interval
        lines.append(
            f"{point.missed} of {point.releases} releases missed ({share}: {100.0 * low:.0f} to {100.0 * high:.0f} %),"
            f" MEV {point.mev:.2f} m/s"
        )
    return lines
