"""Scenes of kind "pose": results of each scene, with other networks, seeds and frames; and refusals."""

from math import asin, cos, hypot, pi, sin

import numpy as np
import numpy.typing as npt
import pytest
from tests.scene.shipped import shipped

from haptether.bridge import Run, SceneError, load_scene, override_scene, simulate, sweep
from haptether.view.figures.rotation import angle_apart
from haptether.view.figures.run import frame_of

Array = npt.NDArray[np.float64]

INERTIA_KG_M2, COULOMB_N_M, TORQUE_N_M = 4e-4, 2e-3, 0.1
"""Parameters of torque_release."""
WITHOUT = "safety.controllers=[]"
GROWTH = (TORQUE_N_M - COULOMB_N_M) / INERTIA_KG_M2
"""Angular acceleration in rad/s² of a handle that nobody holds."""


def angle(quat_wxyz: Array) -> Array:
    """Return the angles of rotations in rad."""
    turned: Array = 2.0 * np.arctan2(np.linalg.norm(quat_wxyz[..., 1:], axis=-1), np.abs(quat_wxyz[..., 0]))
    return turned


def both_ways(delay_s: float, loss: float = 0.0) -> list[str]:
    return [f"link.{way}={{delay_s = {delay_s}, loss = {loss}}}" for way in ("forward", "backward")]


def kinds(run: Run) -> list[str]:
    return [event.kind for event in run.events]


# ------------------------------------------------------------------------------------------------- torque release


@pytest.mark.parametrize("delay_s", [0.0, 0.005, 0.02])
def test_at_once_without_a_grip_the_handle_is_as_fast_as_the_closed_form(delay_s: float) -> None:
    run = simulate("torque_release", overrides=[WITHOUT, *both_ways(delay_s), "operator.rotation.release.decay_s=0.0"])
    # The torque ends 0.1 s after the release; on the hand it ends later by the backward delay, plus or minus a tick.
    expected = GROWTH * (0.1 + delay_s)
    assert run.metrics.max_ejection_rate == pytest.approx(expected, abs=2.0 * GROWTH * 1e-3)


def test_a_grip_that_opens_takes_what_its_own_equation_says() -> None:
    """I w' = tau - c - s (k phi + b w), s from 1 to 0 within 20 ms; it begins where friction held the handle."""
    run = simulate("torque_release", overrides=[WITHOUT])
    release_s = next(event.time_s for event in run.events if event.kind == "engaged") + 1.2
    before = run.signals["hand_torque"][np.searchsorted(run.signals["time_s"], release_s) - 1, 2]
    phi, rate, step = -before / 3.0, 0.0, 1e-6
    for share in np.arange(1.0, 0.0, -step / 0.02):
        push = TORQUE_N_M - share * (3.0 * phi + 0.03 * rate) - COULOMB_N_M
        # At rest friction holds the handle; it only turns in the direction of the push.
        rate = max(rate + push / INERTIA_KG_M2 * step, 0.0)
        phi += rate * step
    assert rate < 0.5 * GROWTH * 0.02
    expected = rate + GROWTH * (0.1 + 0.005 - 0.02)
    assert run.metrics.max_ejection_rate == pytest.approx(expected, abs=GROWTH * 1e-3)


@pytest.mark.parametrize(("controller", "most"), [("vfc", 9.5), ("hsc", 2.5), ("wsc", 6.3), ("pc", 4.5)])
def test_with_each_controller_it_is_slower(controller: str, most: float) -> None:
    """VFC and WSC trip at V_t and V_w over the lever: 0.45 and 0.29 m/s over 0.05 m are 9 and 5.8 rad/s."""
    run = simulate("torque_release", overrides=[f"safety.controllers=[{controller}]"])
    assert run.metrics.max_ejection_rate is not None
    assert 0.0 < run.metrics.max_ejection_rate < most
    assert run.metrics.time_to_trip_s is not None
    assert 0.0 < run.metrics.time_to_trip_s < 0.1
    assert not run.signals["angular_velocity"][-1].any(), "comes to rest"


def test_a_release_of_the_handle_is_a_release_of_the_scene() -> None:
    assert simulate("torque_release", overrides=["run.duration_s=1.0"]).metrics.outcome == "not-released"


def test_a_sweep_of_poses_is_its_runs() -> None:
    torques = [0.05, 0.1, 0.2]
    rows = sweep(
        "torque_release", {"environment.torques.0.torque_n_m.2": torques}, overrides=["safety.controllers=[hsc]"]
    )
    for torque, peak in zip(torques, rows["max_ejection_rate"], strict=True):
        changed = [f"environment.torques.0.torque_n_m=[0.0, 0.0, {torque}]", "safety.controllers=[hsc]"]
        assert simulate("torque_release", overrides=changed).metrics.max_ejection_rate == peak


# --------------------------------------------------------------------------------------------------- peg in hole

RADIUS, CLEARANCE, LENGTH, STIFFNESS = 0.01, 2e-4, 0.018, 1e5
"""Radius, diametral clearance and guided length of the peg in m; stiffness of the walls in N/m."""


def tilted(azimuth: float) -> str:
    half = pi / 72.0
    return f"slave.tool.quat_wxyz=[{cos(half)!r}, {sin(half) * cos(azimuth)!r}, {sin(half) * sin(azimuth)!r}, 0.0]"


@pytest.mark.sampled(3)
@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        [],
        [tilted(0.0)],
        [tilted(pi / 8.0)],
        [tilted(4.0)],
        both_ways(0.0),
        both_ways(0.015),
        [*both_ways(0.005, loss=0.02), "run.seed=7"],
        ["environment.holes.0.entrance=[0.0015, 0.0, 0.0]"],
    ],
    ids=["shipped", "about x", "between points", "the other way", "no delay", "30 ms", "loss", "beside the hole"],
)
def test_a_tilted_peg_goes_to_the_bottom_of_the_hole(overrides: list[str]) -> None:
    run = shipped("peg_in_hole", *overrides)
    tilt = angle(run.signals["slave_orientation"])
    assert tilt[0] == pytest.approx(np.radians(5.0), abs=1e-12)
    # It lies on the bottom, which yields under the press: up to 10 N on one of its points.
    assert 0.02 <= run.signals["hole_depth"][-1] <= 0.02 + 10.0 / STIFFNESS
    assert tilt[-1] < asin(CLEARANCE / LENGTH)
    assert np.linalg.norm(run.signals["environment_force"], axis=1).max() < 10.0
    assert run.metrics.false_trips == 0
    # The hand has turned most of the way.
    assert angle(run.signals["orientation"])[-1] > np.radians(5.0) / 2.0


@pytest.mark.slow
def test_without_torque_on_the_hand_the_peg_stays_as_tilted_as_the_walls_let_it() -> None:
    run = simulate("peg_in_hole", overrides=["coupling.torque_scale=0.01"])
    tilt = angle(run.signals["slave_orientation"])[-1]
    # The servo's torque, at most 1 N m/rad times 5 degrees, presses into both walls.
    yields = 2.0 * np.radians(5.0) / LENGTH / STIFFNESS
    chord = 2.0 * RADIUS * (1.0 - cos(tilt))
    assert asin(CLEARANCE / LENGTH) < tilt < asin((CLEARANCE + chord + yields) / LENGTH)
    assert angle(run.signals["orientation"])[-1] < np.radians(0.5)


# --------------------------------------------------------------------------------------------------------- valve


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.06])
@pytest.mark.parametrize("coulomb", [0.02, 0.05])
def test_a_valve_is_turned_by_90_degrees_and_its_friction_is_felt(delay_s: float, coulomb: float) -> None:
    run = simulate("valve", overrides=[*both_ways(delay_s), f"environment.handles.0.coulomb={coulomb}"])
    signals = run.signals
    turned = signals["handle_angle"]
    # Friction holds this angle in the springs of hand, servo and hold in series.
    assert turned[-1] == pytest.approx(pi / 2.0, abs=coulomb * (0.5 / 3.0 + 1.0 / 5.0 + 1.0 / 50.0))
    rate = np.gradient(turned, signals["slave_time_s"])
    acceleration = np.gradient(rate, signals["slave_time_s"])
    # The tool itself is 2.5 times as hard to turn as the valve, but its own servo does that.
    needed = coulomb + 0.02 * rate + 0.002 * acceleration
    turning = rate > 0.1
    assert turning.sum() > 1500
    assert np.abs(signals["environment_torque"][:, 2] + needed)[turning].max() < 0.05 * coulomb
    late = round(delay_s / 1e-3) + 1
    felt = signals["device_torque"][late:, 2][turning[:-late]]
    assert felt == pytest.approx(-0.5 * needed[:-late][turning[:-late]], abs=0.05 * coulomb)
    assert run.metrics.false_trips == 0


# ------------------------------------------------------------------------------------------------ pick and place


@pytest.mark.sampled(1)
@pytest.mark.slow
@pytest.mark.parametrize("overrides", [[], ["run.seed=1"], [*both_ways(0.02, 0.05), "run.seed=2"]])
def test_a_box_is_carried_and_turned(overrides: list[str]) -> None:
    run = shipped("pick_and_place", *overrides)
    place, turn = run.signals["body_position"], run.signals["body_orientation"]
    # Lifted by 80 mm, minus the sag of the servo, 1 kN/m, under 4.9 N, and of the hand, 300 N/m, under a fifth of it.
    assert place[:, 2].max() == pytest.approx(0.1 - 4.905 / 1000.0 - 0.2 * 4.905 / 300.0, abs=1e-3)
    assert place[-1] == pytest.approx([0.2, 0.0, 0.02], abs=2e-3)
    assert turn[-1] == pytest.approx([cos(pi / 4.0), 0.0, 0.0, sin(pi / 4.0)], abs=np.radians(1.0) / 2.0)
    assert [kind for kind in kinds(run) if kind in {"grip", "drop"}] == ["grip", "drop"]
    assert run.metrics.false_trips == 0
    lifted = place[:, 2] > 0.08
    assert np.median(run.signals["environment_force"][lifted, 2]) == pytest.approx(-4.905, rel=0.01)


@pytest.mark.slow
def test_body_too_heavy_for_the_jaws_slips_out_and_stays() -> None:
    """2 * 0.5 * 4 N is less than its weight of 4.9 N."""
    run = simulate("pick_and_place", overrides=["slave.gripper.force_n=4.0"])
    assert run.signals["body_position"][-1] == pytest.approx([0.0, 0.0, 0.02], abs=1e-3)
    dropped_s = next(event.time_s for event in run.events if event.kind == "drop")
    # It slips out of the jaws on the way up, before the trigger opens them at 8.8 s.
    assert 2.5 < dropped_s < 4.2
    assert run.signals["holds_object"][-4000:].max() == 0.0


# -------------------------------------------------------------------------------------------------------- frames


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8)])
def test_a_frame_between_the_two_sides_turns_commands_and_torques(axis: tuple[float, ...]) -> None:
    """C turns by 90 degrees about an axis: a remote turn about z is felt about C' z, and moves the hand about it."""
    half = sqrt_half = cos(pi / 4.0)
    quat = [half, *(sqrt_half * part for part in axis)]
    run = simulate(
        "torque_release", overrides=[WITHOUT, f"coupling.quat_wxyz={quat!r}", "operator.rotation.release.decay_s=0.0"]
    )
    e, z = np.array(axis), np.array([0.0, 0.0, 1.0])
    # C' by -90 degrees (Rodrigues).
    felt = e * (e @ z) - np.cross(e, z)
    torque, rate = run.signals["device_torque"], run.signals["angular_velocity"]
    assert torque[1000] == pytest.approx(TORQUE_N_M * felt, abs=1e-9)
    fastest = rate[np.argmax(np.linalg.norm(rate, axis=1))]
    assert fastest / np.linalg.norm(fastest) == pytest.approx(felt, abs=1e-3)
    # The command has turned about z, by the same angle.
    command, hand = run.signals["slave_command_orientation"][1150], run.signals["orientation"][1150]
    assert angle(command) == pytest.approx(angle(hand), abs=1e-6)
    assert command[1:3] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert abs(command[3]) > 1e-3


@pytest.mark.parametrize("scene", ["remote_push", "gripper"])
def test_a_scene_of_points_has_nothing_that_turns(scene: str) -> None:
    run = simulate(scene)
    metrics = run.metrics
    assert metrics.max_ejection_rate is metrics.peak_device_torque is metrics.orientation_rmse_rad is None
    assert metrics.torque_rmse_n_m is None
    assert not {"orientation", "slave_orientation", "device_torque", "rotation_tripped"} & set(run.signals)


# ----------------------------------------------------------------------------------------------------- alignment


def conjugate(quat: Array) -> Array:
    turned: Array = quat * np.array([1.0, -1.0, -1.0, -1.0])
    return turned


def product(left: Array, right: Array) -> Array:
    w, z, v, u = left[..., :1], right[..., :1], left[..., 1:], right[..., 1:]
    scalar = w * z - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + z * v + np.cross(v, u)], axis=-1)


def aligned(start: float, most: float, *more: str) -> Run:
    """Run a hand and a tool that begin `start` rad apart, at 0.5 rad/s, with 20 ms each way."""
    half = 0.5 * start
    return simulate(
        "torque_release",
        overrides=[
            *both_ways(0.02),
            f"coupling.alignment={{speed = 0.5, max_angle = {most}}}",
            f"slave.tool.quat_wxyz=[{cos(half)!r}, 0.0, {sin(half)!r}, 0.0]",
            *more,
        ],
    )


def test_a_tool_is_turned_to_the_hand_before_the_two_engage() -> None:
    run = aligned(0.8, 1.0, "run.duration_s=4.5")
    signals, time_s = run.signals, run.signals["time_s"]
    command = signals["slave_command_orientation"]
    left = angle(product(signals["orientation"], conjugate(command)))
    engaged_s = next(event.time_s for event in run.events if event.kind == "engaged")
    # This is the time until both hear one another, plus the turn of 0.8 rad at 0.5 rad/s.
    assert engaged_s == pytest.approx(2 * 0.02 + 1.6, abs=3e-3)
    turning = (time_s > 0.045) & (time_s < 1.63)
    steps = angle(product(command[1:], conjugate(command[:-1])))[turning[1:]]
    assert steps == pytest.approx(0.5e-3, abs=1e-6)
    # The news reaches the hand after 20 ms.
    before = time_s < engaged_s + 0.015
    assert not signals["device_torque"][before].any()
    assert not signals["device_force"][before].any()
    assert np.ptp(signals["slave_command"][before], axis=0) == pytest.approx(0.0, abs=1e-12)
    # From then until the release both have the same orientation, except for the delay.
    held = (time_s >= engaged_s) & (time_s < engaged_s + 1.0)
    rate = np.linalg.norm(signals["angular_velocity"], axis=1)[held].max()
    assert 1e-3 < rate < 1.0
    assert left[held].max() < 0.022 * rate + 1e-6
    assert run.metrics.outcome == "complete"


def test_the_shipped_alignment_turns_is_silent_engages_without_a_jump_and_follows() -> None:
    run = simulate("alignment")
    signals, time_s, dt = run.signals, run.signals["time_s"], 1e-3
    command, torque = signals["slave_command_orientation"], signals["device_torque"]
    apart = angle(product(signals["orientation"], conjugate(command)))
    slave_s, master_s = sorted(event.time_s for event in run.events if event.kind == "engaged")
    # There and back, plus 0.8 rad at 0.5 rad/s; the news takes 20 ms more.
    assert slave_s == pytest.approx(0.04 + 1.6, abs=2 * dt)
    assert master_s == pytest.approx(slave_s + 0.02, abs=2 * dt)
    steps = angle(product(command[1:], conjugate(command[:-1])))
    assert steps[time_s[1:] < slave_s - dt].max() == pytest.approx(0.5 * dt, rel=1e-6)
    assert not torque[time_s < master_s].any()
    assert steps[np.abs(time_s[1:] - slave_s) < 5 * dt].max() <= 0.5 * dt * (1.0 + 1e-6)
    # The tool's torque is felt in full once the force has faded in, at most 200 ms later.
    felt = (time_s > master_s + 0.201) & (time_s < time_s[-1])
    assert torque[felt, 2] == pytest.approx(0.05, abs=1e-9)
    # The hand turns by 0.6 rad, and the tool follows: they differ only by the turn within 20 ms and a tick.
    fastest = np.linalg.norm(signals["angular_velocity"], axis=1).max()
    assert 0.3 < fastest < 1.875 * 0.6 / 1.2 + 0.05
    assert apart[time_s > slave_s].max() == pytest.approx(0.021 * fastest, rel=0.05)
    assert apart[-1] < 1e-6


@pytest.mark.parametrize(("change", "engages"), [("coupling={}", True), ("coupling.alignment.max_angle=0.7", False)])
def test_the_shipped_alignment_beside_none_and_beyond_its_bound(change: str, engages: bool) -> None:
    run = simulate("alignment", overrides=[change])
    apart = angle(product(run.signals["orientation"], conjugate(run.signals["slave_command_orientation"])))
    assert ("engaged" in kinds(run)) == engages
    assert apart[np.isfinite(apart)][0] == pytest.approx(0.8, abs=0.02)
    # Nobody turns it: the tool keeps its start, or follows the turn of the hand.
    assert np.ptp(run.signals["slave_command_orientation"][np.isfinite(apart)], axis=0).any() == engages
    assert run.signals["device_torque"].any() == engages


def test_a_tool_that_is_coupled_at_its_tip_turns_about_it() -> None:
    tip = np.array([0.0, 0.1, 0.0])
    run = simulate("torque_release", overrides=[WITHOUT, "coupling.reference_point=[0.0, 0.1, 0.0]"])
    place, turned = run.signals["slave_position"], run.signals["slave_orientation"]
    known = np.isfinite(turned).all(axis=1)
    place, turned = place[known], turned[known]
    # The hand turns in place; the servo holds the tip against the mass that circles about it.
    assert np.linalg.norm(place - tip, axis=1).max() < 0.05 * np.linalg.norm(tip)
    as_rows = np.broadcast_to([0.0, *tip], turned.shape)
    tool = place - product(product(turned, as_rows), conjugate(turned))[:, 1:]
    angle_about_z = 2.0 * np.arctan2(turned[:, 3], turned[:, 0])
    # The chord of a circle of radius |r|.
    chord = 2.0 * np.linalg.norm(tip) * np.abs(np.sin(0.5 * angle_about_z))
    assert chord.max() > 0.15
    assert np.linalg.norm(tool, axis=1) == pytest.approx(chord, abs=0.005)


def test_the_tool_point_as_reference_point_changes_nothing() -> None:
    plain, named = (
        simulate("valve", overrides=["run.duration_s=2.0", *change])
        for change in ([], ["coupling.reference_point=[0.0, 0.0, 0.0]"])
    )
    for name, values in plain.signals.items():
        assert np.array_equal(values, named.signals[name], equal_nan=True), name


def test_a_tool_that_is_too_far_off_stays_and_never_engages() -> None:
    run = aligned(0.8, 0.7)
    command = run.signals["slave_command_orientation"]
    assert np.ptp(command, axis=0) == pytest.approx(0.0, abs=1e-12)
    assert run.metrics.outcome == "never-engaged"
    assert not run.signals["device_torque"].any()


def test_where_there_is_nothing_to_turn_the_two_engage_at_once() -> None:
    plain, with_it = (
        [event.time_s for event in simulate("torque_release", overrides=change).events if event.kind == "engaged"]
        for change in ([], ["coupling.alignment={}"])
    )
    # The slave engages first, and the master after it: in the same tick, or at most the 5 ms of the backward link
    # later.
    assert with_it[0] == plain[0]
    assert 0.0 <= with_it[1] - plain[1] <= 0.006


# ------------------------------------------------------------------------------------------------------ refusals

REFUSED = [
    # Kinds.
    ("torque_release", "master.axes=2", "[master] axes = 2: must be 3 with kind"),
    ("torque_release", "slave.kind=joints", 'must be "pose", that of the master: there is no map from pose to joints'),
    ("torque_release", "master.kind=linear", "is for what turns"),
    ("peg_in_hole", "master.kind=linear", "is for what turns"),
    # Options that poses need or exclude.
    ("torque_release", "run.stop_early=true", "[run] stop_early"),
    ("torque_release", "slave.control=position", 'must be "pd" with kind = "pose"'),
    ("torque_release", "slave.force_sensor={noise_n = 0.1}", "[slave] force_sensor: is exact"),
    ("torque_release", "coupling.rotation_axis=[0.0, 0.0, 2.0]", "of length 1, not 2"),
    ("torque_release", "coupling={rotation_axis = [0.0, 0.0, 1.0], locks_rotation = true}", "turns about no axis"),
    # Alignment.
    ("remote_push", "coupling.alignment={}", "[coupling] alignment: is for what turns"),
    ("valve", "coupling.alignment.speed=0.0", "[coupling.alignment] speed = 0: must be above 0"),
    (
        "valve",
        "coupling.alignment.max_angle=3.2",
        "[coupling.alignment] max_angle = 3.2: must be above 0 and at most 3.14159",
    ),
    ("valve", "coupling.alignment.max_angle=0.0", "[coupling.alignment] max_angle = 0: must be above 0"),
    ("valve", "coupling.alignment.angle=1.0", "angle"),
    (
        "valve",
        "coupling.alignment.speed=2.6",
        "[coupling.alignment] speed = 2.6: must be at most command_angular_speed",
    ),
    ("valve", "coupling={alignment = {}, command_angular_speed = 0.4}", "must be at most command_angular_speed, 0.4"),
    (
        "valve",
        "coupling.alignment.max_angle=2.1",
        "[coupling.alignment] max_angle = 2.1: must be at most 2 at that speed",
    ),
    ("valve", "coupling={alignment = {}, rotation_scale = 2.0}", "[coupling] rotation_scale = 2: must be 1 with"),
    (
        "valve",
        "coupling={alignment = {}, changes = [{at_s = 1.0, rotation_scale = 0.5}]}",
        "rotation_scale = 0.5: must be 1 with [coupling.alignment]",
    ),
    ("valve", "coupling={alignment = {}, locks_rotation = true}", "[coupling] alignment: turns about any axis"),
    ("valve", "coupling={alignment = {}, rotation_axis = [0.0, 0.0, 1.0]}", "or rotation_axis"),
    ("torque_release", "slave.tool.quat_wxyz=[1.0, 1.0, 0.0, 0.0]", "[slave.tool] quat_wxyz"),
    ("torque_release", "coupling.quat_wxyz=[2.0, 0.0, 0.0, 0.0]", "[coupling] quat_wxyz"),
    # Bodies that are not rigid.
    (
        "torque_release",
        "master.rotation.inertia_kg_m2=[1e-4, 3e-4, 1e-4]",
        "[master.rotation] inertia_kg_m2 = [0.0001, 0.0003, 0.0001]: must be those of a rigid body: none above the sum",
    ),
    ("torque_release", "slave.tool.inertia_kg_m2=[0.021, 0.01, 0.01]", "and 0.021 is above 0.02"),
    ("torque_release", "slave.tool.rotational_stiffness=1e9", "slave or environment: rate of tool and world"),
    ("torque_release", "operator.rotation.stiffness=1e9", "less stiffness or damping in [operator.rotation]"),
    ("torque_release", "safety.rotation.controllers=[vfc, vfc]", "[safety.rotation] controllers = "),
    ("felt_trigger", "safety.gripper.controllers=[wsc, wsc]", "[safety.gripper] controllers = "),
    ("felt_trigger", "master.gripper.encoder_quantum=0.5", "must be at most travel_m"),
    (
        "peg_in_hole",
        "environment.holes.0.chamfer_m=0.5",
        "holes.0] chamfer_m = 0.5: must be at most depth",
    ),
    (
        "torque_release",
        "coupling.reference_point=[0.0, 11.0, 0.0]",
        "[coupling] reference_point = [0, 11, 0]: must be within 10 m",
    ),
    ("remote_push", "coupling.reference_point=[0.0, 0.1, 0.0]", 'is for what turns: give [master] kind = "pose"'),
    # The world of the tool.
    (
        "torque_release",
        "environment.objects=[{contact = {stiffness = 100.0}, body = {mass_kg = 1.0}}]",
        "[[environment.bodies]] has what moves",
    ),
    ("peg_in_hole", "environment.holes.0.axis=[0.0, 0.0, 0.0]", "of any length but 0"),
    ("peg_in_hole", "environment.holes.0.radius=0.0", "radius = 0"),
    ("peg_in_hole", "environment.holes.0.contact.exponent=2.0", "exponent"),
    ("valve", "environment.handles.0.axis=[0.0, 0.0, 0.0]", "of any length but 0"),
    ("valve", "environment.handles.0.stops_rad=[1.0, 1.0]", "the lower stop below the upper"),
    ("pick_and_place", "environment.bodies.0.quat_wxyz=[0.5, 0.0, 0.0, 0.0]", "of norm 1, not 0.5"),
    ("pick_and_place", "environment.bodies.0.half_extents=[0.02, 0.0, 0.02]", "half_extents"),
    # The hand.
    ("torque_release", "operator.rotation.start_wxyz=[0.0, 0.0, 0.0, 0.0]", "of norm 1, not 0"),
    ("valve", "operator.rotation.legs=[{duration_s = 1.0}]", "needs turn or end_wxyz, one of the two"),
    (
        "valve",
        "operator.rotation.legs=[{duration_s = 1.0, turn = [0.0, 0.0, 1.0], end_wxyz = [1.0, 0.0, 0.0, 0.0]}]",
        "needs turn or end_wxyz, one of the two",
    ),
    ("valve", "operator.rotation.legs=[{duration_s = 1.0, turn = [0.0, 0.0, 3.2]}]", "shorter than pi"),
    ("valve", "operator.rotation.legs=[{duration_s = 1.0, end_wxyz = [1.0, 1.0, 0.0, 0.0]}]", "of norm 1"),
    ("torque_release", "operator.rotation.release.kind=strength", "give strength_n_m"),
    # The safety settings.
    ("torque_release", "safety.rotation.lever_m=0.0", "lever_m = 0"),
    ("torque_release", "safety.rotation.grasp_threshold=1.0", "grasp_threshold = 1"),
    ("torque_release", "safety.rotation.energy_threshold_j=0.0", "energy_threshold_j = 0"),
    (
        "torque_release",
        'safety.rotation={controllers = ["hsc"], damping = 1.0}',
        "[safety.rotation] damping = 1: must be at most I / (5 dT) = 0.08",
    ),
    (
        "torque_release",
        'safety.rotation={controllers = ["pc"], pc_max_damping = 1.0}',
        "[safety.rotation] pc_max_damping = 1: must be at most I / (5 dT) = 0.08",
    ),
]


@pytest.mark.parametrize(
    ("scene", "change", "said"), REFUSED, ids=[f"{scene} {change}" for scene, change, _ in REFUSED]
)
def test_what_cannot_be_is_refused_with_its_key(scene: str, change: str, said: str) -> None:
    with pytest.raises(SceneError) as refused:
        simulate(scene, overrides=[change])
    assert said in str(refused.value)


@pytest.mark.parametrize("table", ["master.rotation", "slave.tool", "slave"])
def test_a_table_that_poses_need_is_missed(table: str) -> None:
    scene = load_scene("torque_release", [])
    with pytest.raises(SceneError) as refused:
        override_scene(scene, [f"{table}=none"])
    assert table.split(".", maxsplit=1)[0] in str(refused.value)


def test_quaternions_of_the_signals_are_rotations() -> None:
    signals = simulate("valve").signals
    for name in ("orientation", "slave_orientation", "slave_command_orientation"):
        norms = np.linalg.norm(signals[name], axis=1)
        known = ~np.isnan(norms)
        assert known.any()
        assert norms[known] == pytest.approx(1.0, abs=1e-9), name
    assert hypot(*signals["orientation"][-1]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("quat_wxyz", [[1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0], [0.5, 0.5, -0.5, 0.5]])
def test_the_angle_that_a_picture_of_an_alignment_shows_falls_to_0_in_any_frame(quat_wxyz: list[float]) -> None:
    """`|log(R_s (C R_m C')')|`: at first that of the tool, because the hand is aligned with its base frame."""
    override = f"coupling.quat_wxyz={quat_wxyz!r}"
    run = simulate("alignment", overrides=[override])
    frame = frame_of(run.settings)
    assert frame == tuple(quat_wxyz)
    apart = angle_apart(run.signals, np.array(frame))
    assert apart[1] == pytest.approx(0.8, abs=1e-9)
    assert np.diff(apart[50:1600]) == pytest.approx(-0.5e-3, abs=1e-9)
    assert apart[1640] < 1e-6
    assert frame_of(simulate("valve").settings) is None
