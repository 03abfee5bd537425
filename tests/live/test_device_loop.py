"""Loops stepped by a driver, and the discovery of drivers."""

import gc
import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.left_runs import end_left_runs
from tests.live.sides import how, packaged, until
from tests.ur.stalls import STALL_S, anew_after_stalls

from haptether.bridge import (
    DeviceError,
    LiveMaster,
    LiveSlave,
    MasterLoop,
    MasterRun,
    SlaveLoop,
    SlaveRun,
    drive_master,
    ladder_reason,
    load_master,
    load_scene,
    load_slave,
    read_recording,
    scene_json,
)
from haptether.master import MasterDevice, MasterSample
from haptether.slave import SlaveDevice, SlaveSample

pytestmark = pytest.mark.live

THREE = scene_json(load_scene("three_axis_box", ["link.forward={}", "link.backward={}", "safety.controllers=[]"]))
ONE = scene_json(load_scene("remote_push", ["environment.pushers=[]"]))


class Hand:
    """A hand that follows a path, on as many axes as the path has."""

    paces = False

    def __init__(self, axes: int) -> None:
        self.axes = axes
        self.force: tuple[float, ...] = ()

    def open(self) -> None:
        self.begun_s = time.monotonic()

    def read(self) -> MasterSample:
        depth_m = 0.03 * min(1.0, time.monotonic() - self.begun_s)
        return MasterSample([0.02 - depth_m, *[0.0] * (self.axes - 1)])

    def write(self, force: tuple[float, ...]) -> None:
        self.force = force

    def close(self) -> None:
        pass


class Arm:
    """An arm at its commanded position; x < 0 pushes with 100 N/m. It paces the loop."""

    paces = True

    def __init__(self, axes: int, period_s: float = 1e-3) -> None:
        self.position = (0.02, *[0.0] * (axes - 1))
        self.period_s = period_s
        self.speed = 0.0
        self.steps: list[float] = []
        self.stops = 0

    def open(self) -> None:
        self.next_s = time.monotonic()

    def read(self) -> SlaveSample:
        self.next_s += self.period_s
        time.sleep(max(0.0, self.next_s - time.monotonic()))
        force = [0.0] * len(self.position)
        force[0] = max(0.0, -100.0 * self.position[0])
        return SlaveSample(self.position, [0.0] * len(self.position), force)

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        assert len(position) == len(velocity) == len(self.position)
        self.steps.append(math.dist(position, self.position))
        self.position = position

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        pass


@pytest.mark.alone
@pytest.mark.parametrize("side", [LiveSlave, SlaveLoop])
@anew_after_stalls
def test_a_side_that_begins_leaves_the_interpreter_to_the_loops_that_run(side: type[LiveSlave | SlaveLoop]) -> None:
    """Allocating its memory takes time, in which an arm with an armed watchdog waits for its driver."""
    woken_s, ended = [time.monotonic()], threading.Event()

    def wake() -> None:
        while not ended.is_set():
            time.sleep(5e-4)
            woken_s.append(time.monotonic())

    beside = threading.Thread(target=wake)
    beside.start()
    try:
        begun_s = time.monotonic()
        begun = side(THREE, listen="127.0.0.1:0", keep_s=1800.0, realtime="off", **how())
        took_s = time.monotonic() - begun_s
    finally:
        ended.set()
        beside.join()
    begun.finish()
    assert took_s > 4.0 * STALL_S, "too short to be seen beside a stall of the machine"
    assert max(after - before for before, after in itertools.pairwise(woken_s)) < 0.5 * took_s


def test_a_run_answers_for_its_loop_but_does_not_step_it() -> None:
    loop = SlaveLoop(ONE, listen="127.0.0.1:0", **how())
    run = SlaveRun(Arm(1), loop)
    try:
        assert (run.address, run.recording) == (loop.address, None)
        of_every_side = set(dir(LiveSlave)) & set(dir(LiveMaster)) & set(dir(MasterLoop)) & set(dir(SlaveLoop))
        assert not {name for name in of_every_side if not hasattr(run, name)}
        assert not {name for name in ("begin", "step", "wait", "fail", "announce_end") if hasattr(run, name)}
    finally:
        run.finish()


@pytest.mark.parametrize(("axes", "spec"), [(1, ONE), (3, THREE)])
@anew_after_stalls
def test_a_driven_arm_follows_and_is_felt(axes: int, spec: bytes) -> None:
    arm = Arm(axes)
    loop = SlaveLoop(spec, listen="127.0.0.1:0", **how())
    slave = SlaveRun(arm, loop)
    master = LiveMaster(spec, peer=loop.address, duration_s=1.5, patience_s=10.0, **how())
    until(lambda: master.finished, 20.0)
    felt, report = master.finish()
    done, _ = slave.finish()
    assert slave.error is None
    assert felt.position.shape == ((len(felt), axes) if axes > 1 else (len(felt),))
    force = felt.device_force if axes == 1 else felt.device_force[:, 0]
    pushed = done.environment_force if axes == 1 else done.environment_force[:, 0]
    assert pushed.max() > 1.0
    assert force.max() > 1.0
    # Nothing lies between the two once the ladder has faded in; if this machine stalls a loop, it holds.
    assert report.holds == 0
    assert force.max() == pytest.approx(pushed.max(), rel=0.05)
    # The slave limits a command to 3 m/s; a tick may have been skipped.
    assert max(arm.steps) < 0.03
    assert arm.stops >= 1


@pytest.mark.parametrize(("axes", "spec"), [(1, ONE), (3, THREE)])
def test_a_driven_device_is_led_and_left_without_force(axes: int, spec: bytes) -> None:
    slave = LiveSlave(spec, listen="127.0.0.1:0", **how())
    hand = Hand(axes)
    assert isinstance(hand, MasterDevice)
    master = MasterRun(hand, MasterLoop(spec, peer=slave.address, duration_s=1.5, patience_s=10.0, **how()))
    until(lambda: master.finished, 20.0)
    trace, _ = master.finish()
    far, _ = slave.finish()
    assert master.error is None
    assert len(hand.force) == axes
    assert not any(hand.force)
    x = far.position if axes == 1 else far.position[:, 0]
    assert x.min() < 0.0
    assert np.abs(trace.device_force).max() > 0.2


def test_a_step_refuses_what_is_no_sample_and_stays_alive() -> None:
    loop = MasterLoop(THREE, peer="127.0.0.1:9", **how(realtime="off"))
    loop.begin()
    for bad in ("a", [1.0, 2.0], [[1.0], [2.0], [3.0]], None, [1.0, "b", 2.0], 4.0):
        with pytest.raises(TypeError, match=r"position = .*: must be a sequence of 3 numbers"):
            loop.step(bad)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"velocity = 1\.0"):
        loop.step([0.0] * 3, 1.0)
    assert loop.step([0.0] * 3) == (0.0, 0.0, 0.0)
    assert loop.step(np.zeros(3)) == (0.0, 0.0, 0.0)
    assert loop.step([math.nan, 0.0, 0.0]) == (0.0, 0.0, 0.0)
    assert loop.state == "fault"
    loop.stop()
    assert loop.step([0.0] * 3) is None
    trace, report = loop.finish()
    assert len(trace) == report.ticks == 3
    with pytest.raises(RuntimeError, match="finished before"):
        loop.finish()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"fault": 5}, "fault = 5: must be a text, or None"),
        ({"clutch": "yes"}, "clutch = yes: must be True, False or None"),
        ({"trigger": "0.5"}, "trigger = 0.5: must be a number, or None"),
        ({"buttons": 1 << 40}, "buttons = 1099511627776: must be a whole number from 0 to 2.32 - 1, or None"),
        ({"buttons": -1}, "buttons = -1: must be a whole number"),
        ({"orientation": (1.0, 0.0)}, r"orientation = \(1.0, 0.0\): must be a sequence of 4 numbers"),
        ({"angular_velocity": 1.0}, "angular_velocity = 1.0: must be a sequence of 3 numbers"),
    ],
)
def test_a_step_names_the_part_of_a_sample_that_is_wrong(wrong: dict[str, Any], said: str) -> None:
    loop = MasterLoop(ONE, peer="127.0.0.1:9", **how(realtime="off"))
    loop.begin()
    with pytest.raises(TypeError, match=said):
        loop.step(0.0, **wrong)
    assert loop.step(0.0) == (0.0,)
    loop.stop()
    loop.finish()


@pytest.mark.parametrize(("first", "then"), [(1.0, None), (None, 1.0)])
def test_a_velocity_is_in_every_sample_or_in_none(first: float | None, then: float | None) -> None:
    loop = MasterLoop(ONE, peer="127.0.0.1:9", **how(realtime="off"))
    loop.begin()
    assert loop.step(0.0, first) is not None
    # During a fault the velocity may be missing.
    assert loop.step(0.0, then, fault="unplugged") is not None
    with pytest.raises(TypeError, match=r"velocity is .* must be in every sample or in none"):
        loop.step(0.0, then)
    loop.stop()
    loop.finish()


@pytest.mark.parametrize(
    ("times", "kind", "said"),
    [
        ([0.0, None], TypeError, "time_s is missing, and was not so far: must be in every sample or in none"),
        ([None, 0.0], TypeError, "time_s is given, and was not so far"),
        ([math.nan], ValueError, "time_s = NaN: must be finite, or None"),
        ([0.5, 0.25], ValueError, r"time_s = 0.25 s: is before the last sample's, 0.5 s: must not go back"),
        (["soon"], TypeError, "time_s = soon: must be a number, or None"),
    ],
)
def test_a_time_of_a_sample_is_checked_where_it_enters(times: list[Any], kind: type[Exception], said: str) -> None:
    master = MasterLoop(ONE, peer="127.0.0.1:9", **how(realtime="off"))
    slave = SlaveLoop(ONE, listen="127.0.0.1:0", **how(realtime="off"))
    for loop, sample in ((master, (0.0,)), (slave, (0.0, 0.0, 0.0))):
        loop.begin()
        *before, last = times
        for time_s in before:
            assert loop.step(*sample, time_s=time_s) is not None
        with pytest.raises(kind, match=said):
            loop.step(*sample, time_s=last)
        # A restarted device has another clock.
        assert loop.step(*sample, fault="restarted", time_s=-1.0) is not None
        assert loop.step(*sample, time_s=-1.0) is not None
        loop.stop()
        loop.finish()


class Renewing:
    """A hand or an arm that moves along a path, with a new sample every few ms."""

    paces = False

    def __init__(self, every: int, *, stamped: bool) -> None:
        self.every, self.stamped, self.reads = every, stamped, 0

    def sampled_s(self) -> float:
        """Return the time of the newest sample, by the reads, because the loop is late beside other tests."""
        self.reads += 1
        return 1e-3 * self.every * (self.reads // self.every)

    def open(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    def write(self, *command: object) -> None:
        pass


class RenewingHand(Renewing):
    """A hand with slow samples."""

    def read(self) -> MasterSample:
        time_s = self.sampled_s()
        return MasterSample(0.02 * math.sin(9.0 * time_s), time_s=time_s if self.stamped else None)


class RenewingArm(Renewing):
    """An arm with slow samples."""

    def read(self) -> SlaveSample:
        time_s = self.sampled_s()
        return SlaveSample(0.02 * math.sin(9.0 * time_s), 0.0, 0.0, time_s=time_s if self.stamped else None)


@pytest.mark.parametrize(("every", "stamped"), [(1, False), (2, False), (8, False), (4, True)])
@anew_after_stalls
def test_a_device_that_is_slower_than_its_loop_is_warned_of_and_recorded(
    every: int, *, stamped: bool, tmp_path: Path
) -> None:
    master_loop = MasterLoop(ONE, peer="127.0.0.1:9", record=tmp_path / "hand.mcap", **how(realtime="off"))
    slave_loop = SlaveLoop(ONE, listen="127.0.0.1:0", record=tmp_path / "arm.mcap", **how(realtime="off"))
    runs: list[MasterRun | SlaveRun] = [
        MasterRun(RenewingHand(every, stamped=stamped), master_loop),
        SlaveRun(RenewingArm(every, stamped=stamped), slave_loop),
    ]
    for run, key in zip(runs, ("[run]", "[slave]"), strict=True):
        until(lambda run=run: run.ticks > 600)  # type: ignore[misc]  # bound at once
        said = [event for event in run.security_events() if event.startswith("slow: ")]
        _, report = run.finish()
        assert run.error is None
        assert report.renewal == pytest.approx(1.0 / every, abs=0.02)
        # The warning comes once.
        assert len(said) == (every > 1), said
        for text in said:
            named = re.search(rf"must be one each tick of 1 ms; .*; set \{key} period_s to (0\.0\d+),", text)
            assert named is not None, text
            assert float(named[1]) == pytest.approx(1e-3 * every, rel=0.15)
    for name in ("hand", "arm"):
        seen = read_recording(tmp_path / f"{name}.mcap").signals["renewal"]
        assert np.isnan(seen[0])
        assert seen[-1] == pytest.approx(1.0 / every, abs=0.02)


def test_a_burst_of_samples_is_held_back_to_the_period() -> None:
    loop = MasterLoop(ONE, peer="127.0.0.1:9", **how(realtime="off"))
    loop.begin()
    begun_s = time.monotonic()
    for _ in range(401):
        assert loop.step(0.0) is not None
    took_s = time.monotonic() - begun_s
    # These are 400 gaps of at least 7 / 8 ms, by the same clock.
    assert took_s >= 400 * 0.875e-3
    _, report = loop.finish()
    assert report.ticks == 401


KEPT = (9.9,)
"""Force in N of a device whose driver failed."""


@pytest.mark.parametrize(("failures", "rests"), [(1, True), (3, True), (10**6, False)])
def test_a_device_whose_driver_fails_is_brought_to_rest_again_and_again_or_named(failures: int, rests: bool) -> None:
    class Failing(Hand):
        left = 0

        def write(self, force: tuple[float, ...]) -> None:
            if self.left > 0:
                self.left -= 1
                self.force = KEPT
                message = "the bus is busy"
                raise OSError(message)
            super().write(force)

    device = Failing(1)
    slave = LiveSlave(ONE, listen="127.0.0.1:0", **how())
    run = MasterRun(device, MasterLoop(ONE, peer=slave.address, **how()))
    until(lambda: run.ticks > 20)
    device.left = failures
    until(lambda: run.finished)
    assert isinstance(run.error, DeviceError)
    assert ("KEEPS ITS LAST COMMAND, switch it off" in str(run.error)) is not rests
    assert device.force == ((0.0,) if rests else KEPT)
    run.finish()
    slave.stop()
    slave.finish()


def test_a_device_that_an_interrupted_driver_leaves_under_force_is_named() -> None:
    class Interrupted(Hand):
        reads = 0

        def read(self) -> MasterSample:
            self.reads += 1
            if self.reads > 50:
                raise KeyboardInterrupt
            return super().read()

        def write(self, force: tuple[float, ...]) -> None:
            if self.reads > 50:
                raise OSError
            super().write(force)

    run = MasterRun(Interrupted(1), MasterLoop(ONE, peer="127.0.0.1:9", **how()))
    until(lambda: run.finished)
    assert "KEEPS ITS LAST COMMAND, switch it off: KeyboardInterrupt" in str(run.error)
    run.finish()


@anew_after_stalls
def test_ctrl_c_in_a_driver_leaves_no_force_and_tells_the_peer() -> None:
    class Interrupted(Hand):
        reads = 0

        def read(self) -> MasterSample:
            self.reads += 1
            if self.reads > 1500:
                raise KeyboardInterrupt
            return super().read()

        def write(self, force: tuple[float, ...]) -> None:
            self.strongest = max(getattr(self, "strongest", 0.0), abs(force[0]))
            super().write(force)

    slave = LiveSlave(ONE, listen="127.0.0.1:0", **how())
    hand = Interrupted(1)
    loop, before = MasterLoop(ONE, peer=slave.address, **how()), os.sched_getscheduler(0)
    with pytest.raises(KeyboardInterrupt):
        drive_master(hand, loop)
    assert os.sched_getscheduler(0) == before
    assert hand.force == (0.0,)
    assert hand.strongest > 0.1
    far, _ = slave.finish()
    loop.finish()
    reasons = {ladder_reason(int(code)) for code in set(far.reason.tolist()) if code}
    assert "peer has a fault" in reasons


def test_a_loop_that_did_not_begin_takes_no_step() -> None:
    loop = SlaveLoop(ONE, listen="127.0.0.1:0", **how())
    assert loop.step(0.0, 0.0, 0.0) is None
    trace, report = loop.finish()
    assert (len(trace), report.ticks) == (0, 0)


def without(part: str) -> bytes:
    """Return a live scene without one of its parts."""
    scene = json.loads(ONE)
    del scene[part]
    return json.dumps(scene).encode()


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (scene_json(load_scene("paper_wall")), "slave: is missing"),
        (without("slave"), "slave: is missing"),
        (without("coupling"), r"coupling: a \[slave\] must be coupled"),
        (without("run"), "scene: missing field `run`"),
        (b"{}", "scene: missing field"),
        (ONE[:-1], "scene: EOF while parsing"),
    ],
    ids=["without a slave's side", "no slave", "no coupling", "no run", "empty", "cut short"],
)
def test_a_scene_is_refused_where_it_cannot_be_live(spec: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=f"^{said}"):
        MasterLoop(spec, peer="127.0.0.1:9", **how())
    with pytest.raises(ValueError, match=f"^{said}"):
        SlaveLoop(spec, listen="127.0.0.1:0", **how())


def test_a_device_that_does_not_open_ends_the_run_and_is_closed() -> None:
    class Absent(Hand):
        closed = 0

        def open(self) -> None:
            raise OSError(19, "No such device")

        def close(self) -> None:
            self.closed += 1

    hand = Absent(1)
    run = MasterRun(hand, MasterLoop(ONE, peer="127.0.0.1:9", **how()))
    until(lambda: run.finished)
    run.finish()
    assert isinstance(run.error, DeviceError)
    assert "No such device" in str(run.error)
    assert hand.closed == 1


@pytest.mark.parametrize(
    ("device_s", "scene_s", "fits"),
    [(0.002, 0.002, True), (0.002, 0.00201, True), (0.002, 0.00199, True), (0.002, None, True),
     (0.002, 0.001, False), (0.001, 0.002, False), (0.002, 0.00203, False), (0.002, 0.00197, False),
     (math.nan, 0.001, False)],
)  # fmt: skip
def test_an_arm_that_paces_by_another_period_than_the_scene_has_is_refused(
    device_s: float, scene_s: float | None, fits: bool
) -> None:
    class Paced(Arm):
        closed = 0

        def __init__(self) -> None:
            super().__init__(1, device_s if fits else 0.001)
            # The period is known only once the arm is open, like that of an arm whose controller reports it.
            self.period_s: float | None = None  # type: ignore[assignment]

        def open(self) -> None:
            super().open()
            self.period_s = device_s

        def read(self) -> SlaveSample:
            self.reads = getattr(self, "reads", 0) + 1
            return super().read()

        def close(self) -> None:
            self.closed += 1

    arm = Paced()
    run = SlaveRun(arm, SlaveLoop(ONE, listen="127.0.0.1:0", **how()), period_s=scene_s)
    until(run.ready)
    if fits:
        until(lambda: run.ticks > 3)
    run.finish()
    assert arm.closed == 1
    assert hasattr(arm, "reads") == fits
    if fits:
        assert run.error is None
    else:
        assert str(run.error) == (
            f"[slave] period_s = {scene_s:g}: Paced gives a sample each {device_s:g} s and paces the loop: "
            f"set [slave] period_s = {device_s:g}"
        )


def test_a_device_that_paces_by_another_period_than_the_scene_has_is_refused() -> None:
    class Paced(Hand):
        paces = True
        period_s = 0.002

    hand = Paced(1)
    run = MasterRun(hand, MasterLoop(ONE, peer="127.0.0.1:9", **how()), period_s=0.001)
    until(lambda: run.finished)
    run.finish()
    assert "[run] period_s = 0.001: Paced gives a sample each 0.002 s" in str(run.error)
    assert "set [run] period_s = 0.002" in str(run.error)
    # A device that does not pace runs by the clock of the loop; its own period has no effect.
    Paced.paces = False
    run = MasterRun(hand, MasterLoop(ONE, peer="127.0.0.1:9", **how()), period_s=0.001)
    until(lambda: run.ticks > 3)
    run.finish()
    assert run.error is None


def test_a_device_that_is_given_up_is_closed_and_neither_read_nor_moved() -> None:
    class Blocked(Arm):
        def __init__(self) -> None:
            super().__init__(1)
            self.let, self.calls = threading.Event(), list[str]()

        def open(self) -> None:
            self.let.wait(30.0)

        def read(self) -> SlaveSample:
            self.calls.append("read")
            return super().read()

        def close(self) -> None:
            self.calls.append("close")

    arm = Blocked()
    run = SlaveRun(arm, SlaveLoop(ONE, listen="127.0.0.1:0", **how()))
    assert not run.ready()
    run.give_up()
    assert arm.calls == ["close"]
    assert gc.isenabled()
    arm.let.set()
    until(lambda: run.finished)
    # It is closed a second time, because it was not open yet at the first.
    assert arm.calls == ["close", "close"]
    assert "nobody waited" in str(run.error)


def test_of_two_loops_the_last_that_ends_brings_back_the_interpreter() -> None:
    before_s = sys.getswitchinterval()
    assert gc.isenabled()

    def quiet() -> bool:
        return not gc.isenabled() and sys.getswitchinterval() < 0.1 * before_s

    runs = [SlaveRun(Arm(1), SlaveLoop(ONE, listen="127.0.0.1:0", **how())) for _ in range(2)]
    try:
        until(lambda: all(run.ready() for run in runs))
        assert quiet()
        runs[0].finish()
        assert quiet()
        # A repeated request to end does not affect another loop.
        with pytest.raises(RuntimeError, match="finished before"):
            runs[0].finish()
        assert quiet()
    finally:
        runs[1].finish()
    assert gc.isenabled()
    assert sys.getswitchinterval() == pytest.approx(before_s)
    assert gc.get_freeze_count() == 0


def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        SlaveRun(Arm(1), SlaveLoop(ONE, listen="127.0.0.1:0", **how())).finish()
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_what_a_failed_test_leaves_running_is_ended() -> None:
    before = gc.isenabled()
    master = MasterRun(Hand(1), MasterLoop(ONE, peer="127.0.0.1:9", patience_s=60.0, **how()))
    until(master.ready)
    assert not gc.isenabled()
    assert end_left_runs() == 1
    assert master.finished
    assert gc.isenabled() == before
    assert end_left_runs() == 0


# ------------------------------------------------------------------------------------------- entry points


def declare(monkeypatch: pytest.MonkeyPatch, group: str, **values: str) -> None:
    points = EntryPoints(EntryPoint(name, value, group) for name, value in values.items())

    def found(**selection: Any) -> EntryPoints:  # noqa: ANN401  # as of entry_points
        return points.select(**selection)

    monkeypatch.setattr("haptether.bridge.devices.find.entry_points", found)


def test_drivers_are_found_by_name_and_called_with_their_options(monkeypatch: pytest.MonkeyPatch) -> None:
    declare(monkeypatch, "haptether.slaves", bench=f"{__name__}:Arm", nothing="json:loads", version="json:__name__")
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    arm = load_slave("bench", {"axes": 3})
    assert isinstance(arm, SlaveDevice)
    for name, options, said in (
        ("benchh", {}, "did you mean bench?"),
        ("zzz", {}, "there is simulated, bench, nothing, version"),
        ("bench", {"axis": 3}, "it takes"),
        ("bench", {}, "missing a required argument: 'axes'"),
        ("version", {}, "is no driver: must be a class or a function"),
        ("nothing", {"s": "[]"}, "has no open, read, write, stop, close, paces"),
    ):
        with pytest.raises(ValueError, match=said):
            load_slave(name, options)
    with pytest.raises(ValueError, match=r"haptether\.masters"):
        load_master("bench", {})


DRIVER = """
import time
from haptether.slave import SlaveSample

class Arm:
    paces = False
    def __init__(self, stiffness: float) -> None:
        self.position, self.stiffness = 0.02, stiffness
    def open(self): pass
    def read(self): return SlaveSample(self.position, 0.0, max(0.0, -self.stiffness * self.position))
    def write(self, position, velocity):
        self.position = position[0]
        if self.position < -0.02:
            raise OSError("the arm was unplugged")
    def stop(self): pass
    def close(self): pass
"""


@anew_after_stalls
def test_a_driver_of_another_package_is_driven_by_the_command_and_its_exception_reported(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "haptether"]
    environment = packaged(tmp_path, DRIVER)
    slave = subprocess.Popen(
        [*command, "slave", "--listen", "127.0.0.1:0", "--insecure", "--scene", "remote_push", "--set",
         "slave.device=bench", "--set", "slave.options.stiffness=100.0", "--patience-s", "20", "--json",
         str(tmp_path / "slave.json"), "--force"],
        env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert slave.stderr is not None
        line = ""
        while "listens on" not in line:
            line = slave.stderr.readline()
            assert line, "it ended"
        address = line.split("listens on ")[1].split()[0].rstrip(",")
        master = subprocess.run(
            [*command, "master", "--peer", address, "--insecure", "--scene", "remote_push", "--duration-s", "3"],
            env=environment, capture_output=True, text=True, timeout=30, check=False,
        )  # fmt: skip
        _, said = slave.communicate(timeout=30)
    finally:
        slave.kill()
        slave.wait()
    assert "Arm: OSError: the arm was unplugged" in said, master.stderr
    assert slave.returncode == 1
    assert master.returncode == 1
    assert "the run ended in" in master.stderr
    assert json.loads((tmp_path / "slave.json").read_text())["final_state"] == "fault"


BENCH_SLAVE = (
    sys.executable, "-m", "haptether", "slave", "--listen", "127.0.0.1:0", "--insecure", "--scene", "remote_push",
    "--set", "slave.device=bench",
)  # fmt: skip
ENDING = """
import sys
from haptether.checklist import Checklist
from haptether.slave import SlaveSample

class Arm:
    paces = False
    reads = 0
    def __init__(self, at): self.at = at
    def open(self):
        if self.at == "open":
            raise OSError("the arm was unplugged")
        if self.at == "checklist":
            checklist = Checklist("arm 1")
            checklist.refuse("power", "the arm was unplugged", "plug it in")
            checklist.refuse("brakes", "they are closed", "open them")
            checklist.finish()
    def read(self):
        self.reads += 1
        if self.reads == 500 and self.at == "read":
            raise OSError("the arm was unplugged")
        fault = "the arm was unplugged" if self.reads > 500 and self.at == "fault" else None
        return SlaveSample(0.02, 0.0, 0.0, fault)
    def write(self, position, velocity): pass
    def stop(self): pass
    def close(self): pass
"""


@pytest.mark.parametrize("debug", [False, True])
@pytest.mark.parametrize("at", ["open", "checklist", "read", "fault"])
def test_a_failure_of_a_driver_is_printed_once_and_its_source_line_for_debugging(
    at: str, debug: bool, tmp_path: Path
) -> None:
    ended = subprocess.run(
        [*BENCH_SLAVE, "--set", f"slave.options.at={at}", "--patience-s", "1.5", *(["--debug"] if debug else [])],
        env=packaged(tmp_path, ENDING), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.returncode == 1
    if debug:
        assert at == "fault" or "bench_arm.py" in ended.stderr
        return
    assert ended.stderr.count("the arm was unplugged") == 1, ended.stderr
    assert ended.stderr.count("open them") == (at == "checklist")
    # An exception of a running driver is a fault of its code: both screens have the line.
    assert ("bench_arm.py" in ended.stderr) == (at == "read")
    assert ended.stderr.splitlines()[-1].startswith("haptether: ")


HANGING = """
import sys, time
from haptether.slave import SlaveSample

class Arm:
    paces = False
    reads = 0
    def open(self): pass
    def read(self):
        self.reads += 1
        if self.reads == 100:
            time.sleep(SECONDS)
        return SlaveSample(0.02, 0.0, 0.0)
    def write(self, position, velocity): pass
    def stop(self): print("stopped", file=sys.stderr, flush=True)
    def close(self): print("closed", file=sys.stderr, flush=True)
"""


def test_a_driver_that_blocks_is_reported_while_it_does(tmp_path: Path) -> None:
    ended = subprocess.run(
        [*BENCH_SLAVE, "--patience-s", "4"], env=packaged(tmp_path, HANGING.replace("SECONDS", "2.0")),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    said = (
        "\nfault: the slave has a fault: Arm: KEEPS ITS LAST COMMAND, switch it off: read has not returned for 0.5 s\n"
    )
    assert ended.stderr.count(said) == 1, ended.stderr


class Stuck:
    """A driver with one method that hangs on request, until it is released."""

    def __init__(self, driver: Any, method: str) -> None:  # noqa: ANN401
        self.driver, self.method = driver, method
        self.hangs, self.let = threading.Event(), threading.Event()
        self.calls: list[str] = []

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        found = getattr(self.driver, name)
        if name not in {"read", "write", "stop", "close"}:
            return found

        def called(*arguments: object) -> object:
            if name == self.method and self.hangs.is_set() and threading.current_thread().name == "haptether-loop":
                assert self.let.wait(60.0)
            self.calls.append(name)
            return found(*arguments)

        return called


@pytest.mark.parametrize("method", ["read", "write"])
@pytest.mark.parametrize("side", ["master", "slave"])
@anew_after_stalls
def test_a_driver_that_does_not_return_is_named_on_both_screens_and_left_at_rest(side: str, method: str) -> None:
    device: Any = Stuck(Hand(1) if side == "master" else Arm(1), method)
    run: MasterRun | SlaveRun
    other: LiveMaster | LiveSlave
    if side == "master":
        other = LiveSlave(ONE, listen="127.0.0.1:0", **how())
        run = MasterRun(device, MasterLoop(ONE, peer=other.address, **how()))
    else:
        loop = SlaveLoop(ONE, listen="127.0.0.1:0", **how())
        run = SlaveRun(device, loop)
        other = LiveMaster(ONE, peer=loop.address, **how())
    try:
        until(lambda: run.state == other.state == "engaged")
        # A slave is written to only once it is led.
        until(lambda: device.calls[-20:].count(method) > 0)
        hung_s = time.monotonic()
        device.hangs.set()
        named = f"Stuck: KEEPS ITS LAST COMMAND, switch it off: {method} has not returned for 0.5 s"
        for screen in (run, other):
            until(lambda screen=screen: named in (screen.cause() or ""))  # type: ignore[misc]
        shown_s = time.monotonic() - hung_s
        assert run.state == "fault"
        # The loop goes on without the driver, for readers of telemetry and recordings.
        ticks = run.ticks
        until(lambda: run.ticks > ticks + 10)
        device.calls.clear()
        begun_s = time.monotonic()
        _, report = run.finish()
        took_s = time.monotonic() - begun_s
    finally:
        device.let.set()
        other.stop()
        other.finish()
    assert report.ticks > ticks
    assert "the driver has not returned" in str(run.error)
    # Other threads write zero or stop, and then end it.
    assert device.calls[:2] == ["write" if side == "master" else "stop", "close"]
    if side == "master":
        assert device.driver.force == (0.0,)
    assert shown_s < 1.5
    assert took_s < 5.0


def test_a_driver_that_returns_after_all_goes_on_once_its_fault_is_acknowledged() -> None:
    device: Any = Stuck(Hand(1), "read")
    run = MasterRun(device, MasterLoop(ONE, peer="127.0.0.1:9", **how()))
    try:
        until(lambda: run.ticks > 20)
        device.hangs.set()
        until(lambda: run.state == "fault")
        device.hangs.clear()
        device.let.set()
        device.calls.clear()
        until(lambda: device.calls.count("write") > 20)
        assert run.state == "fault"
        assert device.driver.force == (0.0,)
        run.acknowledge()
        until(lambda: run.state == "disengaged")
    finally:
        device.let.set()
        run.finish()
    assert run.error is None


def test_ctrl_c_says_that_a_second_one_ends_at_once_and_leaves_a_driver_that_hangs(tmp_path: Path) -> None:
    slave = subprocess.Popen(
        BENCH_SLAVE, env=packaged(tmp_path, HANGING.replace("SECONDS", "120.0")), stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert slave.stderr is not None
        while "read has not returned" not in (line := slave.stderr.readline()):
            assert line, "it ended"
        begun_s = time.monotonic()
        slave.send_signal(signal.SIGINT)
        _, said = slave.communicate(timeout=60)
        took_s = time.monotonic() - begun_s
    finally:
        slave.kill()
        slave.wait()
    assert said.count("a second Ctrl-C ends at once") == 1
    assert said.index("stopped") < said.index("closed")
    assert "the driver has not returned" in said
    assert slave.returncode == 1
    # It does not take the 10 s in which an arm may be lowered.
    assert took_s < 8.0


SLOW = """
import sys, time

class Arm:
    paces = False
    def open(self):
        print("opening", file=sys.stderr, flush=True)
        time.sleep(SECONDS)
    def read(self): return 0.02, 0.0, 0.0, None
    def write(self, position, velocity): print("moved", file=sys.stderr, flush=True)
    def stop(self): pass
    def close(self): print("closed", file=sys.stderr, flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("opens_s", [0.6, 120.0])
def test_ctrl_c_ends_a_command_whose_device_opens(tmp_path: Path, opens_s: float, number: signal.Signals) -> None:
    slave = subprocess.Popen(
        BENCH_SLAVE, env=packaged(tmp_path, SLOW.replace("SECONDS", str(opens_s))), stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert slave.stderr is not None
        while "opening" not in (line := slave.stderr.readline()):
            assert line, "it ended"
        begun_s = time.monotonic()
        slave.send_signal(number)
        shown, said = slave.communicate(timeout=30)
        took_s = time.monotonic() - begun_s
    finally:
        slave.kill()
        slave.wait()
    assert slave.returncode == 130
    assert said.count("closed") == 1
    assert "moved" not in said
    assert "listens on" not in said
    assert "Traceback" not in said
    assert shown == ""
    # The limit is 1 s for a device that may still open, plus delays of a busy machine.
    assert took_s < 10.0
