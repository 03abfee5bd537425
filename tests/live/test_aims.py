"""Aims and pushes of a person at the control sockets of two live models."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.live.control_client import Control
from tests.live.test_control import hold, wait_for
from tests.scene.aimed import HAND, aim, aimed
from tests.scene.two_sides import two_sides

from haptether.bridge import LiveMaster, LiveSlave, Scene, override_scene, scene_json, simulate

pytestmark = pytest.mark.live

EXPIRES = 400
"""Ticks after the last aim at which the hand opens."""
PLAIN = ["safety.controllers=[]"]


class Sides:
    """Two sides of a scene, neither pressed, each with a control socket."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        json = scene_json(scene)
        self.paths = [folder / "master", folder / "slave"]
        self.slave = LiveSlave(json, listen="127.0.0.1:0", run_id=2, insecure=True, control=self.paths[1])
        old_s = time.monotonic() - 10.0
        self.master = LiveMaster(
            json, peer=self.slave.address, run_id=1, insecure=True, started_s=old_s, control=self.paths[0]
        )
        wait_for(lambda: self.master.is_answered)

    def traces(self) -> list[Any]:
        return [side.finish()[0] for side in (self.master, self.slave)]

    def end(self) -> None:
        for side in (self.master, self.slave):
            if not side.finished:
                side.finish()


@pytest.fixture
def sides(tmp_path: Path) -> Iterator[Sides]:
    found = Sides(override_scene(aimed(), PLAIN), tmp_path)
    yield found
    found.end()


def aims(control: Control, target: float, over_s: float = 0.1, **hand: float) -> dict[str, Any]:
    return control.set("aim", target=[target], over_s=over_s, **{**HAND, **hand})


def test_an_aim_moves_the_hand_and_couples_nothing(sides: Sides) -> None:
    with Control(sides.paths[0]) as control:
        for _ in range(5):
            answer = aims(control, -0.02)
            assert answer["done"], answer
            time.sleep(0.1)
        last = answer["ticks"]
        time.sleep(0.6)
        assert sides.master.state == "disengaged"
        assert sides.master.ineffective_presses[0] == 1, "that of the old start"
    trace, _ = sides.traces()
    tick = np.rint(trace.time_s * 1e3).astype(int)
    assert trace.position.min() == pytest.approx(-0.02, abs=2e-3)
    pulls = trace.hand_force != 0.0
    # The loop may have taken the aim one tick after the answered one.
    opened = tick[pulls].max() + 1
    assert last + EXPIRES <= opened <= last + EXPIRES + 2
    assert not trace.clutch.any()
    assert set(trace.state) == {0}


def test_a_connection_that_closes_opens_the_hand(sides: Sides) -> None:
    with Control(sides.paths[0]) as control:
        for _ in range(3):
            last = aims(control, -0.02)["ticks"]
            time.sleep(0.1)
    time.sleep(0.5)
    trace, _ = sides.traces()
    pulls = trace.hand_force != 0.0
    opened = np.rint(trace.time_s[pulls].max() * 1e3) + 1
    assert last < opened < last + EXPIRES - 100


def test_one_connection_aims_at_a_time(sides: Sides) -> None:
    with Control(sides.paths[0]) as first, Control(sides.paths[0]) as second:
        assert aims(first, 0.0)["done"]
        refused = aims(second, 0.01)
        assert (refused["done"], "another page or program aims" in refused["text"]) == (False, True)
        assert aims(first, 0.0)["done"]
        time.sleep(0.5)
        assert aims(second, 0.01)["done"]
        assert not aims(first, 0.0)["done"]


def test_an_aim_carries_a_fresh_token(sides: Sides) -> None:
    with Control(sides.paths[0]) as control:
        token = control.ask("status")["token"]
        hand = {"target": [0.0], **HAND}
        for late in (token - 1_000_000, token + 60_000_000, 0):
            answer = control.ask("aim", token=late, **hand)
            assert (answer["done"], "came too late" in answer["text"]) == (False, True)
        for _ in range(8):
            # Each answer has the token of the next aim.
            answer = control.ask("aim", token=token, **hand)
            assert answer["done"], answer
            token = answer["token"]
            time.sleep(0.1)
        time.sleep(0.5)
        assert not control.ask("aim", token=token, **hand)["done"]


def test_invalid_aims_and_pushes_are_refused(sides: Sides) -> None:
    with Control(sides.paths[0]) as master, Control(sides.paths[1]) as slave:
        aimed_at = {"target": [0.0], **HAND}
        for at, do, given, said in (
            (master, "aim", {**aimed_at, "target": [0.0, 0.0]}, "target: 2 values, must be 1, one per axis"),
            (master, "aim", {**aimed_at, "target": []}, "target: 0 values, must be 1"),
            (master, "aim", {**aimed_at, "target": [2.1]}, "|target| = 2.1: must be at most 2 m"),
            (master, "aim", {**aimed_at, "over_s": 0.5}, "over_s = 0.5: must be 0.001 to 0.4 s"),
            (master, "aim", {**aimed_at, "stiffness": 2001.0}, "stiffness = 2001: must be 0 to 2000 N/m"),
            (master, "aim", {**aimed_at, "damping": -1.0}, "damping = -1: must be 0 to 50 N s/m"),
            (master, "aim", {**aimed_at, "strength_n": 51.0}, "strength_n = 51: must be 0 to 50 N"),
            (master, "push", {"force": [1.0], "duration_s": 0.1}, "the tool is at the slave"),
            (slave, "aim", aimed_at, "the hand is at the master"),
            (slave, "push", {"force": [1.0], "duration_s": 0.1}, "the sides are not engaged"),
        ):
            answer = at.set(do, **given)
            assert (answer["done"], said in answer["text"]) == (False, True), answer
    trace, _ = sides.traces()
    assert not trace.hand_force.any()


@pytest.mark.parametrize("rows", [None, [aim(0.0, 0.0)]], ids=["legs", "a file of aims"])
def test_a_side_that_is_not_aimed_refuses(rows: list[dict[str, Any]] | None, tmp_path: Path) -> None:
    scene = override_scene(two_sides(), ["operator.clutch=once"]) if rows is None else aimed(*rows)
    sides = Sides(scene, tmp_path)
    try:
        with Control(sides.paths[0]) as master, Control(sides.paths[1]) as slave:
            assert hold(master)["pressed"]
            wait_for(lambda: sides.slave.state == "engaged")
            for answer in (aims(master, 0.0), slave.set("push", force=[1.0], duration_s=0.1)):
                assert (answer["done"], "no aimed hand" in answer["text"]) == (False, True)
    finally:
        sides.end()


def test_times_of_the_clutch_press_for_no_person(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="without a person"):
        Sides(aimed(clutch=[[0.0, 1.0]]), tmp_path)


def test_a_grip_that_opens_throws_the_device_as_in_virtual_time(sides: Sides) -> None:
    """Hold, press the wall by aims, let go; then the same aims in virtual time."""
    rows: list[dict[str, Any]] = []
    with Control(sides.paths[0]) as control, Control(sides.paths[0]) as person:

        def give(target: float, over_s: float = 0.1, **hand: float) -> None:
            answer = aims(control, target, over_s, **hand)
            assert answer["done"], answer
            rows.append(aim(answer["ticks"] * 1e-3, target, over_s, **hand))

        token: dict[str, int] = {}
        begun_s = time.monotonic()
        while True:
            give(0.02)
            held_ms = round((time.monotonic() - begun_s) * 1e3)
            answer = person.ask("hold", held_ms=held_ms, **token)
            assert answer["done"], answer
            if answer["pressed"]:
                break
            token = {"token": answer["token"]}
            time.sleep(0.1)
        wait_for(lambda: sides.master.state == "engaged")
        for target in (*np.linspace(0.02, -0.045, 8), *[-0.045] * 5):
            give(float(target))
            time.sleep(0.1)
        give(-0.045, strength_n=0.0)
        time.sleep(0.5)
        assert sides.master.state == "engaged"
    trace, _ = sides.traces()
    press_s = float(trace.time_s[np.flatnonzero(trace.clutch)[0]])
    scene = aimed(*rows, clutch=[[press_s, 1e5]])
    run = simulate(scene, overrides=[*PLAIN, f"run.duration_s={trace.time_s[-1]}"])
    open_s = rows[-1]["at_s"]
    live = trace.velocity[trace.time_s > open_s].max()
    virtual = run.signals.velocity[run.signals.time_s > open_s].max()
    assert virtual > 0.2
    assert live == pytest.approx(virtual, rel=0.05)


def test_a_push_acts_on_the_tool(sides: Sides) -> None:
    with Control(sides.paths[0]) as master, Control(sides.paths[1]) as slave:
        assert hold(master)["pressed"]
        wait_for(lambda: sides.slave.state == "engaged")
        for force, duration_s, said in (
            ([31.0], 0.1, "|force| = 31: must be at most 30 N"),
            ([1.0], 2.1, "duration_s = 2.1: must be 0.01 to 2 s"),
            ([1.0, 1.0], 0.1, "force: 2 values, must be 1"),
        ):
            answer = slave.set("push", force=force, duration_s=duration_s)
            assert (answer["done"], said in answer["text"]) == (False, True), answer
        answer = slave.set("push", force=[3.5], duration_s=0.2)
        assert answer["done"], answer
        time.sleep(0.4)
    _, trace = sides.traces()
    pushed = np.abs(trace.environment_force - 3.5) < 1e-9
    tick = np.rint(trace.time_s[pushed] * 1e3)
    assert answer["ticks"] <= tick.min() <= answer["ticks"] + 2
    assert tick.max() - tick.min() == pytest.approx(200, abs=2)
