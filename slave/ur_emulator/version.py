"""The software version of a controller, and what follows from it."""

import re
from dataclasses import dataclass
from typing import Self

OLDEST_CB3, NEWEST_CB3 = (3, 15), (3, 15)
OLDEST_E, NEWEST_E = (5, 4), (5, 26)


@dataclass(frozen=True, slots=True, order=True)
class ControllerVersion:
    """What GET_URCONTROL_VERSION tells: CB3 controllers are of series 3, e-Series and UR-Series ones of series 5."""

    major: int
    minor: int
    bugfix: int = 0
    build: int = 0

    @classmethod
    def parsed(cls, text: str) -> Self:
        """A version from `5.11` or `5.11.10.108`.

        Raises:
            ValueError: Another form, or a series that is not emulated.
        """
        found = re.fullmatch(r"(\d{1,3})\.(\d{1,3})(?:\.(\d{1,9}))?(?:\.(\d{1,9}))?", text)
        if not found:
            message = f"version = {text!r}: must be like 5.11 or 5.11.10.108"
            raise ValueError(message)
        version = cls(*(int(part or 0) for part in found.groups()))
        short = (version.major, version.minor)
        if not (OLDEST_CB3 <= short <= NEWEST_CB3 or OLDEST_E <= short <= NEWEST_E):
            message = f"version = {text}: must be 3.15 (CB3) or 5.4 to 5.26 (e-Series and UR-Series)"
            raise ValueError(message)
        return version

    @property
    def is_cb3(self) -> bool:
        """Whether it is a controller of the third generation."""
        return self.major == 3

    @property
    def rate_hz(self) -> int:
        """Control cycles per second: 125 (CB3) or 500."""
        return 125 if self.is_cb3 else 500

    def has(self, cb3: tuple[int, ...] | None, e_series: tuple[int, ...] | None) -> bool:
        """Whether it has what came with one of two versions; None is never, in that series."""
        since = cb3 if self.is_cb3 else e_series
        return since is not None and (self.major, self.minor, self.bugfix) >= since

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.bugfix}.{self.build}"
