"""JSON content of a page about a side, in text and numbers."""

from typing import Any

from haptether.view.terminal.panel import FORCES, LEFT, MARGIN, PLACES, TIMES, headline
from haptether.view.terminal.state import SideState

EVENTS = 12
"""Latest events shown."""
GRIPPER = {"trigger": "trigger", "gripper": "gripper", "gripper_force": "gripper force [N]"}


def summary(state: SideState | None, trouble: str, path: str) -> dict[str, Any]:
    """Return the side, its ladder, cause, numbers, observers and latest events.

    Args:
        state: State from its telemetry; None before the hello.
        trouble: Reason why no data arrives; empty if it does.
        path: Path of its socket.
    """
    if state is None:
        return {"side": None, "trouble": f"{path}: {trouble}"}
    cause = state.cause
    return {
        "side": state.side,
        "trouble": f"{path}: {trouble}" if trouble else "",
        "has_ended": state.has_ended,
        "version": state.hello.version,
        "secure": state.hello.security == "secure",
        "device": _device(state),
        "scales": _scales(state),
        "time_s": state.time_s,
        "state": state.last("state"),
        "reason": state.last("reason") or "",
        "peer": state.last("peer_state"),
        "headline": headline(state),
        "clutch": state.last("clutch"),
        "cause": None
        if cause is None
        else {
            "at": cause.at,
            "text": cause.text,
            "steps": [{"text": step.text, "at": step.at, "remedy": step.remedy} for step in cause.steps],
        },
        "values": [*_vectors(state), *_times(state), *_gripper(state)],
        "observers": [
            {
                "name": one.controller.upper(),
                "symbol": one.symbol,
                "value": one.value,
                "share": one.share,
                "threshold": one.threshold,
                "above": one.trips_above,
                "tripped": one.tripped,
            }
            for one in state.observers()
        ],
        "held": state.is_held(),
        "events": [[time_s, text] for time_s, text in list(state.events)[-EVENTS:]],
        "lost_ticks": state.lost_ticks + state.dropped,
        "invalid": f"invalid telemetry, {state.invalid} times, at last: {state.invalid_text}" if state.invalid else "",
    }


def _device(state: SideState) -> str:
    scene = state.hello.scene or {}
    table = scene.get(state.side) or {}
    for key in ("driver", "device"):
        if table.get(key):
            return str(table[key])
    return "model"


SCALES = {"master": ("force_scale", "torque_scale"), "slave": ("position_scale", "rotation_scale")}
"""Scales at the side that owns them: translation, and rotation for a pose."""


def _scales(state: SideState) -> dict[str, float]:
    """Return the scales of the scene; telemetry does not contain later changes."""
    scene = state.hello.scene or {}
    table = scene.get("coupling") or {}
    is_pose = (scene.get("master") or {}).get("kind") == "pose"
    return {name: table.get(name, 1.0) for name in SCALES[state.side][: 2 if is_pose else 1]}


def _is_linear(state: SideState) -> bool:
    return ((state.hello.scene or {}).get("master") or {}).get("kind") != "joints"


def _vectors(state: SideState) -> list[dict[str, Any]]:
    found = []
    for name, (label, unit) in PLACES.items():
        if (values := state.last(name)) is not None:
            shown = unit if _is_linear(state) else unit.replace("m", "rad")
            found.append({"label": f"{label} [{shown}]", "values": values, "digits": 4, "peak": None, "signed": True})
    for name, label in FORCES.items():
        if (values := state.last(name)) is not None:
            unit = "N" if name.endswith("force") and _is_linear(state) else "N m"
            found.append(
                {"label": f"{label} [{unit}]", "values": values, "digits": 2, "peak": state.peak(name), "signed": True}
            )
    return found


def _times(state: SideState) -> list[dict[str, Any]]:
    found = []
    for name, label in TIMES.items():
        value, worst = state.last(name), state.peak(name)
        if value is not None and worst is not None:
            found.append({"label": f"{label} [ms]", "values": [value * 1e3], "digits": 2, "peak": worst * 1e3})
    if (loss := state.loss()) is not None:
        found.append({"label": "frames lost [%]", "values": [loss * 100.0], "digits": 1, "peak": None})
    if (put := state.last("port_in_j")) is not None and (drawn := state.last("port_out_j")) is not None:
        found.append({"label": "energy in, out [J]", "values": [put, drawn], "digits": 3, "peak": None})
    if (left := state.last("left_j")) is not None:
        found.append({"label": LEFT, "values": [left], "digits": 4, "peak": None})
    if (margin := state.passivity_margin()) is not None:
        found.append({"label": MARGIN, "values": [margin], "digits": 2, "peak": None})
    if outliers := state.last("outliers"):
        found.append({"label": "samples replaced", "values": [outliers], "digits": 0, "peak": None})
    if (renewal := state.last("renewal")) is not None:
        label = "ticks with a new sample [%]"
        found.append({"label": label, "values": [100.0 * renewal], "digits": 0, "peak": None})
    return found


def _gripper(state: SideState) -> list[dict[str, Any]]:
    found = []
    for name, label in GRIPPER.items():
        if (value := state.last(name)) is not None:
            grips = ", holds something" if name == "gripper" and state.last("holds_object") else ""
            found.append({"label": label + grips, "values": [value], "digits": 2, "peak": None})
    return found
