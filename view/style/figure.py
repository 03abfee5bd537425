"""Figures one or two columns wide, with embeddable fonts, and their export."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from haptether.printable import printable
from haptether.private_file import private_file, refuse_link

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Columns: TypeAlias = Literal[1, 2]
PictureStyle: TypeAlias = Literal["screen", "paper"]
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

STYLES: dict[PictureStyle, dict[str, Any]] = {
    "screen": {},
    # STIX is a Times, which most venues set their text in, and comes with matplotlib.
    "paper": {
        "font.family": "STIXGeneral",
        "mathtext.fontset": "stix",
        "savefig.dpi": 600,
        "font.size": 8.5,
        "axes.labelsize": 8.5,
        "axes.titlesize": 8.5,
        "xtick.labelsize": 8.0,
        "ytick.labelsize": 8.0,
        "legend.fontsize": 8.0,
    },
}
"""Settings of each style beside `STYLE`. A paper has no title: its caption is in the text."""
_STYLE: ContextVar[PictureStyle] = ContextVar("style", default="screen")


@contextmanager
def picture_style(style: PictureStyle) -> Iterator[None]:
    """Draw and write all figures inside the context in a style: for a screen, or for a paper."""
    token = _STYLE.set(style)
    try:
        yield
    finally:
        _STYLE.reset(token)


@contextmanager
def styled() -> Iterator[None]:
    """Use the project's matplotlib style inside the context, regardless of user settings.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
    """
    import matplotlib as mpl

    style = STYLES[_STYLE.get()]
    settings: dict[Any, Any] = {**mpl.rcParamsDefault, "backend": mpl.rcParams["backend"], **STYLE, **style}
    with mpl.rc_context(settings):
        yield


def new_figure(columns: Columns, height_in: float, title: str = "") -> "Figure":
    """Return an empty figure one or two columns wide; call it within `styled`.

    Args:
        columns: Width in page columns.
        height_in: Height in inches; event names add to it.
        title: Title above all panels, cut to the width; a paper has none.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTHS_IN[columns], height_in), layout="constrained")
    FigureCanvasAgg(figure)
    if title and _STYLE.get() != "paper":
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


def small_pt() -> float:
    """Return the size of small text in points, in the current style."""
    import matplotlib as mpl

    return float(mpl.rcParams["legend.fontsize"])


def text_width(figure: "Figure", text: str, size_pt: float | None = None) -> float:
    """Return the width of a text in figure pixels; by default of small text."""
    from matplotlib.text import Text

    drawn = Text(0.0, 0.0, text, fontsize=size_pt or small_pt(), parse_math=False)
    drawn.set_figure(figure)
    return float(drawn.get_window_extent(figure.canvas.get_renderer()).width)  # type: ignore[attr-defined]


def fitted(figure: "Figure", text: str, room: float, size_pt: float | None = None) -> str:
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


LEAST_SPAN = 0.05
"""Smallest height of an axis as a fraction of its largest value."""


def plain_span(low: float, high: float) -> tuple[float, float]:
    """Return limits that draw a constant as one, not as rounding: at least `LEAST_SPAN` of the largest value apart."""
    largest = max(abs(low), abs(high))
    if largest < 1e-12:
        return 0.0, 1.0
    short = max(0.0, LEAST_SPAN * largest - (high - low))
    return low - 0.5 * short, high + 0.5 * short


def plain_ticks(panel: "Axes", most: int) -> None:
    """Format the left axis without an exponent, which would collide with the legend, with at most the given steps.

    The axis is at least `plain_span` of its lines high.
    """
    drawn = panel.dataLim.intervaly
    low, high = plain_span(*drawn)
    if high - low > drawn[1] - drawn[0] >= 0.0:
        margin = 0.08 * (high - low)
        panel.set_ylim(low - margin, high + margin)
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
