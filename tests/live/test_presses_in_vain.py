"""Presses of the clutch without effect, and their reports."""

import io
import os
import secrets
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
from tests.live.sides import Hand

from haptether.bridge import LiveMaster, LiveSlave, MasterLoop, MasterRun, load_scene, scene_json
from haptether.cli.live.run import FlightFile, SideWatch
from haptether.cli.live.sides import started_s
from haptether.cli.shared.stop import Stopped

pytestmark = pytest.mark.live

SCENE = scene_json(load_scene("remote_push", ["environment.pushers=[]", "link.forward={}", "link.backward={}"]))
OLD_S = 5.5
"""Age in s of a start beyond the 5 s for which it counts as a press, docs/ladder.md."""


def how(**others: object) -> dict[str, Any]:
    return {"run_id": secrets.randbits(64), "insecure": True, "realtime": "off", **others}


def until(done: Callable[[], bool], seconds: float = 10.0) -> bool:
    end_s = time.monotonic() + seconds
    while not done() and time.monotonic() < end_s:
        time.sleep(0.01)
    return done()


def run_of(pressed: bool | None, slave: LiveSlave, **others: object) -> MasterRun:
    return MasterRun(Hand(clutch=pressed), MasterLoop(SCENE, peer=slave.address, **how(**others)))


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
            # Press repeatedly, because the loop may be late at a press.
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


def test_a_command_that_stood_still_while_it_loaded_ends_at_once_and_says_why() -> None:
    slave = LiveSlave(SCENE, listen="127.0.0.1:0", **how())
    master = subprocess.Popen(
        [sys.executable, "-m", "haptether", "master", "--insecure", "--peer", slave.address, "--depth", "0",
         "--patience-s", "60"],
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        # The process has begun, and still loads.
        time.sleep(0.1)
        master.send_signal(signal.SIGSTOP)
        time.sleep(OLD_S)
        master.send_signal(signal.SIGCONT)
        _, said = master.communicate(timeout=30.0)
        assert master.returncode == 1
        assert "haptether: the start was more than 5 s ago when the loop began" in said
        assert "start it again" in said
        slave.poll()
        assert slave.state == "disengaged"
    finally:
        master.kill()
        master.communicate()
        slave.finish()


ELSEWHERE = "elsewhere"
"""Stands for a press by a signal or at the console, instead of typed text."""


class Typing(io.StringIO):
    """Standard error that types on the terminal when a question appears, or presses the clutch elsewhere."""

    def __init__(self, terminal: int, press: Callable[[], None], *typed: str) -> None:
        super().__init__()
        self._terminal = terminal
        self._press = press
        self._typed = list(typed)

    def write(self, text: str) -> int:
        if "Type yes" in text and self._typed:
            typed = self._typed.pop(0)
            if typed == ELSEWHERE:
                self._press()
            else:
                os.write(self._terminal, typed.encode())
        return super().write(text)


def asked(
    monkeypatch: pytest.MonkeyPatch, *typed: str, before: str = "", starts_by_press: bool = True
) -> tuple[SideWatch, bool, str]:
    """Run a master with an old start and a typing person; return its watch, true if it engaged, and the output."""
    slave = LiveSlave(SCENE, listen="127.0.0.1:0", **how())
    scene = scene_json(load_scene("remote_push", ["environment.pushers=[]", "operator.clutch=once"]))
    patience_s = 8.0 if starts_by_press else 2.0
    master = LiveMaster(
        scene, peer=slave.address, started_s=time.monotonic() - OLD_S, patience_s=patience_s, duration_s=0.2, **how()
    )
    terminal, side = os.openpty()
    said = Typing(terminal, master.press_clutch, *typed)
    with open(side, closefd=False) as stdin, Stopped() as stopped:
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(sys, "stderr", said)
        os.write(terminal, before.encode())
        try:
            until(lambda: master.is_answered)
            press = master.press_clutch if starts_by_press else None
            stopped.attached(master)
            watch = SideWatch("master", master, stopped, FlightFile(None), insecure=True, press=press)
            begun_s = time.monotonic()
            watch.until_end("master", None, quiet=True)
            assert time.monotonic() - begun_s < 20.0
        finally:
            trace, report = master.finish()
            slave.finish()
            os.close(terminal)
            os.close(side)
    assert len(trace) > 0
    return watch, report.engaged_s < 1e3, said.getvalue()


@pytest.mark.parametrize(
    ("typed", "before", "engages"),
    [
        (("yes\n",), "", True),
        ((ELSEWHERE,), "", True),
        (("no\n",), "", False),
        (("\n",), "", False),
        # An answer typed before the question does not count.
        (("\n",), "yes\n", False),
    ],
)
def test_a_person_at_the_terminal_is_asked_and_presses(
    typed: tuple[str, ...], before: str, engages: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch, engaged, said = asked(monkeypatch, *typed, before=before)
    assert "more than 5 s ago" in said
    assert (engaged, watch.has_void_start) == (engages, not engages)


def test_an_answer_of_uncertain_time_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = ["yes\n", "no\n"]
    stood_still = False

    def late(readers: list[int], *_: object) -> tuple[list[int], list[int], list[int]]:
        # The process stands still between the question and the check of the answer.
        nonlocal stood_still
        if not stood_still:
            stood_still = True
            time.sleep(0.7)
        return real(readers, [], [], 0.0)

    real = select.select
    monkeypatch.setattr(select, "select", late)
    watch, engaged, said = asked(monkeypatch, *answers)
    assert "stood still while this was typed" in said
    assert (engaged, watch.has_void_start) == (False, True)


def test_a_start_that_is_to_press_nothing_is_not_said_to_be_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    watch, engaged, said = asked(monkeypatch, starts_by_press=False)
    assert (engaged, watch.has_void_start) == (False, False)
    assert "for nothing" not in said
    assert "Type yes" not in said


def test_the_start_of_a_process_is_its_own_and_not_of_its_loading() -> None:
    assert started_s() is None, "in somebody else's process"
    program = """
import time
time.sleep(1.0)
from haptether.cli.interrupts import INTERRUPTS
from haptether.cli.live.run import FlightFile, SideWatch
from haptether.cli.live.sides import started_s
from haptether.cli.shared.stop import Stopped
INTERRUPTS.begun = True
print(time.monotonic() - started_s())
"""
    begun_s = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    # The system reports process times in ticks of 10 ms.
    assert 1.0 <= float(ended.stdout) <= time.monotonic() - begun_s + 0.02
