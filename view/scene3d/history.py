"""Signals of a live run, limited to the newest samples."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from haptether.bridge import Signals

Array = npt.NDArray[np.float64]


class History(Signals):
    """Named arrays that grow by samples and drop the oldest; each side has its own times.

    A side without samples has one of NaN, so that no array is empty.

    Args:
        axes: Numbers per sample of each signal; 0 for a single number without an axis.
        most: Samples kept of each side.
    """

    def __init__(self, axes: Mapping[str, int], most: int) -> None:
        super().__init__({})
        self._most = most
        # Twice the kept length; when it is full, its second half moves to the front.
        self._columns: dict[str, Array] = {}
        self.add(axes)
        self._span: dict[str, tuple[int, int]] = {
            time: (0, 1) for time in ("time_s", "slave_time_s") if time in self._columns
        }
        self._is_empty = set(self._span)
        for time in self._span:
            self._columns[time][0] = 0.0

    def append(self, time: str, row: Mapping[str, Any]) -> None:
        """Append a sample of a side.

        Args:
            time: "time_s" for the master, "slave_time_s" for the slave.
            row: Its signals, with the time; missing signals are unknown.
        """
        first, last = self._span[time]
        if time in self._is_empty:
            self._is_empty.remove(time)
            first, last = 0, 0
        names = [name for name in self._columns if self.time_of(name) == time]
        if last == 2 * self._most:
            for name in names:
                self._columns[name][: self._most] = self._columns[name][self._most :]
            first, last = 0, self._most
        for name in names:
            self._columns[name][last] = row.get(name, np.nan)
        self._span[time] = max(first, last + 1 - self._most), last + 1

    def add(self, axes: Mapping[str, int]) -> None:
        """Add further signals, unknown so far."""
        for name, count in axes.items():
            self._columns[name] = np.full((2 * self._most, count) if count else 2 * self._most, np.nan)

    def has_begun(self, time: str) -> bool:
        """True once a side has sent a sample."""
        return time in self._span and time not in self._is_empty

    def time_of(self, name: str) -> str:
        """Name of the times of a signal: "time_s" or "slave_time_s"."""
        return "slave_time_s" if name.startswith(("slave_", "environment_", "gripper", "holds_object")) else "time_s"

    def __getitem__(self, name: str) -> Array:
        if name not in self._columns:
            message = f"no signal {name!r}: there is {', '.join(self._columns)}"
            raise KeyError(message)
        first, last = self._span[self.time_of(name)]
        return self._columns[name][first:last]

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)
