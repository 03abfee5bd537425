"""Presses of the clutch that do nothing, and what is said of them."""

import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from haptether.bridge import LiveMaster, LiveSlave, MasterLoop, MasterRun, load_scene, scene_json
from haptether.cli.live.sides import started_s
from haptether.master import MasterSample

pytestmark = pytest.mark.live

SCENE = scene_json(load_scene("remote_push", ["environment.pushers=[]", "link.forward={}", "link.backward={}"]))
OLD_S = 5.5
"""Beyond the 5 s for which a start is a press, docs/ladder.md."""


def how(**others: object) -> dict[str, Any]:
    return {"run_id": secrets.randbits(64), "insecure": True, "realtime": "off", **others}


def until(done: Callable[[], bool], seconds: float = 10.0) -> bool:
    end_s = time.monotonic() + seconds
    while not done() and time.monotonic() < end_s:
        time.sleep(0.01)
    return done()


class Button:
    """A device that rests, with a button or without."""

    paces = False

    def __init__(self, pressed: bool | None) -> None:
        self.pressed = pressed

    def open(self) -> None:
        pass

    def read(self) -> MasterSample:
        return MasterSample([0.02], clutch=self.pressed)

    def write(self, force: tuple[float, ...]) -> None:
        pass

    def close(self) -> None:
        pass


def run_of(pressed: bool | None, slave: LiveSlave, **others: object) -> MasterRun:
    return MasterRun(Button(pressed), MasterLoop(SCENE, peer=slave.address, **how(**others)))


@pytest.mark.parametrize("pressed", [None, True])
def test_a_start_of_long_ago_couples_nobody_and_is_said(pressed: bool | None) -> None:
    slave = LiveSlave(SCENE, listen="127.0.0.1:0", **how())
    master = run_of(pressed, slave, started_s=time.monotonic() - OLD_S)
    try:
        assert until(lambda: master.is_answered)
        time.sleep(1.0)
        assert (master.state, slave.state) == ("disengaged", "disengaged")
        count, why = master.ineffective_presses
        assert count == 1
        assert why is not None
        assert "more than 5 s ago" in why
        if pressed is None:
            # Anew, should the loop have been late just then.
            def coupled() -> bool:
                master.press_clutch()
                return until(lambda: master.state == "engaged", 1.0)

            assert until(coupled)
        else:
            master.press_clutch()
            assert until(lambda: master.ineffective_presses[0] == 2)
            why = master.ineffective_presses[1]
            assert why is not None
            assert "button" in why or "late" in why
            assert master.state == "disengaged"
    finally:
        master.finish()
        slave.finish()


@pytest.mark.parametrize("age_s", [0.0, 1.0])
def test_a_start_of_a_moment_ago_is_a_press(age_s: float) -> None:
    slave = LiveSlave(SCENE, listen="127.0.0.1:0", **how())
    master = run_of(None, slave, started_s=time.monotonic() - age_s)
    try:
        assert until(lambda: master.state == "engaged")
        assert master.ineffective_presses == (0, None)
    finally:
        master.finish()
        slave.finish()


def test_a_simulated_person_of_a_start_long_ago_presses_nothing_either() -> None:
    slave = LiveSlave(SCENE, listen="127.0.0.1:0", **how())
    scene = scene_json(load_scene("remote_push", ["environment.pushers=[]", "operator.clutch=once"]))
    master = LiveMaster(scene, peer=slave.address, started_s=time.monotonic() - OLD_S, **how())
    try:
        assert until(lambda: master.is_answered)
        time.sleep(0.5)
        assert master.state == "disengaged"
        assert master.ineffective_presses[0] == 1
    finally:
        master.finish()
        slave.finish()


@pytest.mark.parametrize("started", [-1.0, float("nan"), float("inf")])
def test_a_start_that_cannot_be_is_refused(started: float) -> None:
    with pytest.raises(ValueError, match="started_s = "):
        LiveMaster(SCENE, peer="127.0.0.1:9", started_s=started, **how())


@pytest.mark.parametrize("side", [LiveMaster, MasterLoop])
def test_a_start_that_is_still_to_come_is_refused(side: type[LiveMaster | MasterLoop]) -> None:
    with pytest.raises(ValueError, match=r"started_s = .*must not be after now, \d+\.\d{3} s by time\.monotonic"):
        side(SCENE, peer="127.0.0.1:9", started_s=time.monotonic() + 1.0, **how())


def test_a_command_that_stood_still_while_it_loaded_couples_nobody() -> None:
    slave = LiveSlave(SCENE, listen="127.0.0.1:0", **how())
    master = subprocess.Popen(
        [sys.executable, "-m", "haptether", "master", "--insecure", "--peer", slave.address, "--depth", "0"],
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        # It has begun, and loads.
        time.sleep(0.1)
        master.send_signal(signal.SIGSTOP)
        time.sleep(OLD_S)
        master.send_signal(signal.SIGCONT)
        states = set()

        def answered() -> bool:
            slave.poll()
            states.add(slave.state)
            return slave.is_answered

        assert until(answered, 20.0)
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            answered()
            time.sleep(0.01)
        assert states == {"disengaged"}
        master.send_signal(signal.SIGINT)
        _, said = master.communicate(timeout=20.0)
        assert "the clutch was pressed for nothing: the start was more than 5 s ago" in said
        assert f"press anew by its button or kill -USR1 {master.pid}" in said
    finally:
        master.kill()
        master.communicate()
        slave.finish()


def test_the_start_of_a_process_is_its_own_and_not_of_its_loading() -> None:
    assert started_s() is None, "in somebody else's process"
    program = """
import time
time.sleep(1.0)
from haptether.cli.interrupts import INTERRUPTS
from haptether.cli.live.sides import started_s
INTERRUPTS.begun = True
print(time.monotonic() - started_s())
"""
    begun_s = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    # What the system tells of a process is in ticks of 10 ms.
    assert 1.0 <= float(ended.stdout) <= time.monotonic() - begun_s + 0.02
