"""Couplings by controllers by networks: presses of the pair and evaluated hands, with gains for pair and network."""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import inf
from statistics import median

from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import COUPLINGS, Scene, SceneError, override_scene
from haptether.studies.design.contact import scene_numbers, touched
from haptether.studies.design.couplings import bearable_delays
from haptether.studies.design.gains import PressedCoupling, pressed_couplings, without_gains
from haptether.studies.design.press import WALLS, Outcome, Press, Stroke
from haptether.studies.evaluation.evaluate import check_evaluated, conditions, evaluate
from haptether.studies.evaluation.result import (
    EVALUATED_CONTROLLERS,
    EVALUATED_NETWORKS,
    Evaluation,
    EvaluationLimits,
)
from haptether.studies.intervals import FEWEST_OF_MEDIAN, median_interval
from haptether.studies.task import HANDS, RELEASES, ROUND_TRIPS_S, HandBounds, Network, Task

COUPLING_NAMES = tuple(name for name, *_ in COUPLINGS)
"""Names of all couplings."""
UP_TO_S = 1.0
"""Largest round trip in s that is examined for stability."""


class Median(Struct, frozen=True, kw_only=True):
    """Median over seeds of the network."""

    value: float
    interval: tuple[float, float] | None
    """Distribution-free 95 % interval; None for fewer than six."""


class PairCell(Struct, frozen=True, kw_only=True):
    """Pair of devices under one coupling, at one round trip, on one network; no controller acts. None: not known."""

    coupling: str
    round_trip_s: float
    network: str
    changes: tuple[str, ...]
    """Overrides that set the coupling with its gains."""
    outcome: Outcome
    """Worst of the presses and strokes that the ladder does not interrupt; "held" if it interrupts all."""
    runs: int
    """Number of presses and strokes: one of each on a network without jitter and loss, else of each of six seeds up to
    the first that does not rest."""
    held: int
    """Number of these that the ladder interrupts, which count nowhere else."""
    felt: Median | None
    """Force at rest as a share of that of a rigid tool."""
    behind_m: Median | None
    """Distance in m (rad) of the arm behind the hand at rest in contact."""
    drift_m: Median | None
    """Distance in m (rad) between hand and arm at rest after the contact."""
    dissipated_j: Median | None
    """Energy in J that a stroke into the wall and back takes from the hand; below 0 it is given to the hand."""
    thrown: Median | None
    """Largest speed in m/s (rad/s) after the press."""
    stable_up_to_s: float | None
    """Largest round trip in s at which the loop with these gains is stable; None if it is at 1 s, too."""


class CouplingMatrix(Struct, frozen=True, kw_only=True):
    """Couplings by controllers, round trips and networks, in one task."""

    task: str
    unit: str
    """Unit of a distance: "m", or "rad" of joints."""
    wall: float
    """Stiffness in N/m (N m/rad) of the pressed wall."""
    couplings: tuple[str, ...]
    round_trips_s: tuple[float, ...]
    networks: tuple[Network, ...]
    pairs: tuple[PairCell, ...]
    evaluations: dict[str, Evaluation]
    """Evaluation of the task under each coupling; empty for joints, whose hands are not drawn."""
    refused: tuple[str, ...]
    """Couplings that a condition does not allow, each with the reason."""

    @property
    def on_wall(self) -> str:
        """Stiffness of the pressed wall as text."""
        return f"{self.wall:g} {'N m/rad' if self.unit == 'rad' else 'N/m'}"

    def of(self, coupling: str, round_trip_s: float | None = None, network: str | None = None) -> tuple[PairCell, ...]:
        """Return the pair's cells of a coupling, `round_trip_s` in s and network; None matches all."""
        return tuple(
            cell
            for cell in self.pairs
            if cell.coupling == coupling
            and (round_trip_s is None or cell.round_trip_s == round_trip_s)
            and (network is None or cell.network == network)
        )

    def rests_up_to_s(self, coupling: str) -> float | None:
        """Return the largest round trip in s up to which the pair rests on all networks; None if there is none."""
        reached = None
        for round_trip_s in sorted(self.round_trips_s):
            cells = self.of(coupling, round_trip_s)
            if not cells or any(cell.outcome != "rests" for cell in cells):
                break
            reached = round_trip_s
        return reached


def evaluate_couplings(
    task: str,
    *,
    couplings: Sequence[str] = COUPLING_NAMES,
    controllers: Sequence[str] = EVALUATED_CONTROLLERS,
    round_trips_s: Sequence[float] = ROUND_TRIPS_S,
    networks: Sequence[Network] = EVALUATED_NETWORKS,
    hands: int = HANDS,
    releases: int = RELEASES,
    seed: int = 1,
    limits: EvaluationLimits | None = None,
    bounds: HandBounds | None = None,
    overrides: Iterable[str] = (),
    threads: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> CouplingMatrix:
    """Evaluate couplings by controllers, at each round trip, on each network, in one task.

    The pair of the scene is pressed on a wall as stiff as the stiffest contact of the scene, and withdrawn from it.
    Hands do the task. Both have the gains that `pressed_couplings` finds for pair and network.

    Args:
        task: Name of a bundled scene, or path of a scene, with a hand and an arm.
        couplings: Names of couplings.
        controllers: As those of `evaluate`, also the following.
        round_trips_s: Sum of both link delays in s.
        networks: Networks at each round trip.
        hands: Number of hands per coupling.
        releases: Number of release times; the hands share them.
        seed: Seed of hands and networks.
        limits: Limits of a safe verdict.
        bounds: Bounds of the hands; by default `HandBounds()`.
        overrides: Fields of the scene to change first, `table.key=value`.
        threads: Number of threads; by default the number of processors.
        progress: If given, called with a description of the current run.

    Raises:
        ValueError: An unknown coupling, a scene without an arm, or what `evaluate` refuses.
        SceneError: The scene is invalid.
    """
    if unknown := [name for name in couplings if name not in COUPLING_NAMES]:
        message = f"couplings: {unknown[0]!r} is none of {', '.join(COUPLING_NAMES)}"
        raise ValueError(message)
    counts = {"hands": hands, "releases": releases}
    overrides = tuple(overrides)
    check_evaluated([task], controllers, round_trips_s, networks, counts=counts, overrides=overrides)
    pairs: list[PairCell] = []
    evaluations: dict[str, list[Evaluation]] = {}
    refused: dict[str, None] = {}
    met = [(round_trip_s, one) for round_trip_s, of in conditions(networks, round_trips_s).items() for one in of]
    is_turned = False
    wall = 0.0
    for round_trip_s, network in met:
        place = f"{round_trip_s * 1e3:g} ms, {network.name}"
        led = Task(task, round_trip_s, overrides, network=network, by_time=False)
        if led.base.slave is None:
            message = f"{task}: a coupling needs two sides: add [slave]"
            raise ValueError(message)
        is_turned = led.base.master.kind == "joints"
        pair = override_scene(led.held, [f"run.seed={seed}"])
        wall = touched(pair, scene_numbers(pair)).stiffness or WALLS["joints" if is_turned else "linear"]
        found = {one.kind: one for one in _pressed(pair, network, couplings, wall, threads)}
        for name in couplings:
            if progress is not None:
                progress(f"{name}, {place}")
            if name not in found:
                refused[f"{name} at {place}: no gains are stable for this pair."] = None
                continue
            pairs.append(_pair_cell(found[name], pair, led, wall))
            if is_turned:
                continue
            scene = override_scene(without_gains(led.base), found[name].changes)
            try:
                evaluation = evaluate(
                    [replace(scene, title=task)], controllers=controllers, round_trips_s=[round_trip_s],
                    networks=[network], hands=hands, releases=releases, seed=seed, limits=limits, bounds=bounds,
                    transmitted=False, threads=threads,
                )  # fmt: skip
            except SceneError as error:
                refused[f"{name} at {place}: {error}"] = None
                continue
            evaluations.setdefault(name, []).append(evaluation)
    if is_turned:
        refused["Hands of joints are not drawn: there are no false trips and no releases."] = None
    return CouplingMatrix(
        task=task,
        unit="rad" if is_turned else "m",
        wall=wall,
        couplings=tuple(couplings),
        round_trips_s=tuple(sorted({round_trip_s for round_trip_s, _ in met})),
        networks=tuple(networks),
        pairs=tuple(pairs),
        evaluations={name: _merged(of, networks) for name, of in evaluations.items()},
        refused=tuple(refused),
    )


def _pressed(
    pair: Scene, network: Network, couplings: Sequence[str], wall: float, threads: int | None
) -> list[PressedCoupling]:
    """Press a pair under each coupling that has gains, once for each seed of the network."""
    seeds = FEWEST_OF_MEDIAN if network.jitter or network.loss or network.own else 1

    def one(name: str) -> list[PressedCoupling]:
        return [*pressed_couplings(pair, UP_TO_S, (name,), wall, seeds)]

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        return [found for several in pool.map(one, couplings) for found in several]


def _pair_cell(found: PressedCoupling, pair: Scene, task: Task, wall: float) -> PairCell:
    scene, network = override_scene(without_gains(pair), found.changes), task.network
    assert network is not None
    outcomes = [one.outcome for one in found.presses] + [one.outcome for one in found.strokes]
    stable_s = bearable_delays(scene, UP_TO_S, wall)[0]
    return PairCell(
        coupling=found.kind,
        round_trip_s=task.round_trip_s,
        network=network.name,
        changes=found.changes,
        outcome=found.outcome,
        runs=len(outcomes),
        held=outcomes.count("held"),
        felt=_median(found.presses, "felt"),
        behind_m=_median(found.presses, "behind"),
        drift_m=_median(found.strokes, "drift"),
        dissipated_j=_median(found.strokes, "dissipated_j"),
        thrown=_median(found.presses, "thrown"),
        stable_up_to_s=None if stable_s == inf else stable_s,
    )


def _median(runs: Iterable[Press | Stroke], name: str) -> Median | None:
    """Return the median of the runs that reached the end; None if there is none."""
    values: list[float] = [getattr(run, name) for run in runs if run.outcome not in {"diverged", "held"}]
    return Median(value=median(values), interval=median_interval(values)) if values else None


def _merged(evaluations: Sequence[Evaluation], networks: Sequence[Network]) -> Evaluation:
    """Return one evaluation of the conditions of several."""
    releases = sorted((release for one in evaluations for release in one.worst), key=lambda release: release.speed)
    worst = {release.controllers: release for release in releases}
    return replace(
        evaluations[0],
        cells=tuple(cell for one in evaluations for cell in one.cells),
        round_trips_s=tuple(sorted({trip_s for one in evaluations for trip_s in one.round_trips_s})),
        networks=tuple(networks),
        assumed=tuple({text: None for one in evaluations for text in one.assumed}),
        worst=tuple(worst.values()),
    )
