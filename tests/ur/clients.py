"""What the real ur_rtde does with the emulated controller: one scenario a process, its result as JSON on the last line.

`python -m tests.ur.clients SCENARIO HOST [ARGUMENTS]`. A call of ur_rtde that hangs cannot be interrupted from within,
so whoever runs this has a time-out and kills it.
"""

import contextlib
import itertools
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import dashboard_client  # type: ignore[import-not-found]  # they have no stubs
import numpy as np
import rtde_control  # type: ignore[import-not-found]
import rtde_io  # type: ignore[import-not-found]
import rtde_receive  # type: ignore[import-not-found]

START = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
PERIOD_S = 0.002
NO_TIMES = (0.0, 0.0)

Result = dict[str, Any]
SCENARIOS: dict[str, Callable[..., Result]] = {}


def scenario(function: Callable[..., Result]) -> Callable[..., Result]:
    """Makes a function known by its name."""
    SCENARIOS[function.__name__] = function
    return function


class Pace:
    """Absolute deadlines, and how late each was met; late ones are never dropped."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.late_s: list[float] = []
        self._due = time.perf_counter()

    def wait(self) -> None:
        """Waits for the next one."""
        self._due += self.period_s
        left = self._due - time.perf_counter()
        if left > 0.0:
            time.sleep(left)
        self.late_s.append(max(0.0, time.perf_counter() - self._due))


class Stream:
    """Control and Receive clients that stream at a rate, and what came of it.

    Args:
        host: Where the controller is.
        rate_hz: Calls a second.
    """

    def __init__(self, host: str, rate_hz: float = 500.0) -> None:
        self.rate_hz = rate_hz
        self.control = rtde_control.RTDEControlInterface(host)
        self.receive = rtde_receive.RTDEReceiveInterface(host)

    def run(
        self, seconds: float, command: Callable[[float], tuple[object, float]], stop: Callable[[], object]
    ) -> Result:
        """Commands, each with the time in s since the first; then what stops them.

        A command gives what its call returned, and the number that it asked for.
        """
        receive, rows, calls_s, accepted = self.receive, [], [], 0
        count = round(seconds * self.rate_hz)
        pace = Pace(1.0 / self.rate_hz)
        first = time.perf_counter()
        for _ in range(count):
            begin = time.perf_counter()
            # Of the time that it is, not that it should be: a machine that stalls delays a command, but bends no sine.
            returned, wanted = command(begin - first)
            accepted += bool(returned)
            calls_s.append(time.perf_counter() - begin)
            stamp = receive.getTimestamp()
            rows.append(
                (
                    begin - first,
                    wanted,
                    stamp,
                    time.perf_counter() - first,
                    *receive.getActualQ(),
                    *receive.getActualTCPPose(),
                    *receive.getActualTCPForce(),
                )
            )
            pace.wait()
        speed = receive.getActualTCPSpeed()
        stopped = stop()
        values = np.array(rows)
        gaps = np.diff(values[:, 2])
        return {
            "calls": count,
            "accepted": accepted,
            "stopped": stopped,
            "late_p99_s": float(np.quantile(pace.late_s, 0.99)),
            "late_max_s": max(pace.late_s),
            "call_p99_s": float(np.quantile(calls_s, 0.99)),
            "call_max_s": max(calls_s),
            "state_gap_max_s": float(gaps.max()),
            "state_steps_back": int((gaps < 0).sum()),
            "wall_s": values[:, 0].tolist(),
            "command": values[:, 1].tolist(),
            "time_s": values[:, 2].tolist(),
            "seen_s": values[:, 3].tolist(),
            "q": values[:, 4:10].tolist(),
            "pose": values[:, 10:16].tolist(),
            "force": values[:, 16:22].tolist(),
            "speed": speed,
            "runtime_state": receive.getRuntimeState(),
            "safety_mode": receive.getSafetyMode(),
        }

    def servoj(self, seconds: float, amplitude: float, frequency_hz: float) -> Result:
        """A sine of the first joint."""

        def command(t: float) -> tuple[object, float]:
            q = [START[0] + amplitude * (1.0 - np.cos(2 * np.pi * frequency_hz * t)), *START[1:]]
            return self.control.servoJ(q, *NO_TIMES, 1.0 / self.rate_hz, 0.1, 300), q[0]

        return self.run(seconds, command, self.control.servoStop)

    def servol(self, seconds: float, amplitude: float, frequency_hz: float) -> Result:
        """A sine of the tool along z."""
        pose = self.receive.getActualTCPPose()

        def command(t: float) -> tuple[object, float]:
            z = pose[2] + amplitude * (1.0 - np.cos(2 * np.pi * frequency_hz * t))
            return self.control.servoL([*pose[:2], z, *pose[3:]], *NO_TIMES, 1.0 / self.rate_hz, 0.1, 300), z

        return self.run(seconds, command, self.control.servoStop)

    def speedl(self, seconds: float, velocity: list[float], frequency_hz: float) -> Result:
        """A velocity of the tool, constant or as a cosine."""

        def command(t: float) -> tuple[object, float]:
            share = np.cos(2 * np.pi * frequency_hz * t)
            return self.control.speedL([share * v for v in velocity], 0.25, 0.0), share

        return self.run(seconds, command, self.control.speedStop)

    def speedj(self, seconds: float, velocity: list[float]) -> Result:
        """A constant velocity of the joints."""
        return self.run(seconds, lambda _: (self.control.speedJ(velocity, 0.5, 0.0), 0.0), self.control.speedStop)

    def force(self, seconds: float, wrench: list[float]) -> Result:
        """Force mode along x, sent anew in every period."""
        frame, selection, limits = [0.0] * 6, [1, 0, 0, 0, 0, 0], [0.1] * 6

        def command(_: float) -> tuple[object, float]:
            return self.control.forceMode(frame, selection, wrench, 2, limits), 0.0

        return self.run(seconds, command, self.control.forceModeStop)


@scenario
def streams(host: str, rate_hz: float, *runs: list[Any]) -> Result:
    """Modes one after another, each a name with its arguments, from the start each."""
    stream = Stream(host, rate_hz)
    results = {}
    for mode, *arguments in runs:
        results[mode] = getattr(stream, mode)(*arguments)
        stream.control.moveJ(list(START), 3.0, 20.0)
    stream.control.stopScript()
    return results


@scenario
def streams_first(host: str, rate_hz: float, *runs: list[Any]) -> Result:
    """The same under SCHED_FIFO, where that is granted: what else the machine does then delays nothing."""
    with contextlib.suppress(OSError):
        # Below the emulator: a client that waits for it must not hold it up.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))
    return streams(host, rate_hz, *runs)


@scenario
def latency(host: str, times: int) -> Result:
    """From a call of servoJ until a state shows that the target moves, and until RTDE has it."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    waits = []
    control.servoJ(list(START), *NO_TIMES, PERIOD_S, 0.03, 2000)
    for number in range(times):
        q = [START[0] + 0.02 * (1 - number % 2), *START[1:]]
        # What is left of the step before has decayed to 0.1 rad/s²; calls fall everywhere in the control cycle.
        time.sleep(0.2 + number % 8 * 0.00025)
        begin = time.perf_counter()
        control.servoJ(q, *NO_TIMES, PERIOD_S, 0.03, 2000)
        while abs(receive.getTargetQdd()[0]) < 5.0 and time.perf_counter() - begin < 1.0:
            time.sleep(0.0001)
        waits.append(time.perf_counter() - begin)
    control.servoStop()
    control.stopScript()
    return {"p50_s": float(np.median(waits)), "min_s": min(waits), "max_s": max(waits)}


@scenario
def moves(host: str) -> Result:
    """Moves, synchronous and asynchronous, along paths; and what ends them."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    result: Result = {}
    away = [*START[:5], 0.3]
    result["movej"] = control.moveJ(away, 2.0, 8.0)
    result["q"] = receive.getActualQ()
    result["movej_back"] = control.moveJ(list(START), 2.0, 8.0)
    pose = receive.getActualTCPPose()
    up = [*pose[:2], pose[2] + 0.05, *pose[3:]]
    result["movel"] = control.moveL(up, 0.5, 4.0)
    result["off_m"] = float(np.abs(np.subtract(receive.getActualTCPPose(), up)).max())
    result["movej_ik"] = control.moveJ_IK(pose, 2.0, 8.0)
    result["movel_fk"] = control.moveL_FK(list(START), 0.5, 4.0)
    result["async"] = control.moveJ(away, 2.0, 8.0, True)
    time.sleep(0.1)
    result["running"] = control.getAsyncOperationProgress()
    control.stopJ(2.0)
    result["stopped_at"] = receive.getActualQ()[5]
    result["ended"] = control.getAsyncOperationProgress()
    result["path"] = control.moveJ([[*START, 2.0, 8.0, 0.02], [*away, 2.0, 8.0, 0.0]])
    result["path_end"] = receive.getActualQ()
    result["custom"] = control.sendCustomScriptFunction("custom", "  set_standard_digital_out(3, True)\n")
    time.sleep(0.02)
    result["digital"] = receive.getActualDigitalOutputBits()
    control.stopScript()
    result["runtime_state"] = receive.getRuntimeState()
    return result


@scenario
def questions(host: str) -> Result:
    """What is set up and asked for."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    pose = receive.getActualTCPPose()
    result: Result = {"pose": pose}
    result["inverse"] = control.getInverseKinematics(pose)
    result["inverse_near"] = control.getInverseKinematics(pose, list(START), 1e-10, 1e-10)
    result["solution"] = control.getInverseKinematicsHasSolution(pose)
    result["no_solution"] = control.getInverseKinematicsHasSolution([2.0, 2.0, 2.0, 0.0, 0.0, 0.0])
    result["set_tcp"] = control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    result["tcp"] = control.getTCPOffset()
    time.sleep(0.02)
    result["tool_pose"] = receive.getActualTCPPose()
    result["payload"] = control.setPayload(1.5, [0.0, 0.0, 0.05])
    time.sleep(0.02)
    result["payload_kg"] = receive.getPayload()
    result["zero"] = control.zeroFtSensor()
    time.sleep(0.02)
    result["force"] = receive.getActualTCPForce()
    control.getStepTime()
    # The client reads the answer before the controller has given it: the second time it is there.
    time.sleep(0.02)
    result["step_time"] = control.getStepTime()
    result["steady"] = control.isSteady()
    result["within"] = [control.isJointsWithinSafetyLimits(list(START)), control.isPoseWithinSafetyLimits(pose)]
    result["forward"] = control.getForwardKinematics()
    result["jog"] = control.jogStart([0.0, 0.0, 0.02, 0.0, 0.0, 0.0], 0, 0.5)
    time.sleep(0.3)
    result["jog_speed"] = receive.getActualTCPSpeed()
    result["jog_stop"] = control.jogStop()
    result["contact"] = [
        control.startContactDetection(),
        control.readContactDetection(),
        control.stopContactDetection(),
    ]
    control.stopScript()
    return result


@scenario
def watchdog(host: str) -> Result:
    """A watchdog that is kept quiet by commands, then not."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    result: Result = {"armed": control.setWatchdog(10.0)}
    pace = Pace(PERIOD_S)
    begin = 0.0
    for _ in range(250):
        # Before the last command: the watchdog cannot have heard it earlier, however long this process is held up.
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
    """What a person does after a protective stop."""
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
def io(host: str) -> Result:
    """Digital and analog outputs, the speed slider, a second client beside it."""
    inputs_outputs = rtde_io.RTDEIOInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    result: Result = {
        "set": [
            inputs_outputs.setStandardDigitalOut(3, True),
            inputs_outputs.setConfigurableDigitalOut(1, True),
            inputs_outputs.setToolDigitalOut(0, True),
            inputs_outputs.setSpeedSlider(0.5),
            inputs_outputs.setAnalogOutputVoltage(0, 0.25),
            inputs_outputs.setInputIntRegister(20, 5),
            inputs_outputs.setInputDoubleRegister(20, 0.5),
        ]
    }
    time.sleep(0.05)
    result["bits"] = receive.getActualDigitalOutputBits()
    result["slider"] = receive.getTargetSpeedFraction()
    result["analog"] = receive.getStandardAnalogOutput0()
    inputs_outputs.setStandardDigitalOut(3, False)
    time.sleep(0.05)
    result["cleared"] = receive.getActualDigitalOutputBits()
    return result


@scenario
def two_controls(host: str) -> Result:
    """A second control client beside a first, which then goes and comes back."""
    first = rtde_control.RTDEControlInterface(host)
    try:
        rtde_control.RTDEControlInterface(host)
        refused = ""
    except RuntimeError as error:
        refused = str(error)
    receive = rtde_receive.RTDEReceiveInterface(host)
    first.disconnect()
    receive.disconnect()
    states = [first.reconnect(), receive.reconnect(), first.moveJ(list(START), 0.5, 1.0)]
    first.stopScript()
    return {"refused": refused, "states": states}


@scenario
def upper_registers(host: str) -> Result:
    """A control client in the upper range of the registers."""
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
    flags |= rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
    control = rtde_control.RTDEControlInterface(host, 500.0, flags)
    moved = control.moveJ([*START[:5], 0.1], 2.0, 8.0)
    offset = control.getTCPOffset()
    control.stopScript()
    return {"moved": moved, "offset": offset}


@scenario
def connect_control(host: str) -> Result:
    """Only connects."""
    try:
        control = rtde_control.RTDEControlInterface(host)
    except RuntimeError as error:
        return {"refused": str(error)}
    control.stopScript()
    return {"refused": ""}


@scenario
def lost(host: str, seconds: float) -> Result:
    """Streams servoJ and says what happens to each call, until it is told to end; tells when it begins."""
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


if __name__ == "__main__":
    _, name, address, arguments = [*sys.argv, "[]"][:4]
    print(json.dumps(SCENARIOS[name](address, *json.loads(arguments))))
    sys.stdout.flush()
    # Destructors of ur_rtde may wait for threads that wait for the network.
    os._exit(0)
