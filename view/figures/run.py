"""Figure of a run: motion, forces, rotation, ladder and interventions over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from haptether import _core
from haptether.view.figures.events import RunEvent, merged_events
from haptether.view.figures.rotation import angle_apart, angle_from_first
from haptether.view.style.colours import AXES, CONTROLLERS, HELD, SIGNALS, controller_look
from haptether.view.style.events import EventMark, name_events
from haptether.view.style.figure import Columns, letter, new_figure, plain_ticks, styled
from haptether.view.style.legend import legend_above
from haptether.view.style.series import envelope

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]
Recorded = Mapping[str, npt.NDArray[Any]]

LADDER = ["apart", *_core.LADDER_STATES[1:]]
"""Ladder states by code; readers know "disengaged" as "apart"."""
TRIPPED = {bit: name for name, bit in _core.TRIP_BITS}
"""Controllers by bit."""
NOTHING = 2e-3
"""Components below this fraction of the largest axis are not drawn."""
PANEL_IN = 0.95
"""Height of a panel of curves in inches."""
DASHES = ("-", "--", "-.")


class DrawnRun(Protocol):
    """Interface of a drawn run, satisfied by `haptether.Run`."""

    @property
    def scene(self) -> str:
        """Name of the scene."""

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""

    @property
    def signals(self) -> Recorded:
        """Signals by name; slave signals use `slave_time_s` if present."""

    @property
    def events(self) -> Sequence[RunEvent]:
        """Events in time order."""

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the scene by table; may be empty."""


@dataclass(frozen=True, slots=True)
class _Line:
    name: str
    values: Array
    time_s: Array
    colour: str
    dashes: Any = "-"
    steps: bool = False


@dataclass(frozen=True, slots=True)
class _Panel:
    label: str
    lines: list[_Line]
    height: float = 1.0
    bars: tuple[Array, npt.NDArray[np.uint8], tuple[int, ...]] | None = None


def draw_run(run: DrawnRun, columns: Columns = 2) -> "Figure":
    """Draw a run as panels below one another.

    Three axes are drawn as norm and components, joints individually, orientations as the angle from the first. A signal
    with several axes is omitted if it is empty.

    Args:
        run: Run with signals.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The run has no signals.
    """
    panels = _panels(run)
    if not panels:
        message = f"{run.scene}: no signals to draw: the scene has no [record]"
        raise ValueError(message)
    heights = [panel.height for panel in panels]
    with styled():
        title = f"{Path(run.scene).stem or run.scene}, seed {run.seed}"
        figure = new_figure(columns, PANEL_IN * sum(heights) + 0.17 * len(panels) + 0.55, title)
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0].tolist()
        lines_above = [_draw_panel(axis, panel) for axis, panel in zip(axes, panels, strict=True)]
        begin, end = _span(run.signals)
        axes[0].set_xlim(begin, end)
        letter(axes)
        figure.align_ylabels(axes)
        slack = 1e-3 * (end - begin)
        events = [
            EventMark(min(time_s, end), text)
            for time_s, text in merged_events(run.events)
            if begin - slack <= time_s <= end + slack
        ]
        unnamed = name_events(axes, events, 5.0 + 8.0 * lines_above[0])
        axes[-1].set_xlabel("time [s]" + (f"   ({unnamed} more events are marked, not named)" if unnamed else ""))
    return figure


def _span(signals: Recorded) -> tuple[float, float]:
    times = [signals[name] for name in ("time_s", "slave_time_s") if name in signals and len(signals[name])]
    if not times:
        return 0.0, 1.0
    # The last tick is as long as the previous one; a single tick still gets a visible width.
    last = [float(2.0 * time[-1] - time[-2]) if len(time) > 1 else float(time[-1]) + 1e-3 for time in times]
    return float(min(time[0] for time in times)), max(last)


def _draw_panel(axis: "Axes", panel: _Panel) -> int:
    """Draw a panel; return the number of lines in its legend."""
    axis.set_ylabel(panel.label)
    if panel.bars is not None:
        _draw_trips(axis, *panel.bars)
        return 0
    for line in panel.lines:
        drawn = envelope(line.time_s, line.values) if not line.steps else _changes(line.time_s, line.values)
        marker = "." if len(drawn[0]) == 1 else None
        axis.plot(*drawn, label=line.name, color=line.colour, ls=line.dashes, marker=marker,
                  zorder=1.9 if line.colour == SIGNALS["rendered"] else 2.0,
                  drawstyle="steps-post" if line.steps else "default")  # fmt: skip
    if panel.label == "ladder":
        reached = np.unique(np.concatenate([line.values for line in panel.lines]).astype(int))
        axis.set_yticks(reached, [LADDER[code] for code in reached])
        axis.margins(y=0.15)
    else:
        plain_ticks(axis, 4)
    return legend_above(axis)


def _changes(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Keep the first and last value and each change."""
    kept = np.flatnonzero(np.concatenate(([True], np.diff(values) != 0.0)))
    kept = np.unique(np.append(kept, len(values) - 1)) if len(values) else kept
    return time_s[kept], values[kept]


def _draw_trips(axis: "Axes", time_s: Array, tripped: npt.NDArray[np.uint8], rows: tuple[int, ...]) -> None:
    step = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 0.0
    for row, bit in enumerate(rows):
        edges = np.diff(np.concatenate(([0], (tripped & bit) > 0, [0])).astype(np.int8))
        begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
        # Keep a trip of one tick visible.
        bars = [(float(time_s[a]), float(time_s[b - 1] - time_s[a]) + step) for a, b in zip(begins, ends, strict=True)]
        colour = HELD if TRIPPED[bit] == "held" else controller_look(TRIPPED[bit])["color"]
        axis.broken_barh(bars, (row + 0.12, 0.76), facecolor=colour, edgecolor=colour, lw=0.6)
    names = [TRIPPED[bit].upper() if TRIPPED[bit] in CONTROLLERS else TRIPPED[bit] for bit in rows]
    axis.set_yticks(np.arange(len(rows)) + 0.5, names)
    axis.set_ylim(0, len(rows))
    axis.grid(visible=False, axis="y")


# ---------------------------------------------------------------------------------------------- which panels there are


def _panels(run: DrawnRun) -> list[_Panel]:
    signals = run.signals
    kind = str(run.settings.get("master", {}).get("kind", ""))
    place, push = ("[rad]", "[N m]") if kind == "joints" else ("[m]", "[N]")
    speed = "[rad/s]" if kind == "joints" else "[m/s]"
    # An idle hand is not drawn next to a finger.
    of_finger = "trigger_device_force" in signals
    panels: list[_Panel] = []
    for symbol, unit, names in (
        ("position", place, {"position": "hand", "slave_position": "arm"}),
        ("velocity", speed, {"velocity": "hand"}),
        ("force" if kind != "joints" else "torque", push,
         {"device_force": "on the hand", "rendered_force": "rendered", "hand_force": "of the hand"}),
    ):  # fmt: skip
        if of_finger and not any(np.any(signals[name]) for name in names if name in signals):
            continue
        panels += _of_vectors(signals, symbol, unit, names, joints=kind == "joints")
    panels += _of_turns(run)
    for label, names in OTHERS.items():
        panels += _of_vectors(signals, *label, names, joints=False)
    panels += _of_ladder_and_trips(run)
    return panels


OTHERS: dict[tuple[str, str], dict[str, str]] = {
    ("handle", "[rad]"): {"handle_angle": "handle"},
    ("hole", "[m]"): {"hole_depth": "depth"},
    ("body", "[m]"): {"body_position": "body"},
    ("gripper", "0 to 1"): {"trigger": "trigger", "gripper_command": "commanded", "gripper": "jaws"},
    ("finger", "[N]"): {"trigger_device_force": "on the finger", "finger_force": "of the finger"},
    ("finger", "[m/s]"): {"trigger_velocity": "trigger"},
}
"""Quantities that only some runs have: quantity and unit, signals and names."""

TORQUES = {"device_torque": "on the hand", "rendered_torque": "rendered", "hand_torque": "of the hand"}

COLOURS = {
    "position": SIGNALS["hand"],
    "slave_position": SIGNALS["arm"],
    "velocity": SIGNALS["hand"],
    "rendered_force": SIGNALS["rendered"],
    "hand_force": SIGNALS["of the hand"],
    "rendered_torque": SIGNALS["rendered"],
    "hand_torque": SIGNALS["of the hand"],
    "slave_command_orientation": SIGNALS["commanded"],
    "slave_orientation": SIGNALS["arm"],
    "gripper_command": SIGNALS["commanded"],
    "gripper": SIGNALS["arm"],
    "finger_force": SIGNALS["of the hand"],
}


def _time_of(signals: Recorded, name: str) -> Array:
    time_of = getattr(signals, "time_of", None)
    return np.asarray(signals[time_of(name) if time_of is not None else "time_s"], dtype=np.float64)


def _line(signals: Recorded, name: str, text: str, values: Array) -> _Line:
    return _Line(text, values, _time_of(signals, name), COLOURS.get(name, SIGNALS["hand"]))


def _of_vectors(signals: Recorded, symbol: str, unit: str, names: dict[str, str], *, joints: bool) -> list[_Panel]:
    """Return the panels of one quantity: single axis, norm and components of three axes, or each joint."""
    there = {name: text for name, text in names.items() if name in signals and signals[name].size}
    if not there:
        return []
    axes = max(signals[name].reshape(len(signals[name]), -1).shape[1] for name in there)
    label = f"{symbol}\n{unit}"
    if axes == 1:
        return [_Panel(label, [_line(signals, name, text, signals[name].reshape(-1)) for name, text in there.items()])]
    joints = joints or axes > len("xyz")
    components: list[_Line] = []
    # Components of the felt force; components of both positions.
    for dashes, (name, text) in zip(DASHES, list(there.items())[: 2 if symbol == "position" else 1], strict=False):
        values = np.asarray(signals[name], dtype=np.float64)
        largest = np.nanmax(np.abs(values)) if np.isfinite(values).any() else 0.0
        for axis, of_axis in enumerate(values.T):
            if not joints and not np.any(np.abs(of_axis) > NOTHING * largest):
                continue
            which = f"joint {axis + 1}" if joints else "xyz"[axis]
            title = f"{text}, {which}" if symbol == "position" else which
            components.append(_Line(title, of_axis, _time_of(signals, name), AXES[axis % len(AXES)], dashes))
    what = next(iter(there.values())) if symbol != "position" else ""
    named = f"{symbol}\n{what}\n{unit}" if what and len(there) > 1 else label
    if joints:
        return [_Panel(named, components, 1.3)]
    norms = []
    for name, text in there.items():
        values = np.asarray(signals[name], dtype=np.float64)
        # Plot the displacement from the start.
        values = values - _first(values) if symbol in {"position", "body"} else values
        norms.append(_line(signals, name, text, np.linalg.norm(values, axis=1)))
    size = "|x - x(0)|" if symbol in {"position", "body"} else f"|{symbol}|"
    return [_Panel(f"{size}\n{unit}", norms), *([_Panel(named, components)] if components else [])]


def _first(values: Array) -> Array:
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    return values[known[0]] if len(known) else np.zeros(values.shape[1])


def _of_turns(run: DrawnRun) -> list[_Panel]:
    signals, panels = run.signals, []
    frame = frame_of(run.settings)
    if frame is not None and "slave_command_orientation" in signals:
        apart = angle_apart(signals, np.array(frame))
        time_s = _time_of(signals, "slave_command_orientation")
        line = _Line("command from the hand", apart, time_s, SIGNALS["commanded"])
        panels.append(_Panel("apart\n[rad]", [line]))
    turned = {"orientation": "hand", "slave_command_orientation": "commanded", "slave_orientation": "arm"}
    lines = [
        _line(signals, name, text, angle_from_first(np.asarray(signals[name], dtype=np.float64)))
        for name, text in turned.items()
        if name in signals and signals[name].size
    ]
    if lines:
        panels.append(_Panel("turned\n[rad]", lines))
    for symbol, unit, names in (
        ("turning", "[rad/s]", {"angular_velocity": "hand"}),
        ("torque", "[N m]", TORQUES),
    ):
        panels += _of_vectors(signals, symbol, unit, names, joints=False)
    return panels


def frame_of(settings: dict[str, Any]) -> tuple[float, ...] | None:
    """Return C of a scene with alignment; None without alignment, or if C changes during the run."""
    coupling = settings.get("coupling") or {}
    if not coupling.get("alignment"):
        return None
    if any(change.get("quat_wxyz") is not None for change in coupling.get("changes", ())):
        return None
    return tuple(coupling.get("quat_wxyz", (1.0, 0.0, 0.0, 0.0)))


def _of_ladder_and_trips(run: DrawnRun) -> list[_Panel]:
    signals, panels = run.signals, []
    # Keep visible which side changes first.
    sides = {"slave_state": ("arm's side", SIGNALS["arm"], "-"), "state": ("hand's side", SIGNALS["hand"], "--")}
    lines = [
        _Line(text, np.asarray(signals[name], dtype=np.float64), _time_of(signals, name), colour, dashes, steps=True)
        for name, (text, colour, dashes) in sides.items()
        if name in signals and signals[name].size
    ]
    if lines:
        codes = np.concatenate([line.values for line in lines])
        # Each state needs a label, whatever the height of the curves.
        panels.append(_Panel("ladder", lines, max(0.7, (0.15 * float(np.ptp(codes)) + 0.15) / PANEL_IN)))
    armed = run.settings.get("safety", {}).get("controllers", [])
    for label, name, beside in (("tripped", "tripped", "rotation_tripped"), ("finger\ntripped", "trigger_tripped", "")):
        if name not in signals or not signals[name].size:
            continue
        bits = np.nan_to_num(signals[name]).astype(np.uint8)
        if beside in signals:
            bits = bits | np.nan_to_num(signals[beside]).astype(np.uint8)
        seen = int(np.bitwise_or.reduce(bits)) if len(bits) else 0
        rows = tuple(bit for bit, title in TRIPPED.items() if bit & seen or title in armed)
        if rows:
            panels.append(_Panel(label, [], 0.12 + 0.16 * len(rows), (_time_of(signals, name), bits, rows)))
    return panels
