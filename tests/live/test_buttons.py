"""Buttons of a device and their actions in a scene, over sockets."""

import time

import pytest
from tests.live.sides import Arm, Hand, how, until
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import (
    LiveMaster,
    LiveSlave,
    MasterLoop,
    MasterRun,
    SlaveLoop,
    SlaveRun,
    load_scene,
    override_scene,
    scene_json,
)

pytestmark = pytest.mark.live

ENGAGE, GRIPPER = 1 << 4, 1 << 0
SPEC = scene_json(
    override_scene(
        load_scene("remote_push", ["environment.pushers=[]"]),
        ["master.buttons={engage = 4, gripper = 0}", "slave.gripper={speed = 10.0}"],
    )
)


class Buttons(Hand):
    """Device at rest, with buttons."""

    def __init__(self) -> None:
        super().__init__(buttons=0)

    def press(self, button: int, seconds: float = 0.06) -> None:
        # A contact that was open for less than 20 ms counts as a bounce.
        time.sleep(seconds)
        self.buttons = (self.buttons or 0) | button
        time.sleep(seconds)
        self.buttons &= ~button
        time.sleep(seconds)


@anew_after_stalls
def test_a_button_engages_and_another_works_the_gripper() -> None:
    hand = Buttons()
    slave = LiveSlave(SPEC, listen="127.0.0.1:0", **how())
    master = MasterRun(hand, MasterLoop(SPEC, peer=slave.address, duration_s=30.0, patience_s=10.0, **how()))
    until(lambda: master.is_answered)
    time.sleep(0.3)
    assert master.state == "disengaged", "a mapped clutch is not pressed by the start"
    master.press_clutch()
    time.sleep(0.2)
    assert master.state == "disengaged", "nor by a signal"
    hand.press(GRIPPER)
    hand.press(ENGAGE)
    until(lambda: master.state == "engaged" and slave.state == "engaged")
    # The other side falls silent: only a press couples again.
    hand.press(GRIPPER)
    hand.press(GRIPPER)
    time.sleep(0.3)
    hand.press(ENGAGE)
    until(lambda: master.state == "disengaged")
    assert slave.state == "disengaged"
    master.stop()
    near, _ = master.finish()
    slave.stop()
    far, _ = slave.finish()
    assert set(near.trigger.tolist()) == {0.0, 1.0}
    # The gripper was open and the trigger closed at the engagement: the gripper follows after the trigger has met it.
    assert far.gripper_command[-1] == pytest.approx(1.0, abs=0.05)


@anew_after_stalls
def test_a_switch_of_the_clutch_is_open_after_the_sides_have_parted() -> None:
    hand = Buttons()
    slave = LiveSlave(SPEC, listen="127.0.0.1:0", **how())
    address = slave.address
    master = MasterRun(hand, MasterLoop(SPEC, peer=address, duration_s=30.0, patience_s=10.0, **how()))
    until(lambda: master.is_answered)
    hand.press(ENGAGE)
    until(lambda: master.state == "engaged")
    slave.stop()
    slave.finish()
    until(lambda: master.state != "engaged")
    again = LiveSlave(SPEC, listen=address, **how())
    until(lambda: master.is_answered)
    time.sleep(0.5)
    assert master.state not in {"engaged", "stale", "aligning"}
    assert again.state not in {"engaged", "stale"}
    hand.press(ENGAGE)
    until(lambda: master.state == "engaged")
    for side in (master, again):
        side.stop()
        side.finish()


@anew_after_stalls
def test_a_clutch_that_is_closed_or_not_known_must_be_seen_open_first() -> None:
    """Neither a bit that is always set nor a driver that loses the buttons for a while counts as a press."""
    spec = scene_json(
        override_scene(load_scene("remote_push", ["environment.pushers=[]"]), ["master.buttons={clutch = 4}"])
    )
    hand = Buttons()
    hand.buttons = ENGAGE
    slave = LiveSlave(spec, listen="127.0.0.1:0", **how())
    master = MasterRun(hand, MasterLoop(spec, peer=slave.address, duration_s=30.0, patience_s=10.0, **how()))
    until(lambda: master.is_answered)
    time.sleep(0.5)
    assert master.state == "disengaged"
    hand.buttons = 0
    time.sleep(0.1)
    hand.buttons = ENGAGE
    until(lambda: master.state == "engaged")
    hand.buttons = None
    until(lambda: master.state == "disengaged")
    time.sleep(0.1)
    hand.buttons = ENGAGE
    time.sleep(0.5)
    assert master.state == "disengaged"
    hand.buttons = 0
    time.sleep(0.1)
    hand.buttons = ENGAGE
    until(lambda: master.state == "engaged")
    for side in (master, slave):
        side.stop()
        side.finish()


def test_a_driver_of_the_slave_sees_the_buttons() -> None:
    hand = Buttons()
    hand.buttons = 1 << 31 | 1 << 7
    loop = SlaveLoop(SPEC, listen="127.0.0.1:0", **how())
    slave = SlaveRun(Arm(), loop)
    master = LiveMaster(SPEC, peer=slave.address, duration_s=3.0, patience_s=5.0, **how())
    until(lambda: loop.buttons == 0)
    master.stop()
    master.finish()
    slave.stop()
    slave.finish()
    loop = SlaveLoop(SPEC, listen="127.0.0.1:0", **how())
    slave = SlaveRun(Arm(), loop)
    led = MasterRun(hand, MasterLoop(SPEC, peer=slave.address, duration_s=3.0, patience_s=5.0, **how()))
    until(lambda: loop.buttons == 1 << 31 | 1 << 7)
    for side in (led, slave):
        side.stop()
        side.finish()
