"""Scenes in which one number at a time is at an end of its range."""

import copy
from collections.abc import Iterator
from typing import Any

from msgspec import inspect

from haptether.bridge.scene.errors import Path, types_at

Raw = dict[str, Any]

HAND: Raw = {
    "stiffness": 300.0,
    "damping": 5.0,
    "grip_strength_n": 12.0,
    "start": 0.01,
    "legs": [{"duration_s": 0.01, "end": -0.01}],
    "release": {"at_s": 0.005, "decay_s": 0.002},
    "regrasp": {"reaction_s": 0.001, "rise_s": 0.001},
    "tremor": {"amplitude": 1e-4, "frequency_hz": 10.0},
}
DEVICE: Raw = {
    "axes": 2,
    "mass_kg": 0.2,
    "viscous": 0.01,
    "coulomb": 0.05,
    "encoder_quantum": 2e-5,
    "max_force_n": 8.0,
    "force_quantum_n": 0.01,
    "stops": [-0.2, 0.2],
    "position": 0.01,
    "velocity": 0.1,
}
SAFETY: Raw = {
    "controllers": ["vfc", "hsc", "wsc", "pc"],
    "estimator": {"kind": "kalman", "jerk_density": 10.0, "quantum_m": 2e-5},
    "damping": 5.0,
    "velocity_threshold": 0.5,
    "vfc_force_threshold_n": 1.0,
    "grasp_threshold": 1.5,
    "grasp_floor_n": 1e-3,
    "hsc_force_threshold_n": 0.1,
    "hsc_velocity_threshold": 0.05,
    "wsc_force_threshold_n": 0.1,
    "energy_threshold_j": -0.01,
    "energy_ratio": 0.5,
    "window": 10,
    "pc_max_damping": 5.0,
    "hold_off_s": 0.002,
    "release_ramp_s": 0.002,
    "limiter": {"max_force_n": 5.0, "max_slew_n_per_s": 1000.0, "max_power_w": 10.0, "ramp_in_s": 0.002},
}
ENVIRONMENT: Raw = {
    "objects": [
        {
            "shape": {"kind": "plane", "point": 0.0, "normal": [1.0, 0.5]},
            "contact": {
                "law": "hunt-crossley",
                "stiffness": 2000.0,
                "damping": 0.5,
                "exponent": 1.5,
                "friction": 0.3,
            },
            "motion": {"velocity": 0.01, "from_s": 0.001, "until_s": 0.01, "amplitude": 0.001, "frequency_hz": 5.0},
        },
        {
            "shape": {"kind": "sphere", "centre": 0.02, "radius": 0.005},
            "contact": {"stiffness": 500.0},
            "body": {"mass_kg": 0.1, "viscous": 0.1, "coulomb": 0.1, "velocity": 0.01},
        },
        {"shape": {"kind": "box", "centre": -0.02, "half_extents": 0.005}, "contact": {"stiffness": 500.0}},
        {"shape": {"kind": "spring", "anchor": 0.0}, "contact": {"stiffness": 50.0, "damping": 1.0}},
    ],
    "pushers": [
        {"shape": "ramp", "at_s": 0.001, "duration_s": 0.01, "rise_s": 0.005, "force_n": 1.0},
        {"shape": "sine", "frequency_hz": 20.0, "force_n": [1.0, -1.0]},
        {"shape": "half-sine", "duration_s": 0.01, "force_n": 0.5},
        {"shape": "recorded", "recorded": {"time_s": [0.0, 0.01, 0.02], "values": [0.0, 1.0, 0.0]}},
    ],
}
LINEAR: Raw = {
    "objects": [
        {"shape": {"kind": "plane", "normal": [1.0, 0.0]}, "contact": {"stiffness": 500.0, "damping": 2.0}},
        {"shape": {"kind": "spring", "anchor": 0.0}, "contact": {"stiffness": 50.0, "damping": 1.0}},
    ],
    "pushers": [{"shape": "ramp", "at_s": 0.001, "duration_s": 0.01, "rise_s": 0.005, "force_n": 1.0}],
}
ARM: Raw = {
    "mass_kg": 4.0,
    "bandwidth_hz": 15.0,
    "max_speed": 1.0,
    "max_acceleration": 20.0,
    "period_s": 2e-3,
    "position": 0.01,
    "force_sensor": {"noise_n": 0.01, "bias_n": 0.01, "quantum_n": 0.01, "rate_hz": 700.0},
}
COUPLING: Raw = {
    "position_scale": 1.0,
    "force_scale": 1.0,
    "command_speed": 1.0,
    "command_reach": 0.2,
    "changes": [{"at_s": 0.01, "position_scale": 1.5, "force_scale": 0.5}],
}
LINK: Raw = {
    "forward": {"delay_s": 0.001, "jitter_s": 0.0002, "jitter_correlation_s": 0.01, "loss": 0.01, "reorder": 0.01},
    "backward": {"delay_s": 0.001, "duplicate": 0.01},
    "master_clock": {"offset_s": 0.1, "drift_ppm": 10.0, "step_s": 0.001, "step_at_s": 0.01},
    "slave_clock": {"offset_s": 0.1},
}
LADDER: Raw = {
    "stale_after_s": 0.005,
    "hold_after_s": 0.02,
    "stop_after_s": 0.2,
    "extrapolate_s": 0.01,
    "fade_out_s": 0.075,
    "fade_in_s": 0.2,
}


def _scene(run: Raw, estimator: Raw | None = None, **tables: Raw) -> Raw:
    raw: dict[str, Any] = {"schema": 1, "record": {}, "run": {"duration_s": 0.02} | run}
    raw |= {"master": DEVICE, "operator": HAND, "environment": ENVIRONMENT, "safety": SAFETY} | tables
    if estimator is not None:
        raw["safety"] = raw["safety"] | {"estimator": estimator}
    return copy.deepcopy(raw)


FAR: dict[str, Raw] = {
    "slave": ARM,
    "coupling": COUPLING,
    "link": LINK,
    "operator": HAND | {"clutch": [[0.0, 0.015]], "clutch_reaction_s": 0.1},
    "safety": SAFETY | {"ladder": LADDER},
}
BASES: dict[str, Raw] = {
    "exact": _scene({}),
    "adaptive window": _scene(
        {"diverged_position": 1.0, "diverged_speed": 10.0},
        {"kind": "adaptive-window", "noise_bound_m": 2e-5, "max_window": 16},
    ),
    "continuous": _scene(
        {"stop_early": True},
        {"kind": "low-pass", "cutoff_hz": 30.0},
        environment=LINEAR | {"rendering": "continuous"},
    ),
    "arm, integrated": _scene({}, **FAR),
    "arm, solved": _scene(
        {},
        {"kind": "savitzky-golay", "degree": 2, "window": 15},
        **FAR | {"environment": LINEAR, "slave": ARM | {"control": "pd", "stiffness": 1000.0, "damping": 50.0}},
    ),
}
"""Scenes that give nearly every number of every table."""

TINY = (5e-324, 1e-300, 1e-160, 1e-30, 1e-12, 1e-9)
LARGE = (1e3, 1e6)


def numbers(raw: Any, path: Path = ()) -> Iterator[Path]:  # noqa: ANN401  # tables as TOML has them
    """Yield the paths of the numbers in plain tables."""
    if isinstance(raw, dict):
        for key, value in raw.items():
            yield from numbers(value, (*path, key))
    elif isinstance(raw, list):
        for index, value in enumerate(raw):
            yield from numbers(value, (*path, index))
    elif isinstance(raw, int | float) and not isinstance(raw, bool):
        yield path


def extremes(path: Path) -> list[float]:
    """Return test values of a number: the ends of its range, values next to them, and values far inside."""
    found: set[float] = set()
    for kind in types_at(path):
        if isinstance(kind, inspect.IntType):
            found |= {end for end in (kind.ge, kind.gt, kind.le, kind.lt) if end is not None} | {0, 1, 2**31, 2**64 - 1}
        elif isinstance(kind, inspect.FloatType):
            ends = {end for end in (kind.ge, kind.gt, kind.le, kind.lt) if end is not None}
            found |= ends | {end * (1.0 - 1e-9) for end in ends} | {*TINY, *LARGE, -TINY[1], 0.0}
    return sorted(found)


def changed(raw: Raw, path: Path, value: float) -> Raw:
    """Return the tables with another number at one path."""
    raw = copy.deepcopy(raw)
    at: Any = raw
    for step in path[:-1]:
        at = at[step]
    at[path[-1]] = value
    return raw
