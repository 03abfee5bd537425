"""Page of an evaluation in HTML with its figure, or in Markdown: verdicts, numbers, assumptions."""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from haptether.studies.evaluation.figure import VERDICT_COLOURS, VERDICT_WORDS, draw_evaluation, trip_words, words_of
from haptether.studies.evaluation.result import Evaluation, EvaluationCell, Totals, totals
from haptether.view.style.colours import controller_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell: TypeAlias = "str | tuple[str, str]"
UNCONFIRMED = "unconfirmed"
"""Class of a safe but unconfirmed cell."""
MOST_NAMED = 3
"""Largest number of tasks named in a statement."""


class Table(Struct, frozen=True):
    """Table; a cell may have a verdict, or `UNCONFIRMED`, as its colour."""

    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


class Section(Struct, frozen=True):
    """Heading, text and a table."""

    title: str
    text: str = ""
    items: tuple[str, ...] = ()
    table: Table | None = None


def sections(found: Evaluation, worst: str | None) -> Iterator[Section]:
    """Yield the sections of the page."""
    limits = found.limits
    yield Section(
        "Which set-up is safe up to which round trip",
        f"Safe: in every task and network no release leaves the device faster than {limits.speed:g} m/s, the two are"
        f" coupled throughout, and all together have at most {limits.false_trips_per_h:g} false trips per hour held. A"
        " cell says the worst that happened there, and the largest speed after a release; not measured: nobody let go"
        f" where something can be felt. {confirmation(found)}",
        items=statements(found),
        table=_verdict_table(found, None),
    )
    if len(found.tasks) > 1:
        for task in found.tasks:
            yield Section(task, table=_verdict_table(found, task))
    yield Section(
        "Numbers",
        "All tasks together, of each its worst network. Dangerous: releases above the limit, here or where nobody"
        " watches; thrown: those above it here, with the 95 % interval of their share (Wilson 1927). False trips per"
        " hour held with the exact 95 % interval of a Poisson count. Speed: median of the largest after dangerous"
        " releases, with its distribution-free 95 % interval, a dash of fewer than six. Detection: median from where"
        " the grip begins to loosen. Already tripped: releases under an intervention, which are not counted."
        " Energy: largest that a hand that held was given over what it had put in.",
        table=numbers(found),
    )
    yield Section(
        "Transparency while hands hold",
        "Of the network that is worst: errors of position and force of the arm against the device (RMS); of the first"
        " network: what one hand that presses feels as K x + B V, by least squares; a dash where that does not fit.",
        table=_transparency(found),
    )
    yield Section("Worst releases", _worst_text(worst), table=_worst(found))
    yield Section("What was assumed", items=tuple(assumptions(found)))


def confirmation(found: Evaluation) -> str:
    """Return the text on confirmed cells."""
    cells = [
        found.of(controllers=name, round_trip_s=trip_s) for name in found.controllers for trip_s in found.round_trips_s
    ]
    safe = sum(found.verdict(of) == "safe" for of in cells)
    hatched = sum(len(found.unconfirmed(controllers)) for controllers in found.controllers)
    limits = found.limits
    return (
        f"Safe is confirmed where the 95 % intervals exclude more than {_percent(limits.thrown_share)} of releases"
        f" thrown and more than {limits.false_trips_per_h:g} false trips per hour; safe? is hatched, and has the hands"
        f" that it needs for that. Hatched: {hatched} of {safe} safe cells."
    )


def statements(found: Evaluation) -> tuple[str, ...]:
    """Return, for each controller set, the largest safe round trip as text."""
    return tuple(_statement(found, controllers) for controllers in found.controllers)


def verdict_rows(found: Evaluation) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Return head and rows of the verdict table over all tasks as text."""
    table = _verdict_table(found, None)
    return table.head, tuple(tuple(_text(cell) for cell in row) for row in table.rows)


def evaluation_markdown(found: Evaluation, *, command: str = "", worst: str | None = None) -> str:
    """Return the page as Markdown.

    Args:
        found: Evaluation to show.
        command: Command that produced it.
        worst: File name of the worst release; by default none is named.
    """
    return page_markdown(_title(found), made_by(found, command), sections(found, worst))


def page_markdown(title: str, made: str, parts_of: Iterable[Section]) -> str:
    """Return a page as Markdown."""
    parts = [f"# {_plain(title)}", _plain(made)]
    for section in parts_of:
        parts += [f"## {_plain(section.title)}", _plain(section.text)]
        if section.items:
            parts.append("\n".join(f"- {_plain(item)}" for item in section.items))
        if section.table is not None:
            parts.append(_markdown_table(section.table))
    return "\n\n".join(part for part in parts if part) + "\n"


def evaluation_html(found: Evaluation, *, command: str = "", worst: str | None = None) -> str:
    """Return the page as one self-contained HTML file; arguments of `evaluation_markdown`.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
    """
    return page_html(_title(found), made_by(found, command), sections(found, worst), draw_evaluation(found))


def page_html(title: str, made: str, parts_of: Iterable[Section], figure: "Figure") -> str:
    """Return a page as one self-contained HTML file, with the figure below its first section."""
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    picture = drawn.getvalue()
    picture = picture[picture.index("<svg") :]
    body = [f"<h1>{escape(title)}</h1>", f"<p class=made>{escape(made)}</p>"]
    for place, section in enumerate(parts_of):
        body.append(f"<h2>{escape(section.title)}</h2>")
        if section.text:
            body.append(f"<p>{escape(section.text)}</p>")
        if section.items:
            body.append("<ul>" + "".join(f"<li>{escape(item)}</li>" for item in section.items) + "</ul>")
        if section.table is not None:
            body.append(_html_table(section.table))
        if place == 0:
            body.append(f"<figure>{picture}</figure>")
    colours = "".join(f".{verdict}{{background:{colour}}}" for verdict, colour in VERDICT_COLOURS.items())
    green = VERDICT_COLOURS["safe"]
    colours += f".{UNCONFIRMED}{{background:repeating-linear-gradient(135deg,{green} 0 7px,#fff 7px 10px)}}"
    return (
        "<!doctype html>\n<html lang=en><head><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{escape(title)}</title><style>{STYLE}{colours}</style></head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;color:#1c2733;background:#fff}"
    "body{max-width:76em;margin:2em auto;padding:0 1em}"
    "h1{font-size:1.5em}h2{font-size:1.15em;margin:2em 0 .5em}.made{color:#5b6875}"
    "div.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85em}"
    "th,td{padding:.3em .6em;border:1px solid #d5dae0;text-align:right;white-space:nowrap}"
    "th{background:#f3f5f7;white-space:normal;vertical-align:bottom}th:first-child,td:first-child{text-align:left}"
    "figure{margin:1.5em 0}svg{width:100%;height:auto}"
)


def _title(found: Evaluation) -> str:
    return f"Safety under delay: {', '.join(found.tasks)}"


def made_by(found: Evaluation, command: str) -> str:
    """Return command, version, seed and numbers of hands and releases as text."""
    by = f"{command}; " if command else ""
    return f"{by}Haptether {found.version}, seed {found.seed}, {found.hands} hands, {found.releases} times of release."


def _statement(found: Evaluation, controllers: str) -> str:
    """Return the largest safe round trip of a controller set, and the reason for its end."""
    safe_s, unthrown_s = found.safe_up_to_s(controllers), found.unthrown_up_to_s(controllers)
    parts = [_up_to("safe", safe_s)]
    if unthrown_s != safe_s:
        parts.append(_up_to("throws nobody", unthrown_s))
    if unthrown_s is not None:
        counted = totals(found.of(controllers=controllers, round_trip_s=unthrown_s))
        if (share := counted.thrown_share) is not None:
            parts[-1] += (
                f" (0 of {counted.dangerous} dangerous releases; at most {_percent(share[2])} with 95 % confidence)"
            )
    said = f"{controller_title(controllers)}: {', '.join(parts)}."
    beyond = [trip_s for trip_s in sorted(found.round_trips_s) if safe_s is None or trip_s > safe_s]
    if not beyond:
        return f"{said} No longer one was tried.{_confirmed(found, controllers)}"
    cells = list(found.of(controllers=controllers, round_trip_s=beyond[0]))
    verdict = found.verdict(cells)
    where = {
        f"{cell.task} ({cell.network})": None
        for cell in cells
        if (cell.releases == 0 if verdict == "not-measured" else cell.verdict(found.limits) == verdict)
    }
    ending = f"At {beyond[0] * 1e3:g} ms: {VERDICT_WORDS[verdict]}, in {', '.join(list(where)[:MOST_NAMED])}."
    return f"{said} {ending}{_confirmed(found, controllers)}"


def _confirmed(found: Evaluation, controllers: str) -> str:
    """Return the largest confirmed round trip of a controller set, if smaller than the safe one."""
    safe_s, confirmed_s = found.safe_up_to_s(controllers), found.confirmed_up_to_s(controllers)
    if safe_s is None or confirmed_s == safe_s:
        return ""
    trips = [trip_s for trip_s in found.unconfirmed(controllers) if trip_s <= safe_s]
    needed = max(found.hands_needed(found.of(controllers=controllers, round_trip_s=trip_s)) for trip_s in trips)
    return f" {_up_to('Confirmed', confirmed_s)}; {needed} hands of which none is thrown would confirm the rest."


def _up_to(what: str, round_trip_s: float | None) -> str:
    return f"{what} at none of these round trips" if round_trip_s is None else f"{what} up to {round_trip_s * 1e3:g} ms"


def _verdict_table(found: Evaluation, task: str | None) -> Table:
    rows = []
    for controllers in found.controllers:
        cells: list[Cell] = [controller_title(controllers)]
        for round_trip_s in found.round_trips_s:
            of = found.of(task=task, controllers=controllers, round_trip_s=round_trip_s)
            words, speed = words_of(found, of), totals(of).max_speed
            said = words + ("" if speed is None else f", {speed:.2f} m/s")
            cells.append((said, UNCONFIRMED if words.startswith("safe?") else found.verdict(of)))
        cells.append(str(len(found.unconfirmed(controllers, task))))
        rows.append(tuple(cells))
    trips = (" ".join(trip_words(found, trip_s)) for trip_s in found.round_trips_s)
    return Table(("controllers", *trips, "hatched"), tuple(rows))


def numbers(found: Evaluation) -> Table:
    """Return counts, speeds and rates of each controller set at each round trip."""
    head = (
        "controllers", "round trip", "held", "false trips/h", "under intervention", "dangerous", "thrown",
        "already tripped", "speed [m/s]", "detection [ms]", "undetected", "peak force [N]", "energy [J]",
    )  # fmt: skip
    rows = []
    for controllers in found.controllers:
        for round_trip_s in found.round_trips_s:
            cells = found.of(controllers=controllers, round_trip_s=round_trip_s)
            counted = totals(cells)
            rate, share = counted.false_trips_per_h, counted.thrown_share
            rows.append(
                (
                    controller_title(controllers),
                    f"{round_trip_s * 1e3:g} ms",
                    f"{counted.hours * 3600.0:.0f} s",
                    "-" if rate is None else f"{rate[0]:.0f} ({rate[1]:.0f} to {rate[2]:.0f})",
                    _percent(_mean(cells, "intervention_share")),
                    f"{counted.dangerous} of {counted.releases}",
                    "-" if share is None else f"{counted.thrown} ({100.0 * share[1]:.0f} to {100.0 * share[2]:.0f} %)",
                    str(counted.already_tripped),
                    _with_interval(counted),
                    _number(counted.detection_s, 1e3, ".0f"),
                    str(counted.undetected),
                    _number(_most(cells, "peak_force_n"), 1.0, ".2f"),
                    _number(_most(cells, "energy_j"), 1.0, ".3f"),
                )
            )
    return Table(head, tuple(rows))


def _transparency(found: Evaluation) -> Table:
    head = ("task", "controllers", "round trip", "position [mm]", "force [N]", "K [N/m]", "B [N s/m]")
    rows = []
    for task in found.tasks:
        for controllers in found.controllers:
            for round_trip_s in found.round_trips_s:
                cells = found.of(task=task, controllers=controllers, round_trip_s=round_trip_s)
                first = cells[0] if cells else None
                rows.append(
                    (
                        task,
                        controller_title(controllers),
                        f"{round_trip_s * 1e3:g} ms",
                        _number(_most(cells, "position_rmse_m"), 1e3, ".2f"),
                        _number(_most(cells, "force_rmse_n"), 1.0, ".2f"),
                        _number(None if first is None else first.stiffness, 1.0, ".0f"),
                        _number(None if first is None else first.damping, 1.0, ".1f"),
                    )
                )
    return Table(head, tuple(rows))


def _worst_text(worst: str | None) -> str:
    kept = f" {worst} has the fastest under a controller as a scene: haptether simulate {worst}." if worst else ""
    return f"The release after which the device was fastest, of each set of controllers.{kept}"


def _worst(found: Evaluation) -> Table:
    head = ("controllers", "speed [m/s]", "task", "round trip", "network")
    rows = tuple(
        (
            controller_title(release.controllers),
            f"{release.speed:.3f}",
            release.task,
            f"{release.round_trip_s * 1e3:g} ms",
            release.network,
        )
        for release in found.worst
    )
    return Table(head, rows)


def assumptions(found: Evaluation) -> Iterator[str]:
    """Yield what was assumed about hands, releases and networks."""
    yield (
        "Hands are impedances with a path and a tremor, drawn at random; people were not measured. Strokes are made to"
        " be hard, so rates compare set-ups, and do not say what a day's work has."
    )
    yield (
        "A hand lets go while it feels more than half of the largest force that it feels where nobody watches, a torque"
        " as that over the lever; its grip gives way within 50 ms. A finger on a trigger does not let go."
    )
    yield "Device, arm, coupling, estimator, limits and release law are those of the scenes."
    yield from found.assumed
    for network in found.networks:
        parts = ["delay alone"] if not network.jitter and not network.loss else []
        if network.jitter:
            parts.append(f"jitter of {100.0 * network.jitter:g} % of the delay (gamma, 0.1 s)")
        if network.loss:
            parts.append(f"{100.0 * network.loss:g} % lost, {network.mean_burst:g} at once in the mean")
        if network.own_delay_s is not None:
            forward_ms, backward_ms = (1e3 * delay_s for delay_s in network.own_delay_s)
            yield (
                f"Network {network.name}: {network.title}: {forward_ms:.4g} ms there and {backward_ms:.4g} ms back in"
                " the mean, whatever the round trips that are asked for."
            )
            continue
        yield f"Network {network.name}: {', '.join(parts)}, each direction half of the round trip."
    yield "A scene without an arm has no network: what it renders is late by the round trip."


def _with_interval(counted: Totals) -> str:
    if counted.speed is None:
        return "-"
    interval = counted.speed_interval
    return f"{counted.speed:.2f} ({'-' if interval is None else f'{interval[0]:.2f} to {interval[1]:.2f}'})"


def _known(cells: Sequence[EvaluationCell], name: str) -> list[float]:
    return [value for cell in cells if (value := getattr(cell, name)) is not None]


def _most(cells: Sequence[EvaluationCell], name: str) -> float | None:
    return max(_known(cells, name), default=None)


def _mean(cells: Sequence[EvaluationCell], name: str) -> float | None:
    known = _known(cells, name)
    return sum(known) / len(known) if known else None


def _number(value: float | None, scale: float, form: str) -> str:
    return "-" if value is None else f"{value * scale:{form}}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.3g} %"


def _text(cell: Cell) -> str:
    return cell if isinstance(cell, str) else cell[0]


def _plain(text: str) -> str:
    """Escape HTML, links and code of Markdown, on one line."""
    return re.sub(r"[\\`*\[\]]", r"\\\g<0>", escape(" ".join(text.split()), quote=False))


def _markdown_table(table: Table) -> str:
    def line(cells: Iterable[Cell]) -> str:
        return f"| {' | '.join(_plain(_text(cell)).replace('|', '/') for cell in cells)} |"

    return "\n".join([line(table.head), f"|---{'|---:' * (len(table.head) - 1)}|", *map(line, table.rows)])


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in table.head)
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td>{escape(cell)}</td>" if isinstance(cell, str) else f"<td class={cell[1]}>{escape(cell[0])}</td>"
            for cell in row
        )
        + "</tr>"
        for row in table.rows
    )
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
