"""The newest rows of the charts, read by each page at its own speed."""

import collections
from typing import Any


class Rows:
    """Bounded queue of rows with independent readers; a slow reader loses the oldest rows, and the loss is counted.

    Args:
        kept: Rows kept for the slowest reader.
    """

    def __init__(self, kept: int) -> None:
        self._rows: collections.deque[dict[str, Any]] = collections.deque(maxlen=kept)
        self.newest = 0
        """Number of the newest row; the first is 1."""

    def add(self, row: dict[str, Any]) -> None:
        """Append a row."""
        self._rows.append(row)
        self.newest += 1

    def since(self, number: int) -> tuple[list[dict[str, Any]], int]:
        """Kept rows after row `number`, and the number of lost rows."""
        missing = self.newest - number
        kept = min(missing, len(self._rows))
        return list(self._rows)[len(self._rows) - kept :], missing - kept
