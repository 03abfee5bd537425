"""What an evaluation finds: cells, what they say of a set-up at a delay, and the worst release."""

from collections.abc import Iterable, Sequence
from typing import Literal, TypeAlias

from msgspec import Struct

from haptether.bridge import Scene
from haptether.studies.intervals import poisson_interval, wilson_interval
from haptether.studies.task import Network

Verdict: TypeAlias = Literal["not-engaged", "diverged", "thrown", "uncoupled", "trips", "safe"]
VERDICTS: tuple[Verdict, ...] = ("diverged", "thrown", "not-engaged", "uncoupled", "trips", "safe")
"""The worst first."""
UNSAFE: frozenset[Verdict] = frozenset({"diverged", "thrown", "not-engaged"})
IN_THE_WAY: frozenset[Verdict] = frozenset({"uncoupled", "trips"})

EVALUATED_CONTROLLERS = ("none", "vfc", "hsc", "wsc", "hsc+wsc", "vfc+hsc+wsc")
"""Sets of controllers that are compared by default."""
EVALUATED_NETWORKS = (
    Network(name="steady"),
    Network(name="jitter", jitter=0.1),
    Network(name="loss", jitter=0.1, loss=0.02, mean_burst=4.0),
)
"""Networks by default: delay alone; with a jitter of a tenth of it; and with 2 % of loss besides, in bursts of four."""


class EvaluationLimits(Struct, frozen=True, kw_only=True):
    """What is called safe."""

    speed: float = 0.5
    """Speed in m/s above which a release has thrown the device: the paper's WSC and HSC leave 0.36 and 0.3 m/s."""
    false_trips_per_h: float = 60.0
    """Interventions per hour while a hand holds, above which a controller is in the way."""


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
    """Time in h for which hands held."""
    false_trips: int | None
    """Interventions that began meanwhile."""
    intervention_share: float | None
    """Share of that time under intervention."""
    releases: int
    """Hands that let go."""
    dangerous: int
    """Those after which the device exceeds the limit, here or where nobody watches."""
    thrown: int
    """Those after which it does here."""
    speed: float | None
    """Median of the largest speeds in m/s after the dangerous ones, MEV."""
    speed_interval: tuple[float, float] | None
    """95 % interval of that median, distribution-free."""
    max_speed: float | None
    """Largest speed in m/s after any release."""
    detection_s: float | None
    """Median time in s from where the grip begins to loosen to the first intervention, of dangerous ones with one."""
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
        """What it comes to: the worst that happened."""
        if self.held.get("never-engaged", 0) > 0:
            return "not-engaged"
        if self.held.get("diverged", 0) > 0:
            return "diverged"
        if self.thrown > 0:
            return "thrown"
        if any(count > 0 for outcome, count in self.held.items() if outcome not in {"complete", "settled"}):
            return "uncoupled"
        if self.false_trips_per_h is not None and self.false_trips_per_h > limits.false_trips_per_h:
            return "trips"
        return "safe"

    @property
    def false_trips_per_h(self) -> float | None:
        """Rate in 1/h; none where nobody held."""
        return None if self.false_trips is None or not self.hours else self.false_trips / self.hours


class Totals(Struct, frozen=True, kw_only=True):
    """Counts of several cells together."""

    hours: float
    false_trips: int
    releases: int
    dangerous: int
    thrown: int
    max_speed: float | None

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
        """The worst of several; false trips of all tasks are counted together, for a single cell has few."""
        cells = tuple(cells)
        found = {cell.verdict(self.limits) for cell in cells}
        worst: Verdict = next((verdict for verdict in VERDICTS if verdict in found), "safe")
        if worst == "trips":
            rate = totals(cells).false_trips_per_h
            return "trips" if rate is None or rate[0] > self.limits.false_trips_per_h else "safe"
        return worst

    def safe_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """Largest round trip in s up to which each one that was tried is safe; none if already the least is not."""
        return self._up_to_s(controllers, task, UNSAFE | IN_THE_WAY)

    def unthrown_up_to_s(self, controllers: str, task: str | None = None) -> float | None:
        """The same of what throws or diverges alone: a controller that trips falsely is in the way, and safe."""
        return self._up_to_s(controllers, task, UNSAFE)

    def _up_to_s(self, controllers: str, task: str | None, ending: frozenset[Verdict]) -> float | None:
        reached = None
        for round_trip_s in sorted(self.round_trips_s):
            cells = self.of(task=task, controllers=controllers, round_trip_s=round_trip_s)
            if self.verdict(cells) in ending:
                break
            reached = round_trip_s
        return reached


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
        dangerous=sum(cell.dangerous for cell in throwing),
        thrown=sum(cell.thrown for cell in throwing),
        max_speed=max(speeds, default=None),
    )
