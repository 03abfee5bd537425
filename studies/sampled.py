"""Statistics over the samples of each combination of a sweep: means, shares, intervals, and paired differences."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.bridge import Sweep
from haptether.bridge.scene.sweep import METRICS, OUTCOMES
from haptether.studies.intervals import binomial_interval

Array = npt.NDArray[np.float64]
RESAMPLES = 4000
MOST_AT_ONCE = 1 << 20
"""Numbers resampled at once."""
SHARE = re.compile(r"(?P<metric>\w+)\s*(?P<relation>[<>=])\s*(?P<value>\S+)")


class SummaryRow(Struct, frozen=True, kw_only=True):
    """One quantity in one combination."""

    group: dict[str, Any]
    """Values of the combination."""
    quantity: str
    """A metric, for its mean, or a condition on one, for the share of rows that meet it."""
    rows: int
    measured: int
    """Rows in which the quantity was measured."""
    diverged: int
    """Diverged rows: their measurements end there and count in the mean."""
    mean: float | None
    """Mean or share; None if measured in no row."""
    interval: tuple[float, float] | None
    """95 % interval: bootstrap for a mean, None below two values; exact for a share (Clopper and Pearson 1934)."""
    pairs: int | None = None
    """Samples measured here and in the baseline; None without a baseline."""
    difference: float | None = None
    """Mean difference to the baseline over these samples."""
    difference_interval: tuple[float, float] | None = None
    """95 % interval of the difference, by bootstrap over the pairs."""


def sweep_summary(
    sweep: Sweep,
    quantities: Sequence[str],
    by: Sequence[str],
    *,
    baseline: tuple[str, Any] | None = None,
    seed: int = 1,
) -> tuple[SummaryRow, ...]:
    """Summarise each quantity in each combination of the columns `by`.

    Args:
        sweep: All rows; those of a combination differ in their samples, such as `run.seed`.
        quantities: Metrics, or conditions on one: "max_ejection_velocity > 0.5", "outcome = complete".
        by: Varied columns whose combinations are the groups.
        baseline: A column of `by` and one of its values. Each combination is compared, sample by sample, with the one
            that differs only in this column.
        seed: Seed of the bootstrap, 0 or more.

    Raises:
        ValueError: A column does not exist, a condition is invalid, or samples do not pair.

    Source: Efron 1979 (bootstrap), Clopper and Pearson 1934.
    """
    for name in by:
        sweep[name]  # raises if there is no such column
        if name in METRICS:
            message = f"by: {name} is what was measured, not what varies"
            raise ValueError(message)
    labels = {name: sweep[name].tolist() for name in by}
    groups: dict[tuple[Any, ...], list[int]] = {}
    # If only samples vary, all rows are one combination.
    for row, key in enumerate(zip(*labels.values(), strict=True) if by else [()] * len(sweep)):
        groups.setdefault(key, []).append(row)
    others = [name for name in sweep.columns if name not in METRICS and name not in by]
    samples = list(zip(*(sweep[name].tolist() for name in others), strict=True)) or [()] * len(sweep)
    diverged = sweep["outcome"] == "diverged" if "outcome" in sweep.columns else np.zeros(len(sweep), dtype=bool)
    beside = None if baseline is None else _beside(baseline, by, groups)
    found = []
    for quantity in quantities:
        values, is_share = _values(sweep, quantity)
        for key, rows in groups.items():
            own = values[rows]
            known = own[np.isfinite(own)]
            rng = np.random.default_rng(seed)
            pairs = None
            if beside is not None:
                pairs = _paired(values, rows, groups[beside[key]], samples)
            found.append(
                SummaryRow(
                    group=dict(zip(by, key, strict=True)),
                    quantity=quantity,
                    rows=len(rows),
                    measured=len(known),
                    diverged=int(diverged[rows].sum()),
                    mean=float(known.mean()) if len(known) else None,
                    interval=_share_interval(known) if is_share else bootstrap_interval(known, rng),
                    pairs=None if pairs is None else len(pairs),
                    difference=float(pairs.mean()) if pairs is not None and len(pairs) else None,
                    difference_interval=None if pairs is None else bootstrap_interval(pairs, rng),
                )
            )
    return tuple(found)


def bootstrap_interval(values: Array, rng: np.random.Generator) -> tuple[float, float] | None:
    """95 % interval of a mean by the percentiles of resampled means; None for fewer than two values.

    The interval is too narrow for few values: for ten normal values it holds the mean in 90 %.

    Source: Efron 1979.
    """
    if len(values) < 2:
        return None
    at_once = max(1, MOST_AT_ONCE // len(values))
    counts = [min(at_once, RESAMPLES - done) for done in range(0, RESAMPLES, at_once)]
    means = [values[rng.integers(0, len(values), (count, len(values)))].mean(axis=1) for count in counts]
    low, high = np.quantile(np.concatenate(means), (0.025, 0.975))
    return float(low), float(high)


def _share_interval(values: Array) -> tuple[float, float] | None:
    return binomial_interval(int(values.sum()), len(values)) if len(values) else None


def check_summary(
    quantities: Sequence[str],
    metrics: Sequence[str],
    columns: Mapping[str, npt.NDArray[Any]],
    by: Mapping[str, Sequence[Any]],
    baseline: tuple[str, Any] | None = None,
) -> None:
    """Check before a sweep the arguments of `sweep_summary`.

    Args:
        quantities: As of `sweep_summary`.
        metrics: Names of the measured metrics.
        columns: Some values of each varied column.
        by: All values of each column of the combinations.
        baseline: As of `sweep_summary`.

    Raises:
        ValueError: A column does not exist, a condition is invalid, or the baseline is no combination.
    """
    kinds: dict[str, str] = {name: column.dtype.kind for name, column in columns.items()}
    kinds |= {name: _KINDS.get(name, "f") for name in metrics}
    for quantity in quantities:
        _parsed(quantity, kinds)
    if baseline is not None:
        _level(baseline, by)


_KINDS = {"outcome": "U", "reason": "U", "diverged": "b", "ticks": "u"}
"""Kinds of the measured columns other than floating-point numbers."""


def metric_of(quantity: str) -> str:
    """Column of a quantity of `sweep_summary`."""
    condition = SHARE.fullmatch(quantity.strip())
    return condition["metric"] if condition else quantity.strip()


def _parsed(quantity: str, kinds: Mapping[str, str]) -> tuple[str, str | None, Any]:
    """Column of a quantity, and of a condition its relation and limit."""
    condition = SHARE.fullmatch(quantity.strip())
    name = metric_of(quantity)
    if condition is None and re.search("[<>=]", quantity):
        message = f"{quantity!r}: must be METRIC > NUMBER, METRIC < NUMBER, METRIC = NUMBER or outcome = NAME"
        raise ValueError(message)
    if name not in kinds:
        message = f"{quantity!r}: no column {name!r}: there is {', '.join(kinds)}"
        raise ValueError(message)
    kind = kinds[name]
    if condition is None:
        if kind not in "fiub":
            message = f"{quantity!r}: is text: give a share, {name} = VALUE"
            raise ValueError(message)
        return name, None, None
    relation, text = condition["relation"], condition["value"]
    if kind == "U":
        if relation != "=":
            message = f"{quantity!r}: is text: must be {name} = VALUE"
            raise ValueError(message)
        if name == "outcome" and text not in OUTCOMES:
            message = f"{quantity!r}: must be one of {', '.join(OUTCOMES)}"
            raise ValueError(message)
        return name, relation, text
    if text.startswith("="):
        message = f"{quantity!r}: must be {name} > NUMBER, {name} < NUMBER or {name} = NUMBER"
        raise ValueError(message)
    try:
        limit = float(text)
    except ValueError:
        message = f"{quantity!r}: {text!r} must be a number"
        raise ValueError(message) from None
    if not np.isfinite(limit):
        message = f"{quantity!r}: {text} must be a finite number"
        raise ValueError(message)
    return name, relation, limit


def _shown(value: object) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _level(baseline: tuple[str, Any], levels: Mapping[str, Sequence[Any]]) -> tuple[int, Any]:
    """Index of the baseline's column, and the baseline's value."""
    column, value = baseline
    if column not in levels:
        message = f"baseline: {column} is none of {', '.join(levels) or 'what varies: nothing but samples does'}"
        raise ValueError(message)
    # Compare values as tables show them: users do not write all digits.
    shown = {_shown(one): one for one in reversed(levels[column])}
    chosen = next((one for one in levels[column] if one == value), shown.get(_shown(value)))
    if chosen is None:
        allowed = ", ".join(map(_shown, levels[column]))
        message = f"baseline: {column} = {_shown(value)}: must be of {allowed}"
        raise ValueError(message)
    return list(levels).index(column), chosen


def _values(sweep: Sweep, quantity: str) -> tuple[Array, bool]:
    """Quantity in each row, NaN if not measured, and whether it is a share."""
    name, relation, limit = _parsed(quantity, {name: column.dtype.kind for name, column in sweep.columns.items()})
    column = sweep[name]
    if column.dtype.kind == "U":
        return (column == limit).astype(np.float64), True
    measured = np.array([np.nan if value is None else value for value in sweep.values_of(name)], dtype=np.float64)
    if relation is None:
        return measured, column.dtype.kind == "b"
    met = {"<": measured < limit, ">": measured > limit, "=": measured == limit}[relation].astype(np.float64)
    return np.where(np.isfinite(measured), met, np.nan), True


def _beside(
    baseline: tuple[str, Any], by: Sequence[str], groups: Mapping[tuple[Any, ...], list[int]]
) -> dict[tuple[Any, ...], tuple[Any, ...]]:
    """Baseline combination of each combination."""
    levels = {name: list(dict.fromkeys(key[place] for key in groups)) for place, name in enumerate(by)}
    place, chosen = _level(baseline, levels)
    beside = {key: (*key[:place], chosen, *key[place + 1 :]) for key in groups}
    if alone := [key for key in beside.values() if key not in groups]:
        message = f"baseline: there is no {dict(zip(by, alone[0], strict=True))} to compare with"
        raise ValueError(message)
    return beside


def _paired(values: Array, rows: Sequence[int], baseline: Sequence[int], samples: Sequence[tuple[Any, ...]]) -> Array:
    """Differences to the baseline, sample by sample, where both are measured."""
    of_baseline = {samples[row]: row for row in baseline}
    if len(of_baseline) < len(baseline):
        message = "baseline: several rows of one combination have the same samples: vary run.seed"
        raise ValueError(message)
    found = [values[row] - values[of_baseline[samples[row]]] for row in rows if samples[row] in of_baseline]
    differences = np.array(found, dtype=np.float64)
    return differences[np.isfinite(differences)]
