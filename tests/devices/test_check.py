"""`DeviceCheck`: its findings for valid drivers and for each driver with one defect."""

import itertools
import math
import re
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.devices import drivers
from tests.ur.stalls import anew_after_stalls

from haptether.bridge.devices.check.form import Reading, SampleForm, check_kinds
from haptether.bridge.devices.check.push import GAP_S, MAX_PUSH, MAX_SPEED, MAX_TRAVEL, Push, profile
from haptether.bridge.devices.check.report import DeviceCheck, SecondRun
from haptether.bridge.devices.check.series import check_blocking, check_renewal
from haptether.bridge.devices.standalone import Tick, wait_until
from haptether.master import MasterSample
from haptether.slave import SlaveSample

live = pytest.mark.live


def checked(device: object, seconds: float = 1.2, side: str = "master") -> dict[str, tuple[str, str]]:
    """Return verdict and text of each finding of a run of that length."""
    check = DeviceCheck(device, side)  # type: ignore[arg-type]  # one of the two types
    wait_until(lambda: check.run.finished, seconds)
    check.end()
    return {finding.check: (finding.verdict, finding.text) for finding in check.findings()}


@live
@pytest.mark.parametrize("make", [drivers.Stylus, drivers.Paced, drivers.Pose])
@anew_after_stalls
def test_a_driver_that_is_right_passes_and_is_written_zero_only(make: Callable[[], drivers.Stylus]) -> None:
    device = make()
    found = checked(device)
    assert {name for name, (verdict, _) in found.items() if verdict != "pass"} == set()
    assert {"velocity", "units", "jumps", "motion", "period", "close()", "zero at begin and end"} <= found.keys()
    assert ("angular velocity" in found) == (make is drivers.Pose)
    assert device.opened == device.closed == 1
    assert len(device.forces) > 200
    assert set(device.forces) == {(0.0, 0.0, 0.0)}


WRONG = {
    "RaisesInOpen": ("open()", r"raised an exception: RaisesInOpen: OSError: no such bus$"),
    "RaisesInRead": ("read()", r"KeyError: 'encoder'$"),
    "RaisesInWrite": ("write()", r"OSError: unplugged$"),
    "RaisesInEveryWrite": ("zero at begin and end", "KEEPS ITS LAST COMMAND"),
    "RaisesInClose": ("close()", "OSError: busy"),
    "NotANumber": ("finite numbers", r"position = \[nan, 0.0, 0.0\]: must be finite.*first in number 41"),
    "WrongShape": ("shapes", r"velocity = \[0.0, 0.0\]: must be a sequence of 3 numbers"),
    "TwoFields": ("fields", r"read\(\) gives 2 values: must be a MasterSample"),
    "ChangingAxes": ("shapes", "position has 2 axes, that of the first sample 3"),
    "Blocking": ("blocking calls", r"read\(\) took longer than 20 ms"),
    "Millimetres": ("units", "given in mm"),
    "MillimetresPerSecond": ("velocity", "it is in mm/s"),
    "WrongSign": ("velocity", "its sign is wrong"),
    "SometimesVelocity": ("velocity at every sample or none", "velocity is there at some samples"),
    "Jumps": ("jumps", r"axis \d jumps by 0\.\d+ m"),
    "WrongPeriod": ("period", r"period_s = 0.001: must be"),
    "DoesNotWait": ("period", r"read\(\) does not wait for a sample"),
    "TextKinds": ("kinds", "must be a tuple"),
    "Slow": ("renewal", r"a new sample at 2\d %.*must be one each 1 ms.*period_s = 0.004"),
    "NotUnit": ("orientation", "its norm is 1.001"),
    "OwnFrame": ("angular velocity", "in the device's own frame"),
}  # fmt: skip


@pytest.mark.sampled(8)
@live
@pytest.mark.parametrize("name", WRONG)
@anew_after_stalls
def test_what_is_to_be_mended_is_named_with_the_remedy(name: str) -> None:
    check, said = WRONG[name]
    device = getattr(drivers, name)()
    found = checked(device)
    assert found[check][0] == "mend", found
    assert re.search(said, found[check][1]), found[check]
    assert device.closed == 1
    # Whatever the defect, only zero force is ever written.
    assert not any(any(force) for force in device.forces)


@live
def test_a_driver_that_hangs_in_open_or_in_a_call_is_said_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("haptether.bridge.devices.standalone.LEAVE_S", 0.3)
    found = checked(drivers.HungInOpen(), 0.2)
    assert found["open()"] == ("mend", "does not return: nothing can be said of the rest")
    device = drivers.HungInRead()
    found = checked(device, 0.5)
    assert found["read()"] == ("mend", "does not return: nobody can take the device's force away")
    assert "KEEPS ITS LAST COMMAND" in found["zero at begin and end"][1]
    assert device.closed == 1


@pytest.mark.parametrize(
    ("first_s", "later_s", "verdict"),
    [
        (0.025, 0.002, "pass"),
        (0.9, 0.019, "pass"),
        (0.002, 0.025, "mend"),
        (1.2, 0.002, "mend"),
        (0.025, 0.025, "mend"),
    ],
)
def test_the_first_read_may_give_an_arm_its_torque(first_s: float, later_s: float, verdict: str) -> None:
    def tick(index: int, read_s: float) -> Tick:
        return Tick(float(index), index + read_s, index + read_s, None, ((0.0,),))

    ticks = [tick(0, first_s), *(tick(index, later_s) for index in range(1, 5))]
    found = check_blocking(ticks, paces=False, said_s=None)
    assert found.verdict == verdict, found
    assert ("the first read() took" in found.text) == (first_s > 1.0)
    assert ("took longer than 20 ms 4 times" in found.text) == (later_s > 0.02)


@live
@pytest.mark.parametrize("wrong", [{"cycle_s": 0.00162}, {"paces": True, "period_s": 0.002}])
def test_a_period_that_the_device_cannot_keep_is_refused_with_the_number(wrong: dict[str, Any]) -> None:
    device = type("Timed", (drivers.Stylus,), wrong)()
    found = checked(device, 0.5)
    assert found["open()"][0] == "pass"
    if "cycle_s" in wrong:
        said = "period_s = 0.001: a cycle on the bus of this device takes 1.62 ms: must be at least 0.00162;"
        assert found["period"] == ("mend", f"{said} raise it, or the rate of the bus")
    assert not any("does not return" in text for _, text in found.values())
    assert device.closed == 1


@live
@pytest.mark.parametrize("axes", [1, 3, 6])
@anew_after_stalls
def test_an_arm_is_read_and_stopped_and_never_moved(axes: int) -> None:
    arm = drivers.Arm(axes)
    check = DeviceCheck(arm, "slave", "joints")
    wait_until(lambda: check.run.finished, 0.6)
    check.end()
    found = {finding.check: finding.verdict for finding in check.findings()}
    assert arm.calls == ["open", "stop", "close"]
    assert "mend" not in found.values()
    assert found["stop at the end"] == found["axes"] == "pass"
    assert found["motion"] == found["velocity"] == "unseen"
    with pytest.raises(ValueError, match="must be of a master"):
        check.push(0.5, 0)


@live
@pytest.mark.parametrize(
    ("make", "check", "said"),
    [
        (drivers.Drifting, "velocity", r"at rest it says 0\.(5|50\d|49\d) m/s"),
        (drivers.RaisesInStop, "stop at the end", "KEEPS ITS LAST COMMAND"),
        (drivers.OtherAxes, "axes", "axes = 3, but a sample has 1"),
    ],
)
@anew_after_stalls
def test_what_is_wrong_with_an_arm_is_named(make: Callable[[], drivers.Arm], check: str, said: str) -> None:
    found = checked(make(), 0.6, "slave")
    assert found[check][0] == "mend", found
    assert re.search(said, found[check][1]), found[check]


@live
@pytest.mark.parametrize(("make", "verdict"), [(drivers.Stylus, "pass"), (drivers.Turned, "mend")])
@anew_after_stalls
def test_a_push_is_ramped_bounded_ends_by_itself_and_shows_the_sign(
    make: Callable[..., drivers.Stylus], verdict: str
) -> None:
    device = make(held=False)
    check = DeviceCheck(device, "master")
    wait_until(lambda: len(check.run.ticks) > 50, 5.0)
    begun_s = time.monotonic()
    push = check.push(0.5, 0)
    wait_until(lambda: push.ended is not None, 5.0)
    took_s = time.monotonic() - begun_s
    wait_until(lambda: check.run.finished, 0.1)
    check.end()
    (found,) = [finding for finding in check.findings() if finding.check == "push"]
    assert push.ended == "ended by itself"
    assert 1.4 < took_s < 2.0
    assert found.verdict == verdict, found
    forces = [force[0] for force in device.forces]
    assert max(forces) == pytest.approx(0.5)
    assert min(forces) >= 0.0
    # The force rises and falls by 1 N/s, and a tick may be 19 ms late.
    assert max(abs(after - before) for before, after in itertools.pairwise(forces)) < 0.021
    assert not any(any(force) for force in device.forces[-20:])
    assert not any(force[1] or force[2] for force in device.forces)


@live
def test_a_push_is_refused_beyond_its_bound_and_void_where_it_comes_late() -> None:
    check = DeviceCheck(drivers.Stylus(held=False), "master")
    wait_until(lambda: len(check.run.ticks) > 20, 5.0)
    for size, axis in ((1.01, 0), (-0.5, 0), (0.0, 0), (math.nan, 0), (0.5, 3), (0.5, -1)):
        with pytest.raises(ValueError, match="must be"):
            check.push(size, axis)
    check.lead.push, check.lead._asked_s = Push(0.5, 0, "linear"), time.monotonic() - 3.0
    wait_until(lambda: check.lead.push is not None and check.lead.push.ended is not None, 2.0)
    check.end()
    assert check.lead.push.ended == "it was asked for too long ago"
    assert not any(any(force) for force in check.run.watched.device.forces)  # type: ignore[attr-defined]  # a test's


AT_REST = Reading((0.0, 0.0), None, None, None, None, None)


@given(
    size=st.floats(0.01, 1.0),
    moves=st.lists(st.tuples(st.floats(0.0, 0.03), st.floats(-0.01, 0.01)), min_size=1, max_size=200),
    kind=st.sampled_from(["linear", "joints", "pose"]),
)
def test_whatever_moves_a_push_stays_in_its_bounds_and_once_ended_is_zero(
    size: float, moves: list[tuple[float, float]], kind: str
) -> None:
    push, at_s, x = Push(size, 1, kind), 10.0, 0.0
    for step_s, step in moves:
        at_s, x = at_s + step_s, x + step
        was_over = push.ended is not None
        force = push.force(AT_REST._replace(position=(0.0, x)), at_s)
        assert 0.0 <= force <= size
        assert push.begun_s is not None
        if was_over or (step_s > GAP_S and at_s > push.begun_s) or at_s - push.begun_s > 1.5:
            assert force == 0.0
        if abs(push.travel) > MAX_TRAVEL[kind]:
            assert force == 0.0
    assert push.force(None, at_s + 1e-3) == 0.0
    assert push.force(AT_REST, at_s + 2e-3) == 0.0


def test_a_push_ends_by_speed_travel_a_fault_and_a_late_tick() -> None:
    def pushed(step_s: float, speed: float, last: Reading | None = None) -> Push:
        push = Push(0.5, 0, "linear")
        for tick in range(1500):
            push.force(AT_REST._replace(position=(speed * tick * step_s, 0.0)), tick * step_s)
            if push.ended is not None:
                break
            if last is not None and tick == 100:
                push.force(last, tick * step_s + 1e-3)
                break
        return push

    assert pushed(1e-3, 2.0 * MAX_SPEED["linear"]).ended == "it is faster than 0.25"
    assert pushed(1e-3, 0.8 * MAX_SPEED["linear"]).ended == "it has moved by more than 0.05"
    assert pushed(2e-3, 0.0).ended == "ended by itself"
    assert pushed(0.03, 0.0).ended == "a tick came 30 ms after the one before"
    assert pushed(1e-3, 0.0, AT_REST._replace(fault="hot")).ended == "the device reports: hot"


def test_the_ramp_of_a_push() -> None:
    assert [profile(time_s) for time_s in (0.0, 0.25, 0.5, 1.0, 1.25, 1.5, 9.0)] == [0.0, 0.5, 1.0, 1.0, 0.5, 0.0, 0.0]
    assert MAX_PUSH == {"linear": 1.0, "pose": 1.0, "joints": 0.1}


@live
def test_after_an_exception_in_the_loop_a_driver_is_at_rest_and_closed() -> None:
    check = DeviceCheck(drivers.Stylus(), "master")
    wait_until(lambda: len(check.run.ticks) > 5, 5.0)
    check.end()
    device = drivers.Stylus()
    second = SecondRun(device, check, lambda: False)
    wait_until(lambda: second.run.finished, 5.0)
    assert second.finding().verdict == "pass"
    assert "an exception in the middle of the loop" in str(second.run.error)
    assert (device.opened, device.closed, device.forces[-1]) == (1, 1, (0.0, 0.0, 0.0))
    for bad in (drivers.RaisesInClose(), drivers.RaisesInOpen()):
        second = SecondRun(bad, check, lambda: False)
        wait_until(lambda run=second.run: run.finished, 5.0)  # type: ignore[misc]  # bound in the same iteration
        found = second.finding()
        assert found.verdict == "mend"
        assert "when it is opened again" in found.text


NUMBERS = st.one_of(
    st.none(), st.booleans(), st.text(max_size=3), st.floats(), st.integers(-5, 5), st.lists(st.floats(), max_size=8),
    st.lists(st.one_of(st.floats(-1.0, 1.0), st.none(), st.text(max_size=2)), max_size=4), st.complex_numbers(),
)  # fmt: skip


@given(
    parts=st.lists(NUMBERS, min_size=9, max_size=9),
    side=st.sampled_from(["master", "slave"]),
    kind=st.sampled_from(["linear", "joints", "pose"]),
    count=st.integers(0, 10),
)
def test_no_sample_whatever_it_holds_ends_the_check_and_what_passes_is_finite(
    parts: list[object], side: str, kind: str, count: int
) -> None:
    form = SampleForm(side, kind)  # type: ignore[arg-type]  # both literal types
    for sample in (tuple(parts), tuple(parts)[:count], parts[0], MasterSample(*parts)):  # type: ignore[arg-type]  # any
        reading = form.take(sample)
        assert len(form.findings()) == 7
        if reading is None:
            continue
        assert form.axes == len(reading.position)
        for numbers in reading[:5]:
            assert numbers is None or all(map(math.isfinite, numbers))
        assert reading.time_s is None or math.isfinite(reading.time_s)
        if side == "slave":
            assert reading.velocity is not None
            assert reading.force is not None


@pytest.mark.parametrize(
    ("field", "value", "check", "said"),
    [
        ("clutch", 1, "buttons and trigger", "clutch = 1: must be True, False or none"),
        ("buttons", -1, "buttons and trigger", "buttons = -1: must be 0"),
        ("buttons", 1.5, "buttons and trigger", "buttons = 1.5: must be a whole number"),
        ("trigger", 1.5, "buttons and trigger", "trigger = 1.5: must be 0 (open) to 1 (closed)"),
        ("fault", 3, "fields", "fault = 3: must be text"),
        ("position", "0", "shapes", "position = '0': must be a number"),
        ("position", [0.0] * 4, "shapes", 'position has 4 axes: a side of kind "linear" has 1, 2, 3'),
        ("velocity", [math.inf], "finite numbers", "velocity = [inf]: must be finite"),
        ("time_s", math.nan, "time_s", "time_s = nan: must be a finite number of seconds, or none"),
        ("time_s", [0.0], "time_s", "time_s = [0.0]: must be a finite number"),
        ("time_s", True, "time_s", "time_s = True: must be a finite number"),
    ],
)
def test_what_is_wrong_with_a_field_is_said(field: str, value: object, check: str, said: str) -> None:
    form = SampleForm("master", "linear")
    assert form.take(MasterSample(0.0)._replace(**{field: value})) is None  # type: ignore[arg-type]  # invalid
    found = {finding.check: finding for finding in form.findings()}
    assert found[check].verdict == "mend"
    assert said in found[check].text


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([0.0, 0.0, 0.001], None),
        ([1, 2, 3], None),
        ([0.002, 0.001], "time_s = 0.001: is before the last sample's, 0.002: must not go back"),
        ([0.0, None], "time_s is there at some samples and missing at others"),
        ([None, 0.0], "time_s is there at some samples and missing at others"),
        # A restarted device has a new clock.
        ([5.0, "restarted", 0.0], None),
    ],
)
def test_the_times_of_a_device_never_go_back_but_after_a_fault(
    times: list[float | str | None], said: str | None
) -> None:
    form = SampleForm("master", "linear")
    for time_s in times:
        if isinstance(time_s, str):
            form.take(MasterSample(0.0, fault=time_s))
        else:
            form.take(MasterSample(0.0, time_s=time_s))
    text = form.problems["time_s"].text if "time_s" in form.problems else None
    assert text is None if said is None else text is not None and said in text


def renewed(
    every: float, *, quantum: float = 0.0, speed: float = 0.2, loop_s: float = 1e-3, stamped: bool = False
) -> tuple[str, str]:
    """Return verdict and text for a device that a hand moves for 4 s, with a new sample every few ticks."""
    ticks = np.arange(round(4.0 / loop_s))
    sampled = np.floor(ticks / every + 0.3) * every * loop_s
    x = speed * (np.sin(9.0 * sampled) / 9.0 + 0.3 * np.sin(23.0 * sampled) / 23.0)
    if quantum:
        x = np.round(x / quantum) * quantum
    readings = [
        Reading((float(at),), None, None, None, None, None, float(time_s) if stamped else None)
        for at, time_s in zip(x, sampled, strict=True)
    ]
    time_s = np.asarray(ticks * loop_s, dtype=np.float64)
    found = check_renewal(time_s, readings, loop_s, "[run] period_s")
    return found.verdict, found.text


@pytest.mark.parametrize(
    ("about", "verdict", "said"),
    [
        ({"every": 1.0}, "pass", "at 100 % of the reads, one each 1 ms"),
        ({"every": 0.3}, "pass", "at 100 %"),
        ({"every": 1.25}, "mend", r"at 80 %.*one each 1\.25 ms: must be one each 1 ms.*period_s = 0\.001[23],"),
        ({"every": 1.5}, "mend", "at 67 %"),
        ({"every": 2.0}, "mend", r"at 50 %.*one each 2 ms: must be one each 1 ms.*set \[run\] period_s = 0\.002,"),
        ({"every": 8.0}, "mend", r"at 1[23] %.*set \[run\] period_s = 0\.008,"),
        ({"every": 2.0, "loop_s": 2e-3}, "mend", r"one each 4 ms: must be one each 2 ms"),
        ({"every": 20.0}, "mend", r"period_s = 0\.02,"),
        # A coarse encoder does not count as slow, at any speed.
        *(({"every": 1.0, "quantum": 1e-4, "speed": speed}, "pass", "100 %") for speed in (0.2, 0.6)),
        *(({"every": 1.0, "quantum": 1e-4, "speed": speed}, "unseen", "move it faster") for speed in (0.002, 0.02)),
        ({"every": 4.0, "quantum": 2e-5}, "mend", "at 25 %"),
        ({"every": 4.0, "quantum": 1e-4, "speed": 0.02}, "unseen", "move it faster"),
        ({"every": 1.0, "speed": 0.0}, "unseen", "it did not move: move it along every axis"),
        # With time stamps the rate is known even at rest, and for any encoder.
        ({"every": 1.0, "speed": 0.0, "stamped": True}, "pass", "100 %"),
        ({"every": 4.0, "quantum": 1e-4, "speed": 0.02, "stamped": True}, "mend", "at 25 %"),
        ({"every": 2.0, "speed": 0.0, "stamped": True}, "mend", "at 50 %"),
    ],
)
def test_a_device_that_is_slower_than_the_loop_is_told_from_one_that_moves_slowly(
    about: dict[str, Any], verdict: str, said: str
) -> None:
    found = renewed(**about)
    assert found[0] == verdict, found
    assert re.search(said, found[1]), found


def test_reads_that_are_late_say_nothing_of_the_renewal() -> None:
    time_s = np.cumsum(np.tile([1e-4, 1.9e-3], 1000))
    readings = [Reading((float(at),), None, None, None, None, None) for at in 0.02 * np.sin(9.0 * time_s)]
    found = check_renewal(time_s, readings, 1e-3, "[run] period_s")
    assert (found.verdict, "late" in found.text) == ("unseen", True), found


def test_a_slave_of_pose_must_have_all_parts() -> None:
    form = SampleForm("slave", "pose")
    assert form.take(SlaveSample([0.0] * 3, [0.0] * 3, [0.0] * 3)) is None
    assert form.problems["fields"].text == 'orientation is none: a slave of kind "pose" has it at every sample'


@pytest.mark.parametrize("kinds", [("linear",), ["pose"], ("linear", "joints")])
def test_kinds_that_there_are_pass(kinds: object) -> None:
    class Device:
        pass

    device = Device()
    assert check_kinds(device).verdict == "pass"
    device.kinds = kinds  # type: ignore[attr-defined]  # an attribute of drivers
    assert check_kinds(device).verdict == "pass"
    for bad in ("linear", (), ("line",), 3):
        device.kinds = bad  # type: ignore[attr-defined]  # an attribute of drivers
        assert check_kinds(device).verdict == "mend"
