"""What was found of one property of a driver."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from haptether.bridge.devices.open import DeviceError
from haptether.checklist import RefusedError

Verdict = Literal["pass", "mend", "note", "unseen"]
"""As it must be; to be mended; worth knowing; or not to be seen in this run."""


def raised(error: DeviceError) -> str:
    """Text of an exception of a driver, without its place in the source."""
    if isinstance(error.__cause__, RefusedError):
        return f"refused: {error.__cause__}"
    return f"raised an exception: {error.brief}"


def messages(failed: Mapping[str, DeviceError]) -> list[str]:
    """The driver's own texts of what its methods raised."""
    return [str(error.__cause__) for error in failed.values()]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the result."""

    check: str
    """The property."""
    verdict: Verdict
    text: str
    """What was seen, and where it is to be mended what must be."""
