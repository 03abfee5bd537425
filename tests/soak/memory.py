"""Memory of a process, and the test that it stays constant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

PER_S = 300.0
"""Time in s for which `ALLOWED_BYTES` holds; a longer measurement may differ by as much for each such time."""
ALLOWED_BYTES = 64 * 1024
"""Largest change in either direction: sixteen pages, which an allocator takes or returns in one step (a chunk of its
arenas). Over the 270 s between the middles of the compared tenths, 64 KiB is 0.24 bytes per tick: any leak of a loop
per tick, or of the 20 polls per second, exceeds that."""


def anonymous_bytes(process: int) -> int:
    """Return the resident memory without mapped files, which come and go with the page cache."""
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    (line,) = [line for line in status.splitlines() if line.startswith("RssAnon:")]
    return int(line.split()[1]) * 1024


def loop_sleeps(process: int) -> int:
    """Return how often the control loop has slept: once per tick, unless it woke so late that the next tick was due."""
    for task in Path(f"/proc/{process}/task").iterdir():
        if (task / "comm").read_text(encoding="ascii").strip() == "haptether-loop":
            status = (task / "status").read_text(encoding="ascii")
            (line,) = [line for line in status.splitlines() if line.startswith("voluntary_ctxt_switches:")]
            return int(line.split()[1])
    return 0


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Difference of a process's memory between the begin and the end of the second half."""

    first_bytes: int
    """Median of the first tenth of the second half."""
    last_bytes: int
    """Median of the last tenth."""
    allowed_bytes: int
    """Largest difference in either direction."""

    @property
    def grown_bytes(self) -> int:
        """Growth in bytes; negative if the memory shrank."""
        return self.last_bytes - self.first_bytes

    @property
    def is_flat(self) -> bool:
        """True if the difference is within the limit."""
        return abs(self.grown_bytes) <= self.allowed_bytes


def growth(samples: Sequence[int], period_s: float) -> Growth:
    """Compare tenths of the second half; the first half is the warm-up.

    Args:
        samples: Bytes, one each `period_s`; at least 4.
        period_s: In s.
    """
    half = samples[len(samples) // 2 :]
    tenth = max(len(half) // 10, 1)
    times = max(len(half) * period_s / PER_S, 1.0)
    return Growth(
        first_bytes=int(median(half[:tenth])),
        last_bytes=int(median(half[-tenth:])),
        allowed_bytes=int(ALLOWED_BYTES * times),
    )
