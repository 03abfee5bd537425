"""Checks for contradictions within a scene."""

from collections.abc import Iterator
from itertools import pairwise
from math import exp, hypot, log, pi

from haptether._core import PRESS_S, ROUND_TRIP_S
from haptether.bridge.scene.errors import Path, SceneError, contradiction, wrong
from haptether.bridge.scene.resolve import Spec, max_damping, side_kind, spec_of
from haptether.bridge.scene.tables.master import (
    AimsTable,
    OperatorRotationTable,
    OperatorTable,
    RotationTable,
    SeriesTable,
)
from haptether.bridge.scene.tables.ranges import MAX_TICKS, MIN_DURATION_S
from haptether.bridge.scene.tables.session import (
    AlignmentTable,
    ClockTable,
    CouplingTable,
    LadderTable,
    LimiterTable,
    LinksTable,
    LowPass,
    RunTable,
    SafetyTable,
    SavitzkyGolay,
    Scene,
)
from haptether.bridge.scene.tables.slave import (
    SIMULATED,
    ContactTable,
    EnvironmentTable,
    ObjectTable,
    Plane,
    PusherTable,
    SlaveTable,
    Spring,
    ToolTable,
    TorqueTable,
)

SLAVE_PERIOD_S = (1e-5, 2e-2)
MAX_REFERENCE_M = 10.0
"""Largest distance in m of a reference point from the tool point."""
MAX_AIM_M = 2.0
"""Largest distance in m of a target from the origin."""
JERK_DENSITIES = {"kalman": ("jerk_density",), "dual-kalman": ("velocity_jerk_density", "jerk_density")}
"""Keys that set the bandwidth of each Kalman filter."""
KALMAN_BANDWIDTH = (1e-3, 10.0)
"""Bounds on omega dT of the Kalman filter."""


def checked_spec(scene: Scene) -> Spec:
    """Return the numbers of a scene whose parts are consistent.

    Raises:
        SceneError: First contradiction, with table and key.
    """
    for refusal in contradictions(scene):
        raise refusal
    spec = spec_of(scene)
    for refusal in _of_numbers(spec):
        raise refusal
    return spec


def contradictions(scene: Scene) -> Iterator[SceneError]:
    """Yield every contradiction that the tables alone show."""
    yield from _run(scene.run)
    yield from _driver_options(scene)
    yield from _research(scene)
    if scene.operator is not None:
        yield from _operator(scene.operator)
        yield from _operator_of(scene, scene.operator)
    yield from _kind(scene)
    yield from _buttons(scene)
    yield from _felt_trigger(scene)
    if scene.slave is not None:
        yield from _slave(scene.slave, scene.run)
        yield from _takes_force(scene, scene.slave)
    for key in ("link", "coupling", "security"):
        if scene.slave is None and getattr(scene, key) is not None:
            yield contradiction((key,), "needs an arm to lead to: add [slave] or leave it out")
    if scene.coupling is not None:
        yield from _coupling(scene.coupling, scene.master.axes)
    if scene.link is not None:
        yield from _clocks(scene.link)
    if scene.environment is not None:
        yield from _environment(scene.environment, scene.slave is not None, scene.master.axes)
    if scene.slave is not None and scene.safety.signals == "true":
        yield contradiction(
            ("safety", "signals"), 'with a [slave] only "estimated": an endpoint knows what is measured'
        )
    yield from _safety(scene.safety, scene.run.period_s)
    if scene.safety.ladder is not None:
        if scene.slave is None:
            yield contradiction(("safety", "ladder"), "needs an arm at the other end: add [slave] or leave it out")
        yield from _ladder(scene.safety.ladder)


def _is_whole_ns(time_s: float) -> bool:
    return abs(time_s * 1e9 - round(time_s * 1e9)) <= 1e-3


def _run(run: RunTable) -> Iterator[SceneError]:
    if run.seed >= 2**64:
        yield wrong(("run", "seed"), run.seed, "0 to 2^64 - 1")
    if not _is_whole_ns(run.period_s):
        yield wrong(("run", "period_s"), run.period_s, "a whole number of ns")
    if run.duration_s < run.period_s:
        yield wrong(("run", "duration_s"), run.duration_s, f"at least one period of {run.period_s:g} s")
    if run.duration_s / run.period_s > MAX_TICKS * (1.0 + 1e-9):
        allowed = f"at most 2e7 ticks, {MAX_TICKS * run.period_s:g} s at period_s = {run.period_s:g}"
        yield wrong(("run", "duration_s"), run.duration_s, allowed)


def _operator(table: OperatorTable) -> Iterator[SceneError]:
    before_s = -1.0
    for index, (at_s, position) in enumerate(table.trigger):
        path: Path = ("operator", "trigger", index)
        if at_s <= before_s:
            yield wrong((*path, 0), at_s, f"above the time before it, {before_s:g}")
        if not 0.0 <= position <= 1.0:
            yield wrong((*path, 1), position, "0 (open) to 1 (closed)")
        before_s = at_s
    if table.recorded is not None:
        if table.legs:
            yield contradiction(("operator", "recorded"), "stands instead of legs: give one of the two")
        if table.start != 0.0:
            yield contradiction(("operator", "start"), "a recorded path begins where it begins: leave it out")
        yield from _series(table.recorded, ("operator", "recorded"))
    if not isinstance(table.clutch, str):
        # In whole ns, same as the Rust side.
        times = [round(time_s * 1e9) for pair in table.clutch for time_s in pair]
        if any(later <= earlier for earlier, later in pairwise(times)):
            yield contradiction(("operator", "clutch"), "presses and releases must follow one another in time")
    if table.regrasp is not None and table.release is None:
        yield contradiction(("operator", "regrasp"), "needs [operator.release]: who never lets go takes no new hold")
    if table.release is not None:
        if table.stiffness == 0.0 and table.damping == 0.0:
            yield contradiction(("operator", "release"), "needs a hand: stiffness or damping above 0")
        if table.release.kind == "strength" and table.grip_strength_n is None:
            yield contradiction(
                ("operator", "release", "kind"),
                'a strength without bound does not decay: give grip_strength_n, or kind = "gain"',
            )


def _operator_of(scene: Scene, table: OperatorTable) -> Iterator[SceneError]:
    """Check that the rest of the scene has what the operator works."""
    if scene.slave is None and table.clutch != "auto":
        yield contradiction(("operator", "clutch"), "needs an arm to let go of: add [slave] or leave it out")
    if table.trigger and (scene.slave is None or scene.slave.gripper is None):
        yield contradiction(("operator", "trigger"), "leads no gripper: add [slave.gripper] or leave it out")
    if table.aims is None:
        return
    path: Path = ("operator", "aims")
    if scene.slave is None:
        yield contradiction(path, "needs an arm to lead: add [slave] or leave it out")
    if side_kind(scene.master) != "linear":
        yield contradiction(path, f'moves a point: kind = "linear", not "{side_kind(scene.master)}"')
    if scene.master.driver is not None:
        yield contradiction(path, "aims a model: give it or [master] driver, not both")
    for key in _NOT_BESIDE_AIMS:
        if getattr(table, key) != getattr(OperatorTable(), key):
            yield contradiction(("operator", key), "each aim replaces it: give it or [operator.aims], not both")
    yield from _aims(table.aims, path)


_NOT_BESIDE_AIMS = (
    "stiffness", "damping", "grip_strength_n", "legs", "recorded", "release", "regrasp", "tremor"
)  # fmt: skip


def _aims(table: AimsTable, path: Path) -> Iterator[SceneError]:
    if table.file is not None and table.rows:
        yield contradiction((*path, "file"), "either file, or rows")
    before_s = 0.0
    for index, row in enumerate(table.rows):
        if row.at_s < before_s:
            yield wrong((*path, "rows", index, "at_s"), row.at_s, f"at least that of the row before, {before_s:g}")
        before_s = row.at_s
        if isinstance(row.target, tuple) and hypot(*row.target) > MAX_AIM_M:
            yield wrong((*path, "rows", index, "target"), row.target, f"within {MAX_AIM_M:g} m of the origin")


def _buttons(scene: Scene) -> Iterator[SceneError]:
    """Check that each button has one function, and that a gripper exists for the gripper button."""
    table = scene.master.buttons
    if table is None:
        return
    path: Path = ("master", "buttons")
    given = [bit for bit in (table.clutch, table.engage, table.gripper) if bit is not None]
    if scene.slave is None:
        yield contradiction(path, "needs an arm to lead: add [slave] or leave it out")
    if len(set(given)) < len(given):
        yield contradiction(path, "a button of its own for each of clutch, engage and gripper")
    if table.clutch is not None and table.engage is not None:
        yield contradiction((*path, "engage"), "works the clutch as clutch does: give one of the two")
    if table.gripper is not None and (scene.slave is None or scene.slave.gripper is None):
        yield contradiction((*path, "gripper"), "works no gripper: add [slave.gripper] or leave it out")


def _felt_trigger(scene: Scene) -> Iterator[SceneError]:
    """Check keys that a trigger with force feedback needs, and that nothing else may have."""
    finger = scene.operator and scene.operator.finger
    if scene.master.gripper is None:
        of_trigger: dict[Path, object] = {("operator", "finger"): finger, ("safety", "gripper"): scene.safety.gripper}
        for path, given in of_trigger.items():
            if given:
                yield contradiction(path, "is for a trigger that is felt: give [master.gripper], or leave it out")
        return
    at: Path = ("master", "gripper")
    if scene.slave is None or scene.slave.gripper is None:
        yield contradiction(at, "leads no gripper: add [slave.gripper] or leave it out")
    trigger = scene.master.gripper
    if trigger.encoder_quantum > trigger.travel_m:
        yield wrong((*at, "encoder_quantum"), trigger.encoder_quantum, f"at most travel_m, {trigger.travel_m:g}")
    if scene.master.buttons is not None and scene.master.buttons.gripper is not None:
        yield contradiction(("master", "buttons", "gripper"), "works what [master.gripper] leads: give one of the two")
    if scene.run.stop_early:
        yield contradiction(("run", "stop_early"), "a trigger that is felt is not watched for rest: leave it out")
    if finger and finger.release and finger.release.kind == "strength" and finger.strength_n is None:
        yield contradiction(
            ("operator", "finger", "release", "kind"),
            'a strength without bound does not decay: give strength_n, or kind = "gain"',
        )


AXES_OF_KIND = {"linear": (1, 2, 3), "joints": (1, 2, 3, 4, 5, 6, 7), "pose": (3,)}


def _kind(scene: Scene) -> Iterator[SceneError]:
    """Check keys that a side of kind "pose" needs, and that no other kind may have."""
    kind, axes = side_kind(scene.master), scene.master.axes
    if axes not in AXES_OF_KIND[kind]:
        allowed = " or ".join(map(str, AXES_OF_KIND[kind]))
        yield wrong(("master", "axes"), axes, f'{allowed} with kind = "{kind}"')
    if scene.slave is not None and scene.slave.kind not in {None, kind}:
        allowed = f'"{kind}", that of the master: there is no map from {kind} to {scene.slave.kind} yet'
        yield wrong(("slave", "kind"), scene.slave.kind, allowed)
    world = scene.environment
    of_pose: dict[Path, object] = {
        ("master", "rotation"): scene.master.rotation,
        ("operator", "rotation"): scene.operator and scene.operator.rotation,
        ("slave", "tool"): scene.slave and scene.slave.tool,
        ("safety", "rotation"): scene.safety.rotation,
        ("coupling", "rotation_axis"): scene.coupling and scene.coupling.rotation_axis,
        ("coupling", "alignment"): scene.coupling and scene.coupling.alignment,
        ("coupling", "reference_point"): scene.coupling and scene.coupling.reference_point,
        ("environment", "torques"): world and world.torques,
        ("environment", "holes"): world and world.holes,
        ("environment", "handles"): world and world.handles,
        ("environment", "bodies"): world and world.bodies,
    }
    if kind != "pose":
        for path, given in of_pose.items():
            if given:
                yield contradiction(path, 'is for what turns: give [master] kind = "pose", or leave it out')
        return
    yield from _pose(scene)


def _pose(scene: Scene) -> Iterator[SceneError]:
    for path, given in {
        ("slave",): scene.slave,
        ("master", "rotation"): scene.master.rotation,
        ("slave", "tool"): scene.slave and scene.slave.tool,
    }.items():
        if given is None:
            yield contradiction(path, 'is missing: kind = "pose" needs it')
    yield from _rigid(scene.master.rotation, ("master", "rotation", "inertia_kg_m2"))
    if scene.run.stop_early:
        yield contradiction(("run", "stop_early"), "what turns is not watched for rest: leave it out")
    if scene.slave is not None:
        if scene.slave.control != "pd":
            yield wrong(("slave", "control"), scene.slave.control, '"pd" with kind = "pose"')
        if scene.slave.force_sensor is not None:
            yield contradiction(("slave", "force_sensor"), 'is exact with kind = "pose": leave it out')
    if scene.coupling is not None:
        yield from _turning_coupling(scene.coupling)
    if scene.slave is not None and scene.slave.tool is not None:
        yield from _unit(scene.slave.tool.quat_wxyz, ("slave", "tool", "quat_wxyz"))
        yield from _rigid(scene.slave.tool, ("slave", "tool", "inertia_kg_m2"))
    if scene.environment is not None:
        yield from _world(scene.environment)
    if scene.operator is not None and scene.operator.rotation is not None:
        yield from _turning_hand(scene.operator.rotation)


def _turning_coupling(table: CouplingTable) -> Iterator[SceneError]:
    if table.rotation_axis is not None:
        path: Path = ("coupling", "rotation_axis")
        length = hypot(*table.rotation_axis)
        if abs(length - 1.0) > UNIT_QUATERNION:
            yield wrong(path, table.rotation_axis, f"of length 1, not {length:g}")
        if table.locks_rotation:
            yield contradiction(path, "what is locked turns about no axis: give one of the two")
    if table.reference_point is not None and hypot(*table.reference_point) > MAX_REFERENCE_M:
        allowed = f"within {MAX_REFERENCE_M:g} m of the tool point"
        yield wrong(("coupling", "reference_point"), table.reference_point, allowed)
    if table.alignment is not None:
        yield from _alignment(table, table.alignment)


def _alignment(coupling: CouplingTable, table: AlignmentTable) -> Iterator[SceneError]:
    path: Path = ("coupling", "alignment")
    if coupling.locks_rotation or coupling.rotation_axis is not None:
        key = "locks_rotation" if coupling.locks_rotation else "rotation_axis"
        yield contradiction(path, f"turns about any axis: leave it out, or {key}")
    apart = "1 with [coupling.alignment]: at another scale the sides would not stay aligned; leave out one of the keys"
    if coupling.rotation_scale != 1.0:
        yield wrong(("coupling", "rotation_scale"), coupling.rotation_scale, apart)
    for index, change in enumerate(coupling.changes):
        if change.rotation_scale not in {None, 1.0}:
            yield wrong(("coupling", "changes", index, "rotation_scale"), change.rotation_scale, apart)
    allowed = coupling.command_angular_speed
    if not isinstance(allowed, str) and table.speed > allowed:
        yield wrong((*path, "speed"), table.speed, f"at most command_angular_speed, {allowed:g}")
    if table.max_angle / table.speed > PRESS_S - ROUND_TRIP_S:
        most = table.speed * (PRESS_S - ROUND_TRIP_S)
        yield wrong(
            (*path, "max_angle"),
            table.max_angle,
            f"at most {most:g} at that speed, for a press waits {PRESS_S:g} s, and a slow link takes "
            f"{ROUND_TRIP_S:g} s of it: raise speed or lower max_angle",
        )


def _world(table: EnvironmentTable) -> Iterator[SceneError]:
    for index, part in enumerate(table.objects):
        if part.body is not None:
            path: Path = ("environment", "objects", index, "body")
            yield contradiction(path, "around a tool that turns [[environment.bodies]] has what moves: leave it out")
    for index, hole in enumerate(table.holes):
        path = ("environment", "holes", index)
        yield from _direction(hole.axis, (*path, "axis"))
        if hole.chamfer_m > hole.depth:
            yield wrong((*path, "chamfer_m"), hole.chamfer_m, f"at most depth, {hole.depth:g}")
        yield from _contact(hole.contact, (*path, "contact"), 3)
    for index, handle in enumerate(table.handles):
        path = ("environment", "handles", index)
        yield from _direction(handle.axis, (*path, "axis"))
        lower, upper = handle.stops_rad
        if lower >= upper:
            yield wrong((*path, "stops_rad"), handle.stops_rad, "the lower stop below the upper")
    for index, body in enumerate(table.bodies):
        yield from _unit(body.quat_wxyz, ("environment", "bodies", index, "quat_wxyz"))


def _direction(axis: tuple[float, ...], path: Path) -> Iterator[SceneError]:
    if not any(axis):
        yield wrong(path, axis, "of any length but 0")


def _turning_hand(table: OperatorRotationTable) -> Iterator[SceneError]:
    at: Path = ("operator", "rotation")
    yield from _unit(table.start_wxyz, (*at, "start_wxyz"))
    for index, leg in enumerate(table.legs):
        path: Path = (*at, "legs", index)
        if (leg.turn is None) == (leg.end_wxyz is None):
            yield contradiction(path, "needs turn or end_wxyz, one of the two")
        if leg.turn is not None and hypot(*leg.turn) >= pi:
            yield wrong((*path, "turn"), leg.turn, "shorter than pi: a longer way is several legs")
        if leg.end_wxyz is not None:
            yield from _unit(leg.end_wxyz, (*path, "end_wxyz"))
    if table.release is not None and table.release.kind == "strength" and table.strength_n_m is None:
        yield contradiction(
            (*at, "release", "kind"), 'a strength without bound does not decay: give strength_n_m, or kind = "gain"'
        )


def _unit(quat_wxyz: tuple[float, ...], path: Path) -> Iterator[SceneError]:
    norm = hypot(*quat_wxyz)
    if abs(norm - 1.0) > UNIT_QUATERNION:
        yield wrong(path, quat_wxyz, f"of norm 1, not {norm:g}")


def _rigid(table: RotationTable | ToolTable | None, path: Path) -> Iterator[SceneError]:
    """Principal moments of inertia satisfy the triangle inequality for every mass distribution."""
    inertia_kg_m2 = table and table.inertia_kg_m2
    if not isinstance(inertia_kg_m2, tuple) or len(inertia_kg_m2) != 3:
        return
    largest = max(inertia_kg_m2)
    others = sum(inertia_kg_m2) - largest
    if largest > others * (1.0 + 1e-6):
        allowed = f"those of a rigid body: none above the sum of the other two, and {largest:g} is above {others:g}"
        yield wrong(path, inertia_kg_m2, allowed)


def _slave(table: SlaveTable, run: RunTable) -> Iterator[SceneError]:
    low, high = SLAVE_PERIOD_S
    if table.period_s is None and not low <= run.period_s <= high:
        allowed = "1e-05 to 0.02 for an arm that runs at it: give [slave] period_s, or another"
        yield wrong(("run", "period_s"), run.period_s, allowed)
    if table.period_s is not None and not _is_whole_ns(table.period_s):
        yield wrong(("slave", "period_s"), table.period_s, "a whole number of ns")
    if table.control == "pd" and table.stiffness is None:
        yield contradiction(("slave", "stiffness"), 'control = "pd" needs it')
    for key in ("stiffness", "damping"):
        if table.control != "pd" and getattr(table, key) is not None:
            yield contradiction(("slave", key), f'control = "{table.control}" has none, only "pd"')
    if table.takes_force and table.control == "velocity":
        allowed = '"position" or "pd" for an arm that takes forces: it follows a position while nothing couples it'
        yield wrong(("slave", "control"), table.control, allowed)
    if not table.takes_force and table.viscous > 0.0:
        yield contradiction(("slave", "viscous"), "only an arm with takes_force = true has it; leave it out")
    gripper = table.gripper
    if gripper is not None and gripper.object is not None and gripper.object < gripper.position:
        allowed = f"at least [slave.gripper] position, {gripper.position:g}: the jaws meet it from outside"
        yield wrong(("slave", "gripper", "object"), gripper.object, allowed)


def _takes_force(scene: Scene, slave: SlaveTable) -> Iterator[SceneError]:
    if not slave.takes_force:
        return
    if scene.master.kind == "joints" and slave.mass_kg == SlaveTable().mass_kg:
        why = "must be given for joints that take forces: the smallest inertia in kg m², with which bounds brake"
        yield contradiction(("slave", "mass_kg"), why)
    for key in ("tool_mass_kg", "tool_damping", "tool_lead_s"):
        if scene.coupling is not None and getattr(scene.coupling, key) is not None:
            yield contradiction(("coupling", key), "an arm with takes_force = true has no virtual tool; leave it out")


def _driver_options(scene: Scene) -> Iterator[SceneError]:
    """Reject options without a driver that takes them."""
    if scene.master.options and scene.master.driver is None:
        allowed = "left out where a model is held by the operator, or [master] driver must name who takes them"
        yield wrong(("master", "options"), scene.master.options, allowed)
    if scene.slave is not None and scene.slave.options and scene.slave.device == SIMULATED:
        allowed = f'left out where device = "{SIMULATED}", or [slave] device must name the driver that takes them'
        yield wrong(("slave", "options"), scene.slave.options, allowed)
    gripper = None if scene.slave is None else scene.slave.gripper
    if gripper is not None and gripper.options and gripper.device == SIMULATED:
        allowed = f'left out where device = "{SIMULATED}", or device must name the driver that takes them'
        yield wrong(("slave", "gripper", "options"), gripper.options, allowed)


def _research(scene: Scene) -> Iterator[SceneError]:
    """Reject a Python controller if no safety layer can call it."""
    if scene.safety.research is None:
        return
    path: Path = ("safety", "research")
    if scene.master.kind == "pose":
        yield contradiction(path, 'watches what moves, not what also turns: leave it out of kind = "pose"')
    if scene.safety.signals == "true":
        yield contradiction(path, 'sees what is estimated: leave out safety.signals = "true"')
    if scene.master.driver is not None:
        yield contradiction(path, "is for simulated runs: no Python stands between a link and a hand")


UNIT_QUATERNION = 1e-6
"""Allowed deviation of a quaternion norm from 1, for rounded digits."""


def _coupling(table: CouplingTable, axes: int) -> Iterator[SceneError]:
    yield from _frame(table.quat_wxyz, table.locked_axes, axes, ("coupling",))
    before_s = 0.0
    for index, change in enumerate(table.changes):
        path: Path = ("coupling", "changes", index)
        if change.at_s < before_s:
            yield wrong((*path, "at_s"), change.at_s, f"at least that of the change before it, {before_s:g}")
        before_s = change.at_s
        given = [key for key in change.__struct_fields__ if key != "at_s" and getattr(change, key) is not None]
        if not given:
            yield contradiction(
                path, "changes nothing: give kind, position_scale, force_scale, quat_wxyz or locked_axes"
            )
        yield from _frame(change.quat_wxyz, change.locked_axes, axes, path)


def _frame(
    quat_wxyz: tuple[float, ...] | None, locked_axes: tuple[int, ...] | None, axes: int, path: Path
) -> Iterator[SceneError]:
    if quat_wxyz is not None:
        norm = hypot(*quat_wxyz)
        if abs(norm - 1.0) > UNIT_QUATERNION:
            yield wrong((*path, "quat_wxyz"), quat_wxyz, f"of norm 1, not {norm:g}")
        # A plane rotates about z; one axis, or axes that do not span one space, do not rotate.
        fixed = {3: (), 2: (1, 2)}.get(axes, (1, 2, 3))
        if any(quat_wxyz[part] != 0.0 for part in fixed):
            allowed = "a rotation about z with 2 axes" if axes == 2 else f"[1, 0, 0, 0] with {axes} axes"
            yield wrong((*path, "quat_wxyz"), quat_wxyz, allowed)
    if locked_axes is not None:
        if len(set(locked_axes)) != len(locked_axes):
            yield wrong((*path, "locked_axes"), locked_axes, "each at most once")
        if any(axis >= axes for axis in locked_axes):
            yield wrong((*path, "locked_axes"), locked_axes, f"below {axes}, the number of axes")


def _clocks(links: LinksTable) -> Iterator[SceneError]:
    for key in ("master_clock", "slave_clock"):
        clock: ClockTable | None = getattr(links, key)
        if clock is not None and clock.step_s < 0.0:
            allowed = "0 or more: a monotonic clock is never set back"
            yield wrong(("link", key, "step_s"), clock.step_s, allowed)


def _environment(table: EnvironmentTable, has_arm: bool, axes: int) -> Iterator[SceneError]:
    continuous = table.rendering == "continuous"
    if continuous and has_arm:
        yield contradiction(("environment", "rendering"), "an arm stands between: continuous is for a device alone")
    if table.delay_ticks and (has_arm or continuous):
        yield contradiction(("environment", "delay_ticks"), "only a sampled environment without an arm is late")
    for index, part in enumerate(table.objects):
        path: Path = ("environment", "objects", index)
        if continuous and not isinstance(part.shape, Plane):
            yield contradiction((*path, "shape"), "continuous rendering knows only planes")
        yield from _object(part, path)
        yield from _contact(part.contact, (*path, "contact"), axes)
        if isinstance(part.shape, Spring):
            yield from _spring(part.contact, (*path, "contact"))
    for index, pusher in enumerate(table.pushers):
        yield from _pusher(pusher, ("environment", "pushers", index))
    for index, torque in enumerate(table.torques):
        yield from _pusher(torque, ("environment", "torques", index))


def _object(table: ObjectTable, path: Path) -> Iterator[SceneError]:
    if table.body is not None and table.motion is not None:
        yield contradiction((*path, "body"), "what moves on its own does not slide freely: give motion or body")
    if isinstance(table.shape, Plane) and table.shape.normal is not None:
        normal = table.shape.normal
        if not any(normal if isinstance(normal, tuple) else (normal,)):
            yield wrong((*path, "shape", "normal"), normal, "of any length but 0")
    motion = table.motion
    if motion is not None:
        if motion.until_s is not None and motion.until_s < motion.from_s:
            yield wrong((*path, "motion", "until_s"), motion.until_s, f"at least from_s = {motion.from_s:g}")
        amplitude = motion.amplitude
        if any(amplitude if isinstance(amplitude, tuple) else (amplitude,)) and motion.frequency_hz == 0.0:
            yield contradiction((*path, "motion", "amplitude"), "needs frequency_hz above 0")


def _contact(table: ContactTable, path: Path, axes: int) -> Iterator[SceneError]:
    if table.law == "kelvin-voigt" and table.exponent not in {None, 1.0}:
        yield contradiction((*path, "exponent"), 'law = "kelvin-voigt" has none, only "hunt-crossley"')
    if table.friction > 0.0 and axes == 1:
        yield wrong((*path, "friction"), table.friction, "0 with one axis: nothing slides along a surface")


def _spring(table: ContactTable, path: Path) -> Iterator[SceneError]:
    if table.law != "kelvin-voigt":
        yield contradiction((*path, "law"), "a spring is linear: leave it out, or take another shape")
    if table.friction > 0.0:
        yield wrong((*path, "friction"), table.friction, "0 for a spring: it has no surface")


_PUSHER_NEEDS = {
    "step": {"force_n"},
    "ramp": {"force_n", "rise_s"},
    "half-sine": {"force_n", "duration_s"},
    "sine": {"force_n", "frequency_hz"},
    "recorded": {"recorded"},
}
_PUSHER_MAY_HAVE = {"duration_s"}


def _pusher(table: PusherTable | TorqueTable, path: Path) -> Iterator[SceneError]:
    needed = _PUSHER_NEEDS[table.shape]
    for key in ("force_n", "rise_s", "frequency_hz", "duration_s", "recorded"):
        if key not in table.__struct_fields__:
            continue
        given = getattr(table, key) is not None
        if key in needed and not given:
            yield contradiction((*path, key), f'shape = "{table.shape}" needs it')
        if given and key not in needed | _PUSHER_MAY_HAVE:
            yield contradiction((*path, key), f'shape = "{table.shape}" has none')
    if isinstance(table, PusherTable) and table.recorded is not None:
        yield from _series(table.recorded, (*path, "recorded"))


def _series(table: SeriesTable, path: Path) -> Iterator[SceneError]:
    """Check a recorded series whose file has been read."""
    if table.file is not None and (table.time_s is not None or table.values is not None):
        yield contradiction((*path, "file"), "either file, or time_s and values")
        return
    if not table.time_s or not table.values:
        yield contradiction(path, "needs file, or time_s and values with at least one of each")
        return
    if len(table.time_s) != len(table.values):
        yield contradiction(path, f"{len(table.time_s)} times and {len(table.values)} values: must be as many")
    for index, (before, after) in enumerate(pairwise(table.time_s), start=1):
        if after <= before:
            yield wrong((*path, "time_s", index), after, f"above the time before it, {before:g}")
        elif after - before < MIN_DURATION_S:
            allowed = f"at least {MIN_DURATION_S:g} s after the time before it, {before:g}"
            yield wrong((*path, "time_s", index), after, allowed)


def _safety(table: SafetyTable, period_s: float) -> Iterator[SceneError]:
    for path, own in {(): table, ("rotation",): table.rotation, ("gripper",): table.gripper}.items():
        controllers = () if own is None else own.controllers or ()
        if len(set(controllers)) != len(controllers):
            yield wrong(("safety", *path, "controllers"), controllers, "each at most once")
    estimator, path = table.estimator, ("safety", "estimator")
    if isinstance(estimator, LowPass) and estimator.cutoff_hz > 0.5 / period_s:
        yield wrong((*path, "cutoff_hz"), estimator.cutoff_hz, f"at most half the sample rate, {0.5 / period_s:g}")
    if isinstance(estimator, SavitzkyGolay) and estimator.window <= estimator.degree:
        yield wrong((*path, "window"), estimator.window, f"above degree = {estimator.degree}")
    limiter = table.limiter
    if not limiter.enabled and limiter != LimiterTable(enabled=False):
        yield contradiction(("safety", "limiter", "enabled"), "bounds that are off have no other fields")


def _ladder(table: LadderTable) -> Iterator[SceneError]:
    # In whole ns, same as the Rust side.
    stale_ns, hold_ns, stop_ns = (
        round(time_s * 1e9) for time_s in (table.stale_after_s, table.hold_after_s, table.stop_after_s)
    )
    if hold_ns <= stale_ns:
        allowed = f"above stale_after_s = {table.stale_after_s:g}"
        yield wrong(("safety", "ladder", "hold_after_s"), table.hold_after_s, allowed)
    if stop_ns <= hold_ns:
        allowed = f"above hold_after_s = {table.hold_after_s:g}"
        yield wrong(("safety", "ladder", "stop_after_s"), table.stop_after_s, allowed)
    if table.extrapolate_s is not None and round(table.extrapolate_s * 1e9) > hold_ns - stale_ns:
        allowed = f"over before HOLD, at most {(hold_ns - stale_ns) * 1e-9:g}"
        yield wrong(("safety", "ladder", "extrapolate_s"), table.extrapolate_s, allowed)


def _of_numbers(spec: Spec) -> Iterator[SceneError]:
    """Check conditions that need the resolved numbers."""
    run, master, safety = spec["run"], spec["master"], spec["safety"]
    for axis, (low, high) in enumerate(master["stops"] or ()):
        if low >= high:
            yield wrong(("master", "stops"), [low, high], "the lower stop below the upper")
        if not low <= master["position"][axis] <= high:
            allowed = f"within the stops, {low:g} to {high:g}"
            yield wrong(("master", "position"), master["position"][axis], allowed)
    limit = max_damping(master["mass_kg"], run["period_s"])
    allowed = f"at most m / (5 dT) = {limit:g}"
    if set(safety["controllers"]) - {"pc"} and safety["damping"] > limit:
        yield wrong(("safety", "damping"), safety["damping"], allowed)
    if safety["damping"] == 0.0 and safety["probe_force_n"] > 0.0:
        allowed = "0 where damping is 0, as nothing slows the probe"
        yield wrong(("safety", "probe_force_n"), safety["probe_force_n"], allowed)
    if "pc" in safety["controllers"] and safety["pc_max_damping"] > limit:
        yield wrong(("safety", "pc_max_damping"), safety["pc_max_damping"], allowed)
    if safety["rotation"] is not None and master["rotation"] is not None:
        limit = max_damping(master["rotation"]["inertia_kg_m2"], run["period_s"])
        yield from _own_damping(safety, "rotation", f"at most I / (5 dT) = {limit:g}", limit)
    if safety["gripper"] is not None:
        limit = max_damping([master["gripper"]["mass_kg"]], run["period_s"])
        yield from _own_damping(safety, "gripper", f"at most m / (5 dT) = {limit:g}", limit)
    estimator = safety["estimator"]
    for key in JERK_DENSITIES.get(estimator["kind"], ()):
        # (12 q / (quantum² dT))^(1/6) dT by logarithms, so that no power of an allowed value overflows or underflows.
        power = log(12.0 * estimator[key] / run["period_s"]) - 2.0 * log(estimator["quantum_m"])
        bandwidth = exp(power / 6.0) * run["period_s"]
        low, high = KALMAN_BANDWIDTH
        if not low <= bandwidth <= high:
            allowed = (
                f"such that omega dT is {low:g} to {high:g}, not {bandwidth:.3g} as with quantum_m = "
                f"{estimator['quantum_m']:g}"
            )
            yield wrong(("safety", "estimator", key), estimator[key], allowed)


def _own_damping(safety: Spec, table: str, allowed: str, limit: float) -> Iterator[SceneError]:
    own = safety[table]
    controllers = set(safety["controllers"] if own["controllers"] is None else own["controllers"])
    for key, acts in {"damping": controllers - {"pc"}, "pc_max_damping": controllers & {"pc"}}.items():
        if acts and own[key] is not None and own[key] > limit:
            yield wrong(("safety", table, key), own[key], allowed)
