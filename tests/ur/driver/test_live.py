"""The real ur_rtde in the real driver under the bridge, with an emulated controller as another process.

Hanging calls of the library cannot be interrupted from within, so the driver runs in a process that is killed by its
id.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from tests.ur.emulated import Emulated, emulator, free_host
from tests.ur.stalls import anew_after_stalls
from tests.ur.watching import Watching, driven

from haptether.slave import UrSlave

pytest.importorskip("rtde_control")
pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

MEND_S = 10.0
CALM = {"watchdog_hz": 5.0}
"""A shared machine may stall for longer than the default of 100 ms, and the watchdog then fires."""
SHARED_S = 0.35
"""Time in s that a shared machine may add to a time limit, because it delays three processes."""
PERIOD_S = 0.002
LATE_S = 0.02
"""Lateness in s at which an engaged loop holds."""
FASTEST_S = 2 * 7 / 8 * PERIOD_S
"""Least time in s from a command to the motion: the controller's next cycle hears it, the one after moves the arm. Two
ticks of the loop are at least 7/8 of a period apart."""
SLOWEST_S = 0.03 + SHARED_S / 5
"""20 ms of transport, and the begin of the slowest ramp."""


def engaged(watching: Watching, since_s: float = 0.0) -> float:
    """Return the time at which both were coupled."""
    events = [watching.wait_for(side, "engaged", since_s=since_s, patience_s=15.0) for side in ("slave", "master")]
    return max(float(event["at_s"]) for event in events)


class ModeRow(NamedTuple):
    """A mode and its permitted latency: ramp lag and transport, with room for a busy machine."""

    mode: str
    version: str
    options: dict[str, Any]
    latency_s: tuple[float, float]


MODES = [
    # The ramp lag of q'' = gain (q_set - q - lookahead q') is the lookahead; transport takes 4 to 20 ms.
    ModeRow("servoj", "5.11", {"lookahead_time": 0.03, "gain": 2000}, (0.03, 0.09)),
    ModeRow("servol", "5.11", {"lookahead_time": 0.1, "gain": 300}, (0.08, 0.16)),
    ModeRow("speedl", "5.23", {}, (0.0, 0.05)),
    ModeRow("direct-torque", "5.26", {}, (0.0, 0.09)),
]


FORCES = {"mode": "direct-torque", "max_speed": 0.5}
TAKES_FORCE = ("slave.takes_force=true", "slave.mass_kg=10.0", "safety.controllers=[]", "operator.release.at_s=100")


@pytest.mark.parametrize(
    ("kind", "stiffness", "damping", "lasts_s"),
    [("position-force-computed", 200.0, 15.0, 10.0), ("pd-damped", 200.0, 30.0, 6.0)],
)
@anew_after_stalls
def test_an_arm_that_takes_forces_presses_with_that_of_the_coupling(
    kind: str, stiffness: float, damping: float, lasts_s: float
) -> None:
    coupling = (f"coupling.kind={kind}", f"coupling.stiffness={stiffness}", f"coupling.damping={damping}")
    host = free_host()
    with (
        emulator("--scene", "remote_push", "--version", "5.26", host=host),
        driven({**CALM, **FORCES, "host": host}, *TAKES_FORCE, *coupling) as watching,
    ):
        at_s = engaged(watching)
        while time.monotonic() < at_s + lasts_s:
            watching.look(0.05)
        figures = watching.end()
    assert not [event for event in watching.events if event.get("fault")], watching.events
    # The hand of 300 N/m is 45 mm behind a wall of 100 N/m; the device has 0.038 N of friction.
    shared_n = 0.045 / (1.0 / 300.0 + 1.0 / stiffness + 1.0 / 100.0)
    assert figures["pressed_n"] == pytest.approx([shared_n] * 500, abs=0.05)
    assert figures["felt_n"] == pytest.approx([shared_n] * 500, abs=0.1)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("row", MODES, ids=lambda row: row.mode)
@anew_after_stalls
def test_a_hand_leads_the_arm_into_a_wall_and_feels_it(row: ModeRow) -> None:
    host = free_host()
    with emulator("--scene", "remote_push", "--version", row.version, host=host) as emulated:
        with driven({**CALM, "host": host, "mode": row.mode, **row.options}) as watching:
            at_s = engaged(watching)
            while time.monotonic() < at_s + 1.5:
                watching.look(0.05)
            figures = watching.end()
        status = emulated.status()
    assert not [event for event in watching.events if event.get("fault")], watching.events
    # The hand moves 65 mm, minus its deflection in contact: the arm has followed the whole command.
    assert figures["travel_m"] > 0.02
    assert figures["arm_travel_m"] > 0.02
    assert figures["environment_force_n"] > 0.5
    assert figures["device_force_n"] > 0.5
    assert figures["end_s"] < 5.0
    # It has understood every command, is at rest, and no program plays.
    assert status["runtime_state"] == "STOPPED"
    assert math.hypot(*status["tcp_speed"][:3]) < 1e-3
    assert status["safety_mode"] == "NORMAL"
    # The transmitted velocity compensates for transport in speedl and direct-torque: the least latency found is 0.
    low, high = row.latency_s
    assert figures["latency_s"] is not None
    assert low <= figures["latency_s"] <= high + SHARED_S / 5, figures
    # Nothing moves before it is commanded, even with a transmitted velocity.
    assert FASTEST_S <= figures["reaction_s"] <= SLOWEST_S, figures


class FaultRow(NamedTuple):
    """A fault, its remedy, and the driver's text; the cause's own limits in s."""

    name: str
    fault: str
    said: str
    limits_s: tuple[float, float]
    mend: Callable[[Emulated], None]
    """Actions of people beside the arm."""


def nothing(_: Emulated) -> None:
    """Do nothing."""


def released(emulated: Emulated) -> None:
    """Turn the button back, and power the arm."""
    emulated.do("release-emergency-stop")
    emulated.do("power on")
    emulated.wait_for("robot_mode", "RUNNING")


def powered(emulated: Emulated) -> None:
    emulated.do("power on")
    emulated.wait_for("robot_mode", "RUNNING")


def remote(emulated: Emulated) -> None:
    emulated.do("remote-control on")


def full_speed(emulated: Emulated) -> None:
    emulated.do("slider 1")


# RTDE reports a state within a package, so at any time. Silence is detected after 100 ms; the package before it may be
# as old as that of an engaged loop. Remote control is queried once per second, so at any time.
FAULTS = [
    FaultRow("emergency stop", "emergency-stop", "emergency stop: find its cause", (0.0, 0.05), released),
    FaultRow("program stopped", "stop-program", "the control script is stopped", (0.0, 0.05), nothing),
    FaultRow("program paused", "pause-program", "the control script is paused", (0.0, 0.05), nothing),
    FaultRow("power off", "power off", "robot mode power off", (0.0, 0.05), powered),
    FaultRow("remote control off", "remote-control off", "remote control was switched off", (0.0, 2.2),
             remote),
    FaultRow("speed slider down", "slider 0.5", "speed slider at 50 %", (0.0, 0.05), full_speed),
    FaultRow("network gone for 0.4 s", "freeze 0.4", "nothing has come from the controller for 1",
             (0.1 - LATE_S, 0.125), nothing),
    FaultRow("connections closed", "drop all", "the controller closed the connection", (0.0, 0.05), nothing),
]  # fmt: skip


@anew_after_stalls
def test_every_fault_ends_in_fault_and_goes_on_only_after_a_person() -> None:
    host = free_host()
    seen: list[str] = []
    with emulator(host=host) as emulated, driven({**CALM, "host": host, "verify_watchdog": False}) as watching:
        begun_s = engaged(watching)
        # Packages are once late by 60 ms: older than 20 ms is a hold, only older than 100 ms a fault.
        at_s = time.monotonic()
        emulated.do("freeze 0.06")
        took_s = watching.wait_for("slave", "hold", "stop", since_s=at_s)["at_s"] - at_s
        # A loop that is late by more than 20 ms holds; the last package arrived at most a period before the silence.
        assert 0.02 - PERIOD_S <= took_s <= 0.06 + SHARED_S, took_s
        time.sleep(0.1)
        press_s = time.monotonic()
        watching.command("press")
        engaged(watching, since_s=press_s)
        assert not [event for event in watching.events if event.get("fault")]
        for row in FAULTS:
            time.sleep(0.2)
            at_s = time.monotonic()
            emulated.do(row.fault)
            event = watching.wait_for("slave", "fault", since_s=at_s, patience_s=row.limits_s[1] + 10.0)
            took_s = event["at_s"] - at_s
            said = watching.wait_for("fault", since_s=at_s)["fault"]
            assert said.startswith(row.said), (row.name, said)
            min_s, max_s = row.limits_s
            assert min_s <= took_s <= max_s + SHARED_S, (row.name, took_s)
            watching.wait_for("master", "hold", "stop", since_s=at_s)
            seen.append(f"{row.name}: {1e3 * took_s:.0f} ms")
            # The arm rests.
            end_s = time.monotonic() + 5.0
            while math.hypot(*emulated.status()["tcp_speed"][:3]) > 1e-3:
                assert time.monotonic() < end_s, row.name
            row.mend(emulated)
            time.sleep(0.3)
            ack_s = recover(watching)
            watching.wait_for("slave", "disengaged", since_s=ack_s)
            watching.command("press")
            begun_s = engaged(watching, since_s=ack_s)
            assert begun_s > ack_s
            assert emulated.status()["watchdog_hz"] == CALM["watchdog_hz"], row.name
        figures = watching.end()
    assert figures["end_s"] < 5.0
    print("\n".join(seen))


def until_said(watching: Watching, said: str, since_s: float, key: str = "fault") -> None:
    """Wait for a text."""
    event = watching.wait_for(key, since_s=since_s, patience_s=15.0)
    while said not in str(event[key]):
        event = watching.wait_for(key, since_s=event["at_s"] + 1e-6, patience_s=15.0)


def recover(watching: Watching) -> float:
    """Acknowledge until the arm is ready; return the time of the acknowledgement."""
    end_s = time.monotonic() + MEND_S
    while True:
        ack_s = time.monotonic()
        watching.command("ack")
        watching.wait_for("recovering", True, since_s=ack_s)
        done_s = watching.wait_for("recovering", False, since_s=ack_s, patience_s=MEND_S)["at_s"]
        for _ in range(3):
            watching.look(0.02)
        faults = [event for event in watching.events if event["at_s"] >= done_s - 0.01 and event.get("fault")]
        if not faults:
            return ack_s
        assert time.monotonic() < end_s, faults
        time.sleep(0.3)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("mode", ["servoj", "servol", "speedl", "direct-torque"])
@anew_after_stalls
def test_a_soft_stop_from_full_speed_ends_before_the_watchdog(mode: str) -> None:
    """0.2 m/s at 0.5 m/s² or rad/s² would take 0.4 s or longer; the watchdog waits for 0.1 s."""
    host = free_host()
    with emulator("--version", "5.26", host=host) as emulated:
        arm = UrSlave(host=host, mode=mode, stop_deceleration=0.5, verify_watchdog=False)
        arm.open()
        try:
            at_m = arm.read().position
            assert isinstance(at_m, float)
            armed_s = time.monotonic() + 0.3
            while time.monotonic() < armed_s:
                assert arm.read().fault is None
            begun_s = time.monotonic()
            while (t := time.monotonic() - begun_s) < 0.4:
                assert arm.read().fault is None
                # Half a second of constant acceleration to 0.2 m/s, and on.
                arm.write((at_m + 0.25 * t * t,), (0.5 * t,))
            assert math.hypot(*emulated.status()["tcp_speed"][:3]) > 0.1
            arm.stop()
            stopped_s = time.monotonic()
            while time.monotonic() < stopped_s + 0.4:
                assert arm.read().fault is None
            status = emulated.status()
            assert status["runtime_state"] == "PLAYING"
            assert math.hypot(*status["tcp_speed"][:3]) < 1e-3
        finally:
            arm.close()


@anew_after_stalls
def test_a_force_presses_on_a_wall_until_the_loop_is_silent() -> None:
    host = free_host()
    with emulator("--scene", "paper_wall", "--version", "5.26", host=host) as emulated:
        arm = UrSlave(host=host, mode="direct-torque", verify_watchdog=False, **CALM)
        arm.open()
        try:
            begun_s = time.monotonic()
            while time.monotonic() < begun_s + 4.0:
                sample = arm.read()
                assert sample.fault is None
                assert isinstance(sample.velocity, float)
                # The wall has no damping.
                arm.write_force((-5.0 - 60.0 * sample.velocity,))
            assert isinstance(sample.force, float)
            # The arm settles with 1.6 /s: slowest mode of its joints on that wall, as in test_forces.
            assert sample.force == pytest.approx(5.0, abs=5.0 * math.exp(-1.6 * 3.5))
            # A loop that hangs for longer than 20 ms: the driver's own thread stops the arm, before the watchdog.
            time.sleep(0.1)
            status = emulated.status()
            assert status["runtime_state"] == "PLAYING"
            assert math.hypot(*status["tcp_speed"][:3]) < 1e-3
            resumed_s = time.monotonic()
            while time.monotonic() < resumed_s + 2.0:
                sample = arm.read()
                assert sample.fault is None
                assert isinstance(sample.velocity, float)
                arm.write_force((-2.0 - 60.0 * sample.velocity,))
            assert sample.force == pytest.approx(2.0, abs=5.0 * math.exp(-1.6 * 1.9))
        finally:
            arm.close()
        assert emulated.status()["runtime_state"] == "STOPPED"


@anew_after_stalls
def test_a_controller_that_somebody_else_leads_is_refused() -> None:
    host = free_host()
    with emulator(host=host) as emulated:
        emulated.do("in-use on")
        with driven({"host": host, "mode": "speedl"}) as watching:
            until_said(watching, "UrRefusedError: control script: connect (control): ", 0.0, "error")
            said = watching.wait_for("error", since_s=1e-9)
            watching.end()
    assert said is not None


@anew_after_stalls
def test_a_protective_stop_is_unlocked_after_5_s_by_a_person() -> None:
    host = free_host()
    with emulator(host=host) as emulated, driven({**CALM, "host": host, "verify_watchdog": False}) as watching:
        engaged(watching)
        at_s = time.monotonic()
        # This exceeds the limit of 150 N.
        emulated.do("push 400 0.05")
        event = watching.wait_for("slave", "fault", since_s=at_s)
        assert event["at_s"] - at_s < 0.1 + SHARED_S
        said = watching.wait_for("fault", since_s=at_s)["fault"]
        assert said.startswith("protective stop (seen: ")
        watching.command("ack")
        until_said(watching, "protective stop: can be unlocked in", at_s)
        assert emulated.status()["safety_mode"] == "PROTECTIVE_STOP"
        # The emulator, like a real controller, refuses before 5 s after the stop.
        time.sleep(max(0.0, at_s + 5.3 - time.monotonic()))
        ack_s = recover(watching)
        assert emulated.status()["safety_mode"] == "NORMAL"
        watching.command("press")
        engaged(watching, since_s=ack_s)
        watching.end()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("mode", ["servoj", "speedl"])
@anew_after_stalls
def test_a_controller_that_dies_is_a_fault_and_the_end_is_bounded(mode: str) -> None:
    host = free_host()
    with (
        emulator(host=host) as emulated,
        driven({**CALM, "host": host, "mode": mode, "verify_watchdog": False}) as watching,
    ):
        engaged(watching)
        at_s = time.monotonic()
        emulated.process.kill()
        event = watching.wait_for("slave", "fault", since_s=at_s)
        assert event["at_s"] - at_s < 0.125 + SHARED_S
        said = watching.wait_for("fault", since_s=at_s)["fault"]
        assert said.startswith("the controller closed the connection"), said
        watching.command("ack")
        # It probes before it calls the library again: at most 5 s, or a network error at once.
        until_said(watching, f"{host}:30004: connect: ", event["at_s"])
        assert watching.end()["end_s"] < 5.0


@anew_after_stalls
def test_an_arm_whose_driver_is_killed_stops_by_its_watchdog() -> None:
    host = free_host()
    with emulator(host=host) as emulated, driven({"host": host, "mode": "speedl", "watchdog_hz": 10}) as watching:
        engaged(watching)
        end_s = time.monotonic() + 10.0
        while math.hypot(*emulated.status()["tcp_speed"][:3]) < 0.005:
            # A stalled machine has made it hold before the hand moved.
            watching.look(0.01)
            if [event["slave"] for event in watching.events if "slave" in event][-1] == "hold":
                watching.command("press")
            assert time.monotonic() < end_s, watching.events
        at_s = time.monotonic()
        watching.process.kill()
        emulated.wait_for("runtime_state", "STOPPED", patience_s=5.0)
        took_s = time.monotonic() - at_s
        # 100 ms after the last command, which may be as old as that of an engaged loop.
        assert 0.1 - LATE_S < took_s < 0.1 + 0.1 + SHARED_S
        end_s = time.monotonic() + 5.0
        while math.hypot(*emulated.status()["tcp_speed"][:3]) > 1e-3:
            assert time.monotonic() < end_s


@anew_after_stalls
def test_a_controller_that_says_nothing_does_not_hold_the_interpreter() -> None:
    host = free_host()
    with emulator(host=host) as emulated:
        emulated.do("freeze 30")
        with driven({"host": host}) as watching:
            until_said(watching, "UrRefusedError: reachable: ", 0.0, "error")
            assert watching.end()["end_s"] < 5.0
