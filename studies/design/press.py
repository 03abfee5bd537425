"""Press of a scene's pair of devices on one wall, in virtual time: what a coupling does over the scene's link."""

from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct

from haptether.bridge import Scene, simulate
from haptether.studies.design.contact import largest_force_n, scene_numbers

HANDS: dict[str, tuple[float, float]] = {"linear": (300.0, 8.0), "joints": (5.0, 0.3)}
"""K and B of a hand in N/m and N s/m (N m/rad, N m s/rad) for a scene without one."""
WALLS: dict[str, float] = {"linear": 2000.0, "joints": 20.0}
"""Stiffness in N/m (N m/rad) of the wall for a scene without contact."""
DEPTHS: dict[str, float] = {"linear": 0.02, "joints": 0.3}
"""Largest depth in m (rad) of the hand's target beyond the wall."""
LOAD = 0.3
"""Largest force of a rigid tool on the wall, as a share of the cap."""
FADE_S, STROKE_S, SETTLE_S, LAST_S, LET_GO_S = 0.5, 1.0, 6.0, 1.0, 1.5
ROUND_TRIPS = 20.0
"""Time to settle in round trips, added to `SETTLE_S`."""
SLACK = 0.01
"""Share of the force of a rigid tool below which the arm does not follow."""
SWINGS, LEAST_SWING = 0.1, 0.01
"""Swing above which a press does not rest: as a share of its force, and of the force of a rigid tool."""

_COUPLING = (
    "kind", "stiffness", "damping", "impedance", "start_energy_j", "spread_s", "environment_gain", "grasp_gain",
    "play_out_s", "tool_mass_kg", "tool_damping", "tool_lead_s", "position_scale", "force_scale", "command_speed",
)  # fmt: skip
_MASTER = ("mass_kg", "viscous", "coulomb", "encoder_quantum", "measures_velocity", "max_force_n")
_SLAVE = (
    "control", "mass_kg", "bandwidth_hz", "stiffness", "damping", "max_speed", "max_acceleration", "speed_bound",
    "period_s",
)  # fmt: skip


class Press(Struct, frozen=True, kw_only=True):
    """Result of a press: the hand pushes the tool into a wall, holds, and lets go. No controller acts."""

    outcome: Literal["rests", "swings", "slack", "diverged", "held"]
    """Rests; swings while the hand holds; slack, so that next to nothing is felt; diverged; or held by the ladder, so that
    nothing else is known.
    """
    rigid: float
    """Force in N (N m) that a rigid tool would have."""
    felt: float
    """Mean force of the device at rest as a share of `rigid`."""
    behind: float
    """Distance in m (rad) of the arm behind the hand at rest."""
    swing: float
    """Peak to peak of the force in N (N m) at rest."""
    thrown: float
    """Peak speed in m/s (rad/s) after the hand has let go."""


def press(scene: Scene, wall: float | None = None) -> Press:
    """Press the pair of a scene on a wall over its link.

    Device, hand, arm, coupling, estimator, limiter, ladder and link are those of the scene, along one axis; a device that
    turns counts by its translation.

    Args:
        scene: Scene with a [slave].
        wall: Stiffness of the wall in N/m (N m/rad); by default that of `WALLS`.

    Raises:
        SceneError: The coupling is invalid for this pair.
    """
    tables, release_s, rigid = _tables(scene, wall)
    run = simulate(msgspec.convert(tables, Scene))
    signals = run.signals
    assert signals is not None
    engaged = signals.time_s[np.isin(signals.state, (2, 3))]
    thrown = float(run.metrics.max_ejection_velocity or 0.0)
    none = {"rigid": rigid, "felt": 0.0, "behind": 0.0, "swing": 0.0, "thrown": thrown}
    if run.metrics.outcome == "diverged":
        return Press(outcome="diverged", **none)
    end_s = (engaged[0] if engaged.size else 0.0) + release_s
    last = (signals.time_s >= end_s - LAST_S) & (signals.time_s < end_s)
    if not last.any() or not np.isin(signals.state[last], (2, 3)).all():
        return Press(outcome="held", **none)
    force, hand, arm = (np.ravel(part)[last] for part in (signals.rendered_force, signals.position, signals.slave_position))
    mean, swing = float(abs(force.mean())), float(np.ptp(force))
    scale = tables["coupling"]["position_scale"]
    outcome: Literal["rests", "swings", "slack"] = "slack" if mean < SLACK * rigid else "rests"
    return Press(
        outcome="swings" if swing > max(SWINGS * mean, LEAST_SWING * rigid) else outcome,
        rigid=rigid,
        felt=mean / rigid,
        behind=float(abs(np.mean(scale * hand - arm))),
        swing=swing,
        thrown=thrown,
    )


def _tables(scene: Scene, wall: float | None) -> tuple[dict[str, Any], float, float]:
    """Return the tables of a press, the time in s of the release after engaging, and the force of a rigid tool."""
    spec = scene_numbers(scene)
    kind = "joints" if spec["master"]["kind"] == "joints" else "linear"
    stiffness, damping = HANDS[kind]
    if (operator := spec["operator"]) is not None and operator["stiffness"] > 0.0:
        stiffness, damping = operator["stiffness"], operator["damping"]
    wall = wall or WALLS[kind]
    coupling = _stated(spec["coupling"], _COUPLING)
    compliance = 1.0 / stiffness + 1.0 / (coupling["force_scale"] * coupling["position_scale"] * wall)
    depth = min(DEPTHS[kind], LOAD * largest_force_n(spec) * coupling["force_scale"] * compliance)
    master, axis = spec["master"], int(np.argmin(spec["master"]["mass_kg"]))
    link = None if scene.link is None else msgspec.to_builtins(scene.link)
    round_trip_s = sum((one or {}).get("delay_s") or 0.0 for one in _ways(spec))
    release_s = FADE_S + STROKE_S + SETTLE_S + ROUND_TRIPS * round_trip_s
    safety = {**msgspec.to_builtins(scene.safety), "controllers": [], "rotation": None, "gripper": None, "research": None}
    tables = {
        "schema": 1,
        "run": {"duration_s": release_s + LET_GO_S, "period_s": spec["run"]["period_s"], "seed": spec["run"]["seed"]},
        "master": {
            "kind": kind, "axes": 1, "stops": [[-4.0 * DEPTHS[kind], 4.0 * DEPTHS[kind]]],
            **{name: _of_axis(value, axis) for name, value in _stated(master, _MASTER).items()},
        },
        "operator": {
            "stiffness": stiffness, "damping": damping, "grip_strength_n": 1e3, "start": depth, "clutch": "once",
            "legs": [{"duration_s": FADE_S, "end": depth}, {"duration_s": STROKE_S, "end": -depth}],
            "release": {"at_s": release_s, "decay_s": 0.05},
        },
        "slave": {**_stated(spec["slave"], _SLAVE), "position": coupling["position_scale"] * depth},
        "environment": {"objects": [{"shape": {"kind": "plane"}, "contact": {"stiffness": wall}}]},
        "coupling": coupling,
        "link": link,
        "record": {},
        "safety": safety,
    }  # fmt: skip
    return tables, release_s, depth / compliance


def _stated(table: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the keys that have a value; those of a `pd` arm are 0 for others."""
    absent = {"stiffness", "damping"} if table.get("control", "pd") != "pd" else set()
    return {name: table[name] for name in names if name not in absent and table[name] is not None}


def _of_axis(value: Any, axis: int) -> Any:  # noqa: ANN401  # a number, or one per axis
    return value[axis] if isinstance(value, list) else value


def _ways(spec: dict[str, Any]) -> list[dict[str, Any] | None]:
    link = spec["link"] or {}
    return [link.get("forward"), link.get("backward")]
