"""Legends above a panel or beside all panels, away from curves."""

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from haptether.view.style.figure import figure_of, small_pt, text_width

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

HANDLE_EM, GAP_EM, PAD_EM = 1.8, 1.0, 0.5
"""Legend dimensions in font sizes: line length, gap between entries, gap between line and name."""
Outside: TypeAlias = Literal["outside lower center", "outside upper center"]
SPACES: dict[str, Any] = {"handlelength": HANDLE_EM, "columnspacing": GAP_EM, "handletextpad": PAD_EM}


def legend_above(panel: "Axes", handles: "Sequence[Any] | None" = None, width_in: float | None = None) -> int:
    """Put a legend above a panel at its left; return its number of lines.

    Args:
        panel: Panel with labelled lines.
        handles: Listed handles; by default all labelled ones.
        width_in: Width of the panel in inches; by default that of the figure, less one row of labels.
    """
    listed = list(panel.get_legend_handles_labels()[0]) if handles is None else list(handles)
    if not listed:
        return 0
    figure = figure_of(panel)
    room = (figure.get_figwidth() - 1.0 if width_in is None else width_in) * figure.dpi
    listed, columns = _by_row(figure, listed, room)
    panel.legend(handles=listed, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, facecolor="white",
                 edgecolor="none", framealpha=1.0, borderaxespad=0.15, borderpad=0.1, labelspacing=0.2,
                 **SPACES)  # fmt: skip
    return -(-len(listed) // columns)


def legend_beside(part: "FigureBase", handles: "Sequence[Any]", loc: Outside = "outside lower center") -> None:
    """Put one legend of several panels below or above them."""
    figure = part.get_figure(root=True)
    assert figure is not None
    listed, columns = _by_row(figure, list(handles), 0.98 * figure.bbox.width)
    part.legend(handles=listed, loc=loc, ncols=columns, frameon=False, **SPACES)


def _by_row(figure: "Figure", handles: list[Any], room: float) -> tuple[list[Any], int]:
    """Return the handles, ordered so that they read row by row, and the number of columns that fit."""
    em = small_pt() / 72.0 * figure.dpi
    widths = [text_width(figure, str(handle.get_label())) + (HANDLE_EM + PAD_EM + GAP_EM) * em for handle in handles]
    columns = max(1, len(handles))
    while columns > 1 and sum(max(widths[column::columns]) for column in range(columns)) > room:
        columns -= 1
    rows = -(-len(handles) // columns)
    # matplotlib fills by column, but readers go by row.
    order = [row * columns + column for column in range(columns) for row in range(rows)]
    return [handles[place] for place in order if place < len(handles)], columns
