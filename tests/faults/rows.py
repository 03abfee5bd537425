"""A fault with its expected and its measured reaction."""

from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Row:
    """One fault."""

    fault: str
    """Name of the fault."""
    how: Literal["virtual", "processes", "calls", "-"]
    """Method: virtual time, real processes and sockets, or calls from Python; - if it was not done."""
    expected: str
    """Reaction that the documents promise."""
    coupling: str = "position-force"
    """Kind of the coupling."""
    measured: str = ""
    """Measured reaction, in words."""
    reaction_s: float | None = None
    """Time in s from the first missing or wrong input to the last reaction to it."""
    limit_s: float | None = None
    """Longest permitted reaction time in s."""
    moved_m: float | None = None
    """Forbidden travel of the slave's command: during the hold, or against a run without the fault."""
    force_n: float | None = None
    """Largest force on the hand after the fade, during the hold."""
    complaints: tuple[str, ...] = ()
    """Failed checks; empty for a row that passed."""
    applies: bool = True
    """True if this machine can have the fault."""

    @property
    def verdict(self) -> Literal["ok", "FAILED", "n/a"]:
        """Result of the row."""
        if not self.applies:
            return "n/a"
        return "FAILED" if self.complaints else "ok"

    def as_json(self) -> dict[str, Any]:
        """Return the row for machines."""
        return {**asdict(self), "verdict": self.verdict}


class Complaints:
    """Failed checks, collected one by one."""

    def __init__(self) -> None:
        self._found: list[str] = []

    def check(self, is_so: object, otherwise: str) -> None:
        """Note `otherwise` unless `is_so`."""
        if not is_so:
            self._found.append(otherwise)

    def all(self) -> tuple[str, ...]:
        """Return all failed checks."""
        return tuple(self._found)
