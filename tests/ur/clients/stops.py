"""Stops of an arm: by its watchdog, its safety system, a lost network."""

import itertools
import time

import dashboard_client  # type: ignore[import-not-found]  # they have no stubs
import rtde_control  # type: ignore[import-not-found]
import rtde_receive  # type: ignore[import-not-found]
from tests.ur.clients.scenario import NO_TIMES, PERIOD_S, START, Pace, Result, scenario


@scenario
def watchdog(host: str) -> Result:
    """Feed a watchdog by commands, then stop."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    result: Result = {"armed": control.setWatchdog(10.0)}
    pace = Pace(PERIOD_S)
    begin = 0.0
    for _ in range(250):
        # Measured before the last command: the watchdog cannot have heard it earlier, even if this process is delayed.
        begin = time.perf_counter()
        control.speedL([0.0, 0.0, 0.02, 0.0, 0.0, 0.0], 0.5)
        pace.wait()
    result["streaming"] = control.isProgramRunning()
    while control.isProgramRunning() and time.perf_counter() - begin < 2.0:
        time.sleep(0.001)
    result["stopped_after_s"] = time.perf_counter() - begin
    time.sleep(0.2)
    result["speed"] = receive.getActualTCPSpeed()
    result["refused"] = control.speedL([0.0] * 6, 0.5)
    control.reuploadScript()
    time.sleep(0.2)
    result["again"] = control.moveJ(list(START), 0.5, 1.0)
    control.stopScript()
    return result


@scenario
def dashboard(host: str) -> Result:
    """Act like a person after a protective stop."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    client = dashboard_client.DashboardClient(host)
    client.connect()
    result: Result = {
        "version": client.polyscopeVersion(),
        "modes": [client.robotmode(), client.safetymode(), client.safetystatus()],
        "running": client.running(),
        "remote": client.isInRemoteControl(),
        "model": client.getRobotModel(),
        "program": client.programState(),
    }
    result["stop_call"] = control.triggerProtectiveStop()
    time.sleep(0.05)
    result["stopped"] = [receive.isProtectiveStopped(), receive.getSafetyMode(), control.isProgramRunning()]
    result["refused"] = control.moveJ(list(START), 0.5, 1.0)
    try:
        client.unlockProtectiveStop()
        result["too_early"] = ""
    except RuntimeError as error:
        result["too_early"] = str(error)
    time.sleep(0.6)
    client.unlockProtectiveStop()
    client.closeSafetyPopup()
    time.sleep(0.05)
    result["unlocked"] = [receive.isProtectiveStopped(), receive.getSafetyMode()]
    control.reuploadScript()
    time.sleep(0.2)
    result["moves"] = control.moveJ(list(START), 0.5, 1.0)
    client.pause()
    time.sleep(0.05)
    result["paused"] = [receive.getRuntimeState(), control.servoJ(list(START), *NO_TIMES, PERIOD_S, 0.1, 300)]
    client.play()
    time.sleep(0.05)
    result["resumed"] = control.moveJ(list(START), 0.5, 1.0)
    client.stop()
    time.sleep(0.05)
    result["ended"] = receive.getRuntimeState()
    client.loadURP("rtde_control.urp")
    client.popup("hello")
    client.addToLog("hello")
    client.powerOff()
    time.sleep(0.05)
    result["off"] = [client.robotmode(), receive.getRobotMode()]
    client.powerOn()
    client.brakeRelease()
    result["on"] = client.robotmode()
    client.quit()
    return result


@scenario
def lost(host: str, seconds: float) -> Result:
    """Stream servoJ and report the outcome of each call until the end; print a line at the beginning."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    print("streaming", flush=True)
    pace = Pace(PERIOD_S)
    outcomes: list[tuple[float, str]] = []
    stamps: list[tuple[float, float]] = []
    begin = time.perf_counter()
    while (now := time.perf_counter() - begin) < seconds:
        try:
            outcome = str(control.servoJ(list(START), *NO_TIMES, PERIOD_S, 0.1, 300))
        except RuntimeError as error:
            outcome = f"error: {error}"
        if not outcomes or outcomes[-1][1] != outcome:
            outcomes.append((now, outcome))
        stamp = receive.getTimestamp()
        if not stamps or stamps[-1][1] != stamp:
            stamps.append((now, stamp))
        pace.wait()
    gaps = [(b[0] - a[0], a[0]) for a, b in itertools.pairwise(stamps)]
    return {
        "outcomes": outcomes,
        "longest_silence_s": max(gaps)[0] if gaps else None,
        "last_state_s": stamps[-1][0],
        "connected": [control.isConnected(), receive.isConnected()],
    }
