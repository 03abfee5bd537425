"""Sensitivity of the rows of `haptether paper` to unstated conditions.

One factor at a time over its whole range, and a grid of interacting factors: kind and time of the release, and the
estimator. The readings (reference time and duration) are varied in each grid run, because they need no additional run.
"""

import re
from collections.abc import Callable, Iterator, Sequence

import msgspec

from haptether.studies.paper.claims import Bench, claims
from haptether.studies.paper.conditions import FACTORS, READINGS, Conditions, change_text, changed, design
from haptether.studies.paper.report import Change, Explanation, JointFit, PaperReport, PaperRow, Sensitivity


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """One run of the design: its change and rows."""

    change: Change
    rows: list[PaperRow]


def paper_sensitivity(
    report: PaperReport,
    *,
    changes: Sequence[Change] | None = None,
    progress: Callable[[int, int], None] = lambda _done, _of: None,
) -> PaperReport:
    """Return the report with ranges over the factors, explanations, and the best joint fit.

    Args:
        report: Result of `reproduce_paper`.
        changes: Runs, each as factor values; by default all of `docs/paper.md`.
        progress: If given, called with the finished and the total number of conditions.

    Raises:
        KeyError: A factor does not exist.
        ValueError: A parameter is out of range; gives its bound.
    """
    declared = Conditions(operator=report.operator, encoder_quantum=report.device["encoder_quantum"])
    base = Bench(declared)
    runs = [Run(change={}, rows=list(claims(base)))]
    changes = design() if changes is None else changes
    for done, change in enumerate(changes):
        progress(done, len(changes))
        if different(declared, change):
            is_reading = set(change) <= set(READINGS)
            bench = base.read_as(change) if is_reading else Bench(changed(declared, change))
            ways: list[Change] = [{}, *readings()] if len(change) > 1 else [{}]
            runs += [
                Run(change=different(declared, change | reading), rows=list(claims(bench.read_as(reading))))
                for reading in ways
            ]
    progress(len(changes), len(changes))
    rows = [
        msgspec.structs.replace(row, sensitivity=row_sensitivity(row, [(run.change, run.rows[place]) for run in runs]))
        for place, row in enumerate(report.rows)
    ]
    return msgspec.structs.replace(report, rows=rows, joint_fits=joint_fits(report.rows, runs))


def different(declared: Conditions, change: Change) -> Change:
    """Return the part of a change that differs from the declared conditions."""
    return {name: value for name, value in change.items() if changed(declared, {name: value}) != declared}


def readings() -> Iterator[Change]:
    """Yield each value of each factor that affects no run."""
    for name in READINGS:
        for value in FACTORS[name].values:
            yield {name: value}


def counted(row: PaperRow) -> float | None:
    """Return our value unless it is void."""
    return None if row.says_nothing else row.ours


def row_sensitivity(declared: PaperRow, runs: Sequence[tuple[Change, PaperRow]]) -> Sensitivity:
    """Return the sensitivity of one row from its values in all runs."""
    counts = [
        (change, value) for change, row in runs if (value := counted(row)) is not None and admits(declared, change)
    ]
    values = [value for _, value in counts]
    by_factor = {}
    for name in FACTORS:
        alone = [value for change, value in counts if not change or list(change) == [name]]
        if len(alone) > 1:
            by_factor[name] = (min(alone), max(alone))
    extents = {name: greatest - least for name, (least, greatest) in by_factor.items()}
    most = max(extents, key=lambda name: extents[name], default=None)
    return Sensitivity(
        least=min(values, default=None),
        greatest=max(values, default=None),
        by_factor=by_factor,
        most_by=most if most is not None and extents[most] > 1e-12 else None,
        explanations=[] if declared.meets(counted(declared)) else explanations(declared, counts),
        nearest=min((explanation(*of) for of in counts), key=lambda of: distance(declared, of.ours), default=None)
        if declared.paper is not None
        else None,
    )


def admits(row: PaperRow, change: Change) -> bool:
    """Return True if a change may explain the row; a value fitted to a figure may not explain it."""
    return all(not FACTORS[name].only or row.source in FACTORS[name].only for name in change)


def explanation(change: Change, value: float) -> Explanation:
    """Return a run as an explanation."""
    return Explanation(change=change, text=change_text(change), ours=value)


def distance(row: PaperRow, value: float) -> float:
    """Return the distance of a value to the paper's number, in the unit of the row."""
    return abs(value - (row.paper or 0.0))


def explanations(row: PaperRow, counts: Sequence[tuple[Change, float]]) -> list[Explanation]:
    """Return the runs that meet the paper's number: the nearest of each single factor, else of several."""
    meeting = sorted((of for of in counts if row.meets(of[1])), key=lambda of: distance(row, of[1]))
    alone: dict[str, Explanation] = {}
    for change, value in meeting:
        if len(change) == 1:
            alone.setdefault(next(iter(change)), explanation(change, value))
    return list(alone.values()) or [explanation(*of) for of in meeting[:1]]


def experiment(row: PaperRow) -> str:
    """Return the experiment of a row: a figure, or the table; the two forms of VFC are separate."""
    figure = re.sub(r"[a-c]$", "", row.source)
    return f"{figure} {row.controller}" if figure == "Fig. 8" else figure


def joint_fits(declared: Sequence[PaperRow], runs: Sequence[Run]) -> list[JointFit]:
    """Return, for all rows and for each experiment with several numbers, the run that meets most of them.

    Ties are broken by the fewest changes, then by the nearest numbers.
    """
    fits = [run for run in runs if not any(FACTORS[name].only for name in run.change)]
    experiments: dict[str, list[int]] = {}
    for place, row in enumerate(declared):
        if row.paper is not None and "Eq." not in row.source:
            experiments.setdefault(experiment(row), []).append(place)
    places = {
        "all": [place for of in experiments.values() for place in of],
        **{key: of for key, of in experiments.items() if len(of) > 1},
    }

    def met(rows: Sequence[PaperRow], of: Sequence[int]) -> int:
        return sum(rows[place].meets(counted(rows[place])) for place in of)

    def order(run: Run, of: Sequence[int]) -> tuple[int, int, float]:
        differences = [abs(run.rows[place].difference or 0.0) for place in of]
        return met(run.rows, of), -len(run.change), -sum(differences)

    chosen = {key: max(fits, key=lambda run: order(run, of)) for key, of in places.items()}
    return [
        JointFit(
            experiment=key,
            change=run.change,
            text=change_text(run.change),
            met=met(run.rows, places[key]),
            declared=met(declared, places[key]),
            rows=len(places[key]),
        )
        for key, run in chosen.items()
    ]
