"""Figures one or two columns wide, with embeddable fonts, and their export."""

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
"""Widths of one and two columns in inches, as journals require (88.9 mm, 181.9 mm)."""
DPI = 200
"""Resolution of a PNG in dots per inch."""
SMALL_PT = 6.5
"""Size of legends, tick labels and event names in points."""

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
    # TrueType in a PDF and outlines in an SVG do not depend on installed fonts.
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "haptether",
}


@contextmanager
def styled() -> Iterator[None]:
    """Use the project's matplotlib style inside the context, regardless of user settings.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
    """
    import matplotlib as mpl

    settings: dict[Any, Any] = {**mpl.rcParamsDefault, "backend": mpl.rcParams["backend"], **STYLE}
    with mpl.rc_context(settings):
        yield


def new_figure(columns: Columns, height_in: float, title: str = "") -> "Figure":
    """Return an empty figure one or two columns wide; call it within `styled`.

    Args:
        columns: Width in page columns.
        height_in: Height in inches; event names add to it.
        title: Title above all panels, cut to the width.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTHS_IN[columns], height_in), layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        room = figure.bbox.width * 0.98
        lines = [fitted(figure, printable(line), room, 8.5) for line in title.split("\n")]
        # Do not parse file names and reasons as formulas.
        figure.suptitle("\n".join(lines), parse_math=False)
    return figure


def figure_of(panel: "Axes") -> "Figure":
    """Return the figure of a panel."""
    figure = panel.get_figure(root=True)
    assert figure is not None
    return figure


def text_width(figure: "Figure", text: str, size_pt: float = SMALL_PT) -> float:
    """Return the width of a text in figure pixels."""
    from matplotlib.text import Text

    drawn = Text(0.0, 0.0, text, fontsize=size_pt, parse_math=False)
    drawn.set_figure(figure)
    return float(drawn.get_window_extent(figure.canvas.get_renderer()).width)  # type: ignore[attr-defined]


def fitted(figure: "Figure", text: str, room: float, size_pt: float = SMALL_PT) -> str:
    """Return a text cut to a width in pixels, with an ellipsis."""
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
    """Format the left axis without an exponent, which would collide with the legend, with at most the given steps."""
    panel.locator_params(axis="y", nbins=most)
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:.6g}".replace("-", "\N{MINUS SIGN}"))


def letter(panels: "Sequence[Axes]") -> None:
    """Add letters a, b, c, ... outside the upper left corner of each panel."""
    for number, panel in enumerate(panels):
        name = LETTERS[number] if number < len(LETTERS) else str(number + 1)
        panel.annotate(name, (0.0, 1.0), (-5.0, 4.0), xycoords="axes fraction", textcoords="offset points",
                       ha="right", va="bottom", fontweight="bold", fontsize=8.5, gid="letter")  # fmt: skip


def check_columns(columns: int) -> None:
    """Refuse an invalid width.

    Raises:
        ValueError: Neither 1 nor 2.
    """
    if columns not in WIDTHS_IN:
        message = f"columns = {columns}: must be {' or '.join(map(str, WIDTHS_IN))}"
        raise ValueError(message)


def check_picture(path: Path) -> str:
    """Return the format for the suffix of a path.

    Raises:
        ValueError: The suffix is not .png, .pdf or .svg.
    """
    kind = path.suffix[1:].lower()
    if kind not in FORMATS:
        message = f"{path}: must end in {', '.join(f'.{name}' for name in FORMATS)}"
        raise ValueError(message)
    return kind


def written(figure: "Figure", path: str | PathLike[str] | None) -> "Figure":
    """Return the figure, and write it if a path is given.

    Raises:
        ValueError: The suffix is not .png, .pdf or .svg.
        OSError: The file cannot be written, or is a symbolic link.
    """
    if path is not None:
        write_figure(figure, Path(path))
    return figure


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of its suffix with mode 0600; the same figure gives the same bytes.

    Raises:
        ValueError: The suffix is not .png, .pdf or .svg.
        OSError: The file cannot be written, or is a symbolic link.
    """
    kind = check_picture(path)
    refuse_link(path)
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    with styled(), private_file(path) as file:
        figure.savefig(file, format=kind, metadata=metadata)
