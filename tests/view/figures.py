"""Checks of a figure: the places of its texts, and their overlaps."""

from itertools import combinations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

SLACK_PX = 0.5


def texts_of(figure: Figure) -> list[Text]:
    """Return every visible text of a drawn figure."""
    ticks: set[int] = set()
    for panel in figure.axes:
        for axis, limits in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
            low, high = sorted(limits)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                # matplotlib keeps ticks beyond the limits, and does not draw them.
                if not low - 1e-9 * (high - low) <= tick.get_loc() <= high + 1e-9 * (high - low):
                    ticks |= {id(tick.label1), id(tick.label2)}
    return [
        text
        for text in figure.findobj(Text)
        if isinstance(text, Text) and text.get_visible() and text.get_text().strip() and id(text) not in ticks
    ]


def box(text: Text) -> Bbox:
    """Return the box of the letters, without their arrows."""
    renderer = text.get_figure(root=True).canvas.get_renderer()  # type: ignore[union-attr]
    return Text.get_window_extent(text, renderer)


def fallen_off(figure: Figure) -> list[str]:
    """Return the texts that are not wholly within their figure."""
    width, height = figure.bbox.width, figure.bbox.height
    return [
        text.get_text()
        for text in texts_of(figure)
        if (of := box(text)).x0 < -SLACK_PX
        or of.y0 < -SLACK_PX
        or of.x1 > width + SLACK_PX
        or of.y1 > height + SLACK_PX
    ]


def overlapping(figure: Figure) -> list[tuple[str, str]]:
    """Return the pairs of texts that overlap."""
    boxes = [(text.get_text(), box(text)) for text in texts_of(figure)]
    return [
        (one, other)
        for (one, a), (other, b) in combinations(boxes, 2)
        if min(a.x1, b.x1) - max(a.x0, b.x0) > SLACK_PX and min(a.y1, b.y1) - max(a.y0, b.y0) > SLACK_PX
    ]


def covered_panels(figure: Figure) -> list[str]:
    """Return the panels that a legend covers."""
    legends = [legend for panel in figure.axes if (legend := panel.get_legend()) is not None] + list(figure.legends)
    return [
        panel.get_ylabel() for legend in legends for panel in figure.axes if _meet(legend.get_window_extent(), panel)
    ]


def _meet(of: Bbox, panel: Axes) -> bool:
    inside = panel.get_window_extent()
    return bool(
        min(of.x1, inside.x1) - max(of.x0, inside.x0) > SLACK_PX
        and min(of.y1, inside.y1) - max(of.y0, inside.y0) > SLACK_PX
    )


def event_names(figure: Figure) -> list[str]:
    """Return the labels of events."""
    return [text.get_text() for text in figure.findobj(Annotation) if text.get_gid() == "event"]


def check(figure: Figure) -> None:
    """Assert that no text is off the figure or over another, and no legend over a curve."""
    figure.draw_without_rendering()
    assert fallen_off(figure) == []
    assert overlapping(figure) == []
    assert covered_panels(figure) == []
