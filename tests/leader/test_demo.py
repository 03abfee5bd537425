"""Demonstrations with an emulated leader arm, as processes: a pick; a push and a released hand."""

from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from tests.live.sides import Never
from tests.ur.stalls import unheld

from haptether.cli import main
from haptether.dynamixel.description import ArmKinematics, load_arm
from haptether.studies import FollowScene, PickScene, run_follow, run_pick
from haptether.studies.leader import LEADER, Emulated, Leader, hand_path


# The same task with a simulated hand: tests/ur/driver/test_demo.py; the leader arm: tests/leader/test_driver.py.
@pytest.mark.thorough
@pytest.mark.alone
@pytest.mark.timeout(300)
@pytest.mark.parametrize("slave", ["simulated", "ur"])
def test_a_led_arm_picks_something_up(slave: Literal["simulated", "ur"], tmp_path: Path) -> None:
    if slave == "ur":
        pytest.importorskip("rtde_control", reason="the extra ur is not installed")
    scene = PickScene(slave=slave, master="dynamixel")
    result = unheld(lambda: run_pick(scene, tmp_path, lambda *_: None, Never()), pytest.fail)
    assert result.is_done, result
    assert result.lifted_m == pytest.approx(0.06, abs=3e-3)


@pytest.mark.thorough
@pytest.mark.live
@pytest.mark.timeout(400)
def test_a_follower_grips_and_carries_and_a_push_reaches_the_hand_damped(tmp_path: Path) -> None:
    scene = FollowScene(jitter_s=0.0, loss=0.0)
    thrown = {}
    controllers: tuple[Literal["none", "wsc"], ...] = ("none", "wsc")
    for controller in controllers:
        run = partial(run_follow, scene, controller, tmp_path, lambda *_: None, Never())
        result = unheld(run, pytest.fail)
        assert result.is_carried, result
        assert result.led_rad == pytest.approx(scene.led_rad, abs=0.02)
        # The grip is the gripper's setting, measured by current; the trigger gets 0.3 of it.
        assert result.grip_n == pytest.approx(1.5, abs=0.1)
        assert result.finger_n == pytest.approx(0.45, abs=0.1)
        assert result.felt_nm > 0.1
        thrown[controller] = result.thrown_rad_s
    assert thrown["wsc"] < thrown["none"], thrown


def test_the_hand_leads_the_tool_as_the_scene_says() -> None:
    """The path ends 0.1 m aside and 60 degrees about z, and goes down by 0.06 m twice."""
    arm = load_arm(LEADER)
    leader = Leader(arm, Emulated.__new__(Emulated), "", (), Path())
    header, *lines = hand_path(leader, 8.0).splitlines()
    assert header == "time_s,1,2,3,4,5,6,7"
    rows = np.array([[float(number) for number in line.split(",")] for line in lines])
    signs, kinematics = np.array([joint.sign for joint in arm.joints]), ArmKinematics(arm)
    poses = [kinematics.state(signs * row[1:7], np.zeros(6)) for row in rows]
    places = np.array([pose[0] for pose in poses])
    moved = places - places[0]
    np.testing.assert_allclose(moved[-1], (0.0, 0.1, 0.0), atol=1e-6)
    assert moved[:, 2].min() == pytest.approx(-0.06, abs=1e-6)
    between = abs(float(np.dot(poses[0][1], poses[-1][1])))
    assert 2.0 * np.arccos(between) == pytest.approx(np.pi / 3.0, abs=1e-6)
    assert arm.trigger is not None
    assert rows[0, 7] == pytest.approx(arm.trigger.open_rad)
    assert rows[:, 7].min() == pytest.approx(arm.trigger.closed_rad)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--slave", "dynamixel"], "master = simulated: must be dynamixel with --slave dynamixel"),
        (
            ["--master", "dynamixel", "--slave", "dynamixel", "--task", "pick"],
            "task = pick: --slave dynamixel shows both in one",
        ),
        (
            ["--master", "dynamixel", "--task", "push"],
            "task = push: --master dynamixel leads",
        ),
    ],
)
def test_arms_that_do_not_go_together_are_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", *arguments]) == 2
    assert said in capsys.readouterr().err
