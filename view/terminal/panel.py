"""Terminal panel of a live side."""

import io
from collections.abc import Iterable

from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from haptether.printable import printable
from haptether.view.terminal.state import Observer, SideState

STATES = {
    "disengaged": "bold",
    "aligning": "bold yellow",
    "engaged": "bold green",
    "stale": "bold yellow",
    "hold": "bold red",
    "stop": "bold red",
    "fault": "bold red",
}
"""Style of each ladder state."""
SIGNALS = {("master", "press"): "USR1", ("master", "acknowledge"): "USR2", ("slave", "acknowledge"): "USR2"}
"""Signal for `kill` that performs a remedy at its side."""
BAR = 20
"""Bar length in characters from zero to the threshold."""
EIGHTHS = " ▏▎▍▌▋▊▉"
EVENTS = 5
"""Latest events shown."""
MARGIN = "damping B over the least that is passive"
LEFT = "energy that the coupling may give [J]"
FORCES = {
    "rendered_force": "requested F_v",
    "safety_force": "of the controllers F_c",
    "device_force": "exerted F_device",
    "grasp_force": "of the hand F_h, estimated",
    "environment_force": "on the tool F_e",
    "rendered_torque": "requested, torque",
    "safety_torque": "of the controllers, torque",
    "device_torque": "exerted, torque",
    "environment_torque": "on the tool, torque",
}
"""Vectors shown with their largest magnitude of the last second, in N and N m."""
PLACES = {
    "position": ("position", "m"),
    "velocity": ("velocity", "m/s"),
    "command": ("commanded", "m"),
    "angular_velocity": ("turning", "rad/s"),
}
TIMES = {"round_trip_s": "round trip", "age_s": "age of the newest frame", "overshoot_s": "loop late"}
AXES = 3
"""Largest number of axes on one line; otherwise the norm is shown."""


def panel(state: SideState, width: int = 80, height: int | None = None) -> RenderableType:
    """Return all known data of a side in `width` columns.

    Without spacing and events if they do not fit into `height` lines; None for any height.
    """
    whole = _panel(state, width, is_short=False)
    if height is None:
        return whole
    lines = Console(width=width, file=io.StringIO()).render_lines(whole)
    return whole if len(lines) < height else _panel(state, width, is_short=True)


def _panel(state: SideState, width: int, *, is_short: bool) -> Panel:
    room = [] if is_short else [Text("")]
    parts: list[RenderableType] = [_headline(state)]
    if state.cause is not None:
        parts += _cause(state)
    parts.append(_values(state))
    observers = state.observers()
    if observers:
        parts += [*room, _observers(observers, held=state.is_held())]
    parts += [*room, _loop(state)]
    if state.events and not is_short:
        parts += [*room, *_events(state)]
    title = f"{state.side}, Haptether {state.hello.version}".rstrip()
    return Panel(Group(*parts), title=Text(title), title_align="left", border_style=_style(state), width=width)


def headline(state: SideState) -> str:
    """Return the state of a side in one line."""
    clutch = {True: "clutch closed", False: "clutch open"}.get(state.last("clutch"), "")
    peer = state.last("peer_state")
    other = "slave" if state.side == "master" else "master"
    parts = [str(state.last("state") or "no sample yet").upper(), clutch, f"{other}: {peer or 'not heard'}"]
    reason = state.last("reason")
    if reason:
        parts.insert(1, str(reason))
    return "  ".join(part for part in parts if part)


def _style(state: SideState) -> str:
    return STATES.get(str(state.last("state")), "bold").removeprefix("bold").strip() or "none"


def _headline(state: SideState) -> Text:
    name = str(state.last("state") or "no sample yet").upper()
    text = Text(name, style=STATES.get(name.lower(), "bold"))
    text.append(printable(headline(state)).removeprefix(name))
    text.append(f"  {state.time_s:.1f} s", style="dim")
    if state.hello.security != "secure":
        text.append("\nINSECURE: frames are in plain sight", style="bold red")
    return text


def _cause(state: SideState) -> list[RenderableType]:
    assert state.cause is not None
    lines = [Text(printable(f"{state.cause.at}: {state.cause.text}"), style="red")]
    for number, step in enumerate(state.cause.steps, start=1):
        signal = SIGNALS.get((step.at, step.remedy))
        lines.append(Text(printable(f"  {number}. {step.text}")))
        if signal is not None:
            is_here = step.at == state.side
            process = state.hello.process if is_here and state.hello.process else "PID"
            # On a separate line, for copying.
            lines.append(Text(f"     {'here' if is_here else 'there'}: kill -{signal} {process}", style="bold"))
    return list(lines)


def _values(state: SideState) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column(justify="right", no_wrap=True)
    table.add_column(justify="right", no_wrap=True, style="dim")
    for name, (label, unit) in PLACES.items():
        values = state.last(name)
        if values is not None:
            # Joint coordinates are angles.
            shown = unit if _is_linear(state) else unit.replace("m", "rad")
            # As text, because Rich would parse [m] as a style.
            table.add_row(Text(f"{label} [{shown}]"), _vector(state, name, 4), "")
    for name, label in FORCES.items():
        peak = state.peak(name)
        if state.last(name) is None or (peak == 0.0 and name.startswith(("safety", "grasp"))):
            continue
        unit = "N" if name.endswith("force") and _is_linear(state) else "N m"
        table.add_row(Text(f"{label} [{unit}]"), _vector(state, name, 2), "" if peak is None else f"1 s: {peak:.2f}")
    if (put := state.last("port_in_j")) is not None and (drawn := state.last("port_out_j")) is not None:
        table.add_row(Text("energy in, out [J]"), f"{put:.3f}, {drawn:.3f}", "")
    if (left := state.last("left_j")) is not None:
        table.add_row(Text(LEFT), Text(f"{left:.4f}", style="" if left >= 0.0 else "bold red"), "")
    if (margin := state.passivity_margin()) is not None:
        table.add_row(Text(MARGIN), Text(f"{margin:.2f}", style="" if margin > 1.0 else "bold red"), "")
    if outliers := state.last("outliers"):
        table.add_row(Text("samples replaced"), f"{outliers}", "")
    if (renewal := state.last("renewal")) is not None:
        table.add_row(Text("ticks with a new sample [%]"), f"{100.0 * renewal:.0f}", "")
    for name, label in (("trigger", "trigger"), ("gripper", "gripper"), ("gripper_force", "gripper force [N]")):
        value = state.last(name)
        if value is not None:
            grips = ", holds something" if name == "gripper" and state.last("holds_object") else ""
            table.add_row(Text(label), f"{value:.2f}{grips}", "")
    return table


def _is_linear(state: SideState) -> bool:
    return ((state.hello.scene or {}).get("master") or {}).get("kind") != "joints"


def _vector(state: SideState, name: str, digits: int) -> str:
    values = state.last(name)
    if len(values) > AXES:
        norm = state.norm(name)
        return "-" if norm is None else f"|.| {norm:.{digits}f}"
    return "  ".join("-" if value is None else f"{value:+.{digits}f}" for value in values)


def _observers(observers: Iterable[Observer], *, held: bool) -> Table:
    table = Table.grid(padding=(0, 2))
    for _ in range(5):
        table.add_column(no_wrap=True)
    for one in observers:
        value = "-" if one.value is None else f"{one.value:.3g}"
        threshold = "" if one.threshold is None else f"{'>' if one.trips_above else '<'} {one.threshold:g}"
        name = Text(one.controller.upper(), style="bold")
        marks = Text("TRIPPED", style="bold red") if one.tripped else Text("armed", style="green")
        table.add_row(name, Text(f"{one.symbol} = {value}"), _bar(one.share), Text(threshold), marks)
    if held:
        table.add_row(Text(""), Text("an intervention is held on"), Text(""), Text(""), Text(""))
    return table


def _bar(share: float | None) -> Text:
    """Return a bar of the worst value of the last second relative to the threshold."""
    if share is None:
        return Text("")
    eighths = round(min(share, 1.0) * BAR * 8)
    full = "█" * (eighths // 8) + (EIGHTHS[eighths % 8] if eighths % 8 else "")
    style = "red" if share >= 1.0 else "yellow" if share >= 0.5 else "green"
    return Text.assemble((full.ljust(BAR), style), "│")


def _loop(state: SideState) -> Table:
    table = Table.grid(padding=(0, 2))
    for _ in range(3):
        table.add_column(no_wrap=True)
    for name, label in TIMES.items():
        value, worst = state.last(name), state.peak(name)
        if value is not None and worst is not None:
            table.add_row(Text(f"{label} [ms]"), f"{value * 1e3:.2f}", Text(f"1 s: {worst * 1e3:.2f}", style="dim"))
    if (loss := state.loss()) is not None:
        table.add_row(Text("frames lost [%]"), f"{loss * 100:.1f}", Text(_counts(state), style="dim"))
    if state.last("fault"):
        table.add_row("fault code", str(state.last("fault")), "")
    if state.dropped or state.lost_ticks:
        table.add_row("ticks not seen here", str(state.dropped + state.lost_ticks), "")
    if state.invalid:
        said = Text(printable(state.invalid_text), style="red", overflow="ellipsis")
        table.add_row(Text("invalid telemetry", style="red"), str(state.invalid), said)
    return table


def _counts(state: SideState) -> str:
    link = state.link
    return "" if link is None else f"run: {link.missing} of {link.missing + link.fresh + link.late}"


def _events(state: SideState) -> list[Text]:
    return [
        Text(f"{time_s:9.3f}  {printable(text)}", style="dim", overflow="ellipsis", no_wrap=True)
        for time_s, text in list(state.events)[-EVENTS:]
    ]
