"""Sides of kind "pose" over sockets: against virtual time, and with drivers of both ends."""

import json
import math
import time

import numpy as np
import pytest
from tests.live.sides import how, until
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import (
    DeviceError,
    LiveMaster,
    LiveSlave,
    MasterLoop,
    MasterRun,
    Scene,
    SlaveLoop,
    SlaveRun,
    load_scene,
    override_scene,
    scene_json,
    simulate,
)
from haptether.master import MasterSample
from haptether.slave import SlaveSample

pytestmark = pytest.mark.live

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def turning() -> Scene:
    """Return a scene in which a hand turns a handle about two axes, against torques on the tool, and never lets go."""
    return override_scene(
        load_scene("torque_release", ["link={}"]),
        [
            "operator.rotation={stiffness = 3.0, damping = 0.03}",
            "operator.rotation.legs=[{duration_s = 0.6, turn = [0.0, 0.0, 0.5]}, {duration_s = 0.6, turn = [0.3, 0, 0]}]",  # noqa: E501  # one table
            "operator.legs=[{duration_s = 0.8, end = [0.02, 0.0, -0.01]}]",
            "environment.torques=[{shape = 'ramp', at_s = 0.3, rise_s = 0.4, torque_n_m = [0.0, 0.05, 0.0]}]",
            "run.duration_s=1.6",
            "record.every=1",
        ],
    )


SPEC = scene_json(turning())


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle in rad between two orientations, given as unit quaternions."""
    return 2.0 * math.acos(min(1.0, abs(float(np.dot(one, other)))))


@anew_after_stalls
def test_live_and_virtual_time_turn_alike() -> None:
    """Parity: the same turns, positions, torques and forces, at the same time since engagement."""
    slave = LiveSlave(SPEC, listen="127.0.0.1:0", **how())
    master = LiveMaster(SPEC, peer=slave.address, duration_s=1.6, patience_s=10.0, **how())
    until(lambda: master.finished, 20.0)
    near, _ = master.finish()
    slave.stop()
    far, _ = slave.finish()
    run = simulate(turning())
    assert run.reports is not None
    engaged = int(np.flatnonzero(near.state == 2)[0])
    offset_s = run.reports[0].engaged_s
    assert near.orientation is not None
    assert near.device_torque is not None
    assert far.orientation is not None
    begun_s = near.time_s[engaged]
    for time_s in (0.3, 0.6, 0.9, 1.2, 1.5):
        tick = int(np.searchsorted(near.time_s, begun_s + time_s - 5e-4))
        there = round((offset_s + time_s) * 1e3)
        # Loopback and the phase of two loops cost a few ticks, in which the hand turns at most 1.6 rad/s.
        assert angle(near.orientation[tick], run.signals.orientation[there]) < 8e-3
        np.testing.assert_allclose(near.position[tick], run.signals.position[there], atol=5e-4)
        np.testing.assert_allclose(near.device_torque[tick], run.signals.device_torque[there], atol=3e-3)
    # The slave has its own time; its last orientation is that of virtual time.
    assert angle(far.orientation[-1], run.signals.slave_orientation[-1]) < 8e-3


class Hand:
    """A device that turns about z as set by the test, and records its commanded wrenches."""

    paces = False
    kinds = ("pose",)

    def __init__(self) -> None:
        self.orientation: tuple[float, ...] | None = UPRIGHT
        self.wrenches: list[tuple[tuple[float, ...], tuple[float, ...]]] = []

    def open(self) -> None:
        pass

    def read(self) -> MasterSample:
        still = (0.0, 0.0, 0.0)
        return MasterSample(still, still, orientation=self.orientation, angular_velocity=still)

    def write(self, force: tuple[float, ...], torque: tuple[float, ...] | None = None) -> None:
        assert torque is not None
        self.wrenches.append((force, torque))

    def close(self) -> None:
        pass


class Arm:
    """An arm in its commanded pose, which measures a torque."""

    paces = False
    kinds = ("linear", "pose")

    def __init__(self, torque: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.position: tuple[float, ...] = (0.4, 0.1, 0.3)
        self.orientation: tuple[float, ...] = (0.0, 1.0, 0.0, 0.0)
        self.torque = torque
        self.stops = 0

    def open(self) -> None:
        pass

    def read(self) -> SlaveSample:
        still = (0.0, 0.0, 0.0)
        return SlaveSample(self.position, still, still, None, self.orientation, still, self.torque)

    def write(
        self,
        position: tuple[float, ...],
        velocity: tuple[float, ...],
        orientation: tuple[float, ...] | None = None,
        angular_velocity: tuple[float, ...] | None = None,
    ) -> None:
        assert orientation is not None
        assert angular_velocity is not None
        assert len(velocity) == len(angular_velocity) == 3
        self.position, self.orientation = position, orientation

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        pass


def about_z(turned: float) -> tuple[float, ...]:
    return (math.cos(turned / 2), 0.0, 0.0, math.sin(turned / 2))


@anew_after_stalls
def test_drivers_of_both_ends_turn_together() -> None:
    """`R_s = R_m R_m0' R_s0`: half a turn apart about x, the arm turns about z of the base like the hand."""
    hand, arm = Hand(), Arm((0.0, 0.0, 0.05))
    slave = SlaveRun(arm, SlaveLoop(SPEC, listen="127.0.0.1:0", **how()))
    master = MasterRun(hand, MasterLoop(SPEC, peer=slave.address, duration_s=20.0, patience_s=10.0, **how()))
    until(lambda: master.state == "engaged" and slave.state == "engaged")
    for step in range(1, 101):
        # Rounded to 32 bits.
        hand.orientation = tuple(float(np.float32(part)) for part in about_z(0.004 * step))
        time.sleep(2e-3)
    until(lambda: angle(np.array(arm.orientation), np.array((0.0, math.cos(0.2), math.sin(0.2), 0.0))) < 1e-5)
    # The torque fades in over 0.2 s.
    until(lambda: abs(hand.wrenches[-1][1][2] - 0.05) < 1e-3)
    # An invalid orientation gives a zero wrench in that tick, and a fault.
    before = len(hand.wrenches)
    hand.orientation = (1.0, 0.1, 0.0, 0.0)
    until(lambda: master.state == "fault")
    assert all(wrench == ((0.0,) * 3, (0.0,) * 3) for wrench in hand.wrenches[before + 2 :])
    until(lambda: slave.state in {"hold", "stop"})
    master.stop()
    near, _ = master.finish()
    slave.stop()
    far, _ = slave.finish()
    assert near.fault[-1] == 17, "an orientation that is no unit quaternion"
    assert far.command_orientation is not None
    assert hand.wrenches[-1] == ((0.0,) * 3, (0.0,) * 3)


def about_x(turned: float) -> tuple[float, ...]:
    return (math.cos(turned / 2), math.sin(turned / 2), 0.0, 0.0)


def aligning(turned: float) -> tuple[Hand, Arm, MasterRun, SlaveRun]:
    """Return a pair whose arm is turned from its hand: alignment at 1 rad/s up to 1 rad; the master's start presses."""
    spec = scene_json(override_scene(turning(), ["coupling.alignment={speed = 1.0, max_angle = 1.0}"]))
    hand, arm = Hand(), Arm((0.0, 0.0, 0.05))
    arm.orientation = about_x(turned)
    slave = SlaveRun(arm, SlaveLoop(spec, listen="127.0.0.1:0", **how()))
    master = MasterRun(hand, MasterLoop(spec, peer=slave.address, duration_s=20.0, patience_s=10.0, **how()))
    return hand, arm, master, slave


@anew_after_stalls
def test_a_driven_arm_is_turned_to_the_hand_before_the_two_engage() -> None:
    hand, arm, master, slave = aligning(0.8)
    until(lambda: master.state == "engaged" and slave.state == "engaged")
    assert angle(np.array(arm.orientation), np.array(UPRIGHT)) < 1e-6
    # The torque fades in over 0.2 s.
    until(lambda: abs(hand.wrenches[-1][1][2] - 0.05) < 1e-3)
    master.stop()
    near, _ = master.finish()
    slave.stop()
    far, _ = slave.finish()
    assert far.command_orientation is not None
    assert near.device_torque is not None
    turned = np.flatnonzero(far.state == 1)
    assert far.time_s[turned[-1]] - far.time_s[turned[0]] == pytest.approx(0.8, abs=0.15)
    sines = np.linalg.norm(far.command_orientation[turned, 1:], axis=1)
    steps = -np.diff(2.0 * np.arcsin(sines))
    assert steps.min() > -1e-6
    # A late tick makes up for at most one missed tick.
    assert steps.max() < 2.0 * 1e-3 * 1.01
    before = near.state != 2
    before[np.argmax(near.state == 2) :] = False
    assert before.sum() > 700
    assert not near.device_torque[before].any()
    assert not near.device_force[before].any()


def test_a_driven_arm_that_is_turned_too_far_from_the_hand_is_not_moved_and_both_sides_say_so() -> None:
    hand, arm, master, slave = aligning(1.2)
    until(lambda: master.cause() is not None and slave.cause() is not None)
    for side in (master, slave):
        cause = json.loads(side.cause() or "")
        assert cause["at"] == "slave"
        assert "larger than the slave may turn to align" in cause["text"]
        assert [(step["at"], step["remedy"]) for step in cause["steps"]] == [("master", "turn"), ("master", "press")]
    assert (master.state, slave.state) == ("aligning", "disengaged")
    master.stop()
    master.finish()
    slave.stop()
    slave.finish()
    assert arm.orientation == about_x(1.2)
    assert arm.position == (0.4, 0.1, 0.3)
    assert set(hand.wrenches) == {((0.0,) * 3, (0.0,) * 3)}


@pytest.mark.parametrize("end", ["master", "slave"])
def test_a_driver_of_points_is_refused_in_a_scene_of_poses(end: str) -> None:
    hand, arm = Hand(), Arm()
    (hand if end == "master" else arm).kinds = ("linear", "joints")
    slave = SlaveRun(arm, SlaveLoop(SPEC, listen="127.0.0.1:0", **how()))
    master = MasterRun(hand, MasterLoop(SPEC, peer=slave.address, duration_s=5.0, patience_s=5.0, **how()))
    refused = master if end == "master" else slave
    until(lambda: refused.finished)
    assert isinstance(refused.error, DeviceError)
    assert 'a driver of linear or joints: must be of "pose"' in str(refused.error)
    for run in (master, slave):
        run.stop()
        run.finish()
    assert not hand.wrenches or set(hand.wrenches) == {((0.0,) * 3, (0.0,) * 3)}


def test_a_sample_without_an_orientation_ends_the_run() -> None:
    hand = Hand()
    hand.orientation = None
    master = MasterRun(hand, MasterLoop(SPEC, peer="127.0.0.1:9", duration_s=5.0, patience_s=5.0, **how()))
    until(lambda: master.finished)
    assert isinstance(master.error, DeviceError)
    assert 'orientation is missing: a driver in a scene of kind "pose"' in str(master.error)
    master.finish()


def test_sides_of_another_kind_do_not_engage() -> None:
    """Both kinds have the same number of axes, but different coordinates."""
    points = override_scene(
        load_scene("three_axis_box", ["link={}"]), ["run.period_s=0.001", "run.duration_s=1.0", "master.kind='joints'"]
    )
    other = override_scene(points, ["master.kind='linear'"])
    slave = LiveSlave(scene_json(points), listen="127.0.0.1:0", **how())
    master = LiveMaster(scene_json(other), peer=slave.address, duration_s=0.5, patience_s=1.0, **how())
    until(lambda: master.finished, 10.0)
    near, report = master.finish()
    slave.stop()
    slave.finish()
    assert not np.isin(near.state, (2, 3)).any()
    assert report.link.refused > 0 or report.link.fresh == 0
