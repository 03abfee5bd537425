"""Figures as wide as one column or two, with embedded fonts, and their files."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from haptether.printable import printable
from haptether.private_file import private_file, refuse_link

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Columns: TypeAlias = Literal[1, 2]
PictureFormat: TypeAlias = Literal["png", "pdf", "svg"]
LETTERS = "abcdefghijklmnopqrstuvwxyz"
FORMATS: tuple[PictureFormat, ...] = ("png", "pdf", "svg")
WIDTHS_IN = {1: 3.5, 2: 7.16}
"""Widths of one column and of two in inches, as in journals of the field (88.9 mm, 181.9 mm)."""
DPI = 200
SMALL_PT = 6.5
"""Size of legends, tick labels and names of events in points."""

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.labelsize": 7.5,
    "axes.titlesize": 8.0,
    "figure.titlesize": 8.5,
    "xtick.labelsize": SMALL_PT,
    "ytick.labelsize": SMALL_PT,
    "legend.fontsize": SMALL_PT,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-4, 5),
    "axes.formatter.useoffset": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "grid.color": "#d5dae0",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "savefig.dpi": DPI,
    "savefig.bbox": "standard",
    # TrueType in a PDF, outlines in an SVG: both look the same without the font installed.
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "haptether",
}


@contextmanager
def styled() -> Iterator[None]:
    """Apply the project's style to matplotlib within this context, whatever the user's settings.

    Raises:
        ImportError: matplotlib is missing (`haptether[analysis]`).
    """
    import matplotlib as mpl

    settings: dict[Any, Any] = {**mpl.rcParamsDefault, "backend": mpl.rcParams["backend"], **STYLE}
    with mpl.rc_context(settings):
        yield


def new_figure(columns: Columns, height_in: float, title: str = "") -> "Figure":
    """Create an empty figure as wide as one column or two; call it within `styled`.

    Args:
        columns: Columns of a page.
        height_in: Height in inches; names of events add to it.
        title: Title above all panels, truncated to the width.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTHS_IN[columns], height_in), layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        room = figure.bbox.width * 0.98
        lines = [fitted(figure, printable(line), room, 8.5) for line in title.split("\n")]
        # Names of files and reasons are not formulas.
        figure.suptitle("\n".join(lines), parse_math=False)
    return figure


def figure_of(panel: "Axes") -> "Figure":
    """Figure of a panel."""
    figure = panel.get_figure(root=True)
    assert figure is not None
    return figure


def text_width(figure: "Figure", text: str, size_pt: float = SMALL_PT) -> float:
    """Width of a text in pixels of the figure."""
    from matplotlib.text import Text

    drawn = Text(0.0, 0.0, text, fontsize=size_pt, parse_math=False)
    drawn.set_figure(figure)
    return float(drawn.get_window_extent(figure.canvas.get_renderer()).width)  # type: ignore[attr-defined]


def fitted(figure: "Figure", text: str, room: float, size_pt: float = SMALL_PT) -> str:
    """Truncate a text to a width in pixels, with an ellipsis."""
    if text_width(figure, text, size_pt) <= room:
        return text
    short, long = 0, len(text)
    while short < long - 1:
        middle = (short + long) // 2
        if text_width(figure, f"{text[:middle].rstrip()}…", size_pt) <= room:
            short = middle
        else:
            long = middle
    return f"{text[:short].rstrip()}…"


def plain_ticks(panel: "Axes", most: int) -> None:
    """Label a panel's left axis in full, with at most `most` steps: an exponent would collide with its legend."""
    panel.locator_params(axis="y", nbins=most)
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:.6g}".replace("-", "\N{MINUS SIGN}"))


def letter(panels: "Sequence[Axes]") -> None:
    """Put letters a, b, c, ... at the upper left of each panel, outside of it."""
    for number, panel in enumerate(panels):
        name = LETTERS[number] if number < len(LETTERS) else str(number + 1)
        panel.annotate(name, (0.0, 1.0), (-5.0, 4.0), xycoords="axes fraction", textcoords="offset points",
                       ha="right", va="bottom", fontweight="bold", fontsize=8.5, gid="letter")  # fmt: skip


def check_columns(columns: int) -> None:
    """Check a number of columns.

    Raises:
        ValueError: It is neither 1 nor 2.
    """
    if columns not in WIDTHS_IN:
        message = f"columns = {columns}: must be {' or '.join(map(str, WIDTHS_IN))}"
        raise ValueError(message)


def check_picture(path: Path) -> str:
    """Format given by the ending of a path.

    Raises:
        ValueError: The ending is not .png, .pdf or .svg.
    """
    kind = path.suffix[1:].lower()
    if kind not in FORMATS:
        message = f"{path}: must end in {', '.join(f'.{name}' for name in FORMATS)}"
        raise ValueError(message)
    return kind


def written(figure: "Figure", path: str | PathLike[str] | None) -> "Figure":
    """Figure, after writing it if a path is given.

    Raises:
        ValueError: The ending is not .png, .pdf or .svg.
        OSError: The file cannot be written, or is a symbolic link.
    """
    if path is not None:
        write_figure(figure, Path(path))
    return figure


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of the path's ending, with mode 0600; equal figures give equal bytes.

    Raises:
        ValueError: The ending is not .png, .pdf or .svg.
        OSError: The file cannot be written, or is a symbolic link.
    """
    kind = check_picture(path)
    refuse_link(path)
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    with styled(), private_file(path) as file:
        figure.savefig(file, format=kind, metadata=metadata)
