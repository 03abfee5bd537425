"""The newest rows of the charts, which pages take at their own speed."""

import collections
from typing import Any


class Rows:
    """A bounded queue of rows that each reader goes along by itself; one that is slow loses the oldest, counted.

    Args:
        kept: How many wait for the slowest.
    """

    def __init__(self, kept: int) -> None:
        self._rows: collections.deque[dict[str, Any]] = collections.deque(maxlen=kept)
        self.newest = 0
        """Number of the newest row; the first is 1."""

    def add(self, row: dict[str, Any]) -> None:
        """Adds the next row."""
        self._rows.append(row)
        self.newest += 1

    def since(self, number: int) -> tuple[list[dict[str, Any]], int]:
        """The rows after number `number` that are kept, and how many are lost."""
        missing = self.newest - number
        kept = min(missing, len(self._rows))
        return list(self._rows)[len(self._rows) - kept :], missing - kept
