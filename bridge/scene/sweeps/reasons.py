"""Why rows of a sweep were refused or diverged: the first distinct reasons, each with a row that has it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

MOST_REASONS = 5
"""Distinct reasons that are kept."""


@dataclass(frozen=True, kw_only=True)
class RowReason:
    """One reason, and the first row that has it."""

    outcome: str
    """How the row ended."""
    reason: str
    """Why."""
    row: int
    """Its number, from 0."""
    values: Mapping[str, Any]
    """What varies there, by path."""
    rows: int
    """How many rows have the same reason."""


class RowReasons:
    """The reasons of the rows that come, batch by batch."""

    def __init__(self) -> None:
        self._found: dict[str, RowReason] = {}
        self._rows = 0

    @property
    def first(self) -> tuple[RowReason, ...]:
        """The first distinct ones, at most `MOST_REASONS`, in the order of their rows."""
        return tuple(self._found.values())

    @property
    def others(self) -> int:
        """How many rows have a reason that is none of the first."""
        return self._rows - sum(each.rows for each in self._found.values())

    def add(self, first: int, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Takes the rows from the number `first` on: what varies, `outcome`, and the metrics."""
        if "reason" not in columns:
            return
        having = np.flatnonzero(columns["reason"] != "")
        if len(having) == 0:
            return
        self._rows += len(having)
        texts, at, counts = np.unique(columns["reason"][having], return_index=True, return_counts=True)
        names = list(columns)
        varied = names[: names.index("outcome")]
        for place in np.argsort(at).tolist():
            text, row, count = str(texts[place]), int(having[at[place]]), int(counts[place])
            if (known := self._found.get(text)) is not None:
                self._found[text] = replace(known, rows=known.rows + count)
            elif len(self._found) < MOST_REASONS:
                values = {name: columns[name][row].item() for name in varied}
                self._found[text] = RowReason(
                    outcome=str(columns["outcome"][row]), reason=text, row=first + row, values=values, rows=count
                )
