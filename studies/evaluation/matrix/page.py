"""Page of couplings by controllers and networks, in HTML with its figure or in Markdown."""

from collections.abc import Iterator

from haptether.studies.evaluation.matrix.figure import controller_words, draw_couplings, felt_words
from haptether.studies.evaluation.matrix.measure import CouplingMatrix, Median, PairCell
from haptether.studies.evaluation.page import (
    Cell,
    Section,
    Table,
    assumptions,
    made_by,
    numbers,
    page_html,
    page_markdown,
)
from haptether.view.style.colours import controller_title


def couplings_html(found: CouplingMatrix, *, command: str = "") -> str:
    """Return the page as one self-contained HTML file.

    Args:
        found: Matrix to show.
        command: Command that produced it.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
    """
    return page_html(_title(found), _made(found, command), sections(found), draw_couplings(found))


def couplings_markdown(found: CouplingMatrix, *, command: str = "") -> str:
    """Return the page as Markdown; arguments of `couplings_html`."""
    return page_markdown(_title(found), _made(found, command), sections(found))


def sections(found: CouplingMatrix) -> Iterator[Section]:
    """Yield the sections of the page."""
    of_hands = bool(found.evaluations)
    yield Section(
        "Which coupling over which round trip",
        f"A hand presses the pair on a wall of {found.on_wall}, holds, withdraws and lets go, without a controller,"
        " with gains for pair and network. A cell has the force at rest as a share of that of a rigid tool, of its"
        " worst network. Other cells swing, diverged, are saturated (the cap or a stop acts), are slack (the arm does"
        " not follow) or are held: the ladder interrupts every press. Presses that it interrupts do not count"
        " otherwise.",
        items=tuple(statements(found)),
        table=felt_table(found),
    )
    if of_hands:
        yield Section(
            "Couplings by controllers",
            "Many hands do the task. A cell has the largest round trip up to which no release throws the device, and"
            " the highest rate of false trips per hour held of all round trips, each on its worst network.",
            table=controller_table(found),
        )
    yield Section(
        "Presses",
        "Medians over seeds of the network with distribution-free 95 % intervals; a network without jitter and loss"
        " needs one seed. Held: runs that the ladder interrupts. Behind: distance of the arm behind the hand at rest in"
        " contact. Drift: distance between hand and arm at rest after the contact. Dissipated: energy that a stroke"
        " into the wall and back takes from the hand; below 0 the hand gets it. Thrown: largest speed after the hand"
        " lets go. Stable up to:"
        " largest round trip at which the loop with these gains is stable; a dash if it is at 1 s, too.",
        table=_presses(found),
    )
    if of_hands:
        yield Section(
            "Hands",
            "Of each its worst network. False trips per hour held with the exact 95 % interval of a Poisson count."
            " Speed: median of the largest after dangerous releases, the maximum ejection velocity, with its"
            " distribution-free 95 % interval, a dash of fewer than six. Thrown: with the 95 % interval of the share.",
            table=_hands(found),
        )
    yield Section("What was assumed", items=tuple(_assumptions(found)))


def statements(found: CouplingMatrix) -> Iterator[str]:
    """Yield the largest round trip at which each coupling rests, and the first event beyond it, as text."""
    for coupling in found.couplings:
        rests_s = found.rests_up_to_s(coupling)
        said = "rests at none of these round trips" if rests_s is None else f"rests up to {rests_s * 1e3:g} ms"
        beyond = next(
            (cell for cell in found.of(coupling) if cell.outcome != "rests" and cell.round_trip_s > (rests_s or -1.0)),
            None,
        )
        if beyond is not None:
            said += f"; at {beyond.round_trip_s * 1e3:g} ms, {beyond.network}: {beyond.outcome}"
        yield f"{coupling}: {said}."


def felt_table(found: CouplingMatrix) -> Table:
    """Return the felt share of each coupling at each round trip, of its worst network."""
    rows = []
    for coupling in found.couplings:
        cells: list[Cell] = [coupling]
        for round_trip_s in found.round_trips_s:
            words = felt_words(found.of(coupling, round_trip_s))
            cells.append(words if words.endswith("%") else (words, CLASSES.get(words, "not-measured")))
        rows.append(tuple(cells))
    return Table(("coupling", *(f"{round_trip_s * 1e3:g} ms" for round_trip_s in found.round_trips_s)), tuple(rows))


CLASSES = {
    "diverged": "diverged", "swings": "thrown", "saturated": "thrown", "slack": "uncoupled", "held": "not-engaged"
}  # fmt: skip
"""Colour of an outcome as that of a verdict."""


def controller_table(found: CouplingMatrix) -> Table:
    """Return throws and false trips of each coupling under each controller set."""
    controllers = next(iter(found.evaluations.values())).controllers
    rows = []
    for coupling in found.couplings:
        words = [controller_words(found, coupling, of) for of in controllers]
        rows.append((coupling, *((said, "thrown") if said.startswith("thrown") else said for said in words)))
    return Table(("coupling", *map(controller_title, controllers)), tuple(rows))


def _presses(found: CouplingMatrix) -> Table:
    length = "mrad" if found.unit == "rad" else "mm"
    head = (
        "coupling", "round trip", "network", "outcome", "held", "force [%]", f"behind [{length}]", f"drift [{length}]",
        "dissipated [mJ]", f"thrown [{found.unit}/s]", "stable up to", "gains",
    )  # fmt: skip
    return Table(head, tuple(_press_row(cell) for cell in found.pairs))


def _press_row(cell: PairCell) -> tuple[Cell, ...]:
    return (
        cell.coupling,
        f"{cell.round_trip_s * 1e3:g} ms",
        cell.network,
        cell.outcome if cell.outcome == "rests" else (cell.outcome, CLASSES[cell.outcome]),
        f"{cell.held} of {cell.runs}",
        _number(cell.felt, 100.0),
        _number(cell.behind_m, 1e3),
        _number(cell.drift_m, 1e3),
        _number(cell.dissipated_j, 1e3),
        _number(cell.thrown, 1.0),
        "-" if cell.stable_up_to_s is None else f"{cell.stable_up_to_s * 1e3:.3g} ms",
        ", ".join(change.removeprefix("coupling.") for change in cell.changes[1:]) or "-",
    )


def _number(measured: Median | None, scale: float) -> str:
    if measured is None:
        return "-"
    value = f"{measured.value * scale:.3g}"
    if measured.interval is None:
        return value
    low, high = (f"{end * scale:.3g}" for end in measured.interval)
    return value if low == high == value else f"{value} ({low} to {high})"


def _hands(found: CouplingMatrix) -> Table:
    tables = {coupling: numbers(evaluation) for coupling, evaluation in found.evaluations.items()}
    head = next(iter(tables.values())).head
    return Table(("coupling", *head), tuple((name, *row) for name, table in tables.items() for row in table.rows))


def _assumptions(found: CouplingMatrix) -> Iterator[str]:
    yield (
        "Gains are those that check advises for pair and network, else four times the defaults, scaled with the mass of"
        " the device and halved up to four times until press and stroke rest."
    )
    yield from found.refused
    evaluations = [*found.evaluations.values()]
    yield from dict.fromkeys(text for evaluation in evaluations for text in assumptions(evaluation))


def _title(found: CouplingMatrix) -> str:
    return f"Couplings by controllers and networks: {found.task}"


def _made(found: CouplingMatrix, command: str) -> str:
    evaluation = next(iter(found.evaluations.values()), None)
    return command if evaluation is None else made_by(evaluation, command)
