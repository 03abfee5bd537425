"""Resolution of a scene to the numbers of the Rust side: presets and defaults filled in, one value per axis."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from math import cos, hypot, inf, sin, sqrt
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any, Literal, TypeAlias, TypeVar

from msgspec import Struct, inspect
from msgspec.structs import replace

from haptether.bridge.scene.errors import Path, SceneError, place, wrong
from haptether.bridge.scene.tables.master import (
    AimsTable,
    FingerTable,
    MasterTable,
    OperatorRotationTable,
    OperatorTable,
    RotationLegTable,
    SeriesTable,
)
from haptether.bridge.scene.tables.ranges import UNBOUNDED, Broadcast, SideKind
from haptether.bridge.scene.tables.session import (
    AdaptiveWindow,
    CouplingTable,
    DualKalman,
    EstimatorTable,
    Kalman,
    LadderTable,
    LimiterTable,
    LinksTable,
    RotationSafetyTable,
    RunTable,
    SafetyTable,
    Scene,
    TriggerSafetyTable,
)
from haptether.bridge.scene.tables.slave import (
    ContactTable,
    EnvironmentTable,
    GripperTable,
    ObjectTable,
    Plane,
    PusherTable,
    SlaveTable,
    ToolTable,
    TorqueTable,
)
from haptether.master import DEVICE_PRESETS
from haptether.netsim import LinkError, LinkSettings, link_spec, with_files
from haptether.safety import SafetySettings

Spec: TypeAlias = dict[str, Any]
"""Table as the Rust side reads it (`bridge/src/scene/spec.rs`)."""

PYTHON_ONLY: dict[type[Struct], frozenset[str]] = {
    Scene: frozenset({"schema", "title", "shows"}),
    RunTable: frozenset({"integrator"}),
    MasterTable: frozenset({"device", "driver", "options"}),
    RotationLegTable: frozenset({"turn"}),
    SlaveTable: frozenset({"device", "kind", "options"}),
    GripperTable: frozenset({"device", "options"}),
    SeriesTable: frozenset({"file"}),
    AimsTable: frozenset({"file"}),
    LimiterTable: frozenset({"enabled"}),
    SafetyTable: frozenset({"preset"}),
}
"""Fields that are not part of a resolved scene."""

DEFAULT_QUANTUM_M = 2.3e-5
"""Quantum in m that the default estimator assumes for an exact device: that of a PHANTOM Desktop."""
DEFAULT_MAX_FORCE_N = 7.9
DEFAULT_DAMPING = 5.0
"""mu of the paper, in N s/m."""
DEFAULT_PC_DAMPING = 10.0
PAPER_THRESHOLDS: Mapping[str, float | str] = MappingProxyType({
    "velocity_threshold": 0.6,
    "vfc_force_threshold_n": 1.0,
    "vfc_form": "product",
    "hsc_force_threshold_n": 0.1,
    "hsc_velocity_threshold": 0.0,
    "energy_threshold_j": -0.03,
    "wsc_force_threshold_n": 0.0,
    "energy_ratio": 0.5,
    "window": 100,
})  # fmt: skip
"""Thresholds of the preset "paper", from its section 4."""
MEASURED_THRESHOLDS: Mapping[str, float | str] = MappingProxyType({
    "velocity_threshold": 0.45,
    "vfc_force_threshold_n": 0.3,
    "vfc_form": "both",
    "hsc_force_threshold_n": 0.3,
    "hsc_velocity_threshold": 0.05,
    "energy_ratio": 0.05,
    "window": 10,
})  # fmt: skip
"""Thresholds of the preset "measured" (docs/thresholds.md). Those of WSC follow from the device."""
MEASURED_WSC_SPEED = 0.29
"""V_w in m/s: speed of a free device above which WSC of the preset "measured" trips, `sqrt(2 eta |delta| / m)`."""
MEASURED_WSC_FORCE_N = 0.005
"""F_w in N of the preset "measured" for a device with stops."""
PROBED_SPEED = 0.12
"""Default probe force divided by mu, in m/s (rad/s for joints); damped by 1.25 mu, it reaches at most 0.096."""
RELEASE_TRIES = 5
DEFAULT_EXTRAPOLATION_S = 0.015
MIN_FADE_IN_S = 0.2
MAX_LINEAR_AXES = 3


def spec_of(scene: Scene) -> Spec:
    """Return all resolved tables of a scene.

    Raises:
        SceneError: A list does not have one value per axis, the device has no mass, or a link is invalid.
    """
    axes, run, operator = scene.master.axes, scene.run, scene.operator
    start = None if operator is None else _start(operator, axes)
    master = resolved(_master(scene.master, start), axes, ("master",))
    tables = {
        name: resolved(table, axes, (name,))
        for name, table in {
            "run": run,
            "operator": operator
            and replace(
                operator,
                start=start,
                rotation=operator.rotation and _turning(operator.rotation),
                finger=operator.finger or (FingerTable() if scene.master.gripper else None),
            ),
            "slave": scene.slave and _slave(scene.slave, run, master),
            "environment": scene.environment and _environment(scene.environment, axes, run.duration_s),
        }.items()
    }
    if operator is not None:
        tables["operator"] |= _clutch(operator)
    links = scene.link and {**resolved(scene.link, axes, ("link",)), **spec_of_links(scene.link)}
    coupling = None if scene.slave is None else scene.coupling or CouplingTable()
    safety = resolved(_safety(scene, master), axes, ("safety",))
    if not scene.safety.limiter.enabled:
        safety["limiter"] = None
    return {
        **tables,
        "master": master,
        "link": links,
        "coupling": resolved(coupling, axes, ("coupling",)),
        "security": resolved(scene.security, axes, ("security",)),
        "safety": safety,
        "record": resolved(scene.record, axes, ("record",)),
    }


# ---------------------------------------------------------------------------------------------- every field alike


def resolved(value: Any, axes: int, path: Path, broadcast: Broadcast | None = None) -> Any:  # noqa: ANN401  # any field
    """Resolve all fields of a table by their declared types: one value per axis, None for no bound.

    Raises:
        SceneError: A list does not have one value per axis.
    """
    if value is None or value == UNBOUNDED or isinstance(value, LinkSettings):
        return None  # links are resolved by `spec_of_links`
    if isinstance(value, Struct):
        config = value.__struct_config__
        spec = {} if config.tag_field is None else {config.tag_field: config.tag}
        for name, kind in _broadcasts(type(value)).items():
            spec[name] = resolved(getattr(value, name), axes, (*path, name), kind)
        return spec
    if broadcast == "axes":
        return broadcast_axes(value, axes, path)
    if broadcast == "pairs":
        return _broadcast_pairs(value, axes, path)
    if isinstance(value, tuple):
        each: Broadcast | None = "axes" if broadcast == "rows" else None
        return [resolved(item, axes, (*path, index), each) for index, item in enumerate(value)]
    return value


@cache
def _broadcasts(table: type[Struct]) -> dict[str, Broadcast | None]:
    """Return the fields that the Rust side takes, and how their values are broadcast over the axes."""
    kind = inspect.type_info(table)
    assert isinstance(kind, inspect.StructType)
    left_out = PYTHON_ONLY.get(table, frozenset())
    return {field.name: _broadcast(field.type) for field in kind.fields if field.name not in left_out}


def _broadcast(kind: inspect.Type) -> Broadcast | None:
    for alternative in kind.types if isinstance(kind, inspect.UnionType) else (kind,):
        if isinstance(alternative, inspect.Metadata) and alternative.extra:
            declared: Broadcast = alternative.extra["broadcast"]
            return declared
        if isinstance(alternative, inspect.VarTupleType) and _broadcast(alternative.item_type) == "axes":
            return "rows"
    return None


def broadcast_axes(value: float | Sequence[float], axes: int, path: Path) -> list[float]:
    """Return one number per axis.

    Raises:
        SceneError: The list has another length.
    """
    if isinstance(value, int | float):
        return [float(value)] * axes
    if len(value) != axes:
        raise wrong(path, value, f"one number or a list of {axes}, one per axis")
    return [float(one) for one in value]


def _broadcast_pairs(value: Sequence[Any], axes: int, path: Path) -> list[tuple[float, float]]:
    pairs = [one for one in value if isinstance(one, tuple)]
    if len(value) == 2 and not pairs:
        return [(value[0], value[1])] * axes
    if len(pairs) != len(value) or len(pairs) != axes:
        raise wrong(path, value, f"[lower, upper] or a list of {axes} such pairs, one per axis")
    return [(low, high) for low, high in pairs]


# ---------------------------------------------------------------------------------- what depends on other fields


def _master(table: MasterTable, start: tuple[float, ...] | None) -> MasterTable:
    if table.device is not None:
        preset = DEVICE_PRESETS[table.device]
        known = {name: getattr(preset, name) for name in preset.__struct_fields__ if hasattr(table, name)}
        table = replace(table, **{name: value for name, value in known.items() if getattr(table, name) is None})
    if table.mass_kg is None:
        raise SceneError(f"{place(('master', 'mass_kg'))} is missing: give it, or name a device")
    table = _filled(table, viscous=0.0, coulomb=0.0, friction="vector", encoder_quantum=0.0, kind=side_kind(table))
    return _filled(table, measures_velocity=table.encoder_quantum == 0.0, position=0.0 if start is None else start)


def side_kind(table: MasterTable) -> SideKind:
    """Return the kind of coordinates of the scene's sides."""
    return table.kind or ("linear" if table.axes <= MAX_LINEAR_AXES else "joints")


def _turning(table: OperatorRotationTable) -> OperatorRotationTable:
    """Convert the turns of a hand to the orientations at which they end."""
    orientation = table.start_wxyz
    legs = []
    for leg in table.legs:
        orientation = leg.end_wxyz or _turned(leg.turn or (0.0, 0.0, 0.0), orientation)
        legs.append(replace(leg, end_wxyz=orientation))
    return replace(table, legs=tuple(legs))


def _turned(turn: Sequence[float], quat_wxyz: Sequence[float]) -> tuple[float, ...]:
    """Return `exp(turn) R` as a quaternion product; turn is axis times angle in rad."""
    angle = hypot(*turn)
    share = 0.5 if angle == 0.0 else sin(0.5 * angle) / angle
    a, (b, c, d) = cos(0.5 * angle), (share * part for part in turn)
    w, x, y, z = quat_wxyz
    parts = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    norm = hypot(*parts)
    return tuple(part / norm for part in parts)


_Table = TypeVar("_Table", bound=Struct)


def _filled(table: _Table, **defaults: object) -> _Table:
    """Return the table with defaults for absent values."""
    return replace(table, **{name: value for name, value in defaults.items() if getattr(table, name) is None})


def _start(table: OperatorTable, axes: int) -> tuple[float, ...]:
    """Return the start of the hand's path in m per axis."""
    if table.recorded is not None and table.recorded.values:
        path: Path = ("operator", "recorded", "values", 0)
        return tuple(broadcast_axes(table.recorded.values[0], axes, path))
    return tuple(broadcast_axes(table.start, axes, ("operator", "start")))


def _clutch(table: OperatorTable) -> Spec:
    times = None if isinstance(table.clutch, str) else [list(pair) for pair in table.clutch]
    return {"clutch": table.clutch if times is None else "once", "clutch_times": times}


def _slave(table: SlaveTable, run: RunTable, master: Spec) -> SlaveTable:
    critical = 2.0 * sqrt((table.stiffness or 0.0) * table.mass_kg)
    position = tuple(master["position"])
    tool = table.tool and _tool(table.tool)
    return _filled(
        replace(table, tool=tool), stiffness=0.0, damping=critical, period_s=run.period_s, position=position,
        max_force_n=50.0, max_torque_nm=5.0,
    )  # fmt: skip


def _tool(table: ToolTable) -> ToolTable:
    inertia = table.inertia_kg_m2
    least = min(inertia) if isinstance(inertia, tuple) else inertia
    return _filled(table, rotational_damping=2.0 * sqrt(table.rotational_stiffness * least))


def _environment(table: EnvironmentTable, axes: int, duration_s: float) -> EnvironmentTable:
    return replace(
        table,
        objects=tuple(_object(part, axes, duration_s) for part in table.objects),
        pushers=tuple(_pusher(part, duration_s) for part in table.pushers),
        torques=tuple(_pusher(part, duration_s) for part in table.torques),
        holes=tuple(replace(hole, contact=_contact(hole.contact)) for hole in table.holes),
    )


def _object(table: ObjectTable, axes: int, duration_s: float) -> ObjectTable:
    shape, contact, motion = table.shape, table.contact, table.motion
    along_x = (1.0,) + (0.0,) * (axes - 1)
    return replace(
        table,
        shape=_filled(shape, normal=along_x) if isinstance(shape, Plane) else shape,
        contact=_contact(contact),
        motion=motion and _filled(motion, until_s=max(duration_s, motion.from_s)),
    )


def _contact(table: ContactTable) -> ContactTable:
    return _filled(table, exponent=1.0 if table.law == "kelvin-voigt" else 1.5)


_Push = TypeVar("_Push", PusherTable, TorqueTable)


def _pusher(table: _Push, duration_s: float) -> _Push:
    recorded = table.recorded if isinstance(table, PusherTable) else None
    lasts_s = duration_s if recorded is None or not recorded.time_s else recorded.time_s[-1]
    force = {"force_n": 0.0} if isinstance(table, PusherTable) else {}
    return _filled(table, duration_s=lasts_s, rise_s=0.0, frequency_hz=0.0, **force)


def max_damping(mass_kg: Sequence[float], period_s: float) -> float:
    """Return the largest stable damping of a sampled device in N s/m: m / (5 dT) of its lightest axis."""
    return min(mass_kg) / (5.0 * period_s)


def _safety(scene: Scene, master: Spec) -> SafetyTable:
    table = scene.safety
    limit = max_damping(master["mass_kg"], scene.run.period_s)
    max_force_n = master["max_force_n"] or DEFAULT_MAX_FORCE_N
    cap_n = (table.limiter.max_force_n or max_force_n) if table.limiter.enabled else inf
    if table.probe_force_n is not None and table.probe_force_n > cap_n:
        allowed = f"at most what the limiter lets the device exert, {cap_n:g}"
        raise wrong(("safety", "probe_force_n"), table.probe_force_n, allowed)
    table = _filled(table, damping=min(DEFAULT_DAMPING, limit), pc_max_damping=min(DEFAULT_PC_DAMPING, limit))
    return replace(
        _filled(_released(table, max(master["coulomb"]), cap_n), **_thresholds(scene, master)),
        estimator=_estimator(table.estimator, master["encoder_quantum"] or DEFAULT_QUANTUM_M),
        limiter=_filled(table.limiter, max_force_n=max_force_n),
        ladder=None if scene.slave is None else _ladder(table.ladder or LadderTable(), table.limiter),
        rotation=table.rotation or RotationSafetyTable() if side_kind(scene.master) == "pose" else None,
        gripper=table.gripper or TriggerSafetyTable() if scene.master.gripper else None,
    )


def _thresholds(scene: Scene, master: Spec) -> dict[str, float | str]:
    """Return the thresholds of the preset. Joints have no measured thresholds."""
    table, kind = scene.safety, side_kind(scene.master)
    if (table.preset or ("paper" if kind == "joints" else "measured")) == "paper":
        return dict(PAPER_THRESHOLDS)
    eta = table.energy_ratio or float(MEASURED_THRESHOLDS["energy_ratio"])
    return {
        **MEASURED_THRESHOLDS,
        "energy_threshold_j": -min(master["mass_kg"]) * MEASURED_WSC_SPEED**2 / (2.0 * eta),
        "wsc_force_threshold_n": 0.0 if master["stops"] is None else MEASURED_WSC_FORCE_N,
    }


def _released(table: SafetyTable, coulomb: float, max_force_n: float) -> SafetyTable:
    """Fill in the release condition after a trip: an answered probe, or motion if friction c would hide a probe."""
    probe_force_n = PROBED_SPEED * (table.damping or 0.0)
    hidden = probe_force_n * table.probe_threshold < SafetySettings.FRICTION_ROOM * coulomb
    hidden = hidden or probe_force_n > max_force_n
    return _filled(table, probe_force_n=0.0 if hidden else probe_force_n, release_tries=RELEASE_TRIES)


def _estimator(table: EstimatorTable, quantum_m: float) -> EstimatorTable:
    match table:
        case Kalman() | DualKalman():
            return _filled(table, quantum_m=quantum_m)
        case AdaptiveWindow():
            return _filled(table, noise_bound_m=quantum_m)
        case _:
            return table


def _ladder(table: LadderTable, limiter: LimiterTable) -> LadderTable:
    # In whole ns, same as the Rust side, so that rounding cannot extend it beyond HOLD.
    stale_ns, hold_ns = round(table.stale_after_s * 1e9), round(table.hold_after_s * 1e9)
    extrapolate_s = min(DEFAULT_EXTRAPOLATION_S, max(hold_ns - stale_ns, 0) * 1e-9)
    fade_in_s = max(MIN_FADE_IN_S, limiter.ramp_in_s if limiter.enabled else 0.0)
    return _filled(table, extrapolate_s=extrapolate_s, fade_in_s=fade_in_s)


# ------------------------------------------------------------------------------------------------------- links

_Made = TypeVar("_Made")
_Direction = Literal["forward", "backward"]


def embedded_links(links: LinksTable, folder: FilePath) -> LinksTable:
    """Return the links with the contents of their files embedded; paths are relative to `folder`.

    Raises:
        SceneError: A file cannot be read; gives the line.
    """
    return replace(links, **_each(links, lambda link, direction: with_files(link, folder, direction)))


def spec_of_links(links: LinksTable) -> dict[str, Spec | None]:
    """Return both directions in the form of the Rust side.

    Raises:
        SceneError: The settings are invalid.
    """
    return _each(links, link_spec)


def _each(links: LinksTable, make: Callable[[LinkSettings, _Direction], _Made]) -> dict[str, _Made | None]:
    made: dict[str, _Made | None] = {}
    directions: tuple[_Direction, ...] = ("forward", "backward")
    for direction in directions:
        link: LinkSettings | None = getattr(links, direction)
        try:
            made[direction] = None if link is None else make(link, direction)
        except LinkError as error:
            steps: Path = tuple(int(step) if step.isdigit() else step for step in error.key.split("."))
            raise SceneError(f"{place(('link', direction, *steps))}{error.problem}") from None
    return made
