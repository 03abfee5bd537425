"""Count how well `haptether tune` predicts the false trips of unseen hands.

Pairs of sets of recordings are simulated. Each recording is of another random hand that does a task and holds
throughout. The first set of a pair gives the boundary of each observer at a rate of false trips, with its intervals.
Three figures follow:

- held out: exceedances of that boundary in the other set, against the interval of their count,
- all: its rate in the recordings of all pairs, against the interval of the rate,
- closed loop: false trips of the hands of the other set where the controller watches with that threshold and
  intervenes, against the interval of their count.

The report counts how often each lies within its interval; these shares have exact intervals (Clopper and Pearson 1934).
The pairs are independent. Ends with status 1 if a share of held-out sets is below the confidence beyond chance.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from _report import bench_options, print_table, table_file, write_json
from haptether.bridge import Scene, override_scene, simulate, sweep
from haptether.studies.intervals import binomial_interval
from haptether.studies.task import HandBounds, Task
from haptether.studies.tuning import (
    TUNED_FIELDS,
    Boundary,
    Exceedances,
    NormalOperation,
    read_normal_operation,
)

Array = npt.NDArray[np.float64]

EXAMPLE = """example:
  .venv/bin/python benches/tuned_thresholds.py --task remote_push sliding_mass
"""
FIELDS = ("energy_threshold_j", "grasp_threshold", "velocity_threshold")
SETTINGS = (
    "safety.preset=paper",
    "safety.hsc_velocity_threshold=0.05",
    "safety.hsc_force_threshold_n=1.0",
    "safety.window=10",
    "safety.wsc_force_threshold_n=0.1",
)
"""WSC with the window and the gate of docs/thresholds.md; the scene sets the other fields."""


class Pair(NamedTuple):
    """Boundary of one set, and its exceedances in the other set, against the prediction."""

    task: str
    field: str
    boundary: Boundary
    held_out_h: float
    predicted: tuple[int, int]
    held_out: int
    closed_loop_h: float
    closed_loop: int


def main() -> int:
    """Simulate, tune and count; return 1 if fewer held-out counts are in their intervals than chance explains."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--task", nargs="+", default=["remote_push"], help="bundled scenes of two sides")
    options.add_argument("--pairs", type=int, default=40, help="pairs of sets, of each task")
    options.add_argument("--recordings", type=int, default=8, help="recordings of each set")
    options.add_argument("--false-trips-per-h", type=float, default=400.0, help="rate to keep")
    options.add_argument("--confidence", type=float, default=0.95)
    options.add_argument("--round-trip-s", type=float, default=0.1)
    options.add_argument("--set", nargs="*", default=SETTINGS, metavar="KEY=VALUE", help="fields of the scenes")
    options.add_argument("--seed", type=int, default=1)
    chosen = options.parse_args()
    rows: list[dict[str, Any]] = []
    pairs: list[Pair] = []
    for name in chosen.task:
        task = Task(name, chosen.round_trip_s, chosen.set)
        found, all_sets = _pairs(task, chosen)
        pairs += found
        rows += [
            _row(name, field, [pair for pair in found if pair.field == field], all_sets, chosen) for field in FIELDS
        ]
    print_table(
        ("task", "threshold", "pairs", "order k", "D", "held out", "all", "closed loop"),
        (
            (row["task"], row["field"], row["pairs"], f"{row['order']:.1f}", f"{row['grouping']:.2f}",
             *(f"{row[of]}/{row['pairs']}" for of in ("held_out", "all", "closed_loop")))
            for row in rows
        ),
        table_file(chosen.json),
    )  # fmt: skip
    write_json(chosen.json, {"options": vars(chosen), "rows": rows, "pairs": [_plain(pair) for pair in pairs]})
    return int(any(row["pairs"] and row["held_out_interval"][1] < chosen.confidence for row in rows))


def _pairs(task: Task, chosen: argparse.Namespace) -> tuple[list[Pair], dict[str, tuple[Exceedances, float]]]:
    """Return the pairs of a task, and by field the events of all its recordings with their hours."""
    bounds, count = HandBounds(), chosen.recordings
    lasting = task.lasting(bounds)
    hands = task.hands(2 * count * chosen.pairs, chosen.seed, bounds)
    pairs: list[Pair] = []
    sets: list[NormalOperation] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(2 * chosen.pairs):
            rows = slice(number * count, (number + 1) * count)
            hands_of_set = {path: values[rows] for path, values in hands.items()}
            files = list(_recordings(task, hands_of_set, lasting, Path(folder)))
            sets.append(read_normal_operation(files, fields=FIELDS))
            if number % 2:
                found = (_pair(task, field, sets[-2:], hands_of_set, chosen) for field in FIELDS)
                pairs += [pair for pair in found if pair is not None]
    hours = sum(each.hours for each in sets)
    return pairs, {field: (_joined(sets, field, hours), hours) for field in FIELDS}


def _pair(
    task: Task,
    field: str,
    sets: list[NormalOperation],
    hands: dict[str, Array],
    chosen: argparse.Namespace,
) -> Pair | None:
    """Return the boundary of the first set against the second, that of `hands`; None if no boundary keeps the rate."""
    tuned, held_out = sets
    boundary = _events(tuned, field).at_most(chosen.false_trips_per_h, chosen.confidence)
    if boundary is None:
        return None
    trips, hours = _closed_loop(task, hands, field, boundary.value)
    return Pair(
        task=task.name,
        field=field,
        boundary=boundary,
        held_out_h=held_out.hours,
        predicted=boundary.expected_count(held_out.hours, chosen.confidence),
        held_out=_events(held_out, field).count(boundary.value),
        closed_loop_h=hours,
        closed_loop=trips,
    )


def _recordings(task: Task, hands: dict[str, Array], lasting: Scene, folder: Path) -> Iterator[Path]:
    """Yield one recording of each hand, without an intervening controller."""
    for number in range(len(hands["run.seed"])):
        changes = [
            f"{path}={int(values[number]) if path == 'run.seed' else float(values[number])!r}"
            for path, values in hands.items()
        ]
        file = folder / f"{number}.mcap"
        scene = override_scene(task.with_controllers(lasting, None, {}), changes)
        simulate(scene, record=(file, folder / "slave.mcap"))
        yield file


def _events(recorded: NormalOperation, field: str) -> Exceedances:
    return Exceedances(recorded.scores[field], recorded.hours, recorded.period_s)


def _joined(sets: list[NormalOperation], field: str, hours: float) -> Exceedances:
    """Join all recordings into one series."""
    scores = [each.scores[field] for each in sets]
    apart = 10**10
    joined = type(scores[0])(
        np.concatenate([of.value for of in scores]),
        np.concatenate([of.tick + number * apart for number, of in enumerate(scores)]),
        np.concatenate([of.block + number * 10**4 for number, of in enumerate(scores)]),
    )
    return Exceedances(joined, hours, sets[0].period_s)


def _closed_loop(task: Task, hands: dict[str, Array], field: str, value: float) -> tuple[int, float]:
    """Return false trips of hands under a controller with the threshold, and the hours that they held."""
    lasting = task.lasting(HandBounds())
    about = TUNED_FIELDS[field]
    watched = task.with_controllers(lasting, about.controller, {field: about.sign * value})
    found = sweep(watched, samples=hands, threads=1)
    ticks = np.nan_to_num(np.asarray(found["ticks"], dtype=np.float64)).sum()
    return int(np.nansum(found["false_trips"])), float(ticks) * lasting.run.period_s / 3600.0


def _row(
    task: str,
    field: str,
    pairs: list[Pair],
    all_sets: dict[str, tuple[Exceedances, float]],
    chosen: argparse.Namespace,
) -> dict[str, Any]:
    events, hours = all_sets[field]
    held_out = sum(pair.predicted[0] <= pair.held_out <= pair.predicted[1] for pair in pairs)
    rates = [events.count(pair.boundary.value) / hours for pair in pairs]
    intervals = [pair.boundary.interval_per_hour(chosen.confidence) for pair in pairs]
    within = sum(low <= rate <= high for rate, (low, high) in zip(rates, intervals, strict=True))
    loop = [pair.boundary.expected_count(pair.closed_loop_h, chosen.confidence) for pair in pairs]
    closed = sum(low <= pair.closed_loop <= high for pair, (low, high) in zip(pairs, loop, strict=True))
    return {
        "task": task, "field": field, "pairs": len(pairs),
        "order": float(np.mean([pair.boundary.order for pair in pairs])) if pairs else math.nan,
        "grouping": float(np.mean([pair.boundary.grouping for pair in pairs])) if pairs else math.nan,
        "held_out": held_out, "held_out_interval": binomial_interval(held_out, len(pairs)) if pairs else (0.0, 1.0),
        "above": sum(rate > chosen.false_trips_per_h for rate in rates),
        "all": within, "closed_loop": closed,
        "closed_loop_trips": sum(pair.closed_loop for pair in pairs),
        "held_out_trips": sum(pair.held_out for pair in pairs),
        "predicted_trips": sum(pair.boundary.per_hour * pair.held_out_h for pair in pairs),
    }  # fmt: skip


def _plain(pair: Pair) -> dict[str, Any]:
    boundary = pair.boundary
    return {**pair._asdict(), "boundary": {name: getattr(boundary, name) for name in boundary.__struct_fields__}}


if __name__ == "__main__":
    sys.exit(main())
