"""The pure description against closed forms: places of parts, lengths of arrows, times of events."""

import math

import numpy as np
import pytest
from tests.view.shown import shown

from haptether.bridge import RecordTable, Scene, load_scene, override_scene, simulate
from haptether.slave import UR_MODELS, UrKinematics, ur_model
from haptether.view import NothingRecordedError, describe, describe_beside
from haptether.view.scene3d.arm import READY, link_frames
from haptether.view.scene3d.extent import nice_above
from haptether.view.scene3d.mesh import Mesh, box, capsule, cone, cylinder, holed_block, sphere, torus
from haptether.view.scene3d.parts import Arrow
from haptether.view.scene3d.rotation import matrix_of, rotation_to, turn_about

SCENES = ["remote_push", "three_axis_box", "ur_pick", "valve", "moving_wall", "sliding_mass", "gripper", "alignment"]


def volume(mesh: Mesh) -> float:
    """Return the volume by the divergence theorem: positive if all triangles are counter-clockwise from outside."""
    a, b, c = (mesh.points[mesh.triangles[:, corner]] for corner in range(3))
    return float(np.sum(np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box([1.0, 2.0, 3.0]), 48.0),
        (cylinder(1.0, -1.0, 2.0), 3.0 * math.pi),
        (cone(1.0, 0.0, 3.0), math.pi),
        (sphere(2.0), 32.0 / 3.0 * math.pi),
        (capsule(1.0, 3.0), (3.0 + 4.0 / 3.0) * math.pi),
        (torus(3.0, 0.5), 2.0 * math.pi**2 * 3.0 * 0.25),
        (holed_block(1.0, 2.0, 0.0, 3.0), (9.0 * 2.5 - 2.0) * math.pi),
    ],
    ids=["box", "cylinder", "cone", "sphere", "capsule", "torus", "hole"],
)
def test_a_mesh_is_closed_and_faces_outward(mesh: Mesh, expected: float) -> None:
    # Inscribed polygons: 28 sides lack 0.8 % of a circle, the 12 of a ring's profile another 4.5 %.
    assert volume(mesh) == pytest.approx(expected, rel=0.06)
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)
    across = np.cross(
        mesh.points[mesh.triangles[:, 1]] - mesh.points[mesh.triangles[:, 0]],
        mesh.points[mesh.triangles[:, 2]] - mesh.points[mesh.triangles[:, 0]],
    )
    assert np.all(np.einsum("ij,ij->i", across, mesh.normals[mesh.triangles[:, 0]]) >= -1e-12)


def test_rotations_are_those_of_their_quaternions_and_axes() -> None:
    half = 0.35
    quat = np.array([math.cos(half), 0.0, math.sin(half), 0.0])
    assert matrix_of(quat) == pytest.approx(turn_about(np.array([0.0, 2.0, 0.0]), 2.0 * half))
    for direction in ([1.0, 0.0, 0.0], [0.0, 0.0, -2.0], [0.3, -0.4, 1.2]):
        frame = rotation_to(np.array(direction))
        assert frame[:, 2] == pytest.approx(np.array(direction) / np.linalg.norm(direction))
        assert frame.T @ frame == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize("name", UR_MODELS)
def test_the_flange_of_the_links_is_that_of_the_kinematics(name: str) -> None:
    model = ur_model(name)
    kinematics = UrKinematics(model)
    for q in (np.array(READY), np.array([0.3, -1.1, 0.9, -0.4, 1.3, -2.0])):
        assert link_frames(model, q)[-1] == pytest.approx(np.array(kinematics.forward(q)), abs=1e-12)


def test_the_arm_leads_its_gripper_to_where_the_run_has_the_tool() -> None:
    run, _, described = shown("ur_pick")
    tool = described.part("gripper").pose
    time_s = run.signals["slave_time_s"]
    first = tool(0.0)
    assert first is not None
    for time in (0.5, 2.0, 4.0, 6.5):
        now = int(np.searchsorted(time_s, time + 1e-9) - 1)
        base_from_tool = tool(time)
        assert base_from_tool is not None
        moved = run.signals["slave_position"][now] - run.signals["slave_position"][0]
        assert base_from_tool[:3, 3] - first[:3, 3] == pytest.approx(moved, abs=1e-12)
        # The last capsule of the arm ends in the flange, 0.16 m behind the tool point along its axis.
        wrist = described.part("link 6 offset").pose(time)
        assert wrist is not None
        flange = wrist[:3, 3] + 0.0996 * wrist[:3, 2]
        # Postures are computed every 20 ms, and the hand moves at 0.2 m/s: 4 mm.
        assert flange + 0.16 * base_from_tool[:3, 2] == pytest.approx(base_from_tool[:3, 3], abs=4e-3)
    assert any("posture" in note for note in described.notes)


@pytest.mark.parametrize("name", SCENES)
def test_every_part_can_be_asked_at_any_time(name: str) -> None:
    _, _, described = shown(name)
    line = described.timeline
    assert len({part.name for part in described.parts}) == len(described.parts)
    for time in np.linspace(line.begin_s - 1.0, line.end_s + 1.0, 9):
        for part in described.parts:
            at = part.pose(float(time))
            assert at is None or (at.shape == (4, 4) and at[3].tolist() == [0.0, 0.0, 0.0, 1.0]), part.name
        described.status.at(float(time))


@pytest.mark.parametrize("name", SCENES)
def test_an_arrow_is_as_long_as_its_force_times_the_scale(name: str) -> None:
    run, _, described = shown(name)
    for arrow in described.arrows:
        values = run.signals[arrow.name]
        time_s = run.signals["slave_time_s" if arrow.name.startswith("environment") else "time_s"]
        for now in range(0, len(time_s), len(time_s) // 13):
            norm = float(np.linalg.norm(np.atleast_1d(values[now])))
            assert arrow.length(float(time_s[now])) == pytest.approx(arrow.scale * norm)


def seen_length(arrow: Arrow, time_s: float) -> float:
    """Return the distance from the tail to the tip as drawn."""
    tip = arrow.parts()[1].pose(time_s)
    return 0.0 if tip is None else float(np.linalg.norm(tip[:3, 3] - arrow.tail(time_s)))


def test_the_drawn_arrow_points_along_the_force_and_vanishes_without() -> None:
    run, _, described = shown("remote_push")
    force = {arrow.name: arrow for arrow in described.arrows}["environment_force"]
    # The tool presses the wall that fills x < 0, which pushes it along +x.
    tip = force.parts()[1].pose(2.5)
    assert tip is not None
    assert tip[:3, 2] == pytest.approx([1.0, 0.0, 0.0])
    assert seen_length(force, 2.5) == pytest.approx(force.scale * float(run.signals["environment_force"][2500]))
    assert all(part.pose(0.3) is None for part in force.parts())


def test_runs_side_by_side_have_one_scale() -> None:
    with_wsc, scene, alone = shown("remote_push")
    without, other, _ = shown("remote_push", "safety.controllers=[]")
    first, second = describe_beside([(with_wsc, scene, "with"), (without, other, "without")])
    scales = [
        {arrow.name: arrow.scale for arrow in one.arrows if arrow.name != "safety_force"} for one in (first, second)
    ]
    assert scales[0] == scales[1]
    assert [one.title for one in (first, second)] == ["with", "without"]
    assert np.allclose(first.views["hand"], second.views["hand"])
    assert alone.title == scene.title


@pytest.mark.parametrize("name", ["remote_push", "three_axis_box", "valve"])
def test_trails_are_the_signals(name: str) -> None:
    run, _, described = shown(name)
    for trail, signal in (
        ("tool trail", "slave_position"),
        ("command trail", "slave_command"),
        ("hand trail", "position"),
    ):
        (found,) = [one for one in described.trails if one.name == trail]
        values = run.signals[signal].reshape(len(found.points.time_s), -1)
        assert np.array_equal(found.points.values[:, : values.shape[1]], values)
        until = found.until(1.5)
        assert until[-1] == pytest.approx(found.points.values[np.searchsorted(found.points.time_s, 1.5 + 1e-9) - 1])
        # Along one axis, older points are displaced backwards by their age alone.
        begin = np.searchsorted(found.points.time_s, 1.5 - found.window_s)
        assert until[0] - found.points.values[begin] == pytest.approx(found.drift * (1.5 - found.points.time_s[begin]))


def test_events_and_trips_are_at_their_times() -> None:
    run, _, described = shown("remote_push")
    line = described.timeline
    assert [(mark.time_s, mark.kind) for mark in line.marks] == [(event.time_s, event.kind) for event in run.events]
    trip_s = next(event.time_s for event in run.events if event.kind == "trip")
    assert line.next_trip(0.0) == pytest.approx(trip_s)
    assert line.next_trip(trip_s) == pytest.approx(trip_s), "the only one comes again"
    assert shown("free_motion")[2].timeline.next_trip(0.0) is None
    assert line.force_n.max() == pytest.approx(run.metrics.peak_device_force)


def test_the_status_says_what_the_signals_do() -> None:
    run, scene, described = shown("remote_push")
    before, during = described.status.at(2.0), described.status.at(2.745)
    assert (before.master, before.slave, before.intervenes) == ("engaged", "engaged", False)
    assert described.status.at(0.05).master == "aligning"
    assert during.acting == ("wsc",)
    (gauge,) = during.gauges
    energy_j = float(run.signals["windowed_energy_j"][2745])
    threshold_j = scene.ejection_settings().energy_threshold_j
    assert (gauge.value, gauge.threshold) == (energy_j, threshold_j)
    assert gauge.share == pytest.approx(energy_j / threshold_j)
    assert gauge.tripped == (gauge.share > 1.0)
    assert before.device_force == pytest.approx(abs(float(run.signals["device_force"][2000])))


def test_the_hand_opens_where_it_lets_go() -> None:
    run, _, described = shown("remote_push")
    released_s = next(event.time_s for event in run.events if event.kind == "release")
    for time, holds in ((1.0, True), (released_s - 0.01, True), (released_s + 0.2, False)):
        assert (described.part("hand").pose(time) is not None) is holds
        assert (described.part("hand, open").pose(time) is None) is holds


def test_a_contact_is_marked_where_the_tool_is_in_the_wall() -> None:
    run, _, described = shown("remote_push")
    mark = described.part("contact 0").pose
    for time in (0.3, 0.5, 1.0, 2.0, 3.8):
        now = round(1000 * time)
        touches = run.signals["slave_position"][now] <= 0.0 and abs(run.signals["environment_force"][now]) > 1e-6
        assert (mark(time) is not None) == touches, time


def test_the_valve_turns_by_its_angle() -> None:
    run, _, described = shown("valve")
    wheel = described.part("handle 0").pose
    first, later = wheel(0.0), wheel(4.0)
    assert first is not None
    assert later is not None
    turned = later[:3, :3] @ first[:3, :3].T
    assert turned == pytest.approx(
        turn_about(np.array([0.0, 0.0, 1.0]), float(run.signals["handle_angle"][4000])), abs=1e-6
    )


def test_a_body_is_where_it_was_recorded() -> None:
    run, _, described = shown("pick_and_place", "run.duration_s=3.0")
    at = described.part("body 0").pose(2.9)
    assert at is not None
    assert at[:3, 3] == pytest.approx(run.signals["body_position"][2900])


def test_what_moves_by_itself_is_where_its_equation_says() -> None:
    _, _, described = shown("moving_wall")
    scene = load_scene("moving_wall")
    assert scene.environment is not None
    motion = scene.environment.objects[0].motion
    assert motion is not None
    begin, later = described.part("object 0").pose(0.0), described.part("object 0").pose(1.3)
    assert begin is not None
    assert later is not None
    until_s = motion.until_s if motion.until_s is not None else math.inf
    way = np.atleast_1d(motion.velocity)[0] * max(0.0, min(1.3, until_s) - motion.from_s)
    way += np.atleast_1d(motion.amplitude)[0] * math.sin(math.tau * motion.frequency_hz * 1.3)
    assert later[0, 3] - begin[0, 3] == pytest.approx(way)


def joints_scene() -> Scene:
    return override_scene(
        load_scene("remote_push"),
        ["master.kind=joints", "master.axes=4", "master.device=phantom-desktop"],
    )


def test_joints_without_a_geometry_are_dials() -> None:
    try:
        run = simulate(joints_scene())
    except ValueError as error:
        pytest.fail(str(error))
    described = describe(run, joints_scene())
    dial = described.part("hand joint 1").pose(1.0)
    assert dial is not None
    angle = float(run.signals["position"][1000][0])
    assert dial[:3, :3] @ np.array([0.0, 0.0, 1.0]) == pytest.approx([math.sin(angle), 0.0, math.cos(angle)])


def test_what_was_not_recorded_is_said() -> None:
    _, _, described = shown("sliding_mass")
    assert any("not recorded" in note for note in described.notes)
    bare = override_scene(load_scene("remote_push"), [])
    assert isinstance(bare.record, RecordTable)
    run, _, _ = shown("remote_push")
    from msgspec.structs import replace

    assert any("no scene" in note for note in describe(replace(run, specification=b"")).notes)


def test_a_run_without_signals_is_refused() -> None:
    run, scene, _ = shown("remote_push")
    from msgspec.structs import replace

    from haptether.bridge import Signals

    with pytest.raises(NothingRecordedError, match=r"record\.every=1"):
        describe(replace(run, signals=Signals({})), scene)


@pytest.mark.parametrize(("value", "expected"), [(6.2, 10.0), (1.0, 1.0), (0.021, 0.03), (4.4, 5.0), (200.0, 200.0)])
def test_scales_are_round(value: float, expected: float) -> None:
    assert nice_above(value) == pytest.approx(expected)
