"""An emulated arm in virtual time: gravity on its joints, and hands that hold and lead them."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from haptether.cli import main
from haptether.dynamixel.description import ArmDescription, ArmKinematics
from haptether.dynamixel.emulator import ArmLoad, Bus, ControlLine, HeldBy, Joint, JointSettings, servos_of
from haptether.dynamixel.models import SERVO_MODELS


class World:
    """An emulated arm, its control line and its time."""

    def __init__(self, arm: ArmDescription, start: tuple[float, ...] = (), mass_scale: float = 1.0) -> None:
        self.arm = arm
        self.servos = servos_of(arm, baud=4_000_000, firmware=52, start=start)
        self.bus = Bus(self.servos, load=ArmLoad(arm, self.servos, mass_scale=mass_scale))
        self.line = ControlLine(self.bus)
        self.now_s = 10.0
        self.bus.advance(self.now_s)

    def run(self, duration_s: float, each: Callable[[], None] = lambda: None) -> None:
        for _ in range(round(duration_s / 0.005)):
            self.now_s += 0.005
            self.bus.advance(self.now_s)
            each()

    def say(self, line: str) -> str:
        return self.line.answer(line, self.now_s)

    @property
    def q(self) -> list[float]:
        return [
            j.sign * (s.joint.position_rad - j.offset_rad) for j, s in zip(self.arm.joints, self.servos, strict=False)
        ]


def test_it_starts_where_it_is_said(two: ArmDescription) -> None:
    assert World(two).q == pytest.approx([0.0, 0.5])
    assert World(two, (0.3, -0.2)).q == pytest.approx([0.3, -0.2])


def test_it_hangs_down_when_nobody_holds_it(two: ArmDescription) -> None:
    world = World(two, (-0.5, 0.2))
    world.run(20.0)
    kinematics = ArmKinematics(two)
    # Friction stops it where gravity no longer overcomes it.
    for torque, joint in zip(kinematics.gravity(world.q), two.joints, strict=True):
        assert joint.coulomb_nm is not None
        assert abs(torque) <= joint.coulomb_nm + 1e-3
    assert world.q[0] == pytest.approx(-math.pi / 2, abs=0.15)


def test_a_stiff_hand_feels_the_weight(two: ArmDescription) -> None:
    world = World(two)
    for joint, servo in zip(two.joints, world.servos, strict=False):
        at = joint.sign * 0.4 + joint.offset_rad
        assert world.say(f"hand {servo.id} {at} 400 2") == "ok"
    world.run(3.0)
    kinematics = ArmKinematics(two)
    felt = [j.sign * s.joint.hand_nm for j, s in zip(two.joints, world.servos, strict=False)]
    for seen, weight, joint in zip(felt, kinematics.gravity(world.q), two.joints, strict=True):
        assert joint.coulomb_nm is not None
        assert abs(seen - weight) <= joint.coulomb_nm + 1e-6
    loads = [j.sign * s.joint.load_nm for j, s in zip(two.joints, world.servos, strict=False)]
    assert loads == pytest.approx([-weight for weight in kinematics.gravity(world.q)], abs=1e-3)
    assert json.loads(world.say("status").partition(" ")[2])["servos"][0]["hand_nm"] == pytest.approx(felt[0])


def test_masses_can_be_other_than_described(two: ArmDescription) -> None:
    world = World(two, (0.1, 0.2), mass_scale=1.05)
    world.run(0.005)
    loads = [j.sign * s.joint.load_nm for j, s in zip(two.joints, world.servos, strict=False)]
    assert loads == pytest.approx([-1.05 * weight for weight in ArmKinematics(two).gravity((0.1, 0.2))], rel=1e-3)


def test_a_hand_leads_without_a_jerk_and_lets_go(two: ArmDescription) -> None:
    world = World(two)
    for servo in world.servos:
        assert world.say(f"hand {servo.id} {servo.joint.position_rad} 200 2") == "ok"
    world.run(1.0)
    begun = world.servos[0].joint.position_rad
    assert world.say(f"hand 1 {begun + 0.6} 200 2 1.0") == "ok"
    speeds: list[float] = []
    world.run(1.0, lambda: speeds.append(world.servos[0].joint.velocity_rad_s))
    # The peak speed of a minimum-jerk motion is 1.875 times the mean.
    assert max(speeds) == pytest.approx(1.875 * 0.6, rel=0.05)
    assert world.servos[0].joint.position_rad == pytest.approx(begun + 0.6, abs=0.02)
    assert world.say("hand off") == "ok"
    world.run(0.5)
    assert all(servo.joint.hand is None and servo.joint.hand_nm == 0.0 for servo in world.servos)
    assert world.servos[0].joint.position_rad < begun + 0.5
    assert world.say("hand 1 0 10 1") == "ok"
    assert world.say("hand 1 off") == "ok"
    assert world.servos[0].joint.hand is None


@pytest.mark.parametrize("stiffness", [1.0, 200.0, 1e4])
@pytest.mark.parametrize("damping", [0.1, 2.0])
def test_a_hand_that_leads_at_a_constant_speed_needs_what_friction_takes(stiffness: float, damping: float) -> None:
    """F = c + b w for any stiffness of the hand."""
    model = SERVO_MODELS["XL330-M288"]
    joint = Joint(model, JointSettings.of(model))
    speed = 0.5
    joint.hand = HeldBy(
        goal_rad=0.0, stiffness=stiffness, damping=damping, path=((0.0, 100.0), (0.0, 100.0 * speed))
    )  # fmt: skip
    joint.advance(0.0, None)
    for index in range(20_000):
        joint.advance(1e-3 * index, None)
    assert joint.velocity_rad_s == pytest.approx(speed, rel=1e-3)
    assert joint.hand_nm == pytest.approx(joint.settings.coulomb + joint.settings.viscous * speed, rel=1e-3)


@pytest.mark.parametrize("stiffness", [0.0, 1.0, 100.0, 1e4])
@pytest.mark.parametrize("damping", [0.0, 1.0, 1e4])
def test_hands_are_stable_however_stiff(stiffness: float, damping: float) -> None:
    model = SERVO_MODELS["XL330-M077"]
    joint = Joint(model, JointSettings.of(model))
    joint.hand = HeldBy(goal_rad=1.0, stiffness=stiffness, damping=damping)
    farthest = 0.0
    joint.advance(0.0, None)
    for index in range(2000):
        joint.advance(1e-3 * index, None)
        farthest = max(farthest, abs(joint.position_rad), abs(joint.velocity_rad_s) * 1e-3)
        assert np.isfinite(joint.hand_nm)
    assert farthest <= 2.0


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("hand", "the first must be the id of a servo"),
        ("hand 9 0 1 1", "id 9: must be one of 1, 2, 3"),
        ("hand 1 0 1", "must be 4 finite numbers"),
        ("hand 1 nan 1 1", "must be 4 finite numbers"),
        ("hand 1 2000 1 1", "2000: must be at most 1000 rad"),
        ("hand 1 0 -1 1", "stiffness and damping must be 0 to 10000"),
        ("hand 1 0 1 1 -2", "-2: must be 0 to 3600 s"),
    ],
)
def test_hands_that_cannot_be_are_refused(two: ArmDescription, line: str, said: str) -> None:
    world = World(two)
    answer = world.say(line)
    assert answer.startswith("error: hand: ")
    assert said in answer
    assert all(servo.joint.hand is None for servo in world.servos)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--arm", "gelo"], "gelo: No such file or directory: must be a file, or one of aloha-wx250s"),
        (["--arm", "gello-ur", "--servos", "1=XM430-W350"], "arm = gello-ur: has servos of its own"),
        (["--arm", "gello-ur", "--start", "0", "1"], "start: 2 angles: must be 6"),
        (["--arm", "gello-ur", "--start", *["nan"] * 6], "start = nan: must be at most 13 rad"),
        (["--arm", "gello-ur", "--mount-offsets", "0", "1"], "offsets: 2: must be 6, one of each joint of gello-ur"),
        (["--arm", "gello-ur", "--mount-signs", *["0"] * 6], "sign = 0: must be 1 or -1"),
        (["--mount-offsets", "0"], "mount_offsets, mount_signs: are of the joints of an arm: give --arm"),
        (["--arm", "gello-ur", "--mass-scale", "-1"], "mass_scale = -1: must be 0 to 10"),
    ],
)
def test_arms_that_cannot_be_are_refused(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dynamixel-emulator", "--duration-s", "1", *arguments]) == 2
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1


def test_a_hand_follows_a_file(two: ArmDescription, tmp_path: Path) -> None:
    world = World(two)
    begun = world.servos[0].joint.position_rad
    path = tmp_path / "hand.csv"
    # The path begins at its first row.
    path.write_text(f'"time_s","1"\n1700000000,{begun}\n1700000001,{begun + 0.4}\n')
    assert "no hand holds servo 1" in world.say(f"lead {path}")
    world.say(f"hand 1 {begun} 200 2")
    assert world.say(f"lead {path}") == "ok"
    hand = world.servos[0].joint.hand
    assert hand is not None
    assert [hand.place_rad(world.now_s + at) for at in (-1.0, 0.5, 2.0)] == pytest.approx(
        [begun, begun + 0.2, begun + 0.4]
    )
    world.run(1.5)
    assert world.servos[0].joint.position_rad == pytest.approx(begun + 0.4, abs=0.02)
    for text, said in (
        ("", "its header must be time_s and ids of servos"),
        ("time_s,9\n0,0\n", "id 9: must be one of 1, 2, 3"),
        ("time_s,1\n0,0\n0,1\n", "its times must increase"),
        ("time_s,1\n0,nan\n", "must be 2 finite numbers"),
        ("time_s,1\n0,2000\n", "its angles must be at most 1000 rad"),
    ):
        path.write_text(text)
        assert said in world.say(f"lead {path}")
