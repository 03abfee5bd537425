"""Figure of couplings: felt force over the round trip for each network, and throws and false trips by controllers."""

from os import PathLike
from typing import TYPE_CHECKING

from haptether.studies.evaluation.figure import VERDICT_COLOURS
from haptether.studies.evaluation.matrix.measure import CouplingMatrix, PairCell
from haptether.studies.evaluation.result import totals
from haptether.view.style.colours import controller_title
from haptether.view.style.figure import Columns, figure_of, letter, new_figure, small_pt, styled, text_width, written

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Filled = tuple[str, str]
"""Text and colour of a cell."""
OUTCOME_COLOURS = {
    "diverged": VERDICT_COLOURS["diverged"],
    "swings": VERDICT_COLOURS["thrown"],
    "saturated": VERDICT_COLOURS["thrown"],
    "slack": VERDICT_COLOURS["uncoupled"],
    "held": VERDICT_COLOURS["not-engaged"],
}
"""Colours of presses that do not rest, the worst first; those that rest are blue, the darker the more is felt."""
NOTHING = ("-", "#ffffff")
WHITE, BLUE = (255, 255, 255), (96, 165, 217)
ROW_IN, AXIS_IN = 0.19, 0.5
"""Height in inches of a row of cells, and of the axis below a panel."""


def draw_couplings(found: CouplingMatrix, path: str | PathLike[str] | None = None, columns: Columns = 2) -> "Figure":
    """Draw the felt share of each coupling over the round trip for each network, and its throws by controllers.

    Args:
        found: Matrix to draw.
        path: Target picture, .png, .pdf or .svg; None writes no file.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The picture has another suffix.
        OSError: The file cannot be written, or is a symbolic link.
    """
    with styled():
        beside = min(columns, len(found.networks))
        names = [network.name for network in found.networks]
        mosaic = [names[at : at + beside] for at in range(0, len(names), beside)]
        mosaic[-1] += mosaic[-1][-1:] * (beside - len(mosaic[-1]))
        if found.evaluations:
            mosaic.append(["controllers"] * beside)
        height = len(mosaic) * (ROW_IN * len(found.couplings) + AXIS_IN) + 0.2
        figure = new_figure(
            columns, height, f"Couplings in {found.task}: share of a rigid tool's force, pressed on {found.on_wall}"
        )
        panels = figure.subplot_mosaic([[str(name) for name in row] for row in mosaic])
        maps = {
            name: [
                [_felt(found.of(coupling, trip_s, name)) for trip_s in found.round_trips_s]
                for coupling in found.couplings
            ]
            for name in names
        }
        trips = [f"{round_trip_s * 1e3:g}" for round_trip_s in found.round_trips_s]
        for name in names:
            _map(panels[name], maps[name], trips, f"round trip [ms], {name}: force at rest [%]")
        if found.evaluations:
            controllers = next(iter(found.evaluations.values())).controllers
            maps["controllers"] = [[_thrown(found, name, of) for of in controllers] for name in found.couplings]
            label = "round trip up to which no release throws [ms]; most false trips per hour held"
            _map(panels["controllers"], maps["controllers"], [controller_title(of) for of in controllers], label)
        for row in mosaic:
            for place, name in enumerate(row):
                named = found.couplings if place == 0 else [""] * len(found.couplings)
                if row.index(name) == place:
                    panels[name].set_yticks(range(len(named)), named)
        # The layout is known from here on.
        figure.draw_without_rendering()
        for name, cells in maps.items():
            _write(panels[name], cells)
        letter([*panels.values()])
    return written(figure, path)


def felt_words(cells: "Sequence[PairCell]") -> str:
    """Return the least felt share of cells, or why it is unknown, as text."""
    outcomes = [cell.outcome for cell in cells]
    if worst := [outcome for outcome in OUTCOME_COLOURS if outcome in outcomes]:
        return worst[0]
    if not cells:
        return "-"
    return f"{100.0 * min(cell.felt.value for cell in cells if cell.felt is not None):.0f} %"


def controller_words(found: CouplingMatrix, coupling: str, controllers: str) -> str:
    """Return the round trip up to which no release throws, and the highest rate of false trips, as text."""
    evaluation = found.evaluations.get(coupling)
    if evaluation is None:
        return "-"
    reached = evaluation.unthrown_up_to_s(controllers)
    rates = [
        rate[0]
        for trip_s in evaluation.round_trips_s
        if (rate := totals(evaluation.of(controllers=controllers, round_trip_s=trip_s)).false_trips_per_h)
    ]
    up_to = "thrown" if reached is None else f"{reached * 1e3:g} ms"
    return f"{up_to}, {max(rates):.0f} /h" if rates else up_to


def _felt(cells: "Sequence[PairCell]") -> Filled:
    words = felt_words(cells)
    if not words.endswith("%"):
        return words, OUTCOME_COLOURS.get(words, "#ffffff")
    return words.removesuffix(" %"), shade(float(words[:-2]) / 100.0)


def _thrown(found: CouplingMatrix, coupling: str, controllers: str) -> Filled:
    words = controller_words(found, coupling, controllers).replace(" ms", "").replace(" /h", "")
    if words == "-":
        return NOTHING
    if words.startswith("thrown"):
        return words, VERDICT_COLOURS["thrown"]
    reached = found.evaluations[coupling].unthrown_up_to_s(controllers)
    passed = [trip_s for trip_s in found.round_trips_s if reached is not None and trip_s <= reached]
    return words, shade(len(passed) / len(found.round_trips_s))


def shade(share: float) -> str:
    """Return the colour of a share from 0, white, to 1."""
    share = min(1.0, max(0.0, share))
    return "#" + "".join(
        f"{round(light + share * (dark - light)):02x}" for light, dark in zip(WHITE, BLUE, strict=True)
    )


def _map(panel: "Axes", cells: "Sequence[Sequence[Filled]]", columns: "Sequence[str]", label: str) -> None:
    """Draw the colours of a map."""
    from matplotlib.patches import Rectangle

    panel.grid(visible=False)
    for place, row in enumerate(cells):
        for column, (_, colour) in enumerate(row):
            panel.add_patch(Rectangle((column - 0.5, place - 0.5), 1.0, 1.0, fc=colour, ec="white"))
    panel.set_xlim(-0.5, len(columns) - 0.5)
    panel.set_ylim(len(cells) - 0.5, -0.5)
    panel.set_xticks(range(len(columns)), columns)
    panel.tick_params(length=0.0)
    panel.set_xlabel(label)


def _write(panel: "Axes", cells: "Sequence[Sequence[Filled]]") -> None:
    """Write the texts of a map, small enough for the cells."""
    figure = figure_of(panel)
    room = panel.get_window_extent().width / len(cells[0])
    widest = max(text_width(figure, words) for row in cells for words, _ in row)
    size = small_pt() * min(1.0, 0.92 * room / widest)
    for place, row in enumerate(cells):
        for column, (words, _) in enumerate(row):
            panel.text(column, place, words, ha="center", va="center_baseline", fontsize=size)
