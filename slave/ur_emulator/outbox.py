"""What waits to be sent on one connection."""

from collections import deque
from typing import Final

PATIENCE_S: Final = 1.0
"""How long a client may read nothing before its connection is closed."""


class Outbox:
    """Bytes in order; data packages may be held back, and are skipped while others wait.

    Time is an argument, in s.
    """

    def __init__(self) -> None:
        self.ready = bytearray()
        self.skipped = 0
        """Data packages that were never sent."""
        self._held: deque[tuple[float, bytes]] = deque()
        self._stalled_at_s: float | None = None

    def answer(self, packed: bytes) -> None:
        """Takes what must be sent, at once."""
        self.ready += packed

    def package(self, packed: bytes, due_s: float, now_s: float) -> None:
        """Takes a data package that is to leave at `due_s`; it is skipped where an older one still waits."""
        if due_s > now_s or self._held:
            self._held.append((due_s, packed))
        elif self.ready:
            self.skipped += 1
        else:
            self.ready += packed

    def release(self, now_s: float) -> None:
        """Lets go what was held back until now."""
        while self._held and self._held[0][0] <= now_s:
            self.ready += self._held.popleft()[1]

    def next_due_s(self) -> float | None:
        """When the next package that is held back is due."""
        return self._held[0][0] if self._held else None

    def sent(self, count: int, now_s: float) -> None:
        """Takes away what the system has taken over."""
        del self.ready[:count]
        if not self.ready or count:
            self._stalled_at_s = None if not self.ready else now_s
        elif self._stalled_at_s is None:
            self._stalled_at_s = now_s

    def is_stalled(self, now_s: float) -> bool:
        """Whether the client has read nothing for too long."""
        return self._stalled_at_s is not None and now_s - self._stalled_at_s > PATIENCE_S
