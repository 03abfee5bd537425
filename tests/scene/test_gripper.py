"""The gripper of a scene follows the operator's trigger, and keeps its grip through every fault of the link."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from haptether.bridge import Run, Scene, SceneError, load_scene, override_scene, simulate

PICK = """
schema = 1
title = "Picks something up"
[run]
duration_s = 3.0
[master]
device = "touch"
[operator]
legs = [{ duration_s = 1.0, end = 0.02 }]
trigger = [[0.5, 0.0], [1.0, 1.0], [2.0, 1.0], [2.2, 0.0]]
[slave]
[slave.gripper]
speed = 2.0
force_n = 40.0
object = 0.6
[record]
"""


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    path = tmp_path / "pick.toml"
    path.write_text(PICK, encoding="utf-8")
    return load_scene(path, [])


def without_gripper(scene: Scene) -> Scene:
    assert scene.slave is not None
    return replace(scene, slave=replace(scene.slave, gripper=None))


def events(run: Run, *kinds: str) -> list[tuple[float, str]]:
    return [(event.time_s, event.kind) for event in run.events if event.kind in kinds]


def engaged_s(run: Run) -> float:
    return events(run, "engaged")[0][0]


def test_it_closes_on_what_is_between_and_lets_go(scene: Scene) -> None:
    run = simulate(scene)
    begun_s = engaged_s(run)
    (grip_s, first), (drop_s, last) = events(run, "grip", "drop")
    assert (first, last) == ("grip", "drop")
    # The trigger passes 0.6 at 0.8 s, at the speed of the jaws. It opens from 2.0 s on, faster than the jaws: these
    # start from the full stroke of the last command, 0.4 at 2 / s. Add a tick each for the frame, the command and the
    # measurement.
    assert begun_s + 0.8 <= grip_s <= begun_s + 0.8 + 0.004
    assert begun_s + 2.2 <= drop_s <= begun_s + 2.2 + 0.004
    position, force, holds = (run.signals[name] for name in ("gripper", "gripper_force", "holds_object"))
    assert position.max() == 0.6
    assert set(np.unique(force[holds == 1.0])) == {40.0}
    assert not force[holds == 0.0].any()
    speed = np.diff(run.signals["gripper_command"][~np.isnan(run.signals["gripper_command"])]) / scene.run.period_s
    assert np.abs(speed).max() == pytest.approx(2.0, rel=1e-9)


@pytest.mark.parametrize(
    "changes",
    [
        ["link.forward={outages = [{times = {kind = 'once', at_s = 1.6, duration_s = 0.5}}]}"],
        ["link.backward={outages = [{times = {kind = 'once', at_s = 1.6, duration_s = 0.5}}]}"],
        ["operator.clutch=[[0.0, 1.5], [2.6, 2.9]]"],
    ],
    ids=["the master falls silent", "the slave falls silent", "the clutch is let go"],
)
def test_a_grip_is_kept_while_the_sides_are_apart_and_when_they_engage_anew(scene: Scene, changes: list[str]) -> None:
    """The trigger is open at the new engagement: a gripper that jumped to it would drop the object."""
    run = simulate(override_scene(scene, changes))
    assert [kind for _, kind in events(run, "grip", "drop")] == ["grip"]
    assert run.signals["gripper"][-1] == 0.6
    assert run.signals["trigger"][-1] == 0.0
    assert not np.isnan(run.signals["gripper_command"][-1])


def test_a_delay_shifts_it_and_loss_drops_nothing(scene: Scene) -> None:
    run = simulate(
        override_scene(scene, ["link.forward={delay_s = 0.1, loss = 0.05}", "link.backward={delay_s = 0.1}"])
    )
    grip_s, drop_s = (time_s for time_s, _ in events(run, "grip", "drop"))
    begun_s = engaged_s(run)
    assert begun_s + 0.9 <= grip_s <= begun_s + 0.92
    assert begun_s + 2.3 <= drop_s <= begun_s + 2.32


def test_a_scene_without_one_has_no_signals_of_it(scene: Scene) -> None:
    run = simulate(without_gripper(override_scene(scene, ["operator.trigger=[]"])))
    assert not {"gripper", "trigger", "holds_object"} & set(run.signals)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("operator.trigger=[[0.5, 0.0], [0.5, 1.0]]", "trigger.1.0 = 0.5: must be above the time before it"),
        ("operator.trigger=[[0.5, 1.5]]", "trigger.0.1 = 1.5: must be 0 (open) to 1 (closed)"),
        ("slave.gripper.speed=0", "[slave.gripper] speed = 0"),
        ("slave.gripper.position=0.7", "object = 0.6: must be at least [slave.gripper] position, 0.7"),
        ("slave.gripper.object=1.1", "[slave.gripper] object = 1.1"),
        ("slave.gripper.options={host = 'a'}", "[slave.gripper] options"),
    ],
)
def test_what_cannot_be_is_refused_with_its_key(scene: Scene, change: str, said: str) -> None:
    with pytest.raises(SceneError) as refused:
        simulate(override_scene(scene, [change]))
    assert said in str(refused.value)


def test_a_trigger_that_leads_nothing_is_refused(scene: Scene) -> None:
    with pytest.raises(SceneError) as refused:
        simulate(without_gripper(scene))
    assert "[operator] trigger: leads no gripper: add [slave.gripper]" in str(refused.value)


def test_a_run_ends_early_only_when_the_trigger_has_come_to_rest(scene: Scene) -> None:
    run = simulate(override_scene(scene, ["run.duration_s=60.0", "run.stop_early=true"]))
    assert [kind for _, kind in events(run, "grip", "drop")] == ["grip", "drop"]


# ------------------------------------------------------------------------------------------- a trigger that is felt

FEELS = ["master.gripper={travel_m = 0.03, mass_kg = 0.05}"]
FINGER_N, STIFFNESS, TRAVEL_M, MASS_KG = 0.05 * 40.0, 300.0, 0.03, 0.05
"""Force of the jaws' default 40 N at the finger, and finger and trigger of `FEELS`."""
LETS_GO = "operator.finger={release = {at_s = 1.8, decay_s = 0.0, kind = 'gain'}}"
FINGER_SIGNALS = {
    "trigger_velocity", "finger_force", "trigger_rendered_force", "trigger_safety_force", "trigger_device_force",
    "trigger_tripped",
}  # fmt: skip


@pytest.fixture
def felt(scene: Scene) -> Scene:
    return override_scene(scene, FEELS)


def test_a_finger_feels_what_the_jaws_hold_and_nothing_else(felt: Scene) -> None:
    run = simulate(felt)
    assert [kind for _, kind in events(run, "grip", "drop")] == ["grip", "drop"]
    force, time_s = run.signals["trigger_device_force"], run.signals["time_s"]
    (grip_s, _), (drop_s, _) = events(run, "grip", "drop")
    assert not force[(time_s < grip_s) | (time_s > drop_s + 0.002)].any()
    assert force.max() == 0.0
    assert np.diff(force).min() >= -10.0 * felt.run.period_s * (1.0 + 1e-9)
    # After 0.8 s at rest or more: K_f (travel - x) = F_finger = lambda F_jaws. The poles of K_f, B_f = 3 and m are at
    # -30 ± 71 j: e^-24 remains.
    rests = np.searchsorted(time_s, engaged_s(run) + 1.99)
    assert force[rests] == pytest.approx(-FINGER_N, rel=1e-12)
    assert run.signals["finger_force"][rests] == pytest.approx(FINGER_N, abs=1e-9)
    assert run.signals["trigger"][rests] == pytest.approx(1.0 - FINGER_N / STIFFNESS / TRAVEL_M, abs=1e-9)


@pytest.mark.parametrize(("slew", "drops"), [(10.0, 1), (250.0, 3)])
def test_a_force_that_grows_slowly_does_not_throw_the_trigger_back(felt: Scene, slew: float, drops: int) -> None:
    """The finger closes at 60 mm/s: up to K_f V = 18 N/s it continues; far above, the jaws open before they hold."""
    run = simulate(override_scene(felt, [f"master.gripper.max_slew_n_per_s={slew}"]))
    assert len(events(run, "drop")) == drops


def test_a_trigger_that_is_not_felt_goes_where_its_course_says(scene: Scene) -> None:
    run = simulate(scene)
    assert not FINGER_SIGNALS & set(run.signals)
    since_s = np.clip(run.signals["time_s"] - engaged_s(run), 0.0, None)
    expected = np.interp(since_s, [0.5, 1.0, 2.0, 2.2], [0.0, 1.0, 1.0, 0.0])
    assert np.abs(run.signals["trigger"] - expected).max() < 1e-12


def test_a_trigger_that_is_let_go_is_as_fast_as_the_closed_form(felt: Scene) -> None:
    """`v² = 2 F x / m`: the jaws are slower, and press until the trigger has travelled its full way."""
    run = simulate(override_scene(felt, [LETS_GO]))
    way_m = TRAVEL_M - FINGER_N / STIFFNESS
    expected = np.sqrt(2.0 * FINGER_N * way_m / MASS_KG)
    # The signal is sampled once a tick and ends at the stop: at most one tick of F / m is missing.
    fastest = -run.signals["trigger_velocity"].min()
    assert expected - FINGER_N / MASS_KG * felt.run.period_s <= fastest <= expected * (1.0 + 1e-9)


@pytest.mark.parametrize("controller", ["vfc", "hsc", "wsc", "pc"])
def test_each_controller_bounds_how_the_trigger_is_thrown(felt: Scene, controller: str) -> None:
    fastest = [
        -simulate(override_scene(felt, [LETS_GO, f"safety.gripper={{controllers = {watched}}}"]))
        .signals["trigger_velocity"].min()
        for watched in ([], [controller])
    ]  # fmt: skip
    assert fastest[1] < 0.75 * fastest[0]


@pytest.mark.parametrize(
    "changes",
    [
        ["link.forward={outages = [{times = {kind = 'once', at_s = 1.6, duration_s = 0.5}}]}"],
        ["link.backward={outages = [{times = {kind = 'once', at_s = 1.6, duration_s = 0.5}}]}"],
        ["operator.clutch=[[0.0, 1.5], [2.6, 2.99]]"],
    ],
    ids=["the master falls silent", "the slave falls silent", "the clutch is let go"],
)
def test_nothing_is_felt_while_the_sides_are_apart_nor_before_the_jaws_follow_again(
    felt: Scene, changes: list[str]
) -> None:
    run = simulate(override_scene(felt, changes))
    assert [kind for _, kind in events(run, "grip", "drop")] == ["grip"]
    force, time_s = run.signals["trigger_device_force"], run.signals["time_s"]
    is_coupled = np.isin(run.signals["state"], [2, 3])
    parted = 1 + int(np.flatnonzero(is_coupled[:-1] & ~is_coupled[1:])[0])
    assert force[parted - 1] < -1.9
    # The force fades like the force of the hand, within 75 ms; the tick of the hold is the first.
    assert np.diff(force[parted - 1 :]).min() >= 0.0
    assert not force[time_s > time_s[parted] + 0.075].any()
    # Both sides have engaged again meanwhile, with the trigger open and the grip kept.
    assert is_coupled[np.searchsorted(time_s, 2.95)]


def test_what_the_ladder_does_to_the_hand_it_does_to_the_finger(felt: Scene) -> None:
    """At each tick of a hold, the forces of the hand and of the finger keep the same share."""
    run = simulate(
        override_scene(
            felt,
            [
                "environment.pushers=[{at_s = 0.5, force_n = 1.0}]",
                "link.backward={outages = [{times = {kind = 'once', at_s = 1.6, duration_s = 0.5}}]}",
            ],
        )
    )
    held = np.flatnonzero(run.signals["state"] == 4)
    share = {
        name: run.signals[name][held] / run.signals[name][held[0] - 1]
        for name in ("device_force", "trigger_device_force")
    }
    assert 0.0 < share["device_force"][10] < 0.95
    np.testing.assert_allclose(share["trigger_device_force"], share["device_force"], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("master.gripper={mass_kg = 0.05}", "[master.gripper] travel_m"),
        ("master.gripper={travel_m = 0.03}", "[master.gripper] mass_kg"),
        ("master.gripper.travel_m=0", "[master.gripper] travel_m = 0"),
        ("master.gripper.mass_kg=0", "[master.gripper] mass_kg = 0"),
        ("master.gripper.viscous=-0.1", "[master.gripper] viscous = -0.1"),
        ("master.gripper.force_scale=0", "[master.gripper] force_scale = 0"),
        ("master.gripper.max_force_n=51", "[master.gripper] max_force_n = 51"),
        ("master.gripper.max_slew_n_per_s=inf", "[master.gripper] max_slew_n_per_s = inf"),
        ("safety.gripper.damping=10.1", "[safety.gripper] damping = 10.1: must be at most m / (5 dT) = 10"),
        ("safety.gripper.reach_m=0", "[safety.gripper] reach_m = 0"),
        ("operator.finger.release={at_s = 1.0}", "[operator.finger.release] kind: a strength without bound"),
        ("run.stop_early=true", "[run] stop_early: a trigger that is felt"),
        ("master.buttons={gripper = 1}", "[master.buttons] gripper: works what [master.gripper] leads"),
    ],
)
def test_a_felt_trigger_that_cannot_be_is_refused_with_its_key(felt: Scene, change: str, said: str) -> None:
    with pytest.raises(SceneError) as refused:
        simulate(override_scene(felt, ["safety.controllers=['vfc']", change]))
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("operator.finger={}", "[operator] finger: is for a trigger that is felt"),
        ("safety.gripper={}", "[safety] gripper: is for a trigger that is felt"),
    ],
)
def test_what_belongs_to_a_felt_trigger_is_refused_without_one(scene: Scene, change: str, said: str) -> None:
    with pytest.raises(SceneError) as refused:
        simulate(override_scene(scene, [change]))
    assert said in str(refused.value)


def test_a_trigger_that_is_felt_leads_a_gripper(felt: Scene) -> None:
    with pytest.raises(SceneError) as refused:
        simulate(without_gripper(override_scene(felt, ["operator.trigger=[]"])))
    assert "[master] gripper: leads no gripper" in str(refused.value)


# ----------------------------------------------------------------------------------------------- the shipped scene

WAY_M = TRAVEL_M - FINGER_N / STIFFNESS
CLOSED_FORM = float(np.sqrt(2.0 * FINGER_N * WAY_M / MASS_KG))


def test_the_shipped_trigger_feels_what_is_held_and_is_thrown_as_the_closed_form_says() -> None:
    run = simulate("felt_trigger", overrides=["safety.controllers=[]"])
    assert [kind for _, kind in events(run, "grip", "drop")] == ["grip", "drop"]
    force, time_s = run.signals["trigger_device_force"], run.signals["time_s"]
    held = (time_s > 1.4) & (time_s < 1.8)
    assert force[held] == pytest.approx(-FINGER_N, abs=1e-9)
    assert run.signals["trigger"][held] == pytest.approx(WAY_M / TRAVEL_M, abs=1e-3)
    assert not force[time_s < events(run, "grip")[0][0]].any()
    assert -run.signals["trigger_velocity"].min() == pytest.approx(CLOSED_FORM, abs=FINGER_N / MASS_KG * 1e-3)


@pytest.mark.parametrize("controller", ["vfc", "hsc", "wsc", "pc"])
def test_with_a_controller_the_shipped_trigger_is_slower(controller: str) -> None:
    run = simulate("felt_trigger", overrides=[f"safety.gripper.controllers=[{controller}]"])
    assert 0.1 < -run.signals["trigger_velocity"].min() < 0.5 * CLOSED_FORM
    assert run.signals["trigger_tripped"].any()
    trips = [(event.time_s, event.detail) for event in run.events if event.kind == "trip"]
    tripped_s = run.signals["time_s"][run.signals["trigger_tripped"] != 0]
    assert trips[0][0] == pytest.approx(tripped_s[0])
    assert trips[0][1] == f"trigger {controller}"
    assert "recover" in {event.kind for event in run.events if event.detail == "trigger"}


def test_a_force_that_grows_fast_throws_the_shipped_trigger_back() -> None:
    run = simulate("felt_trigger", overrides=["safety.controllers=[]", "master.gripper.max_slew_n_per_s=250"])
    assert [kind for _, kind in events(run, "grip", "drop")] == ["grip", "drop"] * 2
