"""Latest chart rows, which pages read at their own speed."""

import collections
from typing import Any


class Rows:
    """Bounded queue of rows with an independent position per reader; a slow reader loses the oldest, counted.

    Args:
        kept: Number of rows kept.
    """

    def __init__(self, kept: int) -> None:
        self._rows: collections.deque[dict[str, Any]] = collections.deque(maxlen=kept)
        self.newest = 0
        """Number of the latest row, counted from 1."""

    def add(self, row: dict[str, Any]) -> None:
        """Append a row."""
        self._rows.append(row)
        self.newest += 1

    def since(self, number: int) -> tuple[list[dict[str, Any]], int]:
        """Return the kept rows after `number`, and the number of lost ones."""
        missing = self.newest - number
        kept = min(missing, len(self._rows))
        return list(self._rows)[len(self._rows) - kept :], missing - kept
