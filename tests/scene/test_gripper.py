"""The gripper of a scene follows the operator's trigger, and keeps its grip whatever the link does."""

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
    # The trigger passes 0.6 at 0.8 s, as fast as the jaws move; it opens from 2.0 s on, faster than these: from the
    # whole way of the last command, 0.4 at 2 / s. A tick each for the frame, the command and the measurement.
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
    """When they come together again the trigger is open: a gripper that jumped to it would let fall what it holds."""
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
