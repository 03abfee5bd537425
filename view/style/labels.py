"""Labels of axes: words with a unit, in the size of the drawn values."""

import textwrap
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

SMALLER: dict[str, tuple[str, float, float]] = {
    "s": ("ms", 1e3, 1.0),
    "m": ("mm", 1e3, 0.1),
    "J": ("mJ", 1e3, 0.1),
}
"""Unit for small values by unit: name, factor, and the magnitude below which it is used."""
LINE = 20
"""Characters of a label on one line."""
HELD = "\N{NO-BREAK SPACE}"


class AxisLabel(NamedTuple):
    """Quantity of an axis."""

    words: str
    unit: str = ""

    def sized(self, values: npt.ArrayLike) -> tuple[str, float]:
        """Return the label in the unit that suits the largest value, and the factor for the values."""
        unit, factor = self.unit, 1.0
        known = np.abs(np.asarray(values, dtype=np.float64))
        known = known[np.isfinite(known)]
        if self.unit in SMALLER and known.size:
            smaller, by, limit = SMALLER[self.unit]
            if 0.0 < known.max() < limit:
                unit, factor = smaller, by
        return f"{self.words} [{unit}]" if unit else self.words, factor


def wrapped(label: str, most: int = LINE) -> str:
    """Return a label on several lines; a unit stays with the word before it."""
    words, bracket, unit = label.partition(" [")
    held = words + (bracket + unit).replace(" ", HELD)
    return textwrap.fill(held, most, break_long_words=False).replace(HELD, " ")
