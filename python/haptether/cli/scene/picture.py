"""The picture of a run that `haptether simulate --plot` and `haptether plot` draw."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from haptether.printable import printable
from haptether.private_file import private_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from haptether.bridge import Run, Signals

AXIS_NAMES = "xyz"
PANELS = {
    "position [m]": {"position": "hand", "slave_position": "arm"},
    "velocity [m/s]": {"velocity": "hand"},
    "force [N]": {"device_force": "on the hand", "rendered_force": "rendered", "hand_force": "of the hand"},
    "turned [rad]": {
        "orientation": "hand",
        "slave_command_orientation": "commanded",
        "slave_orientation": "arm",
    },
    "turning [rad/s]": {"angular_velocity": "hand"},
    "torque [N m]": {"device_torque": "on the hand", "rendered_torque": "rendered", "hand_torque": "of the hand"},
    "handle [rad]": {"handle_angle": "handle"},
    "hole [m]": {"hole_depth": "depth"},
    "body [m]": {"body_position": "body"},
    "gripper": {"trigger": "trigger", "gripper_command": "commanded", "gripper": "jaws"},
    "finger [N]": {"trigger_device_force": "on the finger", "finger_force": "of the finger"},
    "finger [m/s]": {"trigger_velocity": "trigger"},
    "ladder": {"state": "hand's side", "slave_state": "arm's side"},
    "tripped": {"tripped": "tripped"},
    "finger\ntripped": {"trigger_tripped": "tripped"},
}
"""What is drawn below one another: signals and their labels. A panel without any of them is left out."""
APART = "apart [rad]"
"""The panel of an alignment: how far the arm's command is turned from the hand."""
HEIGHTS = {"gripper": 2, "ladder": 2, "tripped": 1, "finger\ntripped": 1}
"""Of panels, beside 3 of the others."""
LADDER = ["apart", "aligning", "engaged", "stale", "hold", "stop", "fault"]
"""States of the ladder by their code."""
TRIPPED = {1: "VFC", 2: "HSC", 4: "WSC", 8: "PC", 16: "held"}
EVENTS_NAMED = 16
NAME_LENGTH = 36
"""Characters of the name of an event, reasons included; all of it is in the list that is printed."""
MIN_GAP = 0.025
"""Share of the width that two names of events stand apart at least."""
MAX_LINES = 6
"""Of a panel whose legend is as large as that of the others."""
NOTHING = 2e-3
"""Share of the largest axis that is not seen beside it."""


def draw_run(
    run: "Run", events: list[tuple[float, str]], path: Path, frame_wxyz: tuple[float, ...] | None = None
) -> None:
    """Draws positions, velocity, forces, what turns and interventions over time, with the events marked.

    Args:
        run: With its signals.
        events: Times in s and what is written there.
        path: Of the picture: .png, .pdf or .svg.
        frame_wxyz: C, which turns the hand's frame into the arm's: draws how far the two are turned from one another.

    Raises:
        ImportError: matplotlib is not there; it comes with `haptether[analysis]`.
    """
    from matplotlib.figure import Figure

    signals = run.signals
    drawn = {label: lines for label, signals_of in PANELS.items() if (lines := _lines(signals, signals_of))}
    if frame_wxyz is not None and "slave_command_orientation" in signals:
        apart = angle_apart(signals, np.array(frame_wxyz))
        drawn = {APART: [("slave_apart", "command from the hand", apart)]} | drawn
    figure = Figure(figsize=(10.0, max(9.0, 1.9 * len(drawn))), layout="constrained")
    # Names of files and reasons are no formulas.
    figure.suptitle(printable(f"{Path(run.scene).stem}, seed {run.seed}"), parse_math=False)
    panels = figure.subplots(
        len(drawn), 1, sharex=True, squeeze=False, height_ratios=[HEIGHTS.get(label, 3) for label in drawn]
    )[:, 0]
    for panel, (label, lines) in zip(panels, drawn.items(), strict=True):
        for name, described, values in lines:
            if name == "trigger_tripped":
                _draw_trips(panel, signals["time_s"], np.nan_to_num(signals[name]).astype(np.uint8))
                continue
            if name == "tripped":
                of_turn = signals.get("rotation_tripped", np.zeros_like(signals[name]))
                _draw_trips(panel, signals["time_s"], signals[name] | of_turn)
                continue
            of_time_s = signals[signals.time_of(name)]
            if label == "ladder":
                # Which of the two comes first must be seen where they are alike.
                dashes = "--" if name == "state" else "-"
                panel.plot(of_time_s, values, lw=1.2, ls=dashes, label=described, drawstyle="steps-post")
                reached = np.unique(np.concatenate([values for _, _, values in lines]).astype(int))
                panel.set_yticks(reached, [LADDER[code] for code in reached], fontsize=7)
            else:
                panel.plot(of_time_s, values, lw=1.2, label=described)
            panel.legend(fontsize=8 if len(lines) <= MAX_LINES else 6, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for time_of_event, _ in events:
            panel.axvline(time_of_event, color="k", lw=0.6, ls=":")
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    left, right = panels[0].get_xlim()
    _name_events(panels[0], events[:EVENTS_NAMED], right - left)
    panels[-1].set_xlabel("time [s]")
    with private_file(path) as file:
        figure.savefig(file, dpi=120, format=path.suffix[1:].lower())


def _lines(signals: "Signals", of_panel: dict[str, str]) -> list[tuple[str, str, npt.NDArray[np.float64]]]:
    """The lines of a panel: their signals, labels and values.

    Of sides that turn, orientations are drawn as the angle from the first, `|log(R R_0^T)|`, angular velocities as
    their norm, and axes along which there is nothing beside the others are left out.
    """
    lines = []
    turns = "orientation" in signals
    if "trigger_device_force" in signals and not any(np.any(signals[name]) for name in of_panel if name in signals):
        # Beside a finger, a hand that does nothing is not the subject.
        of_panel = {name: described for name, described in of_panel.items() if name.endswith("tripped")}
    for name, described in of_panel.items():
        if name not in signals:
            continue
        values = np.asarray(signals[name])
        if name.endswith("orientation"):
            lines.append((name, described, angle_from_first(values)))
            continue
        if name == "angular_velocity":
            lines.append((name, described, np.linalg.norm(values, axis=1)))
            continue
        columns = values.reshape(len(values), -1) if values.size else values.reshape(0, 1)
        for axis, of_axis in enumerate(columns.T):
            if turns and values.ndim > 1 and not np.any(np.abs(of_axis) > NOTHING * np.nanmax(np.abs(columns))):
                continue
            along = f", {AXIS_NAMES[axis] if axis < 3 else axis}" if values.ndim > 1 else ""
            lines.append((name, f"{described}{along}", of_axis))
    return lines


def angle_from_first(quat_wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """`|log(R R_0^T)|` in rad, 0 to pi, of the first R that is known.

    Args:
        quat_wxyz: Of R, (n, 4); NaN where it is not known.
    """
    known = np.flatnonzero(np.isfinite(quat_wxyz).all(axis=1))
    if not len(known):
        return np.full(len(quat_wxyz), np.nan)
    w, x, y, z = quat_wxyz[known[0]]
    # Of R R_0^T: the real part, and the others.
    conjugate = np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    parts = quat_wxyz @ conjugate.T
    angle: npt.NDArray[np.float64] = 2.0 * np.arctan2(np.linalg.norm(parts[:, 1:], axis=1), np.abs(parts[:, 0]))
    return angle


def angle_apart(signals: "Signals", frame_wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """`|log(R_s (C R_m C')')|` in rad at the times of the arm: of its command, and of the hand as it is at that time.

    Args:
        signals: Of a run of sides that turn.
        frame_wxyz: Of C.
    """
    master_s, slave_s = signals["time_s"], signals.get("slave_time_s", signals["time_s"])
    last = np.clip(np.searchsorted(master_s, slave_s, side="right") - 1, 0, None)
    hand = signals["orientation"][last]
    command = signals["slave_command_orientation"]
    back = frame_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
    target = _product(_product(np.broadcast_to(frame_wxyz, hand.shape), hand), np.broadcast_to(back, hand.shape))
    parts = _product(command, target * np.array([1.0, -1.0, -1.0, -1.0]))
    angle: npt.NDArray[np.float64] = 2.0 * np.arctan2(np.linalg.norm(parts[:, 1:], axis=1), np.abs(parts[:, 0]))
    return angle


def _product(left: npt.NDArray[np.float64], right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Of quaternions w, x, y, z, row by row."""
    w, z, v, u = left[:, :1], right[:, :1], left[:, 1:], right[:, 1:]
    return np.concatenate([w * z - np.sum(v * u, axis=1, keepdims=True), w * u + z * v + np.cross(v, u)], axis=1)


def _name_events(panel: "Axes", events: list[tuple[float, str]], width_s: float) -> None:
    """Names above the panel, each right of the one before."""
    place = -np.inf
    for time_s, text in events:
        place = max(time_s, place + MIN_GAP * width_s)
        above = ("data", "axes fraction")
        name = text if len(text) <= NAME_LENGTH else f"{text[: NAME_LENGTH - 1].rstrip()}…"
        panel.annotate(printable(name), (time_s, 1.0), (place, 1.03), xycoords=above, textcoords=above,
                       parse_math=False, fontsize=7, ha="left", va="bottom", rotation=35,
                       rotation_mode="anchor")  # fmt: skip


def _draw_trips(panel: "Axes", time_s: npt.NDArray[np.float64], tripped: npt.NDArray[np.uint8]) -> None:
    step = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 0.0
    for row, bit in enumerate(TRIPPED):
        edges = np.diff(np.concatenate(([0], (tripped & bit) > 0, [0])).astype(np.int8))
        begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
        # A trip of one tick must still be seen.
        bars = [(time_s[a], time_s[b - 1] - time_s[a] + step) for a, b in zip(begins, ends, strict=True)]
        panel.broken_barh(bars, (row + 0.1, 0.8), facecolor=f"C{row}", edgecolor=f"C{row}", lw=0.6)
    panel.set_yticks(np.arange(len(TRIPPED)) + 0.5, list(TRIPPED.values()), fontsize=7)
    panel.set_ylim(0, len(TRIPPED))
