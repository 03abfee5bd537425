"""A scene as the numbers that the Rust side takes: presets and defaults filled in, one value per axis."""

from collections.abc import Sequence
from math import sqrt
from typing import Any, TypeAlias

import msgspec

from haptether.bridge.scene.errors import Path, SceneError, contradiction, place, wrong
from haptether.bridge.scene.links import spec_of_links
from haptether.bridge.scene.tables.master import MasterTable, OperatorTable, SeriesTable
from haptether.bridge.scene.tables.ranges import MIN_DURATION_S
from haptether.bridge.scene.tables.session import AdaptiveWindow, CouplingTable, Kalman, LadderTable, Scene
from haptether.bridge.scene.tables.slave import ObjectTable, Plane, PusherTable, SlaveTable
from haptether.master import DEVICE_PRESETS

Spec: TypeAlias = dict[str, Any]
"""One table of `bridge/src/scene/spec.rs`."""

DEFAULT_QUANTUM_M = 2.3e-5
"""Quantum that the default estimator takes an exact device to have: that of a PHANTOM Desktop."""
DEFAULT_MAX_FORCE_N = 7.9
DEFAULT_DAMPING = 5.0
"""mu of the paper, in N s/m."""
DEFAULT_PC_DAMPING = 10.0
STEPS_PER_PERIOD = 10
"""Steps per tick of an integrator whose step is not given."""


def spread(value: float | Sequence[float], axes: int, path: Path) -> list[float]:
    """One number per axis.

    Raises:
        SceneError: A list of another length.
    """
    if isinstance(value, int | float):
        return [float(value)] * axes
    if len(value) != axes:
        raise wrong(path, value, f"one number or a list of {axes}, one per axis")
    return [float(one) for one in value]


def spec_of(scene: Scene) -> Spec:
    """All tables of a scene.

    Raises:
        SceneError: A list that does not have one value per axis, a device without mass, or a link that cannot be.
    """
    axes, run = scene.master.axes, scene.run
    start = None if scene.operator is None else operator_start(scene.operator, axes)
    master = _master(scene.master, start)
    environment = scene.environment
    return {
        "run": {
            "duration_s": run.duration_s,
            "period_s": run.period_s,
            "seed": run.seed,
            "integrator": run.integrator,
            "step_s": None if run.integrator == "exact" else run.step_s or run.period_s / STEPS_PER_PERIOD,
            "stop_early": run.stop_early,
            "diverged_position": run.diverged_position,
            "diverged_speed": run.diverged_speed,
        },
        "master": master,
        "operator": scene.operator and _operator(scene.operator, axes),
        "slave": scene.slave and _slave(scene.slave, axes, run.period_s, master["position"]),
        "environment": environment and {
            "rendering": environment.rendering,
            "delay_ticks": environment.delay_ticks,
            "objects": [
                _object(part, axes, ("environment", "objects", index), run.duration_s)
                for index, part in enumerate(environment.objects)
            ],
            "pushers": [
                _pusher(part, axes, ("environment", "pushers", index), run.duration_s)
                for index, part in enumerate(environment.pushers)
            ],
        },
        "link": scene.link and {
            **spec_of_links(scene.link),
            "master_clock": scene.link.master_clock and _plain(scene.link.master_clock),
            "slave_clock": scene.link.slave_clock and _plain(scene.link.slave_clock),
        },
        "coupling": _coupling(scene),
        "security": scene.security and _plain(scene.security),
        "safety": _safety(scene, master),
        "record": scene.record and _plain(scene.record),
    }  # fmt: skip


def _plain(table: msgspec.Struct) -> Spec:
    """All fields of a table, also those that have their defaults."""
    fields = {name: getattr(table, name) for name in table.__struct_fields__}
    tag = table.__struct_config__
    filled = {name: _plain(value) if isinstance(value, msgspec.Struct) else value for name, value in fields.items()}
    return {tag.tag_field: tag.tag, **filled} if tag.tag_field is not None else filled


def _master(table: MasterTable, start: list[float] | None) -> Spec:
    preset = None if table.device is None else DEVICE_PRESETS[table.device]
    axes = table.axes

    def given(key: str, default: Any) -> Any:  # noqa: ANN401  # as different as the fields are
        value = getattr(table, key)
        if value is None and preset is not None:
            value = getattr(preset, key)
        return default if value is None else value

    mass_kg = given("mass_kg", None)
    if mass_kg is None:
        raise SceneError(f"{place(('master', 'mass_kg'))} is missing: give it, or name a device")
    encoder_quantum = given("encoder_quantum", 0.0)
    max_force_n = given("max_force_n", "unbounded")
    position = table.position if table.position is not None else start if start is not None else 0.0
    return {
        "axes": axes,
        "mass_kg": spread(mass_kg, axes, ("master", "mass_kg")),
        "viscous": spread(given("viscous", 0.0), axes, ("master", "viscous")),
        "coulomb": spread(given("coulomb", 0.0), axes, ("master", "coulomb")),
        "friction": given("friction", "vector"),
        "friction_speed": table.friction_speed,
        "encoder_quantum": encoder_quantum,
        "measures_velocity": encoder_quantum == 0.0 if table.measures_velocity is None else table.measures_velocity,
        "max_force_n": None if max_force_n == "unbounded" else max_force_n,
        "force_quantum_n": table.force_quantum_n,
        "stops": _stops(table, axes),
        "position": spread(position, axes, ("master", "position")),
        "velocity": spread(table.velocity, axes, ("master", "velocity")),
    }


def _stops(table: MasterTable, axes: int) -> list[tuple[float, float]] | None:
    if table.stops is None:
        return None
    pairs = [stop for stop in table.stops if isinstance(stop, tuple)]
    numbers = [stop for stop in table.stops if not isinstance(stop, tuple)]
    if len(numbers) == 2 and not pairs:
        return [(numbers[0], numbers[1])] * axes
    if numbers or len(pairs) != axes:
        raise wrong(("master", "stops"), table.stops, f"[lower, upper] or a list of {axes} such pairs, one per axis")
    return [(low, high) for low, high in pairs]


def operator_start(table: OperatorTable, axes: int) -> list[float]:
    """Where the hand's path begins, in m per axis."""
    if table.recorded is not None:
        first: list[float] = series_spec(table.recorded, axes, ("operator", "recorded"))["values"][0]
        return first
    return spread(table.start, axes, ("operator", "start"))


def _operator(table: OperatorTable, axes: int) -> Spec:
    return {
        "stiffness": table.stiffness,
        "damping": table.damping,
        "grip_strength_n": table.grip_strength_n,
        "start": operator_start(table, axes),
        "legs": [
            {
                "duration_s": leg.duration_s,
                "end": spread(leg.end, axes, ("operator", "legs", index, "end")),
                "shape": leg.shape,
            }
            for index, leg in enumerate(table.legs)
        ],
        "recorded": table.recorded and series_spec(table.recorded, axes, ("operator", "recorded")),
        "release": table.release and _plain(table.release),
        "regrasp": table.regrasp and _plain(table.regrasp),
        "tremor": table.tremor and _plain(table.tremor),
        "clutch": table.clutch if isinstance(table.clutch, str) else "once",
        "clutch_times": None if isinstance(table.clutch, str) else [list(times) for times in table.clutch],
        "clutch_reaction_s": table.clutch_reaction_s,
    }


def series_spec(table: SeriesTable, axes: int, path: Path) -> Spec:
    """A recording, whose file has been read.

    Raises:
        SceneError: No values, times that do not increase, or another number of values than times or axes.
    """
    if table.file is not None and (table.time_s is not None or table.values is not None):
        raise contradiction((*path, "file"), "either file, or time_s and values")
    if not table.time_s or not table.values:
        raise contradiction(path, "needs file, or time_s and values with at least one of each")
    if len(table.time_s) != len(table.values):
        raise contradiction(path, f"{len(table.time_s)} times and {len(table.values)} values: must be as many")
    for index, (before, after) in enumerate(zip(table.time_s, table.time_s[1:], strict=False), start=1):
        if after <= before:
            raise wrong((*path, "time_s", index), after, f"above the time before it, {before:g}")
        if after - before < MIN_DURATION_S:
            allowed = f"at least {MIN_DURATION_S:g} s after the time before it, {before:g}"
            raise wrong((*path, "time_s", index), after, allowed)
    values = [spread(value, axes, (*path, "values", index)) for index, value in enumerate(table.values)]
    return {"time_s": list(table.time_s), "values": values}


def _slave(table: SlaveTable, axes: int, period_s: float, position: list[float]) -> Spec:
    stiffness = table.stiffness or 0.0
    critical = 2.0 * sqrt(stiffness * table.mass_kg)
    sensor = table.force_sensor
    return {
        "control": table.control,
        "mass_kg": table.mass_kg,
        "bandwidth_hz": table.bandwidth_hz,
        "stiffness": stiffness,
        "damping": critical if table.damping is None else table.damping,
        "max_speed": None if table.max_speed == "unbounded" else table.max_speed,
        "max_acceleration": table.max_acceleration,
        "period_s": period_s if table.period_s is None else table.period_s,
        "position": position if table.position is None else spread(table.position, axes, ("slave", "position")),
        "force_sensor": sensor
        and {**_plain(sensor), "bias_n": spread(sensor.bias_n, axes, ("slave", "force_sensor", "bias_n"))},
    }


def _object(table: ObjectTable, axes: int, path: Path, duration_s: float) -> Spec:
    shape, contact, motion, body = _plain(table.shape), table.contact, table.motion, table.body
    for key in ("point", "normal", "centre", "half_extents", "anchor"):
        if shape.get(key) is not None:
            shape[key] = spread(shape[key], axes, (*path, "shape", key))
    if isinstance(table.shape, Plane) and table.shape.normal is None:
        shape["normal"] = [1.0] + [0.0] * (axes - 1)
    default_exponent = 1.0 if contact.law == "kelvin-voigt" else 1.5
    return {
        "shape": shape,
        "contact": {
            **_plain(contact),
            "exponent": default_exponent if contact.exponent is None else contact.exponent,
        },
        "motion": motion and {
            **_plain(motion),
            "velocity": spread(motion.velocity, axes, (*path, "motion", "velocity")),
            "amplitude": spread(motion.amplitude, axes, (*path, "motion", "amplitude")),
            "until_s": max(duration_s, motion.from_s) if motion.until_s is None else motion.until_s,
        },
        "body": body and {**_plain(body), "velocity": spread(body.velocity, axes, (*path, "body", "velocity"))},
    }  # fmt: skip


def _pusher(table: PusherTable, axes: int, path: Path, duration_s: float) -> Spec:
    recorded = None if table.recorded is None else series_spec(table.recorded, axes, (*path, "recorded"))
    lasts = table.duration_s
    if lasts is None:
        lasts = recorded["time_s"][-1] if recorded is not None else duration_s
    return {
        "shape": table.shape,
        "at_s": table.at_s,
        "duration_s": lasts,
        "rise_s": table.rise_s or 0.0,
        "frequency_hz": table.frequency_hz or 0.0,
        "force_n": spread(table.force_n or 0.0, axes, (*path, "force_n")),
        "recorded": recorded,
    }


def _coupling(scene: Scene) -> Spec | None:
    if scene.slave is None:
        return None
    table = scene.coupling or CouplingTable()
    return {
        **_plain(table),
        "command_speed": None if table.command_speed == "unbounded" else table.command_speed,
        "command_reach": None if table.command_reach == "unbounded" else table.command_reach,
        "changes": [_plain(change) for change in table.changes],
    }


DEFAULT_EXTRAPOLATION_S = 0.015
MIN_FADE_IN_S = 0.2


def _ladder(scene: Scene) -> Spec | None:
    if scene.slave is None:
        return None
    table = scene.safety.ladder or LadderTable()
    # In whole ns, as the Rust side counts them, so that no rounding makes it last beyond HOLD.
    stale_ns, hold_ns = round(table.stale_after_s * 1e9), round(table.hold_after_s * 1e9)
    extrapolate_s = min(DEFAULT_EXTRAPOLATION_S, max(hold_ns - stale_ns, 0) * 1e-9)
    limiter = scene.safety.limiter
    fade_in_s = max(MIN_FADE_IN_S, limiter.ramp_in_s if limiter.enabled else 0.0)
    return {
        **_plain(table),
        "extrapolate_s": extrapolate_s if table.extrapolate_s is None else table.extrapolate_s,
        "fade_in_s": fade_in_s if table.fade_in_s is None else table.fade_in_s,
    }


def most_damping(mass_kg: Sequence[float], period_s: float) -> float:
    """Most damping in N s/m that a sampled device stands: m / (5 dT) of its lightest axis."""
    return min(mass_kg) / (5.0 * period_s)


def _safety(scene: Scene, master: Spec) -> Spec:
    table = scene.safety
    most = most_damping(master["mass_kg"], scene.run.period_s)
    estimator = _plain(table.estimator)
    quantum = master["encoder_quantum"] or DEFAULT_QUANTUM_M
    if isinstance(table.estimator, Kalman) and table.estimator.quantum_m is None:
        estimator["quantum_m"] = quantum
    if isinstance(table.estimator, AdaptiveWindow) and table.estimator.noise_bound_m is None:
        estimator["noise_bound_m"] = quantum
    limiter = None
    if table.limiter.enabled:
        limiter = _plain(table.limiter)
        del limiter["enabled"]
        limiter["max_force_n"] = table.limiter.max_force_n or master["max_force_n"] or DEFAULT_MAX_FORCE_N
    return {
        **_plain(table),
        "controllers": list(table.controllers),
        "estimator": estimator,
        "damping": min(DEFAULT_DAMPING, most) if table.damping is None else table.damping,
        "pc_max_damping": min(DEFAULT_PC_DAMPING, most) if table.pc_max_damping is None else table.pc_max_damping,
        "limiter": limiter,
        "ladder": _ladder(scene),
    }
