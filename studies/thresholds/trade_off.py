"""Trade-off of a threshold: false trips while a hand holds, against missed releases."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.bridge import Scene, sweep
from haptether.safety import THROWN_SPEED
from haptether.studies.intervals import poisson_interval, wilson_interval
from haptether.studies.task import (
    FIXED,
    HANDS,
    RELEASES,
    ROUND_TRIPS_S,
    THRESHOLD_TASKS,
    HandBounds,
    Releases,
    Task,
    ejection_metrics,
    ejection_speeds,
    refuse_fixed,
)
from haptether.studies.thresholds.law import THRESHOLD_LAWS, ThresholdLaw

Array = npt.NDArray[np.float64]

MAX_ROUND_TRIP_S = 60.0
"""Longest of a measurement; beyond what a ladder bears nothing engages."""
MISSED_SPEED = THROWN_SPEED
"""Speed in m/s above which a release counts as missed."""
LAWS_OWN = (
    *(
        f"safety.{name}"
        for name in (
            "hold_off_s", "release_ramp_s", "probe_force_n", "release_tries", "hsc_velocity_threshold",
            "wsc_force_threshold_n", "energy_ratio", "window", "vfc_form", "vfc_force_threshold_n", "preset",
        )
    ),
    *(f"safety.{law.threshold}" for law in THRESHOLD_LAWS),
)  # fmt: skip
"""Fields that a law sets, whatever the scene contains."""


class TradeOffRow(Struct, frozen=True, kw_only=True):
    """One law with one threshold in one task at one round trip."""

    law: str
    source: str
    """"paper" or "ours"."""
    controller: str
    threshold: float
    """Threshold in the unit of the law."""
    task: str
    round_trip_s: float
    hours: float
    """Simulated time in h in which hands held while coupled, as without controllers."""
    false_trips: int
    """Interventions that began during that time."""
    releases: int
    """Releases that exceed the missed speed without controllers."""
    missed: int
    """Releases that still exceed it."""
    speed: float | None
    """Median of the largest speed in m/s after these releases; None without any."""


class TradeOffPoint(Struct, frozen=True, kw_only=True):
    """One law with one threshold at one round trip, over all tasks, with 95 % intervals."""

    law: str
    threshold: float
    round_trip_s: float
    false_trips_per_h: float | None
    """None without held time."""
    false_trips_per_h_interval: tuple[float, float] | None
    """Exact interval of a Poisson count (Garwood 1936)."""
    missed_share: float | None
    """None without such releases."""
    missed_share_interval: tuple[float, float] | None
    """Interval of Wilson 1927."""


class TradeOff(Struct, frozen=True, kw_only=True):
    """Rows of all laws, thresholds, tasks and round trips."""

    rows: tuple[TradeOffRow, ...]
    laws: tuple[ThresholdLaw, ...]
    tasks: tuple[str, ...]
    round_trips_s: tuple[float, ...]
    hands: int
    seed: int
    missed_speed: float = MISSED_SPEED
    """Speed in m/s."""

    def over(
        self, law: str, threshold: float, *, task: str | None = None, round_trip_s: float | None = None
    ) -> "Counts":
        """Return the counts of a `law` and `threshold`, of a `task` and `round_trip_s` in s; None sums over all."""
        rows = [
            row
            for row in self.rows
            if row.law == law
            and row.threshold == threshold
            and (task is None or row.task == task)
            and (round_trip_s is None or row.round_trip_s == round_trip_s)
        ]
        return Counts(
            hours=sum(row.hours for row in rows),
            false_trips=sum(row.false_trips for row in rows),
            releases=sum(row.releases for row in rows),
            missed=sum(row.missed for row in rows),
        )

    def points(self) -> tuple[TradeOffPoint, ...]:
        """Return each law and threshold at each round trip, over all tasks."""
        points = []
        for law in self.laws:
            for threshold in law.values:
                for round_trip_s in self.round_trips_s:
                    counts = self.over(law.name, threshold, round_trip_s=round_trip_s)
                    low, high = poisson_interval(counts.false_trips)
                    has_any = counts.releases > 0
                    points.append(
                        TradeOffPoint(
                            law=law.name,
                            threshold=threshold,
                            round_trip_s=round_trip_s,
                            false_trips_per_h=counts.per_hour if counts.hours else None,
                            false_trips_per_h_interval=(low / counts.hours, high / counts.hours)
                            if counts.hours
                            else None,
                            missed_share=counts.missed_share if has_any else None,
                            missed_share_interval=wilson_interval(counts.missed, counts.releases) if has_any else None,
                        )
                    )
        return tuple(points)


class Counts(Struct, frozen=True, kw_only=True):
    """Counts, and rates from them."""

    hours: float
    false_trips: int
    releases: int
    missed: int

    @property
    def per_hour(self) -> float:
        """False trips per hour; NaN without held time."""
        return self.false_trips / (self.hours or float("nan"))

    @property
    def missed_share(self) -> float:
        """Fraction of missed releases; NaN without any."""
        return self.missed / self.releases if self.releases else float("nan")


def measure_thresholds(
    *,
    tasks: Sequence[str] = THRESHOLD_TASKS,
    laws: Sequence[ThresholdLaw] = THRESHOLD_LAWS,
    round_trips_s: Sequence[float] = ROUND_TRIPS_S,
    hands: int = HANDS,
    releases: int = RELEASES,
    seed: int = 1,
    bounds: HandBounds | None = None,
    overrides: Iterable[str] = (),
    threads: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> TradeOff:
    """Run tasks with many hands, holding and releasing, for each threshold of each law.

    While a hand holds, each intervention is a false trip. A release counts if the device without controllers exceeds
    `MISSED_SPEED` within 0.5 s; it is missed if the device still exceeds it. All laws use the same hands, releases and
    links, a hold-off of 0.1 s and a release ramp of 0.2 s.

    Args:
        tasks: Bundled scenes.
        laws: Laws with swept thresholds.
        round_trips_s: Sum of both link delays in s, or the force delay without an arm.
        hands: Number of hands per task and round trip.
        releases: Number of release times within the time of large forces; the hands share them.
        seed: Seed of hands and links.
        bounds: Bounds of the hands; by default `HandBounds()`.
        overrides: Fields of each scene to change first, `table.key=value`.
        threads: Number of threads; by default the number of processors.
        progress: If given, called with a description of the current run.

    Raises:
        ValueError: No hand, no release time, or a scene without a hand.
        SceneError: A scene is invalid.
    """
    for name, value in (("hands", hands), ("releases", releases)):
        if value < 1:
            message = f"{name} = {value}: must be 1 or more"
            raise ValueError(message)
    for name, several in (("tasks", tasks), ("round_trips_s", round_trips_s)):
        if not several or len(set(several)) < len(several):
            message = f"{name} = {list(several)}: must be one or more, each once"
            raise ValueError(message)
    if wrong := [value for value in round_trips_s if not 0.0 <= value <= MAX_ROUND_TRIP_S]:
        message = f"round_trips_s: {wrong[0]}: must be between 0 and {MAX_ROUND_TRIP_S:g} s"
        raise ValueError(message)
    bounds, overrides = bounds or HandBounds(), tuple(overrides)
    refuse_fixed(overrides, (*FIXED, *LAWS_OWN, "safety.research"), "is the same for every law here, or the law's own")
    rows: list[TradeOffRow] = []
    for name in tasks:
        for round_trip_s in round_trips_s:
            if progress is not None:
                progress(f"{name}, {round_trip_s * 1e3:g} ms")
            task = Task(name, round_trip_s, overrides)
            run = TaskRuns(task, task.lasting(bounds), task.hands(hands, seed, bounds), releases, threads)
            rows += run.rows(laws)
    return TradeOff(
        rows=tuple(rows),
        laws=tuple(laws),
        tasks=tuple(tasks),
        round_trips_s=tuple(round_trips_s),
        hands=hands,
        seed=seed,
    )


class TaskRuns:
    """One task at one round trip, with hands that hold, and hands that release at times spread over the press."""

    def __init__(self, task: Task, lasting: Scene, hands: dict[str, Array], places: int, threads: int | None) -> None:
        self.task, self.lasting, self.threads = task, lasting, threads
        self.hands = hands
        held = task.hold(task.with_controllers(lasting, None, {}), hands, threads)
        self.hours = sum(run.coupled_s for run in held if run.engaged_s is not None) / 3600.0
        self.releases = task.releases(hands, held, places)
        # Each hand releases once.
        self.thrown = self._speeds(self.releases, None)[0] > MISSED_SPEED if self.releases else np.empty(0, dtype=bool)

    def _over(self, law: ThresholdLaw, rows: dict[str, Array]) -> dict[str, Array]:
        """Combine each hand with each threshold, threshold by threshold."""
        count = len(rows["run.seed"])
        tiled = {path: np.tile(values, len(law.values)) for path, values in rows.items()}
        return tiled | {f"safety.{law.threshold}": np.repeat(np.array(law.values), count)}

    def _speeds(self, releases: Releases, law: ThresholdLaw | None) -> Array:
        """Return the largest speed in m/s after each release, by threshold and hand."""
        watched = self.task.with_controllers(releases.scene, law.controller if law else None, law.fixed if law else {})
        samples = self._over(law, releases.rows) if law else releases.rows
        found = sweep(watched, samples=samples, threads=self.threads, metrics=ejection_metrics(watched))
        return ejection_speeds(releases.scene, found).reshape(len(law.values) if law else 1, -1)

    def released(self, law: ThresholdLaw) -> list[tuple[int, int, Array]]:
        """Return, per threshold, the releases that throw without controllers, the missed ones, and their speeds in m/s.

        A speed is the largest within `WITHIN_S` after the release.
        """
        thrown = self.thrown
        speeds = np.empty((len(law.values), 0))
        if self.releases is not None and thrown.any():
            speeds = self._speeds(self.releases, law)[:, thrown]
        return [(int(thrown.sum()), int((each > MISSED_SPEED).sum()), each) for each in speeds]

    def rows(self, laws: Sequence[ThresholdLaw]) -> list[TradeOffRow]:
        """Return the rows of all laws and thresholds."""
        rows = []
        for law in laws:
            held = sweep(
                self.task.with_controllers(self.lasting, law.controller, law.fixed),
                samples=self._over(law, self.hands),
                threads=self.threads,
                metrics=["false_trips"],
            )
            trips = np.nan_to_num(np.asarray(held["false_trips"], dtype=np.float64)).reshape(len(law.values), -1)
            for threshold, false_trips, (releases, missed, speeds) in zip(
                law.values, trips, self.released(law), strict=True
            ):
                rows.append(
                    TradeOffRow(
                        law=law.name,
                        source=law.source,
                        controller=law.controller,
                        threshold=threshold,
                        task=self.task.name,
                        round_trip_s=self.task.round_trip_s,
                        hours=self.hours,
                        false_trips=int(false_trips.sum()),
                        releases=releases,
                        missed=missed,
                        speed=float(np.median(speeds)) if speeds.size else None,
                    )
                )
        return rows
