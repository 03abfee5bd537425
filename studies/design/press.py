"""Press of a scene's pair of devices on one wall, in virtual time: what a coupling does over the scene's link."""

from typing import Any, Literal, TypeAlias, get_args

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.bridge import Run, Scene, simulate
from haptether.studies.design.contact import largest_force_n, scene_numbers

Array = npt.NDArray[np.float64]
Outcome: TypeAlias = Literal["diverged", "swings", "saturated", "slack", "rests", "held"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
"""Outcomes, worst first; held, which says nothing, last."""
FAILED = frozenset({"diverged", "swings", "saturated"})
"""Outcomes of gains that the pair does not bear."""

HANDS: dict[str, tuple[float, float]] = {"linear": (300.0, 8.0), "joints": (5.0, 0.3)}
"""K and B of a hand in N/m and N s/m (N m/rad, N m s/rad) for a scene without one."""
WALLS: dict[str, float] = {"linear": 2000.0, "joints": 20.0}
"""Stiffness in N/m (N m/rad) of the wall for a scene without contact."""
DEPTHS: dict[str, float] = {"linear": 0.02, "joints": 0.3}
"""Largest depth in m (rad) of the hand's target beyond the wall."""
LOAD = 0.3
"""Largest force of a rigid tool on the wall, as a share of the cap."""
STROKE_S, SETTLE_S, LAST_S, LET_GO_S = 1.0, 6.0, 1.0, 1.5
ROUND_TRIPS = 20.0
"""Time to settle in round trips, added to `SETTLE_S`."""
SLACK, SATURATED = 0.01, 1.2
"""Shares of the force of a rigid tool below which the arm does not follow, and above which the cap or a stop acts."""
SWINGS, LEAST_SWING = 0.1, 0.01
"""Swing above which a press does not rest: as a share of its force, and of the force of a rigid tool."""
ENGAGED_S, ENGAGED_ROUND_TRIPS = 0.5, 2.0
"""Time in s for which the hand rests until both sides are engaged and the force has faded in, with these round trips
more."""
CONTACT_S, APART_S, APART_ROUND_TRIPS = 1.0, 5.0, 8.0
"""Times in s of a stroke in contact and at rest after it, each with these round trips more."""

_COUPLING = (
    "kind", "stiffness", "damping", "impedance", "start_energy_j", "spread_s", "environment_gain", "grasp_gain",
    "play_out_s", "tool_mass_kg", "tool_damping", "tool_lead_s", "position_scale", "force_scale", "command_speed",
)  # fmt: skip
_MASTER = ("mass_kg", "viscous", "coulomb", "encoder_quantum", "measures_velocity", "max_force_n")
_SLAVE = (
    "control", "mass_kg", "bandwidth_hz", "stiffness", "damping", "max_speed", "max_acceleration", "speed_bound",
    "period_s", "takes_force", "viscous", "max_force_n",
)  # fmt: skip


class Press(Struct, frozen=True, kw_only=True):
    """Result of a press: the hand pushes the tool into a wall, holds, and lets go. No controller acts."""

    outcome: Outcome
    """Rests; swings while the hand holds; saturated, at more than a rigid tool would have; slack, with nearly no force;
    diverged; or held by the ladder, so that nothing else is known.
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


class Stroke(Struct, frozen=True, kw_only=True):
    """Result of a stroke: the hand pushes the tool into a wall, holds, withdraws, and rests where it began."""

    outcome: Outcome
    """As that of a press, for the time without contact."""
    drift: float
    """Distance in m (rad) between hand and arm at rest after the contact."""
    dissipated_j: float
    """Work of the hand on the device in J less what the wall still stores; below 0 the arm has given energy to the
    hand."""


def press(scene: Scene, wall: float | None = None) -> Press:
    """Press the pair of a scene on a wall over its link.

    Device, hand, arm, coupling, estimator, limiter, ladder and link are those of the scene, along one axis; a device
    that turns counts by its translation.

    Args:
        scene: Scene with a [slave].
        wall: Stiffness of the wall in N/m (N m/rad); by default that of `WALLS`.

    Raises:
        SceneError: The coupling is invalid for this pair.
    """
    tables, round_trips_s, rigid = _tables(scene, wall)
    operator, depth = tables["operator"], tables["operator"]["start"]
    begin_s = ENGAGED_S + ENGAGED_ROUND_TRIPS * round_trips_s
    release_s = begin_s + STROKE_S + SETTLE_S + ROUND_TRIPS * round_trips_s
    operator["legs"] = [_leg(begin_s, depth), _leg(STROKE_S, -depth)]
    operator["release"] = {"at_s": release_s, "decay_s": 0.05}
    run = _run(tables, release_s + LET_GO_S)
    thrown = float(run.metrics.max_ejection_velocity or 0.0)
    none = {"rigid": rigid, "felt": 0.0, "behind": 0.0, "swing": 0.0, "thrown": thrown}
    last = _last(run, release_s)
    if isinstance(last, str):
        return Press(outcome=last, **none)
    force, apart = _force_and_distance(run, tables)
    mean, swing = float(abs(force[last].mean())), float(np.ptp(force[last]))
    outcome: Outcome = "rests"
    if swing > max(SWINGS * mean, LEAST_SWING * rigid):
        outcome = "swings"
    elif not SLACK * rigid <= mean <= SATURATED * rigid:
        outcome = "slack" if mean < rigid else "saturated"
    return Press(
        outcome=outcome,
        rigid=rigid,
        felt=mean / rigid,
        behind=float(abs(np.mean(apart[last]))),
        swing=swing,
        thrown=thrown,
    )


def stroke(scene: Scene, wall: float | None = None) -> Stroke:
    """Push the pair of a scene into a wall over its link and withdraw; arguments and errors of `press`.

    The hand ends where it began and the arm off the wall, so no spring stores energy: `W = -sum F_device dx` of the
    forces that are held for a tick is the energy that the coupling takes.
    """
    tables, round_trips_s, rigid = _tables(scene, wall)
    operator, depth = tables["operator"], tables["operator"]["start"]
    begin_s = ENGAGED_S + ENGAGED_ROUND_TRIPS * round_trips_s
    contact_s, apart_s = (time_s + APART_ROUND_TRIPS * round_trips_s for time_s in (CONTACT_S, APART_S))
    path = ((begin_s, depth), (STROKE_S, -depth), (contact_s, -depth), (STROKE_S, depth))
    operator["legs"] = [_leg(*one) for one in path]
    lasts_s = begin_s + 2.0 * STROKE_S + contact_s + apart_s
    run = _run(tables, lasts_s)
    last = _last(run, lasts_s)
    if isinstance(last, str):
        return Stroke(outcome=last, drift=0.0, dissipated_j=0.0)
    signals = run.signals
    position, held, contact = (
        np.ravel(part) for part in (signals.position, signals.device_force, signals.environment_force)
    )
    coupling = tables["coupling"]
    stored_j = 0.5 * float(contact[-1]) ** 2 / tables["environment"]["objects"][0]["contact"]["stiffness"]
    force, apart = _force_and_distance(run, tables)
    return Stroke(
        outcome="swings" if float(np.ptp(force[last])) > SWINGS * rigid else "rests",
        drift=float(abs(np.mean(apart[last]))),
        dissipated_j=-float(held[:-1] @ np.diff(position))
        - stored_j * coupling["force_scale"] / coupling["position_scale"],
    )


def _leg(duration_s: float, end: float) -> dict[str, float]:
    return {"duration_s": duration_s, "end": end}


def _run(tables: dict[str, Any], lasts_s: float) -> Run:
    tables["run"]["duration_s"] = lasts_s
    return simulate(msgspec.convert(tables, Scene))


def _last(run: Run, end_s: float) -> "npt.NDArray[np.bool_] | Literal['diverged', 'held']":
    """Return the mask of the last second before a time in s after engaging; or why there is none."""
    signals = run.signals
    if run.metrics.outcome == "diverged":
        return "diverged"
    engaged = signals.time_s[np.isin(signals.state, (2, 3))]
    end_s += engaged[0] if engaged.size else 0.0
    last = (signals.time_s >= end_s - LAST_S) & (signals.time_s < end_s)
    return last if last.any() and np.isin(signals.state[last], (2, 3)).all() else "held"


def _force_and_distance(run: Run, tables: dict[str, Any]) -> tuple[Array, Array]:
    """Return the force in N and the distance of the arm behind the hand in m at each tick."""
    signals = run.signals
    arm = np.interp(signals.time_s, signals.slave_time_s, np.ravel(signals.slave_position))
    return np.ravel(signals.rendered_force), tables["coupling"]["position_scale"] * np.ravel(signals.position) - arm


def _tables(scene: Scene, wall: float | None) -> tuple[dict[str, Any], float, float]:
    """Return the tables of a pair on a wall, its round trip in s, and the force of a rigid tool."""
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
    safety = {
        **msgspec.to_builtins(scene.safety),
        "controllers": [],
        "rotation": None,
        "gripper": None,
        "research": None,
    }
    if (sensor := spec["slave"]["force_sensor"]) is not None:
        sensor = {name: _of_axis(value, axis) for name, value in sensor.items() if value is not None}
    tables = {
        "schema": 1,
        "run": {"period_s": spec["run"]["period_s"], "seed": spec["run"]["seed"]},
        "master": {
            "kind": kind, "axes": 1, "stops": [[-4.0 * DEPTHS[kind], 4.0 * DEPTHS[kind]]],
            **{name: _of_axis(value, axis) for name, value in _stated(master, _MASTER).items()},
        },
        "operator": {
            "stiffness": stiffness, "damping": damping, "grip_strength_n": 1e3, "start": depth, "clutch": "once",
        },
        "slave": {
            **_stated(spec["slave"], _SLAVE), "position": coupling["position_scale"] * depth, "force_sensor": sensor,
        },
        "environment": {"objects": [{"shape": {"kind": "plane"}, "contact": {"stiffness": wall}}]},
        "coupling": coupling,
        "link": link,
        "record": {},
        "safety": safety,
    }  # fmt: skip
    return tables, sum((one or {}).get("delay_s") or 0.0 for one in _ways(spec)), depth / compliance


def _stated(table: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the keys that have a value; those of a `pd` arm, and of one that takes forces, are for no other."""
    absent = {"stiffness", "damping"} if table.get("control", "pd") != "pd" else set()
    if not table.get("takes_force", False):
        absent |= {"viscous"}
    return {name: table[name] for name in names if name not in absent and table[name] is not None}


def _of_axis(value: Any, axis: int) -> Any:  # noqa: ANN401  # a number, or one per axis
    return value[axis] if isinstance(value, list) else value


def _ways(spec: dict[str, Any]) -> list[dict[str, Any] | None]:
    link = spec["link"] or {}
    return [link.get("forward"), link.get("backward")]
