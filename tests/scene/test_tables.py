"""Tables of a scene: refusals and their words, presets, and JSON that matches the Rust side."""

# ruff: noqa: ANN401, E501  # tables of anything, one bad scene a line

import copy
import json
import re
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _programs import built
from haptether.bridge import (
    ContactTable,
    CouplingTable,
    EnvironmentTable,
    LadderTable,
    LegTable,
    LimiterTable,
    MasterTable,
    ObjectTable,
    OperatorTable,
    SafetyTable,
    Scene,
    SceneError,
    SlaveTable,
    Sphere,
    load_scene,
    scene_json,
    scene_names,
)
from haptether.bridge.scene.errors import types_at
from haptether.bridge.scene.resolve import PYTHON_ONLY
from haptether.master import DEVICE_PRESETS
from haptether.netsim import LinkSettings, link_spec
from haptether.netsim.link.settings import DISTRIBUTIONS

ROOT = Path(__file__).resolve().parents[2]

# ------------------------------------------------------------------------------------------- TOML


def toml(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, str) else repr(value)


def written(scene: Mapping[str, Any], folder: Path) -> Path:
    path = folder / "scene.toml"
    path.write_text("".join(f"{key} = {toml(value)}\n" for key, value in scene.items()), encoding="utf-8")
    return path


def full_scene() -> dict[str, Any]:
    """Return a scene with every table."""
    return {
        "schema": 1,
        "title": "everything",
        "shows": "all tables",
        "run": {"duration_s": 2.0, "period_s": 1e-3, "seed": 7},
        "master": {"device": "touch", "stops": [-0.1, 0.1]},
        "operator": {
            "grip_strength_n": 5.0,
            "start": 0.02,
            "legs": [{"duration_s": 1.0, "end": -0.03, "shape": "smooth"}],
            "release": {"at_s": 1.0},
            "regrasp": {"reaction_s": 0.2},
            "tremor": {},
        },
        "slave": {"force_sensor": {"noise_n": 0.1, "rate_hz": 500.0}},
        "environment": {
            "objects": [
                {"contact": {"stiffness": 100.0}, "motion": {"amplitude": 0.01, "frequency_hz": 1.0}},
                {"shape": {"kind": "sphere", "radius": 0.1}, "contact": {"law": "hunt-crossley", "stiffness": 1e4}},
                {"shape": {"kind": "box", "half_extents": 0.1}, "contact": {"stiffness": 1.0}, "body": {"mass_kg": 1}},
                {"shape": {"kind": "spring"}, "contact": {"stiffness": 10.0}},
            ],
            "pushers": [
                {"at_s": 0.5, "force_n": 1.0},
                {"shape": "recorded", "recorded": {"time_s": [0.0, 1.0], "values": [0.0, 1.0]}},
            ],
        },
        "link": {
            "forward": {"delay_s": 0.05, "jitter_s": 0.01, "loss": 0.1},
            "backward": {},
            "master_clock": {"offset_s": 1.0},
            "slave_clock": {"drift_ppm": 20.0, "step_s": 1.0, "step_at_s": 2.0},
        },
        "coupling": {"force_scale": 0.5, "changes": [{"at_s": 1.0, "force_scale": 0.2}]},
        "security": {"secure": True},
        "safety": {
            "controllers": ["wsc", "hsc"],
            "estimator": {"kind": "savitzky-golay"},
            "ladder": {"stop_after_s": 0.1},
        },
        "record": {"every": 2},
    }


def busy_links() -> dict[str, Any]:
    """Return links with every table in the two directions."""
    return {
        "forward": {
            "mtu": 1400,
            "gilbert_elliott": {"to_bad": 0.001, "to_good": 0.3},
            "outages": [
                {"times": {"kind": "once", "at_s": 1.0, "duration_s": 0.1}},
                {"times": {"kind": "periodic", "at_s": 1.0, "period_s": 2.0, "duration_s": 0.1}, "effect": "hold"},
                {"times": {"kind": "random", "mean_up_s": 10.0, "mean_down_s": 0.1}},
            ],
            "rate_bps": 1e6, "queue_ms": 50.0, "discipline": "codel", "cross_traffic": {"rate_bps": 1e5},
            "delay_s": 0.05, "jitter_s": 0.005, "distribution": "gamma", "jitter_correlation_s": 0.1,
            "timeline": [{"at_s": 1.0, "delay_s": 0.1, "ramp_s": 0.5}],
            "slots": {"period_s": 15.0, "start_spike_s": 0.14, "end_spike_s": 0.075, "spike_delay_s": 0.03},
            "attacks": [
                {"action": {"kind": "bit-flip", "bits": 2, "within": {"start": 0, "end": 8}}},
                {"action": {"kind": "replay", "after_s": 1.0}, "target": {"from_s": 1.0, "every": 10}},
                {"action": {"kind": "mirror"}, "target": {"probability": 0.01}},
                {"action": {
                    "kind": "alter",
                    "edits": [
                        {"type": "f64", "offset": 64, "operation": "multiply", "value": -1.0},
                        {"type": "u64", "offset": 16, "operation": "add", "value": 1000},
                    ],
                    "checksum": "crc32", "inject": True,
                }},
            ],
        },
        "backward": {
            "four_state": {"p13": 0.01, "p31": 0.5},
            "opportunities": {"time_ms": [1, 2, 2, 4]}, "queue_packets": 10,
            "trace": {"time_s": [0.0, 1.0], "delay_s": [0.05, 0.06], "repeat": False},
            "reorder": 0.01, "duplicate": 0.01, "corrupt": 0.01, "truncate": 0.01,
        },
    }  # fmt: skip


def local_scene() -> dict[str, Any]:
    """Return a scene without an arm."""
    return {
        "schema": 1,
        "master": {"device": "phantom-desktop"},
        "operator": {},
        "environment": {"objects": [{"contact": {"stiffness": 100.0}}]},
    }


ABSENT = object()
NAN, INF = float("nan"), float("inf")


def changed(scene: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    scene = copy.deepcopy(scene)
    for path, value in changes.items():
        *tables, key = path.split(".")
        table: Any = scene
        for step in tables:
            table = table[int(step)] if isinstance(table, list) else table.setdefault(step, {})
        if value is ABSENT:
            del table[key]
        else:
            table[key] = value
    return scene


# ----------------------------------------------------------------------------------- bad scenes

BAD_ARM_SCENES: list[tuple[dict[str, Any], str]] = [
    # the clutch
    ({"operator.clutch": [[0.0, 1.0], [1.0, 2.0]]}, "[operator] clutch: presses and releases must follow one"),
    ({"operator.clutch_reaction_s": 0.01}, "[operator] clutch_reaction_s = 0.01: must be 0.05 to 60"),
    # buttons
    ({"master.buttons": {"clutch": 32}}, "[master.buttons] clutch = 32: must be 0 to 31"),
    ({"master.buttons": {"clutch": 1, "engage": 2}}, "[master.buttons] engage: works the clutch as clutch does"),
    ({"master.buttons": {"gripper": 1}}, "[master.buttons] gripper: works no gripper: add [slave.gripper]"),
    ({"master.buttons": {"clutch": 1, "gripper": 1}, "slave.gripper": {}}, "[master] buttons: a button of its own for each"),
    # the ladder
    ({"safety.ladder": {"hold_after_s": 0.005}}, "[safety.ladder] hold_after_s = 0.005: must be above stale_after_s = 0.005"),
    ({"safety.ladder": {"stop_after_s": 0.02}}, "[safety.ladder] stop_after_s = 0.02: must be above hold_after_s = 0.02"),
    ({"safety.ladder": {"extrapolate_s": 0.016}}, "[safety.ladder] extrapolate_s = 0.016: must be over before HOLD, at most 0.015"),
    ({"safety.ladder": {"hold_after_s": 0.1, "stop_after_s": 2.0, "extrapolate_s": 0.021}}, "extrapolate_s = 0.021: must be 0 to 0.02"),
    ({"safety.ladder": {"hold_after_s": 0.101}}, "[safety.ladder] hold_after_s = 0.101: must be 1e-09 to 0.1"),
    ({"safety.ladder": {"fade_out_s": 0.049}}, "[safety.ladder] fade_out_s = 0.049: must be 0.05 to 0.1"),
    ({"safety.ladder": {"fade_out_s": 0.11}}, "[safety.ladder] fade_out_s = 0.11: must be 0.05 to 0.1"),
    ({"safety.ladder": {"fade_in_s": 0.19}}, "[safety.ladder] fade_in_s = 0.19: must be 0.2 to 60"),
    ({"safety.ladder": {"stale_after_s": 0.0}}, "[safety.ladder] stale_after_s = 0: must be 1e-09 to 1"),
    ({"safety.ladder": {"ramp_out_s": 0.1}}, "[safety.ladder] has no key ramp_out_s"),
    # the coupling
    ({"coupling.quat_wxyz": [0.0, 0.0, 0.0, 1.0]}, "[coupling] quat_wxyz = [0, 0, 0, 1]: must be [1, 0, 0, 0] with 1 axes"),
    ({"coupling.quat_wxyz": [0.9, 0.0, 0.0, 0.0]}, "[coupling] quat_wxyz = [0.9, 0, 0, 0]: must be of norm 1, not 0.9"),
    ({"coupling.quat_wxyz": [1.0, 0.0, 0.0]}, "[coupling] quat_wxyz = [1, 0, 0]: must be"),
    ({"coupling.locked_axes": [1]}, "[coupling] locked_axes = [1]: must be below 1, the number of axes"),
    ({"coupling.locked_axes": [0, 0]}, "[coupling] locked_axes = [0, 0]: must be each at most once"),
    ({"coupling.command_speed": 0.0}, '[coupling] command_speed = 0: must be above 0 and at most 1e9 or "unbounded"'),
    ({"coupling.command_reach": "far"}, '[coupling] command_reach = "far": must be above 0 and at most 1e9 or "unbounded"'),
    ({"coupling.changes": [{"at_s": 1.0}]}, "[coupling] changes.0: changes nothing: give kind, position_scale, force_scale"),
    ({"coupling.changes.0.force_scale": 0.0}, "[coupling.changes.0] force_scale = 0: must be above 0"),
    ({"coupling.changes": [{"at_s": 1.0, "force_scale": 1.0}, {"at_s": 0.5, "force_scale": 2.0}]},
     "[coupling.changes.1] at_s = 0.5: must be at least that of the change before it, 1"),
    ({"coupling.changes": [{"at_s": 1.0, "locked_axes": [3]}]}, "[coupling.changes.0] locked_axes = [3]: must be below 1"),
    # unknown keys
    ({"safety.windw": 3}, "[safety] has no key windw: did you mean window?"),
    ({"zoo": {}}, "a scene has no key zoo: there is coupling, environment, link, master"),
    ({"link.forwards": {}}, "[link] has no key forwards: did you mean forward?"),
    ({"operator.legs.0.duration": 1.0}, "[operator.legs.0] has no key duration: did you mean duration_s?"),
    ({"environment.objects.1.shape.radios": 1.0}, "[environment.objects.1.shape] has no key radios: did you mean radius?"),
    # types
    ({"run.seed": 1.5}, "[run] seed = 1.5: must be a whole number, at least 0"),
    ({"run.duration_s": "long"}, '[run] duration_s = "long": must be a number, 1e-09 to 1000000'),
    ({"run.stop_early": 1}, "[run] stop_early = 1: must be true or false"),
    ({"run": 3}, "run = 3: must be a table"),
    ({"operator.legs": 3}, "[operator] legs = 3: must be a list of tables"),
    ({"title": 3}, "title = 3: must be a string"),
    ({"environment.objects.0.shape": "plane"}, "must be a table whose kind is one of"),
    ({"environment.objects.0.shape": {"kind": "cone"}}, '[environment.objects.0.shape] kind = "cone": must be one of "plane"'),
    ({"environment.objects.0.shape": {}}, "[environment.objects.0.shape] kind is missing: must be one of"),
    ({"safety.estimator": {"kind": "kalmn"}}, '[safety.estimator] kind = "kalmn": must be one of "backward-difference"'),
    ({"master.device": "phantom"}, '[master] device = "phantom": must be one of "dynamixel-leader"'),
    ({"safety.controllers": ["wso"]}, '[safety] controllers.0 = "wso": must be one of "hsc", "pc", "vfc", "wsc"'),
    # missing
    ({"schema": ABSENT}, "schema is missing: must be 1"),
    ({"master": ABSENT}, "master is missing: must be a table"),
    ({"environment.objects.0.contact": {}}, "[environment.objects.0.contact] stiffness is missing: must be 0 to 1e9"),
    ({"master.device": ABSENT}, "[master] mass_kg is missing: give it, or name a device"),
    # ranges
    ({"schema": 2}, "schema = 2: must be 1"),
    ({"safety.window": 0}, "[safety] window = 0: must be 1 to 3600000"),
    ({"safety.grasp_threshold": 1.0}, "[safety] grasp_threshold = 1: must be above 1"),
    ({"safety.energy_threshold_j": 0.0}, "[safety] energy_threshold_j = 0: must be at least -1e9 and below 0"),
    ({"safety.energy_ratio": 1.5}, "[safety] energy_ratio = 1.5: must be above 0 and at most 1"),
    ({"safety.hold_off_s": 61.0}, "[safety] hold_off_s = 61: must be 0 to 60"),
    ({"master.axes": 8}, "[master] axes = 8: must be one of 1, 2, 3, 4, 5, 6, 7"),
    ({"master.mass_kg": 0.0}, "[master] mass_kg = 0: must be above 0"),
    ({"link.slave_clock": {"drift_ppm": 1e5}}, "[link.slave_clock] drift_ppm = 100000: must be -10000 to 10000"),
    ({"link.slave_clock": {"step_s": -1.0}}, "[link.slave_clock] step_s = -1: must be 0 or more: a monotonic clock is never"),
    ({"link.slave_clock": {"skew": 1.0}}, "[link.slave_clock] has no key skew"),
    ({"link.forward.loss": 1.5}, "[link.forward] loss = 1.5: must be 0 to 1"),
    ({"slave.period_s": 0.03}, "[slave] period_s = 0.03: must be 1e-05 to 0.02"),
    ({"slave.max_speed": "fast"}, '[slave] max_speed = "fast": must be above 0 and at most 1e9 or "unbounded"'),
    ({"record.every": 0}, "[record] every = 0: must be 1 to 1000000"),
    ({"environment.objects.1.contact.exponent": 0.5}, "[environment.objects.1.contact] exponent = 0.5: must be 1 to 5"),
    ({"safety.estimator.degree": 4}, "[safety.estimator] degree = 4: must be 2 to 3"),
    # not finite
    ({"operator.damping": NAN}, "[operator] damping = nan: must be a finite number"),
    ({"operator.start": [INF]}, "[operator] start.0 = inf: must be a finite number"),
    ({"master.stops": [-INF, INF]}, "[master] stops.0 = -inf: must be a finite number"),
    # lists per axis
    ({"operator.start": [0.0, 1.0]}, "[operator] start = [0, 1]: must be one number or a list of 1, one per axis"),
    ({"operator.legs.0.end": [0.0, 0.0, 0.0]}, "[operator.legs.0] end = [0, 0, 0]: must be one number or a list of 1"),
    ({"master.stops": [1.0]}, "[master] stops = [1]: must be [lower, upper] or a list of 1 such pairs"),
    ({"master.stops": [[0.0, 1.0, 2.0]]}, "[master] stops.0 = [0, 1, 2]: must be"),
    ({"environment.pushers.1.recorded.values": [[0.0, 0.0], [1.0, 1.0]]}, "[environment.pushers.1.recorded] values.0 = [0, 0]"),
    # contradictions
    ({"operator.release": ABSENT}, "[operator] regrasp: needs [operator.release]"),
    ({"operator.grip_strength_n": ABSENT}, "[operator.release] kind: a strength without bound does not decay"),
    ({"operator.stiffness": 0.0, "operator.damping": 0.0}, "[operator] release: needs a hand"),
    ({"operator.recorded": {"time_s": [0.0], "values": [0.0]}}, "[operator] recorded: stands instead of legs"),
    # removed fields of earlier versions
    ({"run.integrator": "rk4"}, '[run] integrator = "rk4": must be "exact": the stepped integrators were removed, leave the'),
    ({"run.step_s": 1e-4}, "[run] step_s: was removed with the stepped integrators, leave it out"),
    ({"master.friction_speed": 1e-3}, "[master] friction_speed: was removed with the stepped integrators, leave it out"),
    ({"run.period_s": 1.23456789012e-3}, "[run] period_s = 0.00123456789012: must be a whole number of ns"),
    ({"run.duration_s": 20001.0}, "[run] duration_s = 20001: must be at most 2e7 ticks, 20000 s at period_s = 0.001"),
    ({"run.duration_s": 1e-4}, "[run] duration_s = 0.0001: must be at least one period of 0.001 s"),
    ({"run.period_s": 0.025}, "[run] period_s = 0.025: must be 1e-05 to 0.02"),
    # refusals of netsim
    ({"link.forward.jiter_s": 0.06}, "[link.forward] has no key jiter_s: did you mean jitter_s?"),
    ({"link.forward.jitter_s": 0.06}, "[link.forward] jitter_s"),
    ({"link.forward.mean_burst": 0.5}, "[link.forward] mean_burst = 0.5: must be 1 to 1e9"),
    ({"link.forward.rate_bps": 0.0}, "[link.forward] rate_bps = 0: must be above 0"),
    ({"link.forward.delay_s": INF}, "[link.forward] delay_s = inf: must be a finite number"),
    ({"link.forward.outages": [{"times": {"kind": "once", "at_s": 1.0, "duration_s": -1.0}}]}, "[link.forward.outages.0.times] duration_s = -1: must be"),
    ({"link.forward.outages": [{"times": {"kind": "twice"}}]}, '[link.forward.outages.0.times] kind = "twice": must be one of "once", "periodic", "random"'),
    ({"link.forward.preset": "mon"}, '[link.forward] preset = "mon": must be one of '),
    ({"link.forward.distribution": "nrmal"}, '[link.forward] distribution = "nrmal": must be one of normal, uniform'),
    ({"link.forward.trace": {}}, "[link.forward] trace: needs file, or time_s and delay_s"),
    ({"link.forward.trace": {"file": "a.csv", "time_s": [0.0]}}, "[link.forward.trace] file: either file, or time_s and delay_s"),
    ({"link.forward.gilbert_elliott": {"to_bad": 0.1, "to_good": 0.5}}, "[link.forward] "),
    ({"link.forward.four_state": {"p13": 0.1, "p31": 0.5, "p32": 0.9}, "link.forward.loss": 0.0}, "[link.forward"),
    ({"slave.options": {"host": "a"}},
     '[slave] options = {host = "a"}: must be left out where device = "simulated", or [slave] device must name'),
    ({"master.options": {"port": 7}},
     "[master] options = {port = 7}: must be left out where a model is held by the operator, or [master] driver must name"),
    ({"slave.stiffness": 100.0}, '[slave] stiffness: control = "position" has none, only "pd"'),
    ({"slave.control": "pd"}, '[slave] stiffness: control = "pd" needs it'),
    ({"slave.takes_force": True, "slave.control": "velocity"}, '[slave] control = "velocity": must be "position" or "pd" for'),
    ({"slave.viscous": 1.0}, "[slave] viscous: only an arm with takes_force = true has it"),
    ({"slave.takes_force": True, "slave.max_force_n": -3.0}, "[slave] max_force_n = -3: must be above 0"),
    ({"slave.takes_force": True, "coupling.tool_mass_kg": 1.0}, "[coupling] tool_mass_kg: an arm with takes_force = true has"),
    ({"slave.takes_force": True, "master.kind": "joints"}, "[slave] mass_kg: must be given for joints"),
    ({"environment.rendering": "continuous"}, "[environment] rendering: an arm stands between"),
    ({"environment.delay_ticks": 3}, "[environment] delay_ticks: only a sampled environment without an arm is late"),
    ({"environment.objects.0.body": {"mass_kg": 1.0}}, "[environment.objects.0] body: what moves on its own does not slide"),
    ({"environment.objects.0.contact.exponent": 1.5}, '[environment.objects.0.contact] exponent: law = "kelvin-voigt" has none'),
    ({"environment.objects.0.contact.friction": 0.3}, "[environment.objects.0.contact] friction = 0.3: must be 0 with one axis"),
    ({"environment.objects.0.motion": {"amplitude": 0.1}}, "[environment.objects.0.motion] amplitude: needs frequency_hz"),
    ({"environment.objects.0.motion": {"from_s": 2.0, "until_s": 1.0}}, "until_s = 1: must be at least from_s = 2"),
    ({"environment.objects.0.shape": {"kind": "plane", "normal": 0.0}}, "normal = 0: must be of any length but 0"),
    ({"environment.pushers.0.shape": "recorded", "environment.pushers.0.force_n": ABSENT},
     '[environment.pushers.0] recorded: shape = "recorded" needs it'),
    ({"environment.pushers.0.force_n": ABSENT}, '[environment.pushers.0] force_n: shape = "step" needs it'),
    ({"environment.pushers.0.shape": "ramp"}, '[environment.pushers.0] rise_s: shape = "ramp" needs it'),
    ({"environment.pushers.0.shape": "sine"}, '[environment.pushers.0] frequency_hz: shape = "sine" needs it'),
    ({"environment.pushers.0.shape": "half-sine"}, '[environment.pushers.0] duration_s: shape = "half-sine" needs it'),
    ({"environment.pushers.0.rise_s": 0.1}, '[environment.pushers.0] rise_s: shape = "step" has none'),
    ({"environment.pushers.1.recorded": {"time_s": [0.0, 1.0], "values": [1.0]}}, "2 times and 1 values: must be as many"),
    ({"environment.pushers.1.recorded": {"time_s": [0.0, 0.0], "values": [1.0, 1.0]}}, "time_s.1 = 0: must be above the time"),
    ({"environment.pushers.1.recorded": {}}, "[environment.pushers.1] recorded: needs file, or time_s and values"),
    ({"environment.pushers.1.recorded.file": "a.csv"}, "[environment.pushers.1.recorded] file: either file, or time_s"),
    ({"safety.controllers": ["wsc", "wsc"]}, '[safety] controllers = ["wsc", "wsc"]: must be each at most once'),
    ({"safety.damping": 10.0}, "[safety] damping = 10: must be at most m / (5 dT) = 9"),
    ({"safety.controllers": ["pc"], "safety.pc_max_damping": 10.0}, "[safety] pc_max_damping = 10: must be at most m / (5 dT) = 9"),
    ({"safety.estimator": {"kind": "low-pass", "cutoff_hz": 501.0}}, "cutoff_hz = 501: must be at most half the sample rate, 500"),
    ({"safety.estimator": {"kind": "savitzky-golay", "degree": 3, "window": 3}}, "window = 3: must be above degree = 3"),
    ({"safety.estimator": {"kind": "kalman", "jerk_density": 1e9, "quantum_m": 1e-9}}, "such that omega dT is 0.001 to 10"),
    ({"safety.estimator": {"kind": "dual-kalman", "velocity_jerk_density": 1e9, "quantum_m": 1e-6}}, "velocity_jerk_density = 1e+09: must be such that omega dT is 0.001 to 10"),
    ({"safety.limiter": {"enabled": False, "max_power_w": 5.0}}, "[safety.limiter] enabled: bounds that are off have no other"),
    ({"master.stops": [0.1, -0.1]}, "[master] stops = [0.1, -0.1]: must be the lower stop below the upper"),
    ({"master.stops": [0.05, 0.1]}, "[master] position = 0.02: must be within the stops, 0.05 to 0.1"),
]  # fmt: skip

BAD_LOCAL_SCENES: list[tuple[dict[str, Any], str]] = [
    ({"operator.clutch": "once"}, "[operator] clutch: needs an arm to let go of"),
    ({"link": {"forward": {"delay_s": 0.1}}}, "link: needs an arm to lead to"),
    ({"coupling": {}}, "coupling: needs an arm to lead to"),
    ({"security": {}}, "security: needs an arm to lead to"),
    ({"safety": {"ladder": {}}}, "[safety] ladder: needs an arm at the other end"),
    ({"environment.rendering": "continuous", "environment.objects.0.shape": {"kind": "sphere", "radius": 0.1}},
     "[environment.objects.0] shape: continuous rendering knows only planes"),
    ({"environment.rendering": "continuous", "environment.delay_ticks": 2}, "[environment] delay_ticks: only a sampled"),
    ({"operator.start": 0.1, "operator.recorded": {"time_s": [0.0], "values": [0.0]}}, "[operator] start: a recorded path"),
]  # fmt: skip


def refusal(scene: dict[str, Any], folder: Path) -> str:
    with pytest.raises(SceneError) as refused:
        load_scene(written(scene, folder))
    return str(refused.value)


@pytest.mark.parametrize(("changes", "said"), BAD_ARM_SCENES, ids=[said[:60] for _, said in BAD_ARM_SCENES])
def test_a_bad_scene_is_refused_in_one_line(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    message = refusal(changed(full_scene(), changes), tmp_path)
    assert message.startswith("scene.toml: ")
    assert said in message
    assert "\n" not in message


@pytest.mark.parametrize(("changes", "said"), BAD_LOCAL_SCENES, ids=[said[:60] for _, said in BAD_LOCAL_SCENES])
def test_a_bad_scene_without_an_arm_is_refused_in_one_line(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    assert said in refusal(changed(local_scene(), changes), tmp_path)


def test_the_scenes_that_are_spoilt_above_are_good(tmp_path: Path) -> None:
    for scene in (full_scene(), local_scene()):
        load_scene(written(scene, tmp_path))


def test_a_scene_made_in_python_is_held_against_its_ranges_too() -> None:
    scene = Scene(schema=1, master=MasterTable(device="touch"), safety=SafetyTable(window=0))
    with pytest.raises(SceneError, match=r"\[safety\] window = 0: must be 1 to 3600000"):
        scene_json(scene)


# ---------------------------------------------------------------------------------- the Rust side

Schema = dict[str, Any]
RUST: Schema = json.loads(subprocess.run(built("scene_schema", "quick"), check=True, capture_output=True).stdout)
PYTHON: Schema = msgspec.json.schema(Scene)
TABLES: Schema = PYTHON["$defs"]
LEFT_OUT = {table.__name__: fields for table, fields in PYTHON_ONLY.items()} | {
    "LinkSettings": {"preset"}, "Opportunities": {"file"}, "DelayTrace": {"file", "format", "direction", "half_round_trips"},
}  # fmt: skip
"""Fields that only Python has: they are resolved before the Rust side reads a scene."""


def alternatives(schema: Schema, types: Schema, seen: set[str] | None = None) -> Iterator[Schema]:
    """Yield the alternatives of a value except null; references are followed, and recorded in `seen`."""
    if "$ref" in schema:
        name = schema["$ref"].removeprefix("#/$defs/")
        if seen is not None:
            seen.add(name)
        for one in alternatives(types[name], types, seen):
            yield {**one, "properties": one["properties"] | schema["properties"]} if "properties" in schema else one
    elif choices := schema.get("anyOf", schema.get("oneOf")):
        for choice in choices:
            yield from alternatives(choice, types, seen)
    elif isinstance(schema.get("type"), list):
        yield from ({**schema, "type": kind} for kind in schema["type"] if kind != "null")
    elif schema.get("type") != "null":
        yield schema


def names(schema: Schema) -> set[str]:
    """Return the strings that a value may be, if it is an enumeration."""
    return {name for name in schema.get("enum", [schema.get("const")]) if isinstance(name, str)}


TAGS = {"kind", "type"}


def tables_of(kinds: list[Schema]) -> dict[frozenset[str], Schema]:
    """Return the tables of a union by their tags; a single table has none."""
    tables = [one for one in kinds if "properties" in one]
    if len(tables) < 2:
        return dict.fromkeys([frozenset[str]()], tables[0]) if tables else {}
    return {frozenset[str]().union(*(names(one["properties"].get(key, {})) for key in TAGS)): one for one in tables}


def item(array: Schema) -> Schema:
    found: Schema = array["items"] if "items" in array else array["prefixItems"][0]
    return found


def faults(value: Any, schema: Schema, path: str = "scene") -> list[str]:
    """Return the places where a value does not match the Rust type that serde reads."""
    types = RUST["$defs"]
    if value is None:
        nullable = "null" in schema.get("type", ()) or {"type": "null"} in schema.get("anyOf", ())
        return [] if nullable else [f"{path}: nothing"]
    kinds = list(alternatives(schema, types))
    if isinstance(value, dict):
        tags = frozenset(value[key] for key in TAGS & set(value))
        tables = tables_of(kinds)
        if not tables or (len(tables) > 1 and tags not in tables):
            return [f"{path}: no table"]
        fields = (tables.get(tags) or tables[frozenset()])["properties"]
        different = [f"{path}: {key}" for key in sorted(set(value) ^ set(fields))]
        common = (faults(value[key], fields[key], f"{path}.{key}") for key in set(value) & set(fields))
        return different + [fault for found in common for fault in found]
    if isinstance(value, list):
        arrays = [one for one in kinds if one.get("type") == "array"]
        if not arrays or not arrays[0].get("minItems", 0) <= len(value) <= arrays[0].get("maxItems", len(value)):
            return [f"{path}: no list of {len(value)}"]
        found = (faults(one, item(arrays[0]), f"{path}.{index}") for index, one in enumerate(value))
        return [fault for of_one in found for fault in of_one]
    return [] if any(fits(value, kind) for kind in kinds) else [f"{path} = {value!r}: none of its kinds"]


def fits(value: Any, kind: Schema) -> bool:
    if isinstance(value, bool):
        return kind.get("type") == "boolean"
    if isinstance(value, str):
        return value in names(kind)
    whole = kind.get("type") == "integer" and isinstance(value, int)
    bounded = kind.get("minimum", value) <= value <= kind.get("maximum", value)
    return kind.get("type") == "number" or (whole and bounded)


def differences(python: Schema, rust: Schema, path: str, seen: set[str]) -> list[str]:
    """Return the places where a Python table and a Rust type differ in fields, kinds or names."""
    mine, theirs = list(alternatives(python, TABLES)), list(alternatives(rust, RUST["$defs"], seen))
    found = []
    said = [set().union(*map(names, kinds)) - {"unbounded"} for kinds in (mine, theirs)]
    if path.endswith(".distribution"):
        said[0] |= set(DISTRIBUTIONS)  # a string in Python, that is checked where it is used
    if said[0] != said[1]:
        found.append(f"{path}: {sorted(said[0] ^ said[1])}")
    arrays = [[one for one in kinds if one.get("type") == "array"] for kinds in (mine, theirs)]
    if bool(arrays[0]) != bool(arrays[1]):
        found.append(f"{path}: a list on one side")
    elif arrays[0]:
        found += differences(item(arrays[0][0]), item(arrays[1][0]), f"{path}.0", seen)
    numbers = [
        {one["type"] for one in kinds if one.get("type") in ("number", "integer", "boolean") and not names(one)}
        | {"integer" for one in kinds if isinstance(one.get("enum", [""])[0], int)}
        for kinds in (mine, theirs)
    ]
    if numbers[0] != numbers[1] and not (numbers == [{"number"}, set()] and arrays[0]):  # else broadcast over the axes
        found.append(f"{path}: {numbers[0]}, {numbers[1]}")
    tables = [tables_of(kinds) for kinds in (mine, theirs)]
    if set(tables[0]) != set(tables[1]):
        found.append(f"{path}: tables {set(tables[0]) ^ set(tables[1])}")
    for kind in set(tables[0]) & set(tables[1]):
        left, right = resolved_fields(tables[0][kind]), dict(tables[1][kind]["properties"])
        found += [f"{path}: {key}" for key in sorted(set(left) ^ set(right))]
        for key in (set(left) & set(right)) - (TAGS if kind else set()):
            found += differences(left[key], right[key], f"{path}.{key}", seen)
    return found


def resolved_fields(table: Schema) -> Schema:
    fields = {key: field for key, field in table["properties"].items() if key not in LEFT_OUT.get(table["title"], ())}
    if table["title"] == "OperatorTable":
        words, times = fields["clutch"]["anyOf"]
        fields |= {"clutch": words, "clutch_times": times}
    return fields


def test_both_sides_have_the_same_fields_and_names() -> None:
    seen: set[str] = set()
    assert differences(PYTHON, RUST, "scene", seen) == []
    # A broken comparison could skip everything.
    assert seen >= set(RUST["$defs"])
    assert {"ArmSettings", "LadderSettings", "LinkSettings", "EstimatorKind", "Leg"} <= set(RUST["$defs"])


def test_a_field_or_name_of_one_side_alone_would_be_found() -> None:
    for path, change in {
        "run.stop_early": None, "safety.limiter.max_power_w": None, "slave.control": {"enum": ["position", "pd"]},
        "master.mass_kg": {"type": "number"}, "record.every": {"type": "number"}, "security.secure": {"type": "integer"},
        "environment.objects.0.shape.centre": None, "link.forward.attacks.0.action.bits": None,
    }.items():  # fmt: skip
        tables = copy.deepcopy(TABLES)
        *steps, key = path.split(".")
        kinds = [PYTHON]
        for step in steps:
            kinds = [
                part
                for kind in kinds
                for one in alternatives(kind, tables)
                for part in ([item(one)] if step == "0" else [one.get("properties", {}).get(step, {})])
            ]
        parents = [one for kind in kinds for one in alternatives(kind, tables) if key in one.get("properties", {})]
        if change is None:
            del parents[0]["properties"][key]
        else:
            parents[0]["properties"][key] = change
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(globals(), "TABLES", tables)
            assert any(path.rpartition(".")[0] in found for found in differences(PYTHON, RUST, "scene", set())), path


def test_what_does_not_fit_the_rust_side_would_be_found() -> None:
    spec = json.loads(scene_json(load_scene("remote_push")))
    assert faults(changed(spec, {"run.step": 1.0}), RUST) == ["scene.run: step"]
    for path, value in [
        ("run.seed", 1.0), ("slave.control", "pid"), ("master.mass_kg", 1.0), ("link.forward.distribution", "norml"),
    ]:  # fmt: skip
        assert faults(changed(spec, {path: value}), RUST) == [f"scene.{path} = {value!r}: none of its kinds"]
    assert faults(changed(spec, {"link.forward.distribution": {"table": [0.5]}}), RUST) == [
        "scene.link.forward.distribution.table.0 = 0.5: none of its kinds"
    ]
    assert faults(changed(spec, {"run.seed": None}), RUST) == ["scene.run.seed: nothing"]


@pytest.mark.parametrize("name", scene_names(attacks=True))
def test_a_shipped_scene_is_what_the_rust_side_reads(name: str) -> None:
    scene = load_scene(name)
    assert scene.title
    assert scene.shows
    assert faults(json.loads(scene_json(scene)), RUST) == []
    assert scene_json(scene) == scene_json(load_scene(name))


def test_a_scene_with_every_table_is_what_the_rust_side_reads(tmp_path: Path) -> None:
    for changes in ({}, {"link": busy_links()}):
        spec = json.loads(scene_json(load_scene(written(changed(full_scene(), changes), tmp_path))))
        assert faults(spec, RUST) == []
        assert all(value is not None for value in spec.values())


def test_a_link_has_the_defaults_of_the_rust_side() -> None:
    """Python fills missing fields with the defaults of Rust, field by field."""
    fields = RUST["$defs"]["LinkSettings"]["properties"]
    assert link_spec(LinkSettings(), "forward") == {name: field["default"] for name, field in fields.items()}


def test_the_rules_of_a_link_stand_in_the_same_order_on_both_sides() -> None:
    # A schema has no order.
    sources = (path.read_text(encoding="utf-8") for path in sorted((ROOT / "netsim" / "src").rglob("*.rs")))
    (body,) = (
        found[1] for text in sources if (found := re.search(r"pub struct LinkSettings \{(.*?)\n\}", text, re.DOTALL))
    )
    fields = [name for name in LinkSettings.__struct_fields__ if name != "preset"]
    assert fields == re.findall(r"^    pub (\w+):", body, re.MULTILINE)


# --------------------------------------------------------------------------------- defaults, presets


def spec(**tables: Any) -> dict[str, Any]:
    filled: dict[str, Any] = json.loads(scene_json(Scene(schema=1, **tables)))
    return filled


def test_what_is_absent_is_not_built() -> None:
    filled = spec(master=MasterTable(device="phantom-desktop"))
    absent = {key for key, value in filled.items() if value is None}
    assert absent == {"operator", "slave", "environment", "link", "coupling", "security", "record"}
    assert filled["safety"]["controllers"] == []
    assert filled["safety"]["limiter"] == {
        "max_force_n": 7.9, "max_slew_n_per_s": 1000.0, "max_power_w": 20.0, "ramp_in_s": 0.2
    }  # fmt: skip


@pytest.mark.parametrize("name", DEVICE_PRESETS)
def test_a_preset_fills_what_the_table_leaves_out(name: Any) -> None:
    preset = DEVICE_PRESETS[name]
    filled = spec(master=MasterTable(device=name, axes=3, coulomb=0.5))
    master = filled["master"]
    assert master["mass_kg"] == [preset.mass_kg] * 3
    assert master["viscous"] == [preset.viscous] * 3
    assert master["coulomb"] == [0.5] * 3
    assert master["encoder_quantum"] == preset.encoder_quantum
    assert master["friction"] == preset.friction
    assert filled["safety"]["limiter"]["max_force_n"] == master["max_force_n"] == preset.max_force_n
    assert filled["safety"]["estimator"]["quantum_m"] == preset.encoder_quantum
    assert filled["safety"]["damping"] <= preset.mass_kg / (5 * 1e-3)
    assert faults(filled, RUST) == []


def test_the_presets_are_those_that_a_scene_can_name() -> None:
    (literal,) = (kind for kind in types_at(("master", "device")) if isinstance(kind, msgspec.inspect.LiteralType))
    assert set(literal.values) == set(DEVICE_PRESETS)
    desktop = DEVICE_PRESETS["phantom-desktop"]
    assert (desktop.mass_kg, desktop.viscous, desktop.coulomb) == (0.157, -0.005, 0.038)
    for preset in DEVICE_PRESETS.values():
        assert 0 < preset.continuous_force_n <= preset.max_force_n
        assert preset.encoder_quantum > 0


def test_a_device_of_ones_own_needs_only_a_mass() -> None:
    master = spec(master=MasterTable(mass_kg=0.2))["master"]
    assert master["mass_kg"] == [0.2]
    assert master["encoder_quantum"] == 0.0
    assert master["measures_velocity"] is True
    assert master["max_force_n"] is None


def test_a_bound_can_be_taken_off() -> None:
    filled = spec(master=MasterTable(device="touch", max_force_n="unbounded"))
    assert filled["master"]["max_force_n"] is None
    assert filled["safety"]["limiter"]["max_force_n"] == 7.9


def test_numbers_are_spread_over_all_axes() -> None:
    filled = spec(
        master=MasterTable(device="touch", axes=3, stops=(-0.1, 0.1), velocity=(0.0, 0.1, 0.0)),
        operator=OperatorTable(start=0.01, legs=(LegTable(duration_s=1, end=(0.0, 0.1, 0.2)),)),
        environment=EnvironmentTable(
            objects=(
                ObjectTable(contact=ContactTable(stiffness=100)),
                ObjectTable(shape=Sphere(radius=0.1), contact=ContactTable(stiffness=100, law="hunt-crossley")),
            )
        ),
    )
    assert filled["master"]["stops"] == [[-0.1, 0.1]] * 3
    assert filled["master"]["position"] == filled["operator"]["start"] == [0.01] * 3
    assert filled["master"]["velocity"] == [0.0, 0.1, 0.0]
    assert filled["operator"]["legs"][0]["end"] == [0.0, 0.1, 0.2]
    assert [part["shape"] for part in filled["environment"]["objects"]] == [
        {"kind": "plane", "point": [0.0] * 3, "normal": [1.0, 0.0, 0.0]},
        {"kind": "sphere", "centre": [0.0] * 3, "radius": 0.1},
    ]
    assert [part["contact"]["exponent"] for part in filled["environment"]["objects"]] == [1.0, 1.5]


def test_the_times_of_the_ladder_follow_one_another() -> None:
    tables: dict[str, Any] = {"master": MasterTable(device="touch"), "slave": SlaveTable()}
    assert spec(**tables)["safety"]["ladder"] == {
        "stale_after_s": 0.005, "hold_after_s": 0.02, "stop_after_s": 0.2,
        "extrapolate_s": pytest.approx(0.015, abs=1e-12), "fade_out_s": 0.075, "fade_in_s": 0.2,
    }  # fmt: skip
    # A longer ramp-in applies to each engagement; prediction ends before an early HOLD.
    safety = SafetyTable(limiter=LimiterTable(ramp_in_s=0.5), ladder=LadderTable(hold_after_s=0.008))
    ladder = spec(safety=safety, **tables)["safety"]["ladder"]
    assert (ladder["fade_in_s"], ladder["extrapolate_s"]) == (0.5, pytest.approx(0.003, abs=1e-12))
    safety = SafetyTable(limiter=LimiterTable(ramp_in_s=0.5), ladder=LadderTable(fade_in_s=0.3))
    assert spec(safety=safety, **tables)["safety"]["ladder"]["fade_in_s"] == 0.3
    assert spec(master=MasterTable(device="touch"))["safety"]["ladder"] is None


def test_bounds_of_the_command_can_be_taken_off() -> None:
    tables: dict[str, Any] = {"master": MasterTable(device="touch"), "slave": SlaveTable()}
    coupling = spec(**tables)["coupling"]
    assert (coupling["command_speed"], coupling["command_reach"], coupling["changes"]) == (3.0, None, [])
    coupling = spec(coupling=CouplingTable(command_speed="unbounded", command_reach=0.1), **tables)["coupling"]
    assert (coupling["command_speed"], coupling["command_reach"]) == (None, 0.1)


def test_a_recorded_path_begins_where_it_begins(tmp_path: Path) -> None:
    scene = changed(local_scene(), {"operator.recorded": {"time_s": [0, 1], "values": [0.03, 0.0]}})
    filled = json.loads(scene_json(load_scene(written(scene, tmp_path))))
    assert filled["master"]["position"] == filled["operator"]["start"] == [0.03]


# ------------------------------------------------------------------------------------- random scenes


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, Any]:
    axes = draw(st.sampled_from([1, 2, 3, 4, 5, 6, 7]))
    arm = draw(st.booleans())

    def per_axis(low: float, high: float) -> Any:
        return draw(numbers(low, high) | st.lists(numbers(low, high), min_size=axes, max_size=axes))

    def some(table: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in table.items() if draw(st.booleans())}

    delay = draw(numbers(0, 1))
    shape = draw(
        st.sampled_from([
            {"kind": "plane", "point": per_axis(-1, 1)},
            {"kind": "sphere", "centre": per_axis(-1, 1), "radius": draw(numbers(0.01, 1))},
            {"kind": "box", "half_extents": per_axis(0.01, 1)},
            {"kind": "spring", "anchor": per_axis(-1, 1)},
        ])
    )  # fmt: skip
    scene: dict[str, Any] = {
        "schema": 1,
        "run": some({"duration_s": draw(numbers(0.1, 100)), "seed": draw(st.integers(0, 2**63 - 1))}),
        "master": {"device": draw(st.sampled_from(sorted(DEVICE_PRESETS))), "axes": axes}
        | some({"viscous": per_axis(-1, 1), "coulomb": per_axis(0, 1), "velocity": per_axis(-1, 1)}),
        "operator": some({
            "stiffness": draw(numbers(0, 1e4)),
            "start": per_axis(-1, 1),
            "legs": [{"duration_s": draw(numbers(0.01, 10)), "end": per_axis(-1, 1)}],
            "tremor": {"amplitude": draw(numbers(0, 0.01))},
        }),
        "environment": some({
            "objects": [{"shape": shape, "contact": {"stiffness": draw(numbers(0, 1e5))}}],
            "pushers": [{"shape": "half-sine", "duration_s": draw(numbers(0.01, 10)), "force_n": per_axis(-10, 10)}],
        }),
        "safety": some({
            "controllers": draw(st.lists(st.sampled_from(["vfc", "hsc", "wsc", "pc"]), unique=True)),
            "window": draw(st.integers(1, 3_600_000)),
            "estimator": draw(st.sampled_from([{"kind": "kalman"}, {"kind": "adaptive-window"}, {"kind": "low-pass", "cutoff_hz": 50.0}])),
            "limiter": draw(st.sampled_from([{}, {"enabled": False}, {"max_force_n": 3.0}])),
        }),
        "record": {"every": draw(st.integers(1, 100))},
    }  # fmt: skip
    if arm:
        scene["slave"] = some(
            {"mass_kg": draw(numbers(0.1, 10)), "position": per_axis(-1, 1), "max_speed": "unbounded"}
        )
        scene["link"] = {"forward": {"delay_s": delay, "jitter_s": draw(numbers(0, delay / 4))}}
    return scene


@given(scene=scenes())
def test_a_valid_scene_survives_the_way_to_the_rust_side(
    scene: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    loaded = load_scene(written(scene, tmp_path_factory.mktemp("scene")))
    specification = scene_json(loaded)
    filled = json.loads(specification)
    assert faults(filled, RUST) == []
    axes = scene["master"]["axes"]
    assert {len(filled["master"][key]) for key in ("mass_kg", "viscous", "coulomb", "position", "velocity")} == {axes}
    # Once filled in and written, the scene is fully determined.
    again = msgspec.convert(msgspec.to_builtins(loaded), Scene)
    assert scene_json(again) == specification
