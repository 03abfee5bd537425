"""What was found of one property of a driver."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["pass", "mend", "note", "unseen"]
"""As it must be; to be mended; worth knowing; or not to be seen in this run."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the result."""

    check: str
    """The property."""
    verdict: Verdict
    text: str
    """What was seen, and where it is to be mended what must be."""
