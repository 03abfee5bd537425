"""Layout of a picture: a column per run with its two ends, and bands of text around them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from haptether.view.scene3d.parts import Station

LEAST_SIZE, LARGEST_SIZE = (320, 240), (7680, 4320)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rectangle in pixels, from the upper left corner."""

    left: int
    top: int
    width: int
    height: int

    def holds(self, x: float, y: float) -> bool:
        """True if a point is inside."""
        return self.left <= x < self.left + self.width and self.top <= y < self.top + self.height


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """Layout of one run."""

    head: Rectangle
    captions: dict[Station, Rectangle]
    views: dict[Station, Rectangle]
    """Views of the visible ends."""
    foot: Rectangle


def letter_of(size: tuple[int, int], runs: int) -> int:
    """Height of letters in pixels."""
    width, height = size
    return max(8, round(min(width / (52 + 26 * (runs > 1)) / 1.05 ** (runs - 1), height / 42)))


STATIONS: Final[tuple[Station, Station]] = ("hand", "robot")


def layout(size: tuple[int, int], runs: int, ends: Sequence[Station] = STATIONS) -> list[Column]:
    """Lay out the columns: ends of a single run side by side, of several runs below one another."""
    width, height = size
    letter = letter_of(size, runs)
    gap = 2
    head, caption, foot = round(2.1 * letter), round(1.9 * letter), round(10.4 * letter)
    columns = []
    for number in range(runs):
        left, right = (
            number * width // runs + gap * (number > 0),
            (number + 1) * width // runs - gap * (number < runs - 1),
        )
        wide, low, high = right - left, head, height - foot
        views: dict[Station, Rectangle] = {}
        captions: dict[Station, Rectangle] = {}
        if runs == 1:
            half = (wide - gap) // 2
            places: list[tuple[Station, int, int]] = [(end, left, wide) for end in ends]
            if len(ends) == 2:
                places = [(ends[0], left, half), (ends[1], left + half + gap, wide - half - gap)]
            for station, begin, span in places:
                captions[station] = Rectangle(begin, low, span, caption)
                views[station] = Rectangle(begin, low + caption, span, high - low - caption)
        else:
            middle = (low + high) // 2
            stacked: list[tuple[Station, int, int]] = [(end, low, high) for end in ends]
            if len(ends) == 2:
                stacked = [(ends[0], low, middle), (ends[1], middle, high)]
            for station, top, bottom in stacked:
                captions[station] = Rectangle(left, top, wide, caption)
                views[station] = Rectangle(left, top + caption, wide, bottom - top - caption)
        columns.append(
            Column(
                head=Rectangle(left, 0, wide, head),
                captions=captions,
                views=views,
                foot=Rectangle(left, high, wide, foot),
            )
        )
    return columns
