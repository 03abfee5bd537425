"""The word in which the control script tells of moves that go on by themselves."""

from collections.abc import Callable
from typing import Final

RUNNING: Final = 1 << 15
MAX_PROGRESS: Final = RUNNING - 1
COUNTS: Final = 128


class AsyncProgress:
    """Bits 0-14 progress, 15 running, 16-22 writes modulo 128, 24-30 operation modulo 128.

    Args:
        write: Writes the word.
    """

    def __init__(self, write: Callable[[int], None]) -> None:
        self._write = write
        self._writes = 0
        self._operation = 0

    def begin(self) -> None:
        """A new operation."""
        self._operation = (self._operation + 1) % COUNTS
        self._tell(RUNNING)

    def progress(self, value: int) -> None:
        """How far it is; what is not above 0 counts as a new operation or its end, as in the script."""
        if value == 0:
            self.begin()
        elif value < 0:
            self.end()
        else:
            self._tell(RUNNING + min(value, MAX_PROGRESS))

    def end(self) -> None:
        """It has ended."""
        self._tell(0)

    def _tell(self, low: int) -> None:
        self._writes = (self._writes + 1) % COUNTS
        self._write(self._operation << 24 | self._writes << 16 | low)
