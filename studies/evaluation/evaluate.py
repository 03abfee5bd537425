"""Evaluation runs: tasks with many hands, holding and releasing, per controller set, round trip and network."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from math import inf

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from haptether.bridge import RecordTable, Run, Scene, controller_names, simulate, sweep
from haptether.bridge.devices.find import OWN_CONTROLLERS
from haptether.safety import CONTROLLERS
from haptether.studies.evaluation.result import (
    EVALUATED_CONTROLLERS,
    EVALUATED_NETWORKS,
    Evaluation,
    EvaluationCell,
    EvaluationLimits,
    WorstRelease,
)
from haptether.studies.intervals import median_interval
from haptether.studies.task import (
    FIXED,
    HANDS,
    MAX_ROUND_TRIP_S,
    RELEASES,
    ROUND_TRIPS_S,
    HandBounds,
    Network,
    Releases,
    Task,
    ejection_metrics,
    ejection_speeds,
    refuse_fixed,
)

Array = npt.NDArray[np.float64]

PRESSED_SHARE = 0.1
"""Fraction of the largest force above which a hand counts as pressing, for the transmitted impedance."""
MIN_PRESSED_TICKS = 100
MOST_UNEXPLAINED = 0.2
"""Largest fraction of the force variance that K x + B V may leave unexplained."""
REPLACED = ("link.forward", "link.backward")
"""Fields set by the network, in addition to those of the task."""


def evaluate(
    tasks: Sequence[str | Scene],
    *,
    controllers: Sequence[str] = EVALUATED_CONTROLLERS,
    round_trips_s: Sequence[float] = ROUND_TRIPS_S,
    networks: Sequence[Network] = EVALUATED_NETWORKS,
    hands: int = HANDS,
    releases: int = RELEASES,
    seed: int = 1,
    limits: EvaluationLimits | None = None,
    bounds: HandBounds | None = None,
    overrides: Iterable[str] = (),
    transmitted: bool = True,
    threads: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> Evaluation:
    """Evaluate the safety of each controller set at each round trip, on each network, in each task.

    While a hand holds, each intervention is a false trip. A release under force over 50 ms throws if the device exceeds
    the limit within the next 0.5 s; a release during an intervention is not counted. All controller sets use the same
    hands, releases and network draws. Device, arm, coupling, estimator, limits and release law come from the scene.

    Args:
        tasks: Names of bundled scenes, or paths of scenes, with a working hand; or scenes, each named by its title.
        controllers: Controller sets, names joined by "+", at most one in Python; "none" for no controller.
        round_trips_s: Sum of both link delays in s, or the force delay without an arm. A network with its own delay is
            evaluated at that delay only.
        networks: Networks, including those of `network_of`; a scene without an arm uses the first one of each round
            trip only.
        hands: Number of hands per task.
        releases: Number of release times within the time of large forces; the hands share them.
        seed: Seed of hands and networks.
        limits: Limits of a safe verdict.
        bounds: Bounds of the hands; by default `HandBounds()`.
        overrides: Fields of each scene to change first, `table.key=value`.
        transmitted: False leaves stiffness and damping that a pressing hand feels out, and the runs for them.
        threads: Number of threads; by default the number of processors.
        progress: If given, called with a description of the current run.

    Raises:
        ValueError: No hand, no task, an unknown controller, or a scene without a hand.
        SceneError: A scene is invalid.
    """
    names = [task.title if isinstance(task, Scene) else task for task in tasks]
    overrides, bounds, limits = tuple(overrides), bounds or HandBounds(), limits or EvaluationLimits()
    counts = {"hands": hands, "releases": releases}
    check_evaluated(names, controllers, round_trips_s, networks, counts=counts, overrides=overrides)
    met = conditions(networks, round_trips_s)
    assumed: dict[str, None] = {}
    cells: list[EvaluationCell] = []
    worst: dict[str, WorstRelease] = {}
    for name, given in zip(names, tasks, strict=True):
        for round_trip_s, several in met.items():
            for network in several:
                if progress is not None:
                    progress(f"{name}, {round_trip_s * 1e3:g} ms, {network.name}")
                task = Task(given, round_trip_s, overrides, network=network, by_time=False)
                rows = task.hands(hands, seed, bounds)
                assumed |= dict.fromkeys(task.replaced())
                runs = _Runs(task, task.lasting(bounds), rows, releases, limits=limits, threads=threads)
                for of_set in controllers:
                    cell, release = runs.cell(of_set, transmitted=transmitted)
                    cells.append(cell)
                    if release is not None and release.speed > (worst[of_set].speed if of_set in worst else -inf):
                        worst[of_set] = release
                if task.base.slave is None:
                    break
    return Evaluation(
        cells=tuple(cells),
        tasks=tuple(names),
        controllers=tuple(controllers),
        round_trips_s=tuple(met),
        networks=tuple(networks),
        limits=limits,
        hands=hands,
        releases=releases,
        seed=seed,
        version=version("haptether"),
        assumed=tuple(assumed),
        worst=tuple(sorted(worst.values(), key=lambda release: -release.speed)),
    )


def round_trips_of(network: Network, round_trips_s: Sequence[float]) -> Sequence[float]:
    """Return the requested round trips that apply to a network; only its own one if it has a delay."""
    return round_trips_s if network.round_trip_s is None else (network.round_trip_s,)


def conditions(networks: Sequence[Network], round_trips_s: Sequence[float]) -> dict[float, list[Network]]:
    """Return the networks that are evaluated at each round trip in s, without those that equal one before them."""
    at = {network.name: round_trips_of(network, round_trips_s) for network in networks}
    if any(network.own for network in networks):
        # Merge own round trips and requested ones in order.
        round_trips_s = sorted({round_trip_s for trips in at.values() for round_trip_s in trips})
    met: dict[float, list[Network]] = {round_trip_s: [] for round_trip_s in round_trips_s}
    for round_trip_s, several in met.items():
        for network in networks:
            links = [one.links(0.5 * round_trip_s) for one in several]
            # Without delay there is no jitter.
            if round_trip_s in at[network.name] and network.links(0.5 * round_trip_s) not in links:
                several.append(network)
    return met


def check_evaluated(
    tasks: Sequence[str],
    controllers: Sequence[str],
    round_trips_s: Sequence[float],
    networks: Sequence[Network],
    *,
    counts: Mapping[str, int],
    overrides: Sequence[str],
) -> None:
    """Refuse tasks, controllers, round trips, networks, counts and overrides that cannot be evaluated.

    Raises:
        ValueError: The message has what is allowed.
    """
    refuse_fixed(overrides, (*FIXED, *REPLACED), "is what an evaluation varies")
    for name, value in counts.items():
        if value < 1:
            message = f"{name} = {value}: must be 1 or more"
            raise ValueError(message)
    names = [network.name for network in networks]
    several: dict[str, Sequence[object]] = {
        "tasks": tasks, "controllers": controllers, "round_trips_s": round_trips_s, "networks": names
    }  # fmt: skip
    for name, values in several.items():
        if not values or len(set(values)) < len(values):
            message = f"{name} = {list(values)}: must be one or more, each once"
            raise ValueError(message)
    in_python = controller_names()
    known = ("none", *(controller[0] for controller in CONTROLLERS), *in_python)
    for names_of_set in controllers:
        parts = names_of_set.split("+")
        if len(several_in_python := [part for part in parts if part in in_python]) > 1:
            message = f"controllers = {names_of_set!r}: {' and '.join(several_in_python)}: at most one in Python"
            raise ValueError(message)
        if unknown := [part for part in parts if part not in known or (part == "none" and len(parts) > 1)]:
            message = (
                f"controllers = {names_of_set!r}: {unknown[0]!r} is none of {', '.join(known)}; a set is joined"
                f' by "+": "hsc+wsc"; {OWN_CONTROLLERS}'
            )
            raise ValueError(message)
    if wrong := [value for value in round_trips_s if not 0.0 <= value <= MAX_ROUND_TRIP_S]:
        message = f"round_trips_s: {wrong[0]}: must be between 0 and {MAX_ROUND_TRIP_S:g} s"
        raise ValueError(message)


class _Runs:
    """Runs of one task at one round trip on one network."""

    def __init__(
        self,
        task: Task,
        lasting: Scene,
        hands: dict[str, Array],
        places: int,
        *,
        limits: EvaluationLimits,
        threads: int | None,
    ) -> None:
        self.task, self.hands, self.limits, self.threads = task, hands, limits, threads
        self.lasting = lasting
        self.uncontrolled = task.hold(task.with_controllers(lasting, None, {}), hands, threads)
        self.releases = task.releases(hands, self.uncontrolled, places)
        self.uncontrolled_speeds = self._speeds(self.releases, None)[0] if self.releases else np.empty(0)

    def _speeds(self, releases: Releases, controllers: str | None) -> tuple[Array, Array]:
        """Return the largest speed in m/s after each release (NaN if the run ended earlier) and the time to a trip."""
        scene = self.task.with_controllers(releases.scene, controllers, {})
        metrics = [*ejection_metrics(scene), "time_to_trip_s"]
        found = sweep(scene, samples=releases.rows, threads=self.threads, metrics=metrics)
        speeds = ejection_speeds(scene, found)
        speeds[~np.isfinite(np.asarray(found["max_ejection_velocity"], dtype=np.float64))] = np.nan
        trip = np.asarray(found["time_to_trip_s"], dtype=np.float64)
        return speeds, trip if controllers else np.full(len(speeds), np.nan)

    def cell(self, names: str, *, transmitted: bool) -> tuple[EvaluationCell, WorstRelease | None]:
        """Return the cell of one controller set, and its worst release."""
        controllers = None if names == "none" else names.replace("+", ",")
        watched = self.task.with_controllers(self.lasting, controllers, {})
        held = self.task.hold(watched, self.hands, self.threads) if controllers else self.uncontrolled
        outcomes = Counter(run.metrics.outcome for run in held)
        engaged = all(run.engaged_s is not None for run in held)
        held_s = sum(run.coupled_s for run in held) if engaged else 0.0
        speeds, uncontrolled, detected, already_tripped, worst = self._released(names, controllers)
        limit = self.limits.speed
        dangerous = (speeds > limit) | (uncontrolled > limit)
        trips = detected[dangerous & np.isfinite(detected)]
        stiffness, damping = self._transmitted(controllers) if engaged and transmitted else (None, None)

        def over(name: str, of: Callable[[Array], np.floating]) -> float | None:
            known = [value for run in held if (value := getattr(run.metrics, name)) is not None]
            values = np.array(known, dtype=np.float64)
            values = values[np.isfinite(values)]
            return float(of(values)) if engaged and values.size else None

        least_j = over("passivity_min_j", np.min)
        cell = EvaluationCell(
            task=self.task.name,
            controllers=names,
            round_trip_s=self.task.round_trip_s,
            network=self._network().name,
            held=dict(outcomes),
            hours=held_s / 3600.0,
            holds=sum(run.holds for run in held),
            false_trips=None if (count := over("false_trips", np.sum)) is None else int(count),
            intervention_share=sum(run.intervention_s for run in held) / held_s if held_s else None,
            can_push=self.task.can_push,
            releases=len(speeds),
            already_tripped=already_tripped,
            dangerous=int(dangerous.sum()),
            thrown=int((speeds > limit).sum()),
            speeds=tuple(speeds[dangerous].tolist()),
            speed=float(np.median(speeds[dangerous])) if dangerous.any() else None,
            speed_interval=median_interval(speeds[dangerous].tolist()),
            max_speed=float(speeds.max()) if speeds.size else None,
            detections_s=tuple(trips.tolist()),
            detection_s=float(np.median(trips)) if trips.size else None,
            undetected=int((dangerous & ~np.isfinite(detected)).sum()),
            peak_force_n=over("peak_device_force", np.max),
            energy_j=None if least_j is None else max(0.0, -least_j),
            position_rmse_m=over("position_rmse_m", np.median),
            force_rmse_n=over("force_rmse_n", np.median),
            stiffness=stiffness,
            damping=damping,
        )
        return cell, worst

    def _network(self) -> Network:
        assert self.task.network is not None
        return self.task.network

    def _released(self, names: str, controllers: str | None) -> tuple[Array, Array, Array, int, WorstRelease | None]:
        """Return speeds, speeds without controllers, trip times, number of excluded releases, and the worst one.

        Excluded are releases during an intervention that began while the hand still held.
        """
        if self.releases is None:
            return np.empty(0), np.empty(0), np.empty(0), 0, None
        speeds, detected = self._speeds(self.releases, controllers)
        # A grip that begins to loosen in this tick is complete in it.
        already_tripped = np.isfinite(speeds) & (detected < 0.5 * self.lasting.run.period_s)
        counted = np.flatnonzero(np.isfinite(speeds) & ~already_tripped)
        of = speeds[counted], self.uncontrolled_speeds[counted], detected[counted], int(already_tripped.sum())
        if not counted.size:
            return *of, None
        most = int(counted[speeds[counted].argmax()])
        release = WorstRelease(
            controllers=names,
            task=self.task.name,
            round_trip_s=self.task.round_trip_s,
            network=self._network().name,
            speed=float(speeds[most]),
            scene=self.task.alone(
                self.task.with_controllers(self.releases.scene, controllers, {}), self.releases.rows, most
            ),
        )
        return *of, release

    def _transmitted(self, controllers: str | None) -> tuple[float | None, float | None]:
        """Return stiffness in N/m and damping in N s/m that the scene's hand feels while it presses."""
        scene = self.task.with_controllers(self.task.held, controllers, {})
        return transmitted_impedance(simulate(replace(scene, record=RecordTable())))


def transmitted_impedance(run: Run) -> tuple[float | None, float | None]:
    """Return K in N/m and B in N s/m of `-F_device = K x + B V + F_0` while a hand presses, along the mean force.

    Least squares over ticks with a force above a tenth of the largest. None if there are too few ticks, or if less than
    80 % of the force variance is explained.

    Args:
        run: Run with `position`, `velocity` and `device_force` at each tick.
    """
    named = (np.asarray(run.signals[name]) for name in ("position", "velocity", "device_force"))
    x, v, force = (values.reshape(len(values), -1) for values in named)
    size = np.linalg.norm(force, axis=1)
    pressed = (size > PRESSED_SHARE * size.max()) & (size > 0.0) if len(size) else np.empty(0, dtype=bool)
    if int(pressed.sum()) < MIN_PRESSED_TICKS:
        return None, None
    mean = force[pressed].mean(axis=0)
    if not (norm := float(np.linalg.norm(mean))):
        return None, None
    along = [values[pressed] @ (mean / norm) for values in (x, v, force)]
    columns = np.column_stack([along[0], along[1], np.ones(int(pressed.sum()))])
    scale = np.abs(columns).max(axis=0)
    if not scale.all():
        return None, None
    found, _, rank, _ = np.linalg.lstsq(columns / scale, -along[2], rcond=1e-9)
    left = float(np.var(along[2] + columns / scale @ found))
    if rank < columns.shape[1] or left > MOST_UNEXPLAINED * float(np.var(along[2])):
        return None, None
    return float(found[0] / scale[0]), float(found[1] / scale[1])
