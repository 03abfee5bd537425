"""The UR driver against a controller of plain objects: its calls, their order, and calls that it does not wait for."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.ur.fake_rtde import PERIOD_S, PLAYING, START_POSE, STOPPED, Arm, install

from haptether.bridge import DeviceError
from haptether.bridge.devices.standalone import StandaloneRun
from haptether.slave import SlaveSample, UrSlave
from haptether.slave.ur.checks import UNLOCK_AFTER_S, UrRefusedError
from haptether.slave.ur.connection import END_S, ClosedError, RtdeConnectionError
from haptether.slave.ur.plausible import MAX_WRONG
from haptether.slave.ur.services import Probe
from haptether.slave.ur.stop import REST_S, STOP_S

pytestmark = pytest.mark.slow

LONG_S = 20.0
BLOCKED_S = 0.3
"""Time in s that a call into the driver may take on a busy machine, while the library hangs for 30 s."""


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Iterator[Arm]:
    arm = Arm()
    install(monkeypatch, arm)
    yield arm
    arm.released.set()


class Driven:
    """A driver, stepped as by the loop.

    In `lockstep` each step waits until the thread of the library has made its calls, and the watchdog counts packages:
    its feeding then depends on the driver alone, and not on a machine that stalls.
    """

    def __init__(self, arm: Arm, *, lockstep: bool = False, **options: Any) -> None:  # noqa: ANN401
        self.arm = arm
        self.lockstep = lockstep
        self.driver = UrSlave(host="fake", **({"mode": "speedl"} | options))
        self.driver.open()
        self.home = START_POSE[0]
        if lockstep:
            arm.count_packages()

    def step(self, *, moving: bool = False, at: float = 0.0) -> SlaveSample:
        sample = self.driver.read()
        if moving and sample.fault is None:
            self.driver.write((self.home + at,), (0.0,))
        if self.lockstep:
            self.await_calls()
        return sample

    def await_calls(self) -> None:
        """Wait until the thread of the library has nothing to do."""
        worker, end_s = self.driver._connection.worker, time.monotonic() + LONG_S
        while worker._calls or worker._newest or worker._running:
            assert time.monotonic() < end_s, self.arm.names[-20:]
            time.sleep(1e-4)

    def until(self, holds: Callable[[SlaveSample], bool], *, moving: bool = False) -> SlaveSample:
        end_s = time.monotonic() + LONG_S
        while not holds(sample := self.step(moving=moving)):
            assert time.monotonic() < end_s, (sample, self.arm.names[-20:])
        return sample

    def moves(self) -> None:
        self.until(lambda _: self.arm.names[-1] == "speedL", moving=True)

    def fault(self, *, moving: bool = False) -> str:
        sample = self.until(lambda sample: sample.fault is not None, moving=moving)
        assert sample.fault is not None
        return sample.fault

    def ready(self) -> None:
        """Acknowledge, and wait until the driver could be engaged."""
        self.driver.acknowledge()
        self.until(lambda _: self.driver._recovery is None)


def test_the_watchdog_is_tried_and_armed_before_the_first_motion(arm: Arm) -> None:
    driven = Driven(arm, payload_kg=1.5, tool=[0.0] * 6)
    opened = arm.names
    assert opened.index("setPayload") < opened.index("zeroFtSensor") < opened.index("setWatchdog")
    # The watchdog fired, so the script was uploaded again.
    assert opened[-2:] == ["setWatchdog", "reuploadScript"]
    assert arm.watchdog_hz is None
    driven.moves()
    after = arm.names[len(opened) :]
    assert after[0] == "setWatchdog"
    assert after.index("setWatchdog") < after.index("speedL")
    assert arm.watchdog_hz == 10.0
    driven.driver.close()


def test_a_watchdog_that_does_not_bite_is_refused(arm: Arm) -> None:
    arm.watchdog_bites = False
    with pytest.raises(UrRefusedError, match="watchdog: does not bite"):
        Driven(arm, watchdog_hz=50)
    assert "speedL" not in arm.names


def test_a_refusal_leaves_no_script_behind(arm: Arm) -> None:
    driver = UrSlave(host="fake", mode="speedl")
    arm.watchdog_bites = False
    with pytest.raises(UrRefusedError):
        driver.open()
    # The loop closes a device that could not be opened.
    driver.close()
    assert "stopScript" in arm.names
    assert "kill" in arm.names


def test_an_arm_that_is_closed_while_it_recovers_is_not_connected_again(arm: Arm) -> None:
    driven = Driven(arm)
    # Packages still come, so only the control interface would be connected.
    stopped(arm)
    driven.fault()
    arm.blocks.add("probe")
    driven.driver.acknowledge()
    driven.driver.close()
    sent = len(arm.said)
    arm.released.set()
    end_s = time.monotonic() + 0.5
    while time.monotonic() < end_s:
        time.sleep(0.01)
    # It is neither started, nor killed after a start.
    assert {"connect", "kill"}.isdisjoint(arm.names[sent:])


def test_it_is_heard_while_it_waits(arm: Arm) -> None:
    driven = Driven(arm)
    end_s = time.monotonic() + 0.5
    while time.monotonic() < end_s:
        assert driven.step().fault is None
    assert arm.names.count("kickWatchdog") >= 5
    driven.driver.close()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"robot_mode": 5}, "robot mode: idle: power the arm on"),
        ({"safety_mode": 3, "safety_bits": 4}, "safety mode: protective stop: find the cause"),
        ({"safety_mode": 7, "safety_bits": 1 << 6}, "safety mode: robot emergency stop"),
        ({"runtime_state": 2, "version": (5, 11, 0, 0)}, "program: playing: somebody else's program"),
        ({"version": (5, 3, 0, 0), "runtime_state": 1}, "software: 5.3.0: needs"),
        ({"version": (3, 14, 9, 0), "runtime_state": 1}, "software: 3.14.9: needs"),
        ({"version": (4, 9, 0, 0), "runtime_state": 1}, "software: 4.9.0: needs"),
        ({"version": (10, 8, 0, 0), "runtime_state": 1}, "software: 10.8.0: needs 3.15 (CB3), or 5.4 and later"),
        ({"version": (10, 12, 0, 0), "runtime_state": 1}, "PolyScope X has no dashboard server"),
        ({"version": (11, 0, 0, 0), "runtime_state": 1}, "PolyScope X has no dashboard server"),
        (
            {"scripts_refused": True},
            "scripts: fake:30003: Connection refused: is the Real-Time Client interface enabled",
        ),
        ({"dashboard_gone": True}, "dashboard: dashboard: timed out: is the dashboard server enabled"),
        ({"dashboard_gone": True, "version": (5, 4, 0, 0)}, "dashboard: dashboard: timed out: is the dashboard server"),
        (
            {"dashboard_gone": True, "version": (3, 15, 0, 0)},
            "dashboard: dashboard: timed out: is the dashboard server",
        ),
        ({"remote": False, "runtime_state": 2, "orphaned": True}, "program: playing: somebody else's program"),
        ({"remote": False, "runtime_state": 1}, "remote control: off: switch the pendant"),
        ({"slider": 0.5, "runtime_state": 1}, "speed slider: 50 %: set it to 100 % on the pendant"),
    ],
)
def test_what_is_not_ready_is_refused_before_anything_is_sent(arm: Arm, change: dict[str, Any], said: str) -> None:
    for name, value in change.items():
        setattr(arm, name, value)
    with pytest.raises(UrRefusedError) as refused:
        Driven(arm)
    assert said in str(refused.value)
    assert arm.said == []


def test_a_control_script_of_an_earlier_run_is_ended_before_the_next(
    arm: Arm, capsys: pytest.CaptureFixture[str]
) -> None:
    arm.runtime_state, arm.orphaned = 2, True
    driven = Driven(arm)
    assert "ok       program: the control script of an earlier run played without a client" in capsys.readouterr().err
    driven.moves()
    driven.driver.close()


@pytest.mark.parametrize("how", ["does not start", "does not connect"])
def test_a_script_that_may_start_after_the_end_is_ended(arm: Arm, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    if how == "does not connect":
        arm.raises.add("connect")
    else:
        monkeypatch.setattr("haptether.slave.ur.connection.START_S", 0.05)
        monkeypatch.setattr("tests.ur.fake_rtde.Control.connect", lambda _: True)
        monkeypatch.setattr("tests.ur.fake_rtde.Control.reuploadScript", lambda _: True)
    driver = UrSlave(host="fake")
    with pytest.raises(UrRefusedError, match="control script: "):
        driver.open()
    assert arm.ends == 0
    driver.close()
    assert arm.ends == 1


def test_a_program_that_plays_at_the_end_is_stopped_once(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    driven.driver.close()
    assert "stopScript" in arm.names
    assert (arm.ends, arm.dashboard.count("stop")) == (0, 0)


@pytest.mark.parametrize(("plays", "said"), [(True, "a program still plays: stop it on the pendant"), (False, None)])
def test_a_program_that_plays_on_after_the_end_is_reported(
    arm: Arm, capsys: pytest.CaptureFixture[str], plays: bool, said: str | None
) -> None:
    driven = Driven(arm)
    driven.driver._soft_stop.cut()
    driven.until(lambda _: arm.runtime_state == STOPPED)
    if plays:
        arm.runtime_state = PLAYING
    driven.driver.close()
    ends = [line for line in capsys.readouterr().err.splitlines() if "at the end" in line]
    assert ends == ([] if said is None else [f"ur fake: at the end: {said}"])


def test_the_checklist_says_all_lines(arm: Arm, capsys: pytest.CaptureFixture[str]) -> None:
    Driven(arm, payload_kg=1.5).driver.close()
    said = capsys.readouterr().err
    for line in (
        "reachable", "software: 5.11.0", "scripts: port 30003", "remote control: on", "robot mode: running",
        "safety mode: normal",
        "speed slider: 100 %", "program: stopped", "workspace: no planes", "payload: 1.5 kg", "tool: ",
        "force sensor: zeroed", "watchdog: 10 Hz, tried",
    ):  # fmt: skip
        assert f"ur fake: ok       {line}" in said, said


@pytest.mark.parametrize("version", [(5, 11, 0, 0), (5, 25, 9, 0), (3, 15, 8, 0)])
def test_the_software_line_refuses_a_mode_that_it_lacks(
    arm: Arm, version: tuple[int, int, int, int], capsys: pytest.CaptureFixture[str]
) -> None:
    arm.version = version
    text = ".".join(map(str, version[:3]))
    with pytest.raises(UrRefusedError, match=f"^software: {text}: mode = 'direct-torque' needs 5.26 or later"):
        Driven(arm, mode="direct-torque")
    assert arm.said == []
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"ur fake: REFUSED  software: {text}: mode = ")


@pytest.mark.parametrize("call", ["connect", "getTCPOffset"])
def test_a_script_that_does_not_start_or_answer_is_refused_with_a_remedy(
    arm: Arm, call: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arm.raises.add(call)
    with pytest.raises(UrRefusedError, match=r"control script: .*Broken pipe: does a popup or the log of the pendant"):
        Driven(arm)
    assert "ur fake: REFUSED  control script: " in capsys.readouterr().err


def test_without_the_library_the_error_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(RtdeConnectionError, match=r"ur-rtde is not installed: install haptether\[ur\]"):
        UrSlave(host="127.0.3.99").open()


def test_a_first_command_elsewhere_is_refused(arm: Arm) -> None:
    driven = Driven(arm)
    driven.until(lambda _: driven.driver._watchdog.armed)
    driven.step(moving=True, at=0.012)
    assert "12.0 mm away from where the tool is" in driven.fault()
    assert "speedL" not in arm.names
    driven.driver.close()


def test_speed_is_bounded_whatever_is_commanded(arm: Arm) -> None:
    driven = Driven(arm, max_speed=0.1, axis=[0, 2, 0])
    driven.home = START_POSE[1]
    driven.moves()
    for tick in range(100):
        driven.step(moving=True, at=0.1 * tick)
    orders = [call[1] for call in arm.said if call[0] == "speedL"]
    assert max(sum(part**2 for part in xd[:3]) ** 0.5 for xd in orders) <= 0.1 + 1e-12
    # The tool moves along the axis only.
    assert max(abs(xd[0]) + abs(xd[2]) for xd in orders) < 1e-12
    driven.driver.close()


def test_an_arm_that_would_go_on_is_stopped_in_silence(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    # Nothing calls the driver any more, as if the bridge hung.
    end_s = time.monotonic() + LONG_S
    while "speedStop" not in arm.names:
        assert time.monotonic() < end_s
        time.sleep(0.001)
    assert arm.names.count("speedStop") == 1
    # The next order leads the arm from its present position.
    arm.kicked_s = time.monotonic()
    arm.runtime_state = 2
    driven.moves()
    driven.step(moving=True, at=0.02)
    assert driven.step().fault is None
    driven.driver.close()


def test_torques_begin_anew_after_silence(arm: Arm) -> None:
    arm.version = (5, 26, 0, 0)
    driven = Driven(arm, mode="direct-torque")
    driven.until(lambda _: arm.names[-1] == "directTorque", moving=True)
    end_s = time.monotonic() + LONG_S
    while "stopJ" not in arm.names:
        assert time.monotonic() < end_s
        time.sleep(0.001)
    # A person has moved the arm meanwhile: springs from its old position would throw it back with 30 N m.
    arm.q[1] += 0.1
    arm.kicked_s, arm.runtime_state = time.monotonic(), 2
    sent = len(arm.said)
    driven.until(lambda _: "directTorque" in arm.names[sent:], moving=True)
    (torque,) = next(call[1:] for call in arm.said[sent:] if call[0] == "directTorque")
    assert max(map(abs, torque)) < 1.0
    driven.driver.close()


def test_a_stop_returns_at_once_and_is_done_once(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    arm.blocks.add("speedStop")
    begun_s = time.monotonic()
    driven.driver.stop()
    driven.driver.stop()
    assert time.monotonic() - begun_s < BLOCKED_S
    arm.released.set()
    driven.until(lambda _: not driven.driver._soft_stop.stopping)
    assert arm.names.count("speedStop") == 1
    assert driven.step().fault is None
    driven.driver.close()


def test_a_stop_that_is_not_heard_ends_the_program(arm: Arm) -> None:
    driven = Driven(arm, watchdog_hz=5)
    driven.moves()
    arm.blocks.add("speedStop")
    arm.watchdog_bites = False
    driven.driver.stop()
    fault = driven.fault()
    assert "has not returned" in fault or "was not acknowledged" in fault
    driven.until(lambda _: "stop" in arm.dashboard)
    assert arm.runtime_state == STOPPED
    assert "kill" in arm.names
    driven.driver.close()


def test_an_arm_that_moves_on_after_its_stop_ends_the_program(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    arm.qd[2] = 0.3
    driven.driver.stop()
    begun_s = time.monotonic()
    assert driven.fault().startswith("a soft stop was acknowledged, and the arm still moves")
    # The fault comes only after the time that a soft stop may take.
    assert time.monotonic() - begun_s > STOP_S
    driven.until(lambda _: "stop" in arm.dashboard)
    assert "kill" in arm.names
    driven.driver.close()


def test_an_arm_that_rests_for_one_package_does_not_rest(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    driven.driver.stop()
    driven.until(lambda _: not driven.driver._soft_stop.heard)
    # The motion reverses.
    driven.step()
    arm.qd[2] = 0.3
    assert driven.fault().startswith("a soft stop was acknowledged, and the arm still moves")
    driven.driver.close()


def test_nothing_moves_an_arm_that_still_comes_to_rest(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    # A busy machine may see the arm at rest late.
    monkeypatch.setattr("haptether.slave.ur.stop.REST_S", LONG_S)
    driven = Driven(arm, lockstep=True)
    driven.moves()
    arm.qd[2] = 0.3
    driven.driver.stop()
    sent = len(arm.said)
    for _ in range(round(0.3 / PERIOD_S)):
        assert driven.step(moving=True).fault is None
    assert "speedL" not in arm.names[sent:]
    # The watchdog is fed all the while; its limit is 0.1 s.
    assert "kickWatchdog" in arm.names[sent:]
    arm.qd[2] = 0.0
    driven.until(lambda _: "speedL" in arm.names[sent:], moving=True)
    driven.driver.close()


def test_an_arm_that_rested_may_be_moved_by_somebody_else(arm: Arm) -> None:
    driven = Driven(arm, lockstep=True)
    driven.moves()
    driven.driver.stop()
    driven.until(lambda _: not driven.driver._soft_stop.stopping)
    arm.qd[2] = 0.3
    end_s = time.monotonic() + REST_S + 0.3
    while time.monotonic() < end_s:
        assert driven.step().fault is None
    driven.driver.close()


def test_a_stop_that_fails_is_reported_beside_the_fault_that_it_was_for(
    arm: Arm, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = Driven(arm, lockstep=True)
    driven.moves()
    arm.refuses.add("speedStop")
    slowed(arm)
    fault = driven.fault(moving=True)
    assert fault.startswith("speed slider at 70 %")
    driven.until(lambda _: "kill" in arm.names)
    assert "a soft stop was not acknowledged: the program is ended" in capsys.readouterr().err
    driven.until(lambda _: "stop" in arm.dashboard)
    assert driven.step().fault == fault
    driven.driver.close()


def test_a_stop_behind_a_call_that_hangs_ends_the_program(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    arm.watchdog_bites = False
    arm.blocks.add("speedL")
    sent = len(arm.said)
    # A stalled machine has paused the arm, which then goes on once it rested.
    driven.until(lambda _: "speedL" in arm.names[sent:], moving=True)
    # Something else stops the arm before the call is overdue.
    slowed(arm)
    assert driven.fault().startswith("speed slider")
    driven.until(lambda _: "stop" in arm.dashboard)
    assert "kill" in arm.names
    driven.driver.close()


def test_an_acknowledgement_clears_no_fault_that_was_not_shown(arm: Arm) -> None:
    driven = Driven(arm)
    driven.until(lambda _: driven.driver._watchdog.armed)
    driven.driver.write((driven.home + 0.012,), (0.0,))
    driven.driver.acknowledge()
    fault = driven.step().fault
    assert fault is not None
    assert "12.0 mm away from where the tool is" in fault
    driven.ready()
    assert driven.step().fault is None
    driven.driver.close()


def test_an_arm_that_was_closed_while_it_opened_is_not_connected(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = UrSlave(host="fake")

    def slow(host: str, limit_s: float = 5.0) -> Probe:
        driver.close()
        return arm.probe(host, limit_s)

    monkeypatch.setattr("haptether.slave.ur.checks.probe", slow)
    with pytest.raises(ClosedError, match="closed before it was open"):
        driver.open()
    assert arm.said == []


class Nothing:
    """A lead that writes nothing."""

    def step(self, sample: object, at_s: float) -> None:
        """Write nothing."""


@pytest.mark.parametrize("call", ["probe", "connect", "getTCPOffset", "zeroFtSensor", "setWatchdog", "reuploadScript"])
def test_an_arm_that_is_given_up_while_it_opens_reports_nothing_more_and_is_left_without_a_program(
    arm: Arm, call: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arm.blocks.add(call)
    arm.blocked.clear()
    run = StandaloneRun(UrSlave(host="fake", mode="speedl"), Nothing())
    assert arm.blocked.wait(20.0)
    capsys.readouterr()
    # The process of the library is killed, or the last call before it returns.
    threading.Timer(0.05, arm.released.set).start()
    begun_s = time.monotonic()
    assert run.end()
    assert time.monotonic() - begun_s < 2.5
    assert isinstance(run.error, DeviceError)
    assert isinstance(run.error.__cause__, ClosedError)
    assert capsys.readouterr().err == ""
    assert arm.runtime_state == STOPPED
    assert call == "probe" or "kill" in arm.names


@pytest.mark.parametrize(
    ("mode", "qd", "requested", "want"),
    [
        # The watchdog takes 0.1 s, of which 50 ms are for braking.
        ("servoj", 0.7, 5.0, 14.0),
        ("servol", 0.7, 5.0, 14.0),
        ("servoj", 0.2, 5.0, 5.0),
        ("servoj", 3.0, 5.0, 20.0),
        ("speedl", 0.0, 0.5, 4.0),
        ("direct-torque", 0.7, 5.0, 14.0),
    ],
)
def test_a_stop_ends_before_the_watchdog_would(arm: Arm, mode: str, qd: float, requested: float, want: float) -> None:
    arm.version = (5, 26, 0, 0)
    driven = Driven(arm, mode=mode, stop_deceleration=requested)
    order, call = {
        "servoj": ("servoJ", "servoStop"), "servol": ("servoL", "servoStop"), "speedl": ("speedL", "speedStop"),
        "direct-torque": ("directTorque", "stopJ"),
    }[mode]  # fmt: skip
    driven.until(lambda _: arm.names[-1] == order, moving=True)
    arm.qd[1], arm.speed[0] = -qd, 0.2
    # The fourth package is accepted, however fast the joint seems to have become.
    for _ in range(MAX_WRONG + 1):
        driven.step(moving=True)
    driven.driver.stop()
    arm.qd[1] = 0.0
    driven.until(lambda _: call in arm.names)
    assert arm.said[arm.names.index(call)][1] == pytest.approx(want)
    driven.driver.close()


@pytest.mark.parametrize("mode", ["servoj", "servol", "speedl"])
def test_an_arm_that_does_not_follow_is_a_fault(arm: Arm, mode: str) -> None:
    driven = Driven(arm, mode=mode, max_speed=0.1)
    driven.until(lambda _: driven.driver._watchdog.armed)
    # The arm accepts every command and stands still. The limit is 20 mm, plus 0.3 s and the lookahead at 0.1 m/s.
    begun_s = time.monotonic()
    fault, at = None, 0.0
    while fault is None:
        at = min(at + 0.0002, 0.5)
        fault = driven.step(moving=True, at=at).fault
        assert time.monotonic() - begun_s < LONG_S
    assert "the arm does not follow: 5" in fault
    assert "(allowed 55 mm)" in fault
    driven.driver.close()


def test_a_tool_outside_its_workspace_is_refused_before_it_moves(arm: Arm) -> None:
    with pytest.raises(UrRefusedError, match=r"workspace: 1 plane, the tool 84\.1 mm outside: move the tool inside"):
        Driven(arm, workspace=[[0.0, 0.0, 2.0, 0.6]])
    assert "speedL" not in arm.names


def test_the_workspace_is_for_the_tool_of_the_options(arm: Arm) -> None:
    """The pendant's tool is the flange, 84 mm outside; the tool of the options reaches inside."""
    arm.tool_moves = True
    Driven(arm, tool=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0], workspace=[[0.0, 0.0, 2.0, 0.6]]).driver.close()


@pytest.mark.parametrize("name", ["speedL", "kickWatchdog"])
def test_a_call_that_hangs_is_a_fault_and_nothing_waits_for_it(arm: Arm, name: str) -> None:
    driven = Driven(arm)
    arm.watchdog_bites = False
    arm.blocks.add(name)
    slowest = 0.0
    end_s = time.monotonic() + LONG_S
    while True:
        begun_s = time.monotonic()
        sample = driven.step(moving=name == "speedL")
        slowest = max(slowest, time.monotonic() - begun_s)
        if sample.fault is not None:
            break
        assert time.monotonic() < end_s
    assert f"{name} has not returned: the controller does not answer" in sample.fault
    assert slowest < BLOCKED_S
    begun_s = time.monotonic()
    driven.driver.close()
    assert time.monotonic() - begun_s < 5.0
    # The second way was taken, at the latest at the end.
    assert "stop" in arm.dashboard


def test_the_end_is_bounded_where_the_library_hangs(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    arm.blocks |= {"stopScript", "disconnect"}
    begun_s = time.monotonic()
    driven.driver.stop()
    driven.driver.close()
    # Both calls hang: each is awaited up to its limit.
    assert 2 * END_S <= time.monotonic() - begun_s < 5.0
    assert arm.names.index("stopScript") < arm.names.index("disconnect")
    assert "stop" in arm.dashboard


@pytest.mark.parametrize("how", ["refuses", "raises"])
def test_commands_that_fail_are_a_fault(arm: Arm, how: str) -> None:
    driven = Driven(arm)
    driven.moves()
    getattr(arm, how).add("speedL")
    assert "the controller takes no commands: speedL" in driven.fault(moving=True)
    driven.driver.close()


def emergency(arm: Arm) -> None:
    arm.safety_mode, arm.safety_bits, arm.runtime_state, arm.robot_mode = 7, 1 << 6 | 1 << 7 | 1 << 10, STOPPED, 3


def paused(arm: Arm) -> None:
    arm.runtime_state = 4


def stopped(arm: Arm) -> None:
    arm.runtime_state = STOPPED


def safeguard(arm: Arm) -> None:
    arm.safety_mode, arm.safety_bits, arm.runtime_state = 5, 1 << 4 | 1 << 10, 4


def violation(arm: Arm) -> None:
    arm.safety_mode, arm.safety_bits, arm.runtime_state = 8, 1 << 8 | 1 << 10, STOPPED


def frozen(arm: Arm) -> None:
    arm.frozen_at = 1.0


def closed(arm: Arm) -> None:
    arm.connected = False


def local(arm: Arm) -> None:
    arm.remote = False


def slowed(arm: Arm) -> None:
    arm.slider = 0.7


def powered_off(arm: Arm) -> None:
    arm.robot_mode, arm.runtime_state = 3, STOPPED


FAULTS: list[tuple[Callable[[Arm], None], str]] = [
    (Arm.stop_by_protection, "protective stop (seen: 0.0 N, 0.000 m/s, joint 6 0.0000 rad"),
    (emergency, "emergency stop: find its cause, release the button, power the arm on"),
    (safeguard, "safeguard stop: close the safeguard"),
    (violation, "safety system: violation"),
    (stopped, "the control script is stopped"),
    (paused, "the control script is paused"),
    (powered_off, "robot mode power off"),
    (frozen, "nothing has come from the controller for 1"),
    (closed, "the controller closed the connection"),
    (local, "remote control was switched off"),
    (slowed, "speed slider at 70 %: set it to 100 % on the pendant"),
]


@pytest.mark.parametrize(("cause", "said"), FAULTS, ids=lambda value: getattr(value, "__name__", None))
def test_each_fault_is_latched_with_its_reason(arm: Arm, cause: Callable[[Arm], None], said: str) -> None:
    driven = Driven(arm)
    driven.moves()
    before = len(arm.names)
    cause(arm)
    fault = driven.fault(moving=True)
    assert fault.startswith(said), fault
    # The arm is stopped, or its connection cut as a last resort, without a request.
    driven.until(lambda _: not {"speedStop", "kill"}.isdisjoint(arm.names[before:]))
    # The cause is gone by itself, but the fault stays until it is acknowledged.
    sent = len([name for name in arm.names if name == "speedL"])
    arm.runtime_state, arm.safety_mode, arm.safety_bits, arm.robot_mode = 2, 1, 1, 7
    arm.connected, arm.frozen_at, arm.remote, arm.slider = True, None, True, 1.0
    for _ in range(20):
        assert driven.step().fault == fault
        driven.driver.write((driven.home,), (0.0,))
    assert len([name for name in arm.names if name == "speedL"]) == sent
    driven.driver.close()


def test_a_fault_stops_an_arm_that_nothing_else_would_stop(arm: Arm) -> None:
    # A servo holds its last target, so silence of the commands does not end it.
    driven = Driven(arm, mode="servoj")
    driven.until(lambda _: arm.names[-1] == "servoJ", moving=True)
    local(arm)
    driven.fault(moving=True)
    driven.until(lambda _: "servoStop" in arm.names)
    driven.driver.close()


def test_a_process_that_does_not_connect_in_time_is_ended(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("haptether.slave.ur.connection.CONNECT_S", 0.2)
    arm.blocks.add("connect")
    with pytest.raises(UrRefusedError, match=r"connect \(control\): has not returned within 0.2 s"):
        Driven(arm)
    # Otherwise it would upload its script once it comes through, with nobody to arm the watchdog.
    assert arm.names[-1] == "kill"


def test_an_acknowledgement_makes_it_ready_and_leaves_it_disengaged(arm: Arm) -> None:
    driven = Driven(arm)
    driven.moves()
    stopped(arm)
    driven.fault()
    sent = len(arm.said)
    driven.ready()
    assert driven.step().fault is None
    again = arm.names[sent:]
    assert "reuploadScript" in again
    assert "zeroFtSensor" not in again
    assert "speedL" not in again
    # The watchdog was lost with the script.
    driven.until(lambda _: arm.watchdog_hz is not None)
    driven.moves()
    driven.driver.close()


def test_a_protective_stop_is_unlocked_by_a_person_and_not_at_once(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    driven = Driven(arm)
    driven.moves()
    arm.stop_by_protection()
    driven.fault()
    driven.driver.acknowledge()
    assert "can be unlocked in" in driven.fault()
    assert "unlock protective stop" not in arm.dashboard
    monkeypatch.setattr("haptether.slave.ur.checks.UNLOCK_AFTER_S", 0.0)
    assert UNLOCK_AFTER_S == 5.0
    driven.ready()
    assert driven.step().fault is None
    assert "unlock protective stop" in arm.dashboard
    driven.driver.close()


def test_an_emergency_stop_is_for_people_beside_the_arm(arm: Arm) -> None:
    driven = Driven(arm)
    emergency(arm)
    driven.fault()
    driven.driver.acknowledge()
    fault = driven.fault()
    assert "safety mode: robot emergency stop" in fault
    assert "robot mode: power off" in fault
    assert arm.dashboard.count("power on") == arm.dashboard.count("brake release") == 0
    driven.driver.close()


def test_a_lost_connection_is_made_anew(arm: Arm) -> None:
    driven = Driven(arm)
    closed(arm)
    driven.fault()
    driven.ready()
    assert driven.step().fault is None
    # The old process, which would reconnect by itself, is gone before.
    assert [name for name in arm.names if name in {"kill", "connect"}] == ["connect", "kill", "connect"]
    driven.driver.close()


def test_a_library_that_hangs_is_left_and_replaced(arm: Arm) -> None:
    driven = Driven(arm)
    arm.watchdog_bites = False
    arm.blocks.add("kickWatchdog")
    driven.fault()
    arm.blocks.clear()
    arm.watchdog_bites = True
    driven.ready()
    assert driven.step().fault is None
    assert arm.names.count("connect") == 2
    driven.driver.close()


def test_whoever_engages_too_early_begins_again(arm: Arm) -> None:
    driven = Driven(arm)
    stopped(arm)
    driven.fault()
    arm.blocks.add("reuploadScript")
    driven.driver.acknowledge()
    assert driven.step().fault is None
    driven.driver.write((driven.home,), (0.0,))
    assert "engaged before the arm was ready" in driven.fault()
    arm.released.set()
    driven.driver.close()


def test_positions_forces_and_axes(arm: Arm) -> None:
    arm.force = [1.0, -2.0, 3.0, 0.0, 0.0, 0.0]
    arm.speed = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]
    one = Driven(arm, axis=[0, 0, -2], force_filter_hz=None, zero_ft_sensor=False)
    sample = one.step()
    assert sample[:3] == pytest.approx((-START_POSE[2], -0.3, -3.0))
    one.driver.close()
    arm.runtime_state = STOPPED
    three = Driven(arm, axes=3, force_filter_hz=None, zero_ft_sensor=False)
    sample = three.step()
    assert sample.position == pytest.approx(START_POSE[:3])
    assert sample.velocity == pytest.approx((0.1, 0.2, 0.3))
    assert sample.force == pytest.approx((1.0, -2.0, 3.0))
    three.driver.close()
