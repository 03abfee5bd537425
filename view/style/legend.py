"""Legends above a panel or below all panels, away from curves."""

from typing import TYPE_CHECKING, Any

from haptether.view.style.figure import figure_of, small_pt, text_width

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HANDLE_EM, GAP_EM, PAD_EM = 1.8, 1.0, 0.5
"""Legend dimensions in font sizes: line length, gap between entries, gap between line and name."""


def legend_above(
    panel: "Axes", handles: "Sequence[Any] | None" = None, width_in: float | None = None, above_pt: float = 0.0
) -> int:
    """Put a legend above a panel at its left; return its number of lines.

    Args:
        panel: Panel with labelled lines.
        handles: Listed handles; by default all labelled ones.
        width_in: Width of the panel in inches; by default that of the figure, less one row of labels.
        above_pt: Height in points already used above the panel.
    """
    from matplotlib.transforms import offset_copy

    listed = list(panel.get_legend_handles_labels()[0]) if handles is None else list(handles)
    if not listed:
        return 0
    figure = figure_of(panel)
    room = (figure.get_figwidth() - 1.0 if width_in is None else width_in) * figure.dpi
    em = small_pt() / 72.0 * figure.dpi
    widths = [text_width(figure, str(handle.get_label())) + (HANDLE_EM + PAD_EM + GAP_EM) * em for handle in listed]
    columns = len(listed)
    while columns > 1 and sum(max(widths[column::columns]) for column in range(columns)) > room:
        columns -= 1
    rows = -(-len(listed) // columns)
    # matplotlib fills by column, but readers go by row.
    order = [row * columns + column for column in range(columns) for row in range(rows)]
    listed = [listed[place] for place in order if place < len(listed)]
    panel.legend(handles=listed, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, facecolor="white",
                 bbox_transform=offset_copy(panel.transAxes, figure, y=above_pt, units="points"), edgecolor="none",
                 framealpha=1.0,
                 borderaxespad=0.15, borderpad=0.1, handlelength=HANDLE_EM, columnspacing=GAP_EM, handletextpad=PAD_EM,
                 labelspacing=0.2)  # fmt: skip
    return rows


def legend_below(figure: "Figure", handles: "Sequence[Any]") -> None:
    """Put one legend of several panels below them."""
    widths = [text_width(figure, str(handle.get_label())) for handle in handles]
    em = small_pt() / 72.0 * figure.dpi
    room = max(widths, default=0.0) + (HANDLE_EM + PAD_EM + GAP_EM) * em
    columns = max(1, min(len(handles), int(0.98 * figure.bbox.width / room)))
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns, frameon=False,
                  handlelength=HANDLE_EM, columnspacing=GAP_EM, handletextpad=PAD_EM)  # fmt: skip
