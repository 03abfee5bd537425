"""Reasons why rows of a sweep were refused or diverged: the first distinct ones, each with an example row."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

MOST_REASONS = 5
"""Largest number of distinct reasons that are kept."""


@dataclass(frozen=True, kw_only=True)
class RowReason:
    """Reason and the first row that has it."""

    outcome: str
    reason: str
    row: int
    """Row number, from 0."""
    values: Mapping[str, Any]
    """Varied values of the row, by path."""
    rows: int
    """Number of rows with the same reason."""


class RowReasons:
    """Reasons of rows added in batches."""

    def __init__(self) -> None:
        self._found: dict[str, RowReason] = {}
        self._rows = 0

    @property
    def first(self) -> tuple[RowReason, ...]:
        """First distinct reasons, at most `MOST_REASONS`, in row order."""
        return tuple(self._found.values())

    @property
    def others(self) -> int:
        """Number of rows with another reason."""
        return self._rows - sum(each.rows for each in self._found.values())

    def add(self, first: int, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Add rows from number `first` on, with varied values, `outcome` and metrics."""
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
