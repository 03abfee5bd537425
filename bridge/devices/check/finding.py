"""Result of checking one property of a driver."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from haptether.bridge.devices.open import DeviceError
from haptether.checklist import RefusedError

Verdict = Literal["pass", "mend", "note", "unseen"]
"""Valid; must be fixed; information only; not observable in this run."""


def raised(error: DeviceError) -> str:
    """Text of a driver exception, without its source location."""
    if isinstance(error.__cause__, RefusedError):
        return f"refused: {error.__cause__}"
    return f"raised an exception: {error.brief}"


def messages(failed: Mapping[str, DeviceError]) -> list[str]:
    """Driver texts of the exceptions that its methods raised."""
    return [str(error.__cause__) for error in failed.values()]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the check result."""

    check: str
    """Name of the property."""
    verdict: Verdict
    text: str
    """Observation and, if a fix is required, where to make it."""
