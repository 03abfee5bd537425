"""A fault, what is expected of it, and what was seen."""

from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Row:
    """One fault."""

    fault: str
    """What was done."""
    how: Literal["virtual", "processes", "calls", "-"]
    """In virtual time, with real processes and sockets, by calls from Python; - where it was not done."""
    expected: str
    """Which reaction the documents promise."""
    measured: str = ""
    """What was seen, in words."""
    reaction_s: float | None = None
    """From the first thing that was missing or wrong to the last reaction to it, in s."""
    limit_s: float | None = None
    """Longest time that may take, in s."""
    moved_m: float | None = None
    """How far the slave's command travelled where it must not: while it held, or against a run without the fault."""
    force_n: float | None = None
    """Largest force on the hand later than the fade, while it held."""
    complaints: tuple[str, ...] = ()
    """What was not as expected; none for a row that passed."""
    applies: bool = True
    """Whether there is something here that can have this fault."""

    @property
    def verdict(self) -> Literal["ok", "FAILED", "n/a"]:
        """How it ended."""
        if not self.applies:
            return "n/a"
        return "FAILED" if self.complaints else "ok"

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        return {**asdict(self), "verdict": self.verdict}


class Complaints:
    """What was not as expected, gathered check by check."""

    def __init__(self) -> None:
        self._found: list[str] = []

    def check(self, is_so: object, otherwise: str) -> None:
        """Note `otherwise` unless `is_so`."""
        if not is_so:
            self._found.append(otherwise)

    def all(self) -> tuple[str, ...]:
        """All of them."""
        return tuple(self._found)
