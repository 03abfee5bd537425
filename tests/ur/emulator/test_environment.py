"""Environment of the emulated arm's tool: the contact of a simulation, placed around the tool."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from haptether.bridge import load_scene, scene_json
from haptether.slave import ForceSensor, SceneTouch
from haptether.slave.ur_emulator import ToolEnvironment

REST = (0.0, 0.0, 0.0)


def touch(name: str, *overrides: str) -> SceneTouch:
    return SceneTouch(scene_json(load_scene(name, overrides)))


def test_a_box_pushes_back_along_its_nearest_face() -> None:
    box = touch("three_axis_box")
    assert (box.axes, box.start) == (3, [0.02, -0.02, 0.0])
    assert box.force(0.0, (0.01, 0.0, 0.0), REST) == (0.0, 0.0, 0.0)
    assert not box.touches
    # 150 N/m, 1 N s/m, and friction of 0.1 of the normal force; the slip is above 1 mm/s.
    x, y, z = box.force(0.0, (-0.01, 0.0, 0.0), (-0.2, 0.3, 0.0))
    assert x == pytest.approx(150.0 * 0.01 + 1.0 * 0.2)
    assert (y, z) == pytest.approx((-0.1 * x, 0.0))
    assert box.touches


def test_a_scene_of_one_axis_acts_along_x() -> None:
    wall = touch("paper_wall")
    assert wall.axes == 1
    assert wall.force(0.0, (-0.01, 5.0, 7.0), REST) == pytest.approx((2.0, 0.0, 0.0))


def test_pushers_wait_to_be_started() -> None:
    pushed = touch("remote_push")
    free = (0.5, 0.0, 0.0)
    assert pushed.force(3.0, free, REST) == (0.0, 0.0, 0.0)
    pushed.start_pushers(1.0)
    # 3.5 N from 1.6 s on, rising in 0.5 s, for 2 s.
    for t, force in [(2.5, 0.0), (2.85, 1.75), (3.5, 3.5), (4.7, 0.0)]:
        assert pushed.force(t, free, REST)[0] == pytest.approx(force, abs=1e-9)
    pushed.reset()
    assert pushed.force(3.5, free, REST) == (0.0, 0.0, 0.0)


def test_a_wall_moves_with_the_time_of_the_scene() -> None:
    wall = touch("moving_wall")
    place = (0.01, 0.0, 0.0)
    # 0.05 m/s from 0.5 s to 1.3 s.
    for t, depth in [(0.0, -0.01), (0.9, 0.01), (2.0, 0.03)]:
        assert wall.force(t, place, REST)[0] == pytest.approx(300.0 * max(0.0, depth) + (0.05 if t == 0.9 else 0.0))


def test_a_block_that_is_pushed_takes_the_momentum() -> None:
    block = touch(
        "sliding_mass", "environment.objects.0.body.viscous=0", "environment.objects.0.body.coulomb=0",
        "environment.objects.0.contact.damping=0",
    )  # fmt: skip
    momentum, x, v, h = 0.0, 0.001, -0.1, 0.0005
    for step in range(2000):
        force = block.force(step * h, (x, 0.0, 0.0), (v, 0.0, 0.0))[0]
        momentum += force * h
        block.advance(step * h, h, (x, 0.0, 0.0), (v, 0.0, 0.0))
        x += v * h
    # A tool at constant speed is a moving wall: the block bounces off elastically at twice its speed.
    assert momentum == pytest.approx(0.5 * 2 * 0.1, rel=0.02)
    block.reset()
    assert block.force(0.0, (-0.001, 0.0, 0.0), REST)[0] == pytest.approx(0.2)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused_at_the_boundary(bad: float) -> None:
    box = touch("three_axis_box")
    for call in (
        lambda: box.force(bad, REST, REST),
        lambda: box.force(0.0, (bad, 0.0, 0.0), REST),
        lambda: box.force(0.0, REST, (0.0, bad, 0.0)),
        lambda: box.advance(0.0, bad, REST, REST),
        lambda: box.start_pushers(bad),
        lambda: ForceSensor().sample((0.0, bad, 0.0), 0),
        lambda: ForceSensor(noise_n=bad),
        lambda: ForceSensor(bias_n=(bad, 0.0, 0.0)),
    ):
        with pytest.raises(ValueError, match="must be"):
            call()


def test_scenes_that_do_not_lie_around_a_tool() -> None:
    with pytest.raises(ValueError, match="must be 1, 2 or 3"):
        touch("free_motion", "master.axes=6")
    with pytest.raises(ValueError, match="scene"):
        SceneTouch(b"{}")


def test_noise_has_its_deviation_and_depends_on_seed_and_index_alone() -> None:
    sensor, other = ForceSensor(noise_n=2.0, bias_n=(1.0, 0.0, -1.0), seed=3), ForceSensor(noise_n=2.0, seed=4)
    samples = np.array([sensor.sample((10.0, 0.0, 0.0), index) for index in range(20_000)])
    # The mean of 20 000 samples has a deviation of 0.014 N, the deviation one of 0.01 N; the tolerance is five of
    # these.
    assert samples.mean(axis=0) == pytest.approx((11.0, 0.0, -1.0), abs=0.07)
    assert samples.std(axis=0) == pytest.approx((2.0,) * 3, abs=0.05)
    assert sensor.sample((10.0, 0.0, 0.0), 7) == tuple(samples[7])
    assert other.sample((10.0, 0.0, 0.0), 7) != tuple(samples[7])
    assert ForceSensor(quantum_n=0.5).sample((0.3, -0.8, 0.0), 0) == (0.5, -1.0, 0.0)


# ---------------------------------------------------------------------------------------------------- around the tool


def test_the_scene_lies_where_the_tool_was_first() -> None:
    around = ToolEnvironment(touch("paper_wall"))
    tool = (-0.2, -0.4, 0.3)
    assert around.force(0.0, tool, REST) == (0.0, 0.0, 0.0)
    # The scene's device starts 5 mm before the wall of 200 N/m.
    assert around.force(0.1, (-0.215, 0.1, 0.2), REST) == pytest.approx((2.0, 0.0, 0.0))
    around.anchor((-0.215, 0.0, 0.0))
    assert around.force(0.2, (-0.215, 0.1, 0.2), REST) == (0.0, 0.0, 0.0)


def test_time_stands_still_until_it_is_engaged() -> None:
    around = ToolEnvironment(touch("remote_push"))
    free = (0.0, 0.0, 0.0)
    assert around.force(50.0, free, REST) == (0.0, 0.0, 0.0)
    assert not around.engaged
    around.engage()
    assert around.engaged
    assert around.force(50.0 + 1.85, free, REST)[0] == pytest.approx(1.75)
    around.engage()
    assert around.force(50.0 + 2.5, free, REST)[0] == pytest.approx(3.5)
    around.reset()
    assert around.force(60.0, free, REST) == (0.0, 0.0, 0.0)
    assert not around.engaged


def test_pushes_add_to_the_scene_and_end() -> None:
    around = ToolEnvironment(touch("paper_wall"))
    around.force(1.0, REST, REST)
    around.push((1.0, 2.0, 3.0), 0.5)
    assert around.force(1.4, (-0.015, 0.0, 0.0), REST) == pytest.approx((3.0, 2.0, 3.0))
    assert around.force(1.5, (-0.015, 0.0, 0.0), REST) == pytest.approx((2.0, 0.0, 0.0))


def test_a_clamp_turns_the_tool_back_until_it_ends() -> None:
    around = ToolEnvironment()
    begin = Rotation.from_rotvec((0.3, -2.0, 0.5))
    assert around.moment(begin.as_matrix(), REST) == (0.0, 0.0, 0.0)
    around.clamp(20.0, 2.0)
    assert around.moment(begin.as_matrix(), REST) == pytest.approx(REST, abs=1e-12)
    turned = (Rotation.from_rotvec((0.0, 0.1, -0.2)) * begin).as_matrix()
    # -20 N m/rad times the turn, and -2 N m s/rad times the rate, both in the base frame.
    assert around.moment(turned, (1.0, 0.0, 0.0)) == pytest.approx((-2.0, -2.0, 4.0))
    # It holds another orientation from then on, and none after a reset.
    around.clamp(20.0)
    assert around.moment(turned, (1.0, 0.0, 0.0)) == pytest.approx(REST, abs=1e-12)
    around.reset()
    assert around.moment(begin.as_matrix(), REST) == (0.0, 0.0, 0.0)
