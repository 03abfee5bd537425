"""The trade-off of a threshold: how often it trips while a hand holds, and how often it misses one that lets go."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.bridge import Scene, sweep
from haptether.studies.intervals import poisson_interval, wilson_interval
from haptether.studies.task import THRESHOLD_TASKS, HandBounds, Task, ejection_speeds
from haptether.studies.thresholds.law import THRESHOLD_LAWS, ThresholdLaw

Array = npt.NDArray[np.float64]

MISSED_SPEED = 0.5
"""Speed in m/s above which a release is missed: WSC and HSC of the paper leave 0.36 and 0.3 m/s, no controller 1.3."""
FIXED = frozenset(
    f"safety.{name}"
    for name in (
        "controllers", "hold_off_s", "release_ramp_s", "probe_force_n", "release_tries", "hsc_velocity_threshold",
        "wsc_force_threshold_n", "window", "vfc_form", "vfc_force_threshold_n",
        *(law.threshold for law in THRESHOLD_LAWS),
    )
)  # fmt: skip
"""What a law or a task sets, whatever the scene says."""
WITHIN_S = 0.3
"""Time in s after the grip is gone within which that counts."""


class TradeOffRow(Struct, frozen=True, kw_only=True):
    """One law with one threshold in one task at one round trip."""

    law: str
    source: str
    """"paper" or "ours"."""
    controller: str
    threshold: float
    """In the unit of the law."""
    task: str
    round_trip_s: float
    hours: float
    """Simulated time in h while hands held."""
    false_trips: int
    """Interventions that began meanwhile."""
    releases: int
    """Releases that throw the device beyond the missed speed where nobody watches."""
    missed: int
    """Those that still do."""
    speed: float | None
    """Median of the largest speed in m/s after these releases; none without any."""


class TradeOffPoint(Struct, frozen=True, kw_only=True):
    """One law with one threshold at one round trip, over all tasks, with 95 % intervals."""

    law: str
    threshold: float
    round_trip_s: float
    false_trips_per_h: float
    false_trips_per_h_interval: tuple[float, float]
    """Exact, of a Poisson count (Garwood 1936)."""
    missed_share: float | None
    """None where there was nothing to miss."""
    missed_share_interval: tuple[float, float] | None
    """Of Wilson 1927."""


class TradeOff(Struct, frozen=True, kw_only=True):
    """Rows of all laws, thresholds, tasks and round trips."""

    rows: tuple[TradeOffRow, ...]
    laws: tuple[ThresholdLaw, ...]
    tasks: tuple[str, ...]
    round_trips_s: tuple[float, ...]
    hands: int
    seed: int
    missed_speed: float = MISSED_SPEED
    """In m/s."""

    def over(
        self, law: str, threshold: float, *, task: str | None = None, round_trip_s: float | None = None
    ) -> "Counts":
        """The counts of a law and threshold, over the tasks and round trips that are not given."""
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
        """Each law and threshold at each round trip, over all tasks."""
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
                            false_trips_per_h=counts.per_hour,
                            false_trips_per_h_interval=(low / counts.hours, high / counts.hours),
                            missed_share=counts.missed_share if has_any else None,
                            missed_share_interval=wilson_interval(counts.missed, counts.releases) if has_any else None,
                        )
                    )
        return tuple(points)


class Counts(Struct, frozen=True, kw_only=True):
    """What was counted, and the rates that it says."""

    hours: float
    false_trips: int
    releases: int
    missed: int

    @property
    def per_hour(self) -> float:
        """False trips per hour; NaN where nobody held."""
        return self.false_trips / (self.hours or float("nan"))

    @property
    def missed_share(self) -> float:
        """Share of releases that were missed; NaN without any."""
        return self.missed / self.releases if self.releases else float("nan")


def measure_thresholds(
    *,
    tasks: Sequence[str] = THRESHOLD_TASKS,
    laws: Sequence[ThresholdLaw] = THRESHOLD_LAWS,
    round_trips_s: Sequence[float] = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3),
    hands: int = 8,
    releases: int = 4,
    seed: int = 1,
    bounds: HandBounds | None = None,
    overrides: Iterable[str] = (),
    threads: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> TradeOff:
    """Runs tasks with many hands, held and let go, for each threshold of each law.

    Held: each intervention that begins is a false trip. Let go: of the releases after which an unwatched device exceeds
    `MISSED_SPEED` within 0.3 s, those after which it still does are missed. All laws have the same hands, releases and
    links, a hold-off of 0.1 s and a release ramp of 0.2 s.

    Args:
        tasks: Bundled scenes.
        laws: Whose thresholds are swept.
        round_trips_s: In s: both delays of a link together, or by how much a force without an arm is late.
        hands: How many hold each task, at each round trip.
        releases: Times at which each task is let go, at most as many as hands; the hands share them.
        seed: Of hands and links.
        bounds: What hands may be; by default `HandBounds()`.
        overrides: Fields of each scene to change first, `table.key=value`.
        threads: Of the runs; by default as many as there are processors.
        progress: Called with what is run.

    Raises:
        ValueError: No hand, no time, or a scene without a hand.
        SceneError: A scene that cannot be built.
    """
    for name, value in (("hands", hands), ("releases", releases)):
        if value < 1:
            message = f"{name} = {value}: must be 1 or more"
            raise ValueError(message)
    for name, several in (("tasks", tasks), ("round_trips_s", round_trips_s)):
        if not several or len(set(several)) < len(several):
            message = f"{name} = {list(several)}: must be one or more, each once"
            raise ValueError(message)
    for override in overrides:
        if (key := override.partition("=")[0].strip()) in FIXED:
            message = f"{override}: {key} is the same for every law here, or the law's own"
            raise ValueError(message)
    bounds, overrides = bounds or HandBounds(), tuple(overrides)
    rows: list[TradeOffRow] = []
    for name in tasks:
        for round_trip_s in round_trips_s:
            if progress is not None:
                progress(f"{name}, {round_trip_s * 1e3:g} ms")
            task = Task(name, round_trip_s, overrides)
            run = TaskRuns(task, task.hands(hands, seed, bounds), releases, threads)
            rows += run.rows(laws, task.lasting(bounds))
    return TradeOff(
        rows=tuple(rows),
        laws=tuple(laws),
        tasks=tuple(tasks),
        round_trips_s=tuple(round_trips_s),
        hands=hands,
        seed=seed,
    )


class TaskRuns:
    """One task at one round trip, done by hands that hold, and that let go at times spread over what is pressed."""

    def __init__(self, task: Task, hands: dict[str, Array], releases: int, threads: int | None) -> None:
        self.task, self.threads = task, threads
        self.hands, self.count = hands, len(hands["run.seed"])
        # Each hand lets go once, at one of the times.
        times = task.release_times(min(releases, self.count))
        self.groups = [
            (task.let_go(at_s, WITHIN_S), np.arange(self.count) % len(times) == place)
            for place, at_s in enumerate(times)
        ]
        self.groups = [(scene, chosen) for scene, chosen in self.groups if chosen.any()]
        self.thrown = [self._thrown(scene, None, chosen)[0] for scene, chosen in self.groups]

    def _over(self, law: ThresholdLaw, chosen: "npt.NDArray[np.bool_]") -> dict[str, Array]:
        """Each chosen hand with each threshold, threshold by threshold."""
        count = int(chosen.sum())
        rows = {path: np.tile(values[chosen], len(law.values)) for path, values in self.hands.items()}
        return rows | {f"safety.{law.threshold}": np.repeat(np.array(law.values), count)}

    def _thrown(
        self, scene: Scene, law: ThresholdLaw | None, chosen: "npt.NDArray[np.bool_]"
    ) -> tuple["npt.NDArray[np.bool_]", Array]:
        """Whether each release exceeds the missed speed, and the speed, by threshold and hand."""
        if law is None:
            watched = self.task.watched(scene, None, {})
            samples = {path: values[chosen] for path, values in self.hands.items()}
            shape: tuple[int, ...] = (-1,)
        else:
            watched = self.task.watched(scene, law.controller, law.fixed)
            samples, shape = self._over(law, chosen), (len(law.values), -1)
        found = sweep(watched, samples=samples, threads=self.threads)
        speed = np.nan_to_num(np.asarray(found["max_ejection_velocity"], dtype=np.float64))
        return (ejection_speeds(scene, found) > MISSED_SPEED).reshape(shape), speed.reshape(shape)

    def released(self, law: ThresholdLaw) -> list[tuple[int, int, Array]]:
        """Of each threshold: releases that throw where nobody watches, those of them missed, and their speeds in m/s.

        A speed is the largest within `WITHIN_S` after the grip is gone.
        """
        of = [
            (thrown, *self._thrown(scene, law, chosen))
            for (scene, chosen), thrown in zip(self.groups, self.thrown, strict=True)
            if thrown.any()
        ]
        found = []
        for place in range(len(law.values)):
            speeds = [speed[place][thrown] for thrown, _, speed in of]
            count = sum(int(thrown.sum()) for thrown, _, _ in of)
            missed = sum(int(fast[place][thrown].sum()) for thrown, fast, _ in of)
            found.append((count, missed, np.concatenate(speeds) if speeds else np.zeros(0)))
        return found

    def rows(self, laws: Sequence[ThresholdLaw], lasting: Scene) -> list[TradeOffRow]:
        """Of all laws and thresholds; `lasting` is the task that is held throughout."""
        everyone = np.ones(self.count, dtype=bool)
        rows = []
        for law in laws:
            held = sweep(
                self.task.watched(lasting, law.controller, law.fixed),
                samples=self._over(law, everyone),
                threads=self.threads,
            )
            trips = np.nan_to_num(np.asarray(held["false_trips"], dtype=np.float64)).reshape(len(law.values), -1)
            ticks = np.nan_to_num(np.asarray(held["ticks"], dtype=np.float64)).reshape(len(law.values), -1)
            hours = ticks.sum(axis=1) * lasting.run.period_s / 3600.0
            released = self.released(law)
            for place, threshold in enumerate(law.values):
                releases, missed, speeds = released[place]
                rows.append(
                    TradeOffRow(
                        law=law.name,
                        source=law.source,
                        controller=law.controller,
                        threshold=threshold,
                        task=self.task.name,
                        round_trip_s=self.task.round_trip_s,
                        hours=float(hours[place]),
                        false_trips=int(trips[place].sum()),
                        releases=releases,
                        missed=missed,
                        speed=float(np.median(speeds)) if speeds.size else None,
                    )
                )
        return rows
