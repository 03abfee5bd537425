"""Which numbers a field takes, many at once."""

import math
from collections.abc import Mapping
from numbers import Integral
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import inspect

from haptether.bridge.scene.errors import Path, allowed_at, members, shown, types_at, wrong

LARGEST_EXACT = 2**53 - 1
"""Values travel as float64: of two whole numbers above this, both may be the same one."""
MAX_ROWS = 10_000_000
"""Rows of a sweep in memory, some 600 bytes each while they are run, and values of one path of any sweep."""
MAX_STORED_ROWS = 10**12 - 1
"""Rows of a sweep to a file: what the names in a journal count."""
EXACT = "a whole number below 2^53: the columns of a sweep are float64"
"""What a field that counts takes, where it varies."""


def check_rows(counts: Mapping[str, int], sampled: int | None = None, *, stored: bool = False) -> None:
    """Refuses more rows than can be, before their values are looked at, which takes longer the more they are.

    Args:
        counts: How many values each path has of which every combination is run.
        sampled: How many samples each combination has; none for one without samples.
        stored: Whether the rows go to a file, batch by batch.

    Raises:
        ValueError: With what there are too many of.
    """
    for name, count in counts.items():
        if count > MAX_ROWS:
            message = f"{name}: {count} values: must be at most {MAX_ROWS}"
            raise ValueError(message)
    if sampled is not None and sampled > MAX_ROWS:
        message = f"samples = {sampled}: must be at most {MAX_ROWS}"
        raise ValueError(message)
    rows, most = math.prod(counts.values()) * (sampled or 1), MAX_STORED_ROWS if stored else MAX_ROWS
    if rows > most:
        remedy = "" if stored else " in memory; a file that ends in .csv or .parquet takes more"
        message = f"{rows} rows: must be at most {most}{remedy}"
        raise ValueError(message)


def takes_numbers(path: Path) -> bool:
    """Whether numbers may stand at a path of the schema: of a list of numbers, one for every axis."""
    kinds = types_at(path)
    items = [item for kind in kinds if isinstance(kind, inspect.VarTupleType) for item in members(kind.item_type)]
    # Nobody here knows the types of what a driver or a controller of one's own takes.
    return any(isinstance(kind, inspect.FloatType | inspect.IntType | inspect.AnyType) for kind in (*kinds, *items))


def counts_on(path: Path) -> bool:
    """Whether whole numbers alone may stand at a path, and such that float64 does not hold are among them."""
    numbers = [kind for kind in types_at(path) if isinstance(kind, inspect.FloatType | inspect.IntType)]
    return bool(numbers) and all(
        isinstance(kind, inspect.IntType) and (kind.le is None or kind.le > LARGEST_EXACT) for kind in numbers
    )


def out_of_range(path: Path, values: npt.NDArray[np.float64]) -> dict[int, str]:
    """What is wrong with the values that are outside the range of their type, by their row."""
    kinds = [kind for kind in types_at(path) if isinstance(kind, inspect.FloatType | inspect.IntType)]
    good = np.zeros(len(values), dtype=bool)
    for kind in kinds:
        inside = np.ones(len(values), dtype=bool)
        for limit, holds in (
            (kind.gt, np.greater), (kind.ge, np.greater_equal), (kind.lt, np.less), (kind.le, np.less_equal)
        ):  # fmt: skip
            if limit is not None:
                inside &= holds(values, limit)
        if isinstance(kind, inspect.IntType):
            inside &= (values == np.rint(values)) & (np.abs(values) <= LARGEST_EXACT)
        good |= inside
    outside = {}
    for row in np.flatnonzero(~good).tolist():
        seen = as_typed(float(values[row]))
        if counts_on(path) and seen > LARGEST_EXACT:
            outside[row] = str(wrong(path, seen, EXACT))
            continue
        outside[row] = str(wrong(path, seen, allowed_at(path, seen)))
    return outside


def as_typed(value: float) -> float | int:
    """Whole numbers as such, so that they fit fields that count; those that measure take either."""
    if value.is_integer() and abs(value) <= LARGEST_EXACT:
        return int(value)
    return value


def whole_number(name: str, value: Any, least: int, most: int | None = None) -> int:  # noqa: ANN401  # of a caller
    """A whole number by its type, neither a boolean nor a float, of `least` to `most`.

    Raises:
        ValueError: With what it must be.
    """
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if is_whole and least <= value and (most is None or value <= most):
        return int(value)
    # A float as such: 1.0 is not 1.
    seen = repr(float(value)) if isinstance(value, float) else shown(value)
    kind = "" if is_whole else "a whole number, "
    message = f"{name} = {seen}: must be {kind}{least} {'or more' if most is None else f'to {most}'}"
    raise ValueError(message)
