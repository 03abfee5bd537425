"""What an evaluation finds: cells, what they say of a set-up at a delay, and the worst release."""

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
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
"""The worst first."""
UNSAFE: frozenset[Verdict] = frozenset({"diverged", "thrown", "not-engaged", "not-measured"})
"""Verdicts that do not exclude a thrown device."""
MOST_HANDS = 100_000
"""Hands that nobody runs: as many are needed, or more."""
INTERFERING: frozenset[Verdict] = frozenset({"uncoupled", "trips"})
"""Verdicts of a loop that interrupts the task and throws no device."""

EVALUATED_CONTROLLERS = ("none", "vfc", "hsc", "wsc", "hsc+wsc", "vfc+hsc+wsc")
"""Sets of controllers that are compared by default."""
EVALUATED_NETWORKS = (
    Network(name="steady"),
    Network(name="jitter", jitter=0.1),
    Network(name="loss", loss=0.02, mean_burst=4.0),
    Network(name="jitter+loss", jitter=0.1, loss=0.02, mean_burst=4.0),
)
"""Networks by default: delay alone; with a jitter of a tenth of it; with 2 % of loss, in bursts of four; with both."""


class EvaluationLimits(Struct, frozen=True, kw_only=True):
    """What is called safe."""

    speed: float = THROWN_SPEED
    """Speed in m/s above which a release has thrown the device."""
    false_trips_per_h: float = 60.0
    """Interventions per hour while a hand holds, above which a controller interferes with the task."""
    thrown_share: float = 0.1
    """Share of releases that throw, which the 95 % interval must exclude before "safe" is confirmed."""


class EvaluationCell(Struct, frozen=True, kw_only=True):
    """One set of controllers in one task, at one round trip, through one network. None is what was not measured."""

    task: str
    controllers: str
    """Their names, joined by "+"; "none" without any."""
    round_trip_s: float
    network: str
    held: dict[str, int]
    """How many runs of hands that held ended how, by the names of `Metrics.outcome`."""
    hours: float
    """Time in h for which hands held and the two were coupled."""
    holds: int
    """How often the coupling ended meanwhile: HOLD, STOP or a fault, also where it resumed."""
    false_trips: int | None
    """Interventions that began meanwhile."""
    intervention_share: float | None
    """Share of that time under intervention."""
    can_push: bool
    """Whether anything can be felt: there is an arm, or something to touch."""
    releases: int
    """Hands that let go, without those that did under an intervention."""
    already_tripped: int
    """Those: what a controller does of them says nothing of a release."""
    dangerous: int
    """Those after which the device exceeds the limit, here or where nobody watches."""
    thrown: int
    """Those after which it does here."""
    speeds: tuple[float, ...]
    """Largest speeds in m/s after the dangerous ones."""
    speed: float | None
    """Median of the largest speeds in m/s after the dangerous ones, MEV."""
    speed_interval: tuple[float, float] | None
    """95 % interval of that median, distribution-free; none of fewer than six."""
    max_speed: float | None
    """Largest speed in m/s after any release."""
    detections_s: tuple[float, ...]
    """Times in s from where the grip begins to loosen to the first intervention, of dangerous ones with one."""
    detection_s: float | None
    """Median of them."""
    undetected: int
    """Dangerous releases without an intervention within the time that was watched."""
    peak_force_n: float | None
    """Largest |F_device| in N while hands held."""
    energy_j: float | None
    """Largest energy in J that a hand that held was given, over what it had put in."""
    position_rmse_m: float | None
    """Median position error of the arm in m while hands held, RMS."""
    force_rmse_n: float | None
    """Median error of the force in N, RMS."""
    stiffness: float | None
    """Transmitted stiffness in N/m, what one hand that holds feels: `F = K x + B V + F_0`, by least squares."""
    damping: float | None
    """Transmitted damping in N s/m, of the same fit."""

    def verdict(self, limits: EvaluationLimits) -> Verdict:
        """The worst of its findings; without a release it is not measured whether one is safe."""
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
        """Rate in 1/h; none where nobody held."""
        return None if self.false_trips is None or not self.hours else self.false_trips / self.hours


class Totals(Struct, frozen=True, kw_only=True):
    """Counts of several cells together."""

    hours: float
    false_trips: int
    releases: int
    already_tripped: int
    dangerous: int
    thrown: int
    undetected: int
    max_speed: float | None
    speeds: tuple[float, ...]
    """After the dangerous ones."""
    detections_s: tuple[float, ...]

    @property
    def speed(self) -> float | None:
        """Median of the largest speeds in m/s after dangerous releases."""
        return median(self.speeds) if self.speeds else None

    @property
    def speed_interval(self) -> tuple[float, float] | None:
        """Its distribution-free 95 % interval; none of fewer than six."""
        return median_interval(self.speeds)

    @property
    def detection_s(self) -> float | None:
        """Median time in s to the first intervention, of dangerous releases with one."""
        return median(self.detections_s) if self.detections_s else None

    @property
    def false_trips_per_h(self) -> tuple[float, float, float] | None:
        """Rate in 1/h and its exact 95 % interval (Garwood 1936)."""
        if not self.hours:
            return None
        low, high = poisson_interval(self.false_trips)
        return self.false_trips / self.hours, low / self.hours, high / self.hours

    @property
    def thrown_share(self) -> tuple[float, float, float] | None:
        """Share of dangerous releases that still threw, and its 95 % interval (Wilson 1927)."""
        if not self.dangerous:
            return None
        return self.thrown / self.dangerous, *wilson_interval(self.thrown, self.dangerous)


class WorstRelease(Struct, frozen=True, kw_only=True):
    """The release after which a device was fastest, of one set of controllers."""

    controllers: str
    task: str
    round_trip_s: float
    network: str
    speed: float
    """In m/s."""
    scene: Scene
    """A scene of it by itself, which has that speed."""


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
    """What of its scenes was changed or left out."""
    worst: tuple[WorstRelease, ...]
    """One a set of controllers after which a device was let go, the fastest first."""

    def of(
        self, *, task: str | None = None, controllers: str | None = None, round_trip_s: float | None = None
    ) -> tuple[EvaluationCell, ...]:
        """The cells of what is given."""
        return tuple(
            cell
            for cell in self.cells
            if (task is None or cell.task == task)
            and (controllers is None or cell.controllers == controllers)
            and (round_trip_s is None or cell.round_trip_s == round_trip_s)
        )

    def verdict(self, cells: Iterable[EvaluationCell]) -> Verdict:
        """The worst of several; false trips of all tasks are counted together, for a single cell has few.

        A task in which nothing can be felt has no release to be measured, and says nothing of those of others.

        Raises:
            ValueError: No cell.
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
        """How many hands each task takes until the 95 % intervals confirm that the cells are safe, at most 100 000.

        The intervals are Wilson's of the share of releases that throw and Garwood's of the false trips per hour, of
        counts that grow with the hands. Neither may reach its limit. `hands` where those that ran are enough.
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
        """Whether the cells are safe, and the hands that ran are enough to say so."""
        return self.verdict(cells) == "safe" and self.hands_needed(cells) <= self.hands

    def unconfirmed(self, controllers: str, task: str | None = None) -> tuple[float, ...]:
        """Round trips in s at which cells are safe, and too few hands ran to say so."""
        trips = (
            (trip_s, self.of(task=task, controllers=controllers, round_trip_s=trip_s)) for trip_s in self.round_trips_s
        )
        return tuple(
            trip_s for trip_s, cells in trips if self.verdict(cells) == "safe" and not self.is_confirmed(cells)
        )

    def confirmed_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """As `safe_up_to_s`, as far as each round trip is confirmed.

        Raises:
            ValueError: A set of controllers or a task that was not evaluated.
        """
        safe_s, unconfirmed = self.safe_up_to_s(controllers, task), self.unconfirmed(controllers, task)
        trips = [trip_s for trip_s in self.round_trips_s if safe_s is not None and trip_s <= safe_s]
        return max((trip_s for trip_s in trips if trip_s < min(unconfirmed, default=inf)), default=None)

    def safe_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """Largest round trip in s up to which each one that was tried is safe; none if already the least is not.

        Raises:
            ValueError: A set of controllers or a task that was not evaluated.
        """
        return self._up_to_s(controllers, task, UNSAFE | INTERFERING)

    def unthrown_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """The same of what throws or diverges alone: a controller that trips falsely interferes, and is safe.

        Raises:
            ValueError: A set of controllers or a task that was not evaluated.
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
    """Whether releases were measured in each cell in which there is something to be felt, and in one at least."""
    cells = tuple(cells)
    return all(cell.releases > 0 or not cell.can_push for cell in cells) and any(cell.releases > 0 for cell in cells)


def totals(cells: Sequence[EvaluationCell]) -> Totals:
    """Counts of several cells at one round trip: of each task those of its worst network.

    The same hands meet every network, so that counts over networks would say more than they know.
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
