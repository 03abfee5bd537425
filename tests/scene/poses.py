"""Strategies for Hypothesis: scenes of kind "pose" with any combination of their parts, grippers and buttons."""

import math
from typing import Any

from hypothesis import strategies as st
from tests.scene.strategies import (
    Raw,
    contacts,
    couplings,
    ladders,
    links,
    masters,
    objects,
    operators,
    per_axis,
    pushers,
    real,
    safeties,
    table,
)

AXES = 3
Vector = list[float]


def vectors(low: float, high: float) -> st.SearchStrategy[Vector]:
    return st.lists(real(low, high), min_size=3, max_size=3)


def directions() -> st.SearchStrategy[Vector]:
    long = vectors(-1.0, 1.0).filter(lambda vector: math.hypot(*vector) > 0.1)
    return long.map(lambda vector: [part / math.hypot(*vector) for part in vector])


IDENTITY: Vector = [1.0, 0.0, 0.0, 0.0]


def conjugate(of: Vector) -> Vector:
    return [of[0], -of[1], -of[2], -of[3]]


def product(left: Vector, right: Vector) -> Vector:
    """Return the product of two quaternions w, x, y, z: the turn of the right one comes first."""
    (a, b, c, d), (w, x, y, z) = left, right
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]


@st.composite
def orientations(draw: st.DrawFn) -> Vector:
    half, axis = draw(real(-3.1, 3.1)), draw(directions())
    return [math.cos(half), *(math.sin(half) * part for part in axis)]


@st.composite
def inertias(draw: st.DrawFn, low: float, high: float) -> Any:  # noqa: ANN401  # a number or one per axis
    """Draw an inertia, sometimes of no rigid body; a rigid one has sums of two of three squared lengths."""
    match draw(st.sampled_from(["even", "body", "body", "body", "any"])):
        case "even":
            return draw(real(low, high))
        case "body":
            squares = draw(vectors(0.5 * low, 0.5 * high))
            return [sum(squares) - one for one in squares]
        case _:
            return draw(vectors(low, high))


def is_rigid(inertia: Any) -> bool:  # noqa: ANN401
    """Return true if a body can have these moments."""
    return not isinstance(inertia, list) or 2.0 * max(inertia) <= sum(inertia)


@st.composite
def turning_hands(draw: st.DrawFn, duration_s: float) -> Raw:
    turn = vectors(-1.7, 1.7).filter(lambda vector: math.hypot(*vector) < 3.1)
    leg = st.one_of(
        table({"duration_s": real(0.005, 0.3), "turn": turn}, shape=st.sampled_from(["linear", "smooth"])),
        table({"duration_s": real(0.005, 0.3), "end_wxyz": orientations()}),
    )
    hand: Raw = draw(
        table(
            {"legs": st.lists(leg, max_size=4)},
            stiffness=real(0.0, 10.0),
            damping=real(0.0, 0.1),
            strength_n_m=real(0.0, 1.0),
            start_wxyz=orientations(),
        )
    )
    if draw(st.booleans()):
        kinds = ["strength", "gain"] if "strength_n_m" in hand else ["gain"]
        release = {"at_s": real(0.0, duration_s), "kind": st.sampled_from(kinds)}
        hand["release"] = draw(table(release, decay_s=real(0.0, 0.1)))
    return hand


@st.composite
def arms(draw: st.DrawFn, period_s: float) -> Raw:
    required = {"control": st.just("pd"), "stiffness": real(1.0, 5000.0)}
    arm: Raw = draw(
        table(
            required,
            mass_kg=real(0.1, 10.0),
            damping=real(0.0, 200.0),
            max_speed=real(0.05, 2.0) | st.just("unbounded"),
            period_s=st.sampled_from([period_s, 5e-4, 1e-3, 2e-3, 8e-3]),
        )
    )
    points = st.lists(vectors(-0.05, 0.05), max_size=3)
    tool: dict[str, st.SearchStrategy[Any]] = {
        "rotational_damping": real(0.0, 1.0),
        "max_angular_speed": real(0.1, 10.0) | st.just("unbounded"),
        "quat_wxyz": orientations(),
        "points": points,
        "jaw_width_m": real(0.01, 0.2),
        "jaw_friction": real(0.0, 1.5),
        "jaw_stiffness": real(1e3, 1e5),
        "jaw_radius_m": real(1e-3, 0.05),
    }
    arm["tool"] = draw(table({"inertia_kg_m2": inertias(1e-3, 0.1), "rotational_stiffness": real(0.0, 100.0)}, **tool))
    return arm


@st.composite
def grippers(draw: st.DrawFn) -> Raw:
    gripper: Raw = draw(table(position=real(0.0, 0.5), speed=real(0.1, 100.0), force_n=real(0.0, 100.0)))
    if draw(st.booleans()):
        gripper["object"] = draw(real(gripper.get("position", 0.0), 1.0))
    return gripper


@st.composite
def felt_triggers(draw: st.DrawFn) -> Raw:
    return draw(
        table(
            {"travel_m": real(5e-3, 0.05), "mass_kg": real(0.01, 0.5)},
            viscous=real(0.0, 1.0),
            coulomb=real(0.0, 0.5),
            encoder_quantum=real(1e-6, 1e-4),
            force_scale=real(1e-3, 1.0),
            max_force_n=real(0.1, 20.0),
            max_slew_n_per_s=real(1.0, 1e4),
            max_power_w=real(0.01, 50.0),
        )
    )


@st.composite
def fingers(draw: st.DrawFn, duration_s: float) -> Raw:
    finger: Raw = draw(table({}, stiffness=real(0.0, 1000.0), damping=real(0.0, 20.0), strength_n=real(0.0, 50.0)))
    if draw(st.booleans()):
        kinds = ["strength", "gain"] if "strength_n" in finger else ["gain"]
        release = {"at_s": real(0.0, duration_s), "kind": st.sampled_from(kinds)}
        finger["release"] = draw(table(release, decay_s=real(0.0, 0.1)))
    return finger


def safeties_of_trigger() -> st.SearchStrategy[Raw]:
    return table(
        {},
        reach_m=real(0.01, 1.0),
        controllers=st.lists(st.sampled_from(["vfc", "hsc", "wsc", "pc"]), unique=True),
        velocity_threshold=real(1e-3, 2.0),
        vfc_force_threshold_n=real(1e-3, 5.0),
        grasp_threshold=real(1.01, 5.0),
        grasp_floor_n=real(1e-5, 1.0),
        hsc_force_threshold_n=real(0.0, 1.0),
        energy_threshold_j=real(-0.1, -1e-5),
    )


@st.composite
def triggers(draw: st.DrawFn) -> list[list[float]]:
    times = sorted(draw(st.lists(st.integers(0, 400), max_size=5, unique=True)))
    return [[time * 1e-3, draw(real(0.0, 1.0) | st.sampled_from([0.0, 1.0]))] for time in times]


@st.composite
def worlds(draw: st.DrawFn) -> Raw:
    torque = table({"torque_n_m": per_axis(AXES, -0.3, 0.3)}, at_s=real(0.0, 0.3), duration_s=real(1e-3, 0.3))
    hole = table(
        {
            "entrance": vectors(-0.03, 0.03),
            "radius": real(1e-3, 0.02),
            "depth": real(1e-3, 0.05),
            "contact": contacts(AXES, "plane"),
        },
        axis=directions(),
        chamfer_m=real(0.0, 1e-3),
    )
    handle = table(
        {
            "point": vectors(-0.1, 0.1),
            "axis": directions(),
            "grip": vectors(-0.05, 0.05),
            "inertia_kg_m2": real(1e-3, 0.1),
        },
        reach_m=real(1e-2, 0.2),
        width_m=real(0.0, 0.1),
        viscous=real(0.0, 0.1),
        coulomb=real(0.0, 0.1),
        stiffness=real(0.0, 1.0),
        stops_rad=st.just([-1.0, 1.0]),
        hold_stiffness=real(100.0, 1e4),
        hold_rotational_stiffness=real(0.0, 50.0),
    )
    body = table(
        {"mass_kg": real(0.05, 2.0), "half_extents": vectors(5e-3, 0.05), "position": vectors(-0.05, 0.05)},
        quat_wxyz=orientations(),
        gravity=real(0.0, 10.0),
    )
    resting = objects(AXES).filter(lambda thing: "body" not in thing)
    return {
        "objects": draw(st.lists(resting, max_size=2)),
        "pushers": draw(st.lists(pushers(AXES), max_size=1)),
        "torques": draw(st.lists(torque, max_size=2)),
        "holes": draw(st.lists(hole, max_size=1)),
        "handles": draw(st.lists(handle, max_size=1)),
        "bodies": draw(st.lists(body, max_size=1)),
    }


def alignments(coupling: Raw) -> st.SearchStrategy[Raw]:
    """Draw an alignment within the bound on the angular speed; most are fast enough to end within a scene."""
    bound = coupling.get("command_angular_speed", 2.5)
    fastest = 30.0 if isinstance(bound, str) else min(bound, 30.0)
    # A press waits 5 s, of which the slowest link takes 1 s.
    speeds = real(0.3 * fastest, fastest)
    return speeds.flatmap(
        lambda speed: table({"speed": st.just(speed), "max_angle": real(1e-2, min(3.1, 3.9 * speed))})
    )


def aligned(coupling: Raw, alignment: Raw) -> Raw:
    """Return the coupling with an alignment but no rotation scales: alignment persists only with a scale of 1."""
    kept = {key: value for key, value in coupling.items() if key != "rotation_scale"}
    changes = [
        {key: value for key, value in change.items() if key != "rotation_scale"} for change in coupling["changes"]
    ]
    return kept | {"changes": changes, "alignment": alignment}


@st.composite
def turning_couplings(draw: st.DrawFn, duration_s: float) -> Raw:
    scales = {"rotation_scale": real(0.1, 5.0), "torque_scale": real(0.1, 5.0)}
    coupling = draw(couplings(AXES, duration_s))
    coupling["changes"] = [change | draw(table({}, **scales)) for change in coupling["changes"]]
    coupling |= draw(
        table(
            {},
            **scales,
            command_angular_speed=real(0.05, 30.0) | st.just("unbounded"),
            command_turn=real(0.05, 3.0) | st.just("unbounded"),
        )
    )
    if draw(st.booleans()):
        coupling["reference_point"] = draw(vectors(-0.3, 0.3))
    match draw(st.sampled_from(["free", "free", "aligned", "aligned", "locked", "about"])):
        case "aligned":
            coupling = aligned(coupling, draw(alignments(coupling)))
        case "locked":
            coupling["locks_rotation"] = True
        case "about":
            coupling["rotation_axis"] = draw(directions())
    return coupling


def safeties_of_rotation() -> st.SearchStrategy[Raw]:
    return table(
        {},
        lever_m=real(0.01, 0.2),
        shares_trips=st.booleans(),
        controllers=st.lists(st.sampled_from(["vfc", "hsc", "wsc", "pc"]), unique=True),
        velocity_threshold=real(0.1, 50.0),
        vfc_torque_threshold_n_m=real(1e-3, 0.5),
        grasp_threshold=real(1.01, 5.0),
        grasp_floor_n_m=real(1e-5, 0.1),
        hsc_torque_threshold_n_m=real(0.0, 0.1),
        energy_threshold_j=real(-0.1, -1e-4),
        max_torque_n_m=real(1e-3, 1.0),
        max_slew_n_m_per_s=real(0.1, 1e3),
        max_power_w=real(0.1, 100.0),
    )


@st.composite
def with_gripper(draw: st.DrawFn, scene: Raw) -> Raw:
    """Return the scene with a gripper, whose trigger the finger may feel."""
    gripper = scene["slave"]["gripper"] = draw(grippers())
    operator, duration_s = scene.get("operator"), scene["run"]["duration_s"]
    if operator is not None:
        operator |= draw(table({}, trigger=triggers()))
    if draw(st.booleans()):
        scene["master"]["gripper"] = draw(felt_triggers())
        scene["safety"] |= draw(table({}, gripper=safeties_of_trigger()))
        if operator is not None:
            operator |= draw(table({}, finger=fingers(duration_s)))
            if draw(st.booleans()):
                # It closes on something at once.
                opening = gripper.setdefault("position", 0.0)
                gripper["object"] = opening + 0.1
                operator["trigger"] = [[0.0, opening], [0.2 * duration_s, 1.0]]
    return scene


@st.composite
def near_the_hand(draw: st.DrawFn, scene: Raw) -> Vector:
    """Return an orientation of the tool from which it can align with the hand within the scene."""
    coupling, duration_s = scene["coupling"], scene["run"]["duration_s"]
    speed, max_angle = coupling["alignment"]["speed"], coupling["alignment"]["max_angle"]
    half = 0.5 * draw(real(0.0, min(0.2 * duration_s * speed, max_angle)))
    frame = coupling.get("quat_wxyz", IDENTITY)
    hand = scene.get("operator", {}).get("rotation", {}).get("start_wxyz", IDENTITY)
    off = [math.cos(half), *(math.sin(half) * part for part in draw(directions()))]
    return product(off, product(product(frame, hand), conjugate(frame)))


@st.composite
def raw_poses(draw: st.DrawFn) -> Raw:
    """Draw tables of a scene of kind "pose", valid except for bodies that are not rigid."""
    period_s = draw(st.sampled_from([5e-4, 1e-3, 2e-3, 5e-3]))
    duration_s = draw(real(0.05, 0.5))
    master = draw(masters(AXES)) | {"kind": "pose"}
    master["rotation"] = draw(
        table(
            {"inertia_kg_m2": inertias(1e-4, 5e-3)},
            viscous=real(0.0, 1e-2),
            coulomb=real(0.0, 1e-2),
            measures_angular_velocity=st.booleans(),
            max_torque_n_m=real(1e-2, 1.0) | st.just("unbounded"),
        )
    )
    scene: Raw = {
        "schema": 1,
        "run": {"duration_s": duration_s, "period_s": period_s, "seed": draw(st.integers(0, 99))},
        "master": master,
        "safety": draw(safeties(period_s, has_arm=True)),
        "slave": draw(arms(period_s)),
        "record": {},
    }
    if draw(st.booleans()):
        scene["operator"] = draw(operators(AXES, duration_s, has_arm=True))
        if draw(st.integers(0, 3)) > 0:
            scene["operator"]["rotation"] = draw(turning_hands(duration_s))
    if draw(st.booleans()):
        draw(with_gripper(scene))
    if draw(st.integers(0, 3)) == 0:
        bits = draw(st.lists(st.integers(0, 31), min_size=2, max_size=2, unique=True))
        buttons = {draw(st.sampled_from(["clutch", "engage"])): bits[0]}
        # If a button works the gripper, no finger leads it, and a felt trigger is refused.
        is_free = "gripper" in scene["slave"] and "gripper" not in master
        master["buttons"] = buttons | ({"gripper": bits[1]} if is_free else {})
    if draw(st.integers(0, 4)) > 0:
        scene["environment"] = draw(worlds())
    if draw(st.booleans()):
        scene["safety"]["rotation"] = draw(safeties_of_rotation())
    if draw(st.booleans()):
        scene["safety"]["ladder"] = draw(ladders())
    scene |= draw(
        table(
            {"coupling": turning_couplings(duration_s)},
            link=table({}, forward=links(), backward=links()),
            security=table({}, secure=st.booleans()),
        )
    )
    if draw(st.integers(0, 4)) == 0:
        del scene["coupling"]
    elif "alignment" in scene["coupling"] and draw(st.integers(0, 3)) > 0:
        scene["slave"]["tool"]["quat_wxyz"] = draw(near_the_hand(scene))
    return scene
