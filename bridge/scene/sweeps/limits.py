"""Number ranges of fields, checked for many values at once."""

import math
from collections.abc import Mapping
from numbers import Integral
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import inspect

from haptether.bridge.scene.errors import Path, allowed_at, members, shown, types_at, wrong

LARGEST_EXACT = 2**53 - 1
"""Values travel as float64, where larger integers are not distinct."""
MAX_ROWS = 10_000_000
"""Row limit of a sweep in memory (about 600 bytes per running row), and value limit per path of any sweep."""
MAX_STORED_ROWS = 10**12 - 1
"""Row limit of a sweep to a file, from the digits in journal names."""
EXACT = "a whole number below 2^53: the columns of a sweep are float64"
"""Allowed value of a varied integer field, for messages."""


def check_rows(counts: Mapping[str, int], sampled: int | None = None, *, stored: bool = False) -> None:
    """Refuse too many rows before their values are checked, which takes longer the more there are.

    Args:
        counts: Number of values per path of the grid.
        sampled: Number of samples per combination; None without samples.
        stored: True if the rows go to a file in batches.

    Raises:
        ValueError: Names the excess.
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
    """Return True if a path of the schema takes numbers, or a list with one number per axis."""
    kinds = types_at(path)
    items = [item for kind in kinds if isinstance(kind, inspect.VarTupleType) for item in members(kind.item_type)]
    # Types of driver and custom controller options are unknown.
    return any(isinstance(kind, inspect.FloatType | inspect.IntType | inspect.AnyType) for kind in (*kinds, *items))


def counts_on(path: Path) -> bool:
    """Return True if a path takes integers only, including integers that float64 cannot hold."""
    numbers = [kind for kind in types_at(path) if isinstance(kind, inspect.FloatType | inspect.IntType)]
    return bool(numbers) and all(
        isinstance(kind, inspect.IntType) and (kind.le is None or kind.le > LARGEST_EXACT) for kind in numbers
    )


def out_of_range(path: Path, values: npt.NDArray[np.float64]) -> dict[int, str]:
    """Return the errors of values outside the range of their type, by row."""
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
    """Convert integral floats to int, so that they fit integer fields; float fields accept either."""
    if value.is_integer() and abs(value) <= LARGEST_EXACT:
        return int(value)
    return value


def whole_number(name: str, value: Any, least: int, most: int | None = None) -> int:  # noqa: ANN401  # of a caller
    """Return an integer from `least` to `most`; booleans and floats are refused.

    Raises:
        ValueError: Gives the allowed values.
    """
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if is_whole and least <= value and (most is None or value <= most):
        return int(value)
    # Keep the decimal point of a float: 1.0 is not 1.
    seen = repr(float(value)) if isinstance(value, float) else shown(value)
    kind = "" if is_whole else "a whole number, "
    message = f"{name} = {seen}: must be {kind}{least} {'or more' if most is None else f'to {most}'}"
    raise ValueError(message)
