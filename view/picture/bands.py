"""Bands of text around the views: title, legends, ladder, link, gauges, and time line."""

import functools
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageColor, ImageDraw, ImageFont

from haptether.printable import printable
from haptether.view.picture.layout import Column, Rectangle
from haptether.view.scene3d import colours
from haptether.view.scene3d.description import Description
from haptether.view.scene3d.parts import Station
from haptether.view.scene3d.status import Gauge, Status

Pixels = npt.NDArray[np.uint8]

FINER = 2
"""Bands are drawn this many times larger and scaled down, for smooth edges."""
NAMES = {"hand": "hand", "robot": "robot"}
ELLIPSIS = "…"
NUMBER_COLOURS = {"hand": colours.DEVICE_FORCE, "tool": colours.ENVIRONMENT_FORCE, "V": colours.MEASURED}
"""Colours by the last word of a number's name."""
MARGIN = 0.7
"""Left and right margin of the time line, in letters."""
STATUS_LETTERS = 3.9
"""Height of the two rows above the names of events, in letters."""
CURSOR_LETTERS = 0.9
"""Width of the time cursor, in letters."""


@functools.cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib and has all letters needed."""
    import matplotlib as mpl

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, size)


class Band:
    """A drawing area with the letter as the unit of length."""

    def __init__(self, rectangle: Rectangle, letter: int, ground: str = colours.GROUND) -> None:
        self.rectangle = rectangle
        self.letter = letter
        self.width = rectangle.width / letter
        self.height = rectangle.height / letter
        self._unit = FINER * letter
        self._image = Image.new("RGB", (FINER * rectangle.width, FINER * rectangle.height), ground)
        self._draw = ImageDraw.Draw(self._image)

    def width_of(self, text: str, size: float = 1.0, *, bold: bool = False) -> float:
        """Width of a text in letters."""
        return font(round(size * self._unit), bold=bold).getlength(text) / self._unit

    def text(
        self, x: float, y: float, text: str, colour: str = colours.INK, *,
        size: float = 1.0, bold: bool = False, within: float = math.inf, anchor: str = "lm",
    ) -> float:  # fmt: skip
        """Write on one line, truncated to a width; return its end."""
        text = printable(text)
        if self.width_of(text, size, bold=bold) > within:
            while text and self.width_of(text + ELLIPSIS, size, bold=bold) > within:
                text = text[:-1]
            text = text.rstrip() + ELLIPSIS if text else ""
        self._draw.text(self._at(x, y), text, colour, font=font(round(size * self._unit), bold=bold), anchor=anchor)
        return x + self.width_of(text, size, bold=bold)

    def box(self, x: float, y: float, width: float, height: float, colour: str, *, round_by: float = 0.0) -> None:
        """Draw a filled rectangle."""
        if width > 0.0:
            corners = [self._at(x, y), self._at(x + width, y + height)]
            self._draw.rounded_rectangle(corners, round_by * self._unit, fill=colour)

    def line(self, points: list[tuple[float, float]], colour: str, width: float = 0.1) -> None:
        """Draw a polyline."""
        self._draw.line(
            [self._at(*point) for point in points], colour, max(1, round(width * self._unit)), joint="curve"
        )

    def area(self, points: list[tuple[float, float]], colour: str) -> None:
        """Draw a filled polygon."""
        if len(points) > 2:
            self._draw.polygon([self._at(*point) for point in points], fill=colour)

    def pixels(self) -> Pixels:
        """Pixels, (height, width, 3)."""
        small = self._image.resize((self.rectangle.width, self.rectangle.height), Image.Resampling.BOX)
        return np.asarray(small)

    def _at(self, x: float, y: float) -> tuple[float, float]:
        return x * self._unit, y * self._unit


def caption(
    described: Description, station: Station, rectangle: Rectangle, letter: int, pixels_per_metre: float
) -> Pixels:
    """Caption of an end: name, colours of arrows and trails, and the scale of forces."""
    band = Band(rectangle, letter, "#eceff3")
    middle = 0.5 * band.height
    x = band.text(0.6, middle, NAMES[station], bold=True) + 0.8
    arrows = sorted((arrow for arrow in described.arrows if arrow.station == station), key=lambda arrow: arrow.heads)
    # For joints, the measured values are torques; the force at the tip is computed from them.
    joints = described.status.joints
    measured = [arrow for arrow in arrows if arrow.heads == (2 if joints else 1)]
    if measured and math.isfinite(pixels_per_metre):
        scale = _bar_of(measured[0].scale * pixels_per_metre / letter)
        length = scale * measured[0].scale * pixels_per_metre / letter
        label = f"{scale:g} {'N m' if joints else 'N'}"
        begin = band.width - 0.6 - length
        band.line([(begin, middle), (begin + length, middle)], colours.INK, 0.16)
        for end in (begin, begin + length):
            band.line([(end, middle - 0.3), (end, middle + 0.3)], colours.INK, 0.12)
        limit = begin - band.width_of(label, 0.85) - 0.4
        band.text(limit, middle, label, size=0.85)
    else:
        limit = band.width - 0.3
    rows = [(arrow.label, arrow.colour, 0.4) for arrow in arrows]
    trails = [trail for trail in described.trails if trail.station == station]
    rows += [(trail.label, trail.colour, 0.14) for trail in trails]
    for label, colour, thick in dict.fromkeys(rows):
        width = 1.3 + band.width_of(label, 0.85) + 0.9
        if x + width > limit:
            break
        band.box(x, middle - 0.5 * thick, 0.95, thick, colour, round_by=0.06)
        band.text(x + 1.2, middle, label, size=0.85)
        x += width
    return band.pixels()


def _bar_of(letters_per_newton: float) -> float:
    """Force in N, or torque in N m, of 1, 2 or 5 times a power of ten, with a bar of about four letters."""
    wanted = 4.0 / letters_per_newton
    power = 10.0 ** math.floor(math.log10(wanted))
    return max((step * power for step in (1.0, 2.0, 5.0) if step * power <= wanted), default=power)


class Bands:
    """Head and foot of a run over time."""

    def __init__(self, described: Description, column: Column, letter: int) -> None:
        self._described = described
        self._column = column
        self._letter = letter
        self._line_top = column.foot.height / letter - 4.9
        self.renew(described)

    def renew(self, described: Description) -> None:
        """Use a new time line of the same run."""
        self._described = described
        quiet = Band(self._column.foot, self._letter)
        self._draw_line(quiet)
        self._width = quiet.width
        self._quiet = quiet.pixels()

    def head(self) -> Pixels:
        """Title and results."""
        band = Band(self._column.head, self._letter)
        middle = 0.5 * band.height
        figures = self._described.figures
        within = band.width - 1.2
        x = band.text(0.6, middle, self._described.title, size=1.25, bold=True, within=within)
        if (room := within - x - 1.0) > 12.0:
            needed = band.width_of(figures, 0.85)
            shown = figures
            while needed > room and "   " in shown:
                shown = shown.rpartition("   ")[0]
                needed = band.width_of(shown, 0.85)
            if needed <= room:
                band.text(band.width - 0.6, middle, shown, colours.FAINT_INK, size=0.85, anchor="rm")
        return band.pixels()

    def foot(self, time_s: float, note: str = "") -> Pixels:
        """Status, gauges and the time line with a cursor.

        Args:
            time_s: Time shown.
            note: Further text, for example the playing speed.
        """
        # This runs 30 times a second, so it redraws only changing parts.
        foot = self._column.foot
        band = Band(Rectangle(foot.left, foot.top, foot.width, round(STATUS_LETTERS * self._letter)), self._letter)
        status = self._described.status.at(time_s)
        self._write_status(band, status, note)
        self._write_gauges(band, status)
        pixels = self._quiet.copy()
        pixels[: band.rectangle.height] = band.pixels()
        self._draw_cursor(pixels, self._x(self._width, time_s))
        return pixels

    def time_at(self, x: float, y: float) -> float | None:
        """Time in s at a pixel of the time line; None elsewhere."""
        foot = self._column.foot
        if not foot.holds(x, y) or (y - foot.top) / self._letter < self._line_top - 1.4:
            return None
        line = self._described.timeline
        share = ((x - foot.left) / self._letter - MARGIN) / (self._width - 2.0 * MARGIN)
        return line.begin_s + min(max(share, 0.0), 1.0) * (line.end_s - line.begin_s)

    def _write_status(self, band: Band, status: Status, note: str) -> None:
        y = 0.95
        x = band.text(0.6, y, f"{status.time_s:7.3f} s".strip(), bold=True, size=1.1) + 0.9
        x = max(x, 6.2)
        for name, state in (("hand", status.master), ("robot", status.slave)):
            if state:
                x = self._chip(band, x, y, f"{name} {state}", colours.LADDER.get(state, colours.LINE)) + 0.5
        if status.intervenes:
            who = "+".join(status.acting).upper() or "a controller"
            x = self._chip(band, x, y, f"{who} damps", colours.TRIP, ink="#ffffff") + 0.5
        words = note
        if not words and math.isfinite(status.age_s):
            words = f"newest frame {1e3 * status.age_s:.0f} ms older than usual" if status.age_s > 0.0015 else ""
        words = words or (status.reason if status.master not in {"", "engaged"} else "")
        if words and (room := band.width - x - 0.6) > 4.0:
            band.text(band.width - 0.6, y, words, colours.FAINT_INK, size=0.85, anchor="rm",
                      within=room)  # fmt: skip

    def _chip(self, band: Band, x: float, y: float, text: str, colour: str, *, ink: str = colours.INK) -> float:
        width = band.width_of(text, 0.85) + 0.9
        if x + width > band.width - 0.3:
            return x
        band.box(x, y - 0.68, width, 1.36, colour, round_by=0.4)
        band.text(x + 0.45, y, text, ink, size=0.85)
        return x + width

    def _write_gauges(self, band: Band, status: Status) -> None:
        y = 2.85
        x = 0.6
        for name, value, unit in status.numbers:
            band.box(x, y - 0.35, 0.35, 0.7, NUMBER_COLOURS[name.rpartition(" ")[2]], round_by=0.08)
            band.text(x + 0.6, y, f"{name} {value:.2f} {unit}", size=0.9)
            # Reserve the width of the widest number, so that nothing moves between frames.
            x += 0.6 + band.width_of(f"{name} 00.00 {'rad/s' if status.joints else 'm/s'}", 0.9) + 0.9
        if not status.gauges:
            if band.width - x > 9.0 and "hand" in self._described.views:
                band.text(x, y, "no controller watches", colours.FAINT_INK, size=0.9, within=band.width - x - 0.6)
            return
        room = (band.width - x - 0.6) / len(status.gauges)
        for number, gauge in enumerate(status.gauges):
            self._gauge(band, x + number * room, y, room - 0.8, gauge)

    def _gauge(self, band: Band, x: float, y: float, width: float, gauge: Gauge) -> None:
        name = gauge.controller.upper()
        begin = band.text(x, y, name, colours.TRIP if gauge.tripped else colours.INK, size=0.9, bold=True) + 0.4
        bar = min(7.0, 0.55 * (x + width - begin))
        if bar < 1.5:
            return
        band.box(begin, y - 0.4, bar, 0.8, "#dfe4ea", round_by=0.25)
        # The threshold is at three quarters, so that larger values are visible.
        full = 0.75 * bar
        colour = colours.TRIP if gauge.share >= 1.0 else colours.SAFETY_FORCE
        band.box(
            begin, y - 0.4, min(bar, gauge.share * full), 0.8, colour, round_by=min(0.25, 0.5 * gauge.share * full)
        )
        band.line([(begin + full, y - 0.6), (begin + full, y + 0.6)], colours.INK, 0.12)
        room = x + width + 0.8 - begin - bar - 0.4
        texts = (gauge.text, f"{gauge.symbol} {gauge.value:.2g}{gauge.unit}", f"{gauge.value:.2g}{gauge.unit}")
        for text in texts if math.isfinite(gauge.value) else texts[:1]:
            if band.width_of(text, 0.85) <= room:
                band.text(begin + bar + 0.4, y, text, colours.FAINT_INK, size=0.85)
                break

    def _x(self, width: float, time_s: float) -> float:
        line = self._described.timeline
        span = max(line.end_s - line.begin_s, 1e-9)
        return MARGIN + (time_s - line.begin_s) / span * (width - 2.0 * MARGIN)

    def _draw_line(self, band: Band) -> None:
        line, top = self._described.timeline, self._line_top
        left, right = MARGIN, band.width - MARGIN
        ladder, force, low = top + 0.35, top + 0.75, top + 3.35
        band.box(left, force, right - left, low - force, "#eef1f5")
        for begin, end in line.trips:
            band.box(
                self._x(band.width, begin),
                force,
                max(self._x(band.width, end) - self._x(band.width, begin), 0.08),
                low - force,
                "#f8d3d7",
            )
        for begin, end, state in line.ladder:
            band.box(
                self._x(band.width, begin),
                ladder - 0.35,
                self._x(band.width, end) - self._x(band.width, begin),
                0.5,
                colours.LADDER[state],
            )
        if len(line.force_n) and (peak := float(line.force_n.max())) > 0.0:
            points = [
                (self._x(band.width, float(t)), low - 0.08 - float(f) / peak * (low - force - 0.3))
                for t, f in zip(line.force_time_s, line.force_n, strict=True)
            ]
            band.area([(points[0][0], low), *points, (points[-1][0], low)], "#c5dbf5")
            band.line(points, colours.DEVICE_FORCE, 0.09)
        for mark in line.marks:
            x = self._x(band.width, mark.time_s)
            band.line([(x, force), (x, low)], colours.INK if mark.named else colours.LINE, 0.07)
        for x, text, is_trip in self._labels(band):
            band.text(x, top - 0.72, text, colours.TRIP if is_trip else colours.INK, size=0.78)
        for tick_s in _ticks(line.begin_s, line.end_s, band.width):
            x = self._x(band.width, tick_s)
            band.line([(x, low), (x, low + 0.25)], colours.FAINT_INK, 0.07)
            anchor = "lm" if x < left + 0.6 else "rm" if x > right - 0.6 else "mm"
            band.text(x, low + 0.85, f"{tick_s:g} s", colours.FAINT_INK, size=0.78, anchor=anchor)

    def _labels(self, band: Band) -> list[tuple[float, str, bool]]:
        """Names of events with their positions; names that would overlap are merged."""
        groups: list[tuple[float, list[str]]] = []
        for mark in self._described.timeline.marks:
            x = self._x(band.width, mark.time_s)
            if not mark.named:
                continue
            if groups and x < groups[-1][0] + band.width_of(", ".join(groups[-1][1]), 0.78) + 0.6:
                groups[-1][1].append(mark.text)
            else:
                groups.append((x, [mark.text]))
        labels = []
        for number, (x, texts) in enumerate(groups):
            end = groups[number + 1][0] - 0.5 if number + 1 < len(groups) else band.width - 0.3
            text = ", ".join(dict.fromkeys(texts))
            while len(texts) > 1 and x + band.width_of(text, 0.78) > end:
                # Drop the last name that is no trip: trips matter most.
                texts.pop(next((n for n in range(len(texts) - 1, -1, -1) if not texts[n].startswith("trip")), -1))
                text = ", ".join(dict.fromkeys(texts))
            begin = min(x, band.width - 0.3 - band.width_of(text, 0.78))
            labels.append((begin, text, any(name.startswith("trip") for name in texts)))
        return labels

    def _draw_cursor(self, pixels: Pixels, x: float) -> None:
        """Draw the cursor, a line with a point above, over the pixels."""
        top, letter = self._line_top - 0.3, self._letter
        width, height = math.ceil(CURSOR_LETTERS * letter) + 2, math.ceil(4.0 * letter)
        left, first = round((x - 0.5 * CURSOR_LETTERS) * letter) - 1, int(top * letter)
        band = Band(Rectangle(0, 0, width, height), letter, "#ffffff")
        middle, down = x - left / letter, top - first / letter
        band.line([(middle, down + 0.2), (middle, down + 3.8)], "#000000", 0.16)
        band.area([(middle - 0.35, down + 0.05), (middle + 0.35, down + 0.05), (middle, down + 0.6)], "#000000")
        begin, end = max(0, -left), min(width, pixels.shape[1] - left)
        if begin >= end:
            # Runs side by side may end at different times.
            return
        covered = 1.0 - band.pixels()[:, begin:end, :1] / 255.0
        under = pixels[first : first + height, left + begin : left + end]
        covered = covered[: len(under)]
        ink = np.array(ImageColor.getrgb(colours.INK), dtype=np.float64)
        under[:] = np.rint(under + covered * (ink - under))


def _ticks(begin_s: float, end_s: float, width: float) -> list[float]:
    """Round times in s, about eight letters apart."""
    wanted = max(end_s - begin_s, 1e-6) / max(2.0, width / 8.0)
    power = 10.0 ** math.floor(math.log10(wanted))
    step = next(s * power for s in (1.0, 2.0, 5.0, 10.0) if s * power >= wanted * (1.0 - 1e-9))
    return [n * step for n in range(math.ceil(begin_s / step - 1e-9), math.floor(end_s / step + 0.01) + 1)]
