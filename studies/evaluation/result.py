"""Results of an evaluation: cells, verdicts per delay, and the worst release."""

from collections.abc import Iterable, Sequence
from math import ceil, inf
from statistics import median
from typing import Literal, TypeAlias, get_args

from msgspec import Struct

from haptether.bridge import Scene
from haptether.safety import THROWN_SPEED
from haptether.studies.intervals import median_interval, poisson_interval, wilson_interval
from haptether.studies.task import Network

Verdict: TypeAlias = Literal["diverged", "thrown", "not-engaged", "uncoupled", "trips", "not-measured", "safe"]
"""Verdict on a cell, worst first."""
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
"""Verdicts, worst first."""
UNSAFE: frozenset[Verdict] = frozenset({"diverged", "thrown", "not-engaged", "not-measured"})
"""Verdicts that do not exclude a thrown device."""
MOST_HANDS = 100_000
"""Upper limit of the reported number of hands."""
INTERFERING: frozenset[Verdict] = frozenset({"uncoupled", "trips"})
"""Verdicts of a loop that interrupts the task but throws no device."""

EVALUATED_CONTROLLERS = ("none", "vfc", "hsc", "wsc", "hsc+wsc", "vfc+hsc+wsc")
"""Default controller sets."""
EVALUATED_NETWORKS = (
    Network(name="steady"),
    Network(name="jitter", jitter=0.1),
    Network(name="loss", loss=0.02, mean_burst=4.0),
    Network(name="jitter+loss", jitter=0.1, loss=0.02, mean_burst=4.0),
)
"""Default networks: delay only; jitter of a tenth of it; 2 % loss in bursts of four; both."""


class EvaluationLimits(Struct, frozen=True, kw_only=True):
    """Limits of a safe verdict."""

    speed: float = THROWN_SPEED
    """Speed in m/s above which a release has thrown the device."""
    false_trips_per_h: float = 60.0
    """Interventions per hour while a hand holds, above which a controller interferes with the task."""
    thrown_share: float = 0.1
    """Fraction of throwing releases that the 95 % interval must exclude to confirm "safe"."""


class EvaluationCell(Struct, frozen=True, kw_only=True):
    """Result of one controller set in one task, at one round trip, on one network. None stands for not measured."""

    task: str
    controllers: str
    """Names joined by "+"; "none" for no controller."""
    round_trip_s: float
    network: str
    held: dict[str, int]
    """Number of runs with a holding hand per outcome of `Metrics.outcome`."""
    hours: float
    """Time in h for which hands held while coupled."""
    holds: int
    """Number of ends of the coupling during that time: HOLD, STOP or a fault, even if resumed."""
    false_trips: int | None
    """Interventions that began during that time."""
    intervention_share: float | None
    """Fraction of that time under intervention."""
    can_push: bool
    """True if a force can be felt: there is an arm, or an object."""
    releases: int
    """Number of releases, without those during an intervention."""
    already_tripped: int
    """Number of releases during an intervention, which say nothing about detection."""
    dangerous: int
    """Releases after which the device exceeds the limit, with or without controllers."""
    thrown: int
    """Releases after which the device exceeds the limit with these controllers."""
    speeds: tuple[float, ...]
    """Largest speeds in m/s after dangerous releases."""
    speed: float | None
    """Median of the largest speeds in m/s after dangerous releases, MEV."""
    speed_interval: tuple[float, float] | None
    """Distribution-free 95 % interval of that median; None for fewer than six."""
    max_speed: float | None
    """Largest speed in m/s after any release."""
    detections_s: tuple[float, ...]
    """Times in s from the loosening of the grip to the first intervention, for dangerous releases with one."""
    detection_s: float | None
    """Median of these times."""
    undetected: int
    """Dangerous releases without an intervention within the observed time."""
    peak_force_n: float | None
    """Largest |F_device| in N while hands held."""
    energy_j: float | None
    """Largest energy in J that a holding hand received, net of its own."""
    position_rmse_m: float | None
    """Median RMS position error of the arm in m while hands held."""
    force_rmse_n: float | None
    """Median RMS force error in N."""
    stiffness: float | None
    """Transmitted stiffness in N/m felt by one holding hand: `F = K x + B V + F_0`, by least squares."""
    damping: float | None
    """Transmitted damping in N s/m of the same fit."""

    def verdict(self, limits: EvaluationLimits) -> Verdict:
        """Return the worst applicable verdict; without a release the safety is not measured."""
        rate = self.false_trips_per_h
        applies: dict[Verdict, bool] = {
            "diverged": self.held.get("diverged", 0) > 0,
            "thrown": self.thrown > 0,
            "not-engaged": self.held.get("never-engaged", 0) > 0,
            "uncoupled": self.holds > 0 or not self.held.keys() <= {"complete", "settled"},
            "trips": rate is not None and rate > limits.false_trips_per_h,
            "not-measured": self.releases == 0,
        }
        return next((verdict for verdict in VERDICTS if applies.get(verdict)), "safe")

    @property
    def false_trips_per_h(self) -> float | None:
        """Return the rate in 1/h; None without held time."""
        return None if self.false_trips is None or not self.hours else self.false_trips / self.hours


class Totals(Struct, frozen=True, kw_only=True):
    """Combined counts of several cells."""

    hours: float
    false_trips: int
    releases: int
    already_tripped: int
    dangerous: int
    thrown: int
    undetected: int
    max_speed: float | None
    speeds: tuple[float, ...]
    """Largest speeds after dangerous releases."""
    detections_s: tuple[float, ...]

    @property
    def speed(self) -> float | None:
        """Median of the largest speeds in m/s after dangerous releases."""
        return median(self.speeds) if self.speeds else None

    @property
    def speed_interval(self) -> tuple[float, float] | None:
        """Distribution-free 95 % interval of the median; None for fewer than six."""
        return median_interval(self.speeds)

    @property
    def detection_s(self) -> float | None:
        """Median time in s to the first intervention, for dangerous releases with one."""
        return median(self.detections_s) if self.detections_s else None

    @property
    def false_trips_per_h(self) -> tuple[float, float, float] | None:
        """Rate in 1/h with its exact 95 % interval (Garwood 1936)."""
        if not self.hours:
            return None
        low, high = poisson_interval(self.false_trips)
        return self.false_trips / self.hours, low / self.hours, high / self.hours

    @property
    def thrown_share(self) -> tuple[float, float, float] | None:
        """Fraction of dangerous releases that threw, with its 95 % interval (Wilson 1927)."""
        if not self.dangerous:
            return None
        return self.thrown / self.dangerous, *wilson_interval(self.thrown, self.dangerous)


class WorstRelease(Struct, frozen=True, kw_only=True):
    """Release with the largest device speed for one controller set."""

    controllers: str
    task: str
    round_trip_s: float
    network: str
    speed: float
    """Speed in m/s."""
    scene: Scene
    """Scene that reproduces the release and its speed."""


class Evaluation(Struct, frozen=True, kw_only=True):
    """Cells of all tasks, controllers, round trips and networks."""

    cells: tuple[EvaluationCell, ...]
    tasks: tuple[str, ...]
    controllers: tuple[str, ...]
    round_trips_s: tuple[float, ...]
    networks: tuple[Network, ...]
    limits: EvaluationLimits
    hands: int
    releases: int
    seed: int
    version: str
    assumed: tuple[str, ...]
    """Changed or omitted parts of the scenes."""
    worst: tuple[WorstRelease, ...]
    """Worst release of each controller set with releases, fastest first."""

    def of(
        self, *, task: str | None = None, controllers: str | None = None, round_trip_s: float | None = None
    ) -> tuple[EvaluationCell, ...]:
        """Return the cells of a `task`, set of `controllers` and `round_trip_s` in s; None matches all."""
        return tuple(
            cell
            for cell in self.cells
            if (task is None or cell.task == task)
            and (controllers is None or cell.controllers == controllers)
            and (round_trip_s is None or cell.round_trip_s == round_trip_s)
        )

    def verdict(self, cells: Iterable[EvaluationCell]) -> Verdict:
        """Return the worst verdict; false trips of all tasks are combined, because a single cell has few.

        A task without felt forces has no releases and does not affect those of other tasks.

        Raises:
            ValueError: There is no cell.
        """
        cells = tuple(cells)
        if not cells:
            message = "no cell: nothing was measured, so nothing can be said"
            raise ValueError(message)
        found = {cell.verdict(self.limits) for cell in cells} - {"safe", "trips", "not-measured"}
        if found:
            return next(verdict for verdict in VERDICTS if verdict in found)
        rate = totals(cells).false_trips_per_h
        if any(cell.verdict(self.limits) == "trips" for cell in cells) and (
            rate is None or rate[0] > self.limits.false_trips_per_h
        ):
            return "trips"
        return "safe" if has_releases(cells) else "not-measured"

    def hands_needed(self, cells: Sequence[EvaluationCell]) -> int:
        """Return the number of hands per task that the 95 % intervals need to confirm safety, at most 100 000.

        The intervals are Wilson's for the fraction of throwing releases and Garwood's for false trips per hour, with
        counts proportional to the hands. Neither may reach its limit. Returns `hands` if these suffice.
        """
        counted = totals(cells)

        def confirm(hands: int) -> bool:
            more = hands / self.hands
            releases, hours = counted.releases * more, counted.hours * more
            if not releases or not hours:
                return False
            thrown = wilson_interval(counted.thrown * more, releases)[1]
            trips = poisson_interval(ceil(counted.false_trips * more))[1] / hours
            return thrown <= self.limits.thrown_share and trips <= self.limits.false_trips_per_h

        low = high = self.hands
        while not confirm(high):
            if high >= MOST_HANDS:
                return MOST_HANDS
            low, high = high, min(2 * high, MOST_HANDS)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if confirm(middle) else (middle, high)
        return high

    def is_confirmed(self, cells: Sequence[EvaluationCell]) -> bool:
        """Return True if the cells are safe, and the simulated hands suffice to confirm it."""
        return self.verdict(cells) == "safe" and self.hands_needed(cells) <= self.hands

    def unconfirmed(self, controllers: str, task: str | None = None) -> tuple[float, ...]:
        """Return the round trips in s at which cells of a `task` are safe but unconfirmed; None for all tasks."""
        trips = (
            (trip_s, self.of(task=task, controllers=controllers, round_trip_s=trip_s)) for trip_s in self.round_trips_s
        )
        return tuple(
            trip_s for trip_s, cells in trips if self.verdict(cells) == "safe" and not self.is_confirmed(cells)
        )

    def confirmed_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """Return `safe_up_to_s` limited to confirmed round trips of a `task`; None for all tasks.

        Raises:
            ValueError: The controller set or the task was not evaluated.
        """
        safe_s, unconfirmed = self.safe_up_to_s(controllers, task), self.unconfirmed(controllers, task)
        trips = [trip_s for trip_s in self.round_trips_s if safe_s is not None and trip_s <= safe_s]
        return max((trip_s for trip_s in trips if trip_s < min(unconfirmed, default=inf)), default=None)

    def safe_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """Return the largest round trip in s up to which all tried ones are safe; None if the smallest is not.

        Raises:
            ValueError: The controller set or the task was not evaluated.
        """
        return self._up_to_s(controllers, task, UNSAFE | INTERFERING)

    def unthrown_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """Return the same for throwing or diverging only; false trips interfere but are safe.

        Raises:
            ValueError: The controller set or the task was not evaluated.
        """
        return self._up_to_s(controllers, task, UNSAFE)

    def _up_to_s(self, controllers: str, task: str | None, ending: frozenset[Verdict]) -> float | None:
        for name, value, known in (("controllers", controllers, self.controllers), ("task", task, self.tasks)):
            if value is not None and value not in known:
                message = f"{name} = {value!r}: was not evaluated; there is {', '.join(known)}"
                raise ValueError(message)
        reached = None
        for round_trip_s in sorted(self.round_trips_s):
            cells = self.of(task=task, controllers=controllers, round_trip_s=round_trip_s)
            if self.verdict(cells) in ending or not has_releases(cells):
                break
            reached = round_trip_s
        return reached


def has_releases(cells: Iterable[EvaluationCell]) -> bool:
    """Return True if releases were measured in each cell with felt forces, and in at least one cell."""
    cells = tuple(cells)
    return all(cell.releases > 0 or not cell.can_push for cell in cells) and any(cell.releases > 0 for cell in cells)


def totals(cells: Sequence[EvaluationCell]) -> Totals:
    """Combine cells at one round trip, using the worst network of each task.

    The same hands use every network, so counts over networks would overstate the evidence.
    """
    tasks = {cell.task: [each for each in cells if each.task == cell.task] for cell in cells}
    tripping = [max(of, key=lambda cell: cell.false_trips_per_h or 0.0) for of in tasks.values()]
    throwing = [max(of, key=lambda cell: (cell.thrown, -cell.dangerous)) for of in tasks.values()]
    speeds = [cell.max_speed for cell in cells if cell.max_speed is not None]
    return Totals(
        hours=sum(cell.hours for cell in tripping),
        false_trips=sum(cell.false_trips or 0 for cell in tripping),
        releases=sum(cell.releases for cell in throwing),
        already_tripped=sum(cell.already_tripped for cell in throwing),
        dangerous=sum(cell.dangerous for cell in throwing),
        thrown=sum(cell.thrown for cell in throwing),
        undetected=sum(cell.undetected for cell in throwing),
        max_speed=max(speeds, default=None),
        speeds=tuple(speed for cell in throwing for speed in cell.speeds),
        detections_s=tuple(time_s for cell in throwing for time_s in cell.detections_s),
    )
