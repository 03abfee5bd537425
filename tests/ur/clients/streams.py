"""Commands at a rate in every mode, and the delay until a command shows."""

import contextlib
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rtde_control  # type: ignore[import-not-found]  # they have no stubs
import rtde_receive  # type: ignore[import-not-found]
from tests.ur.clients.scenario import NO_TIMES, PERIOD_S, START, Pace, Result, scenario


class Stream:
    """Control and Receive clients that stream at a rate, with their measurements.

    Args:
        host: Address of the controller.
        rate_hz: Calls per second.
    """

    def __init__(self, host: str, rate_hz: float = 500.0) -> None:
        self.rate_hz = rate_hz
        self.control = rtde_control.RTDEControlInterface(host)
        self.receive = rtde_receive.RTDEReceiveInterface(host)

    def run(
        self, seconds: float, command: Callable[[float], tuple[object, float]], stop: Callable[[], object]
    ) -> Result:
        """Call `command` with the time in s since the first call, then `stop`.

        A command returns the result of its call, and the requested number.
        """
        receive, rows, calls_s, accepted = self.receive, [], [], 0
        count = round(seconds * self.rate_hz)
        pace = Pace(1.0 / self.rate_hz)
        first = time.perf_counter()
        for _ in range(count):
            begin = time.perf_counter()
            # The actual time counts, not the due time: a stalled machine delays a command, but does not bend the sine.
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
        """Run a sine of the first joint."""

        def command(t: float) -> tuple[object, float]:
            q = [START[0] + amplitude * (1.0 - np.cos(2 * np.pi * frequency_hz * t)), *START[1:]]
            return self.control.servoJ(q, *NO_TIMES, 1.0 / self.rate_hz, 0.1, 300), q[0]

        return self.run(seconds, command, self.control.servoStop)

    def servol(self, seconds: float, amplitude: float, frequency_hz: float) -> Result:
        """Run a sine of the tool along z."""
        pose = self.receive.getActualTCPPose()

        def command(t: float) -> tuple[object, float]:
            z = pose[2] + amplitude * (1.0 - np.cos(2 * np.pi * frequency_hz * t))
            return self.control.servoL([*pose[:2], z, *pose[3:]], *NO_TIMES, 1.0 / self.rate_hz, 0.1, 300), z

        return self.run(seconds, command, self.control.servoStop)

    def speedl(self, seconds: float, velocity: list[float], frequency_hz: float) -> Result:
        """Run a velocity of the tool, constant or as a cosine."""

        def command(t: float) -> tuple[object, float]:
            share = np.cos(2 * np.pi * frequency_hz * t)
            return self.control.speedL([share * v for v in velocity], 0.25, 0.0), share

        return self.run(seconds, command, self.control.speedStop)

    def speedj(self, seconds: float, velocity: list[float]) -> Result:
        """Run a constant velocity of the joints."""
        return self.run(seconds, lambda _: (self.control.speedJ(velocity, 0.5, 0.0), 0.0), self.control.speedStop)

    def force(self, seconds: float, wrench: list[float]) -> Result:
        """Run force mode along x, sent again in every period."""
        frame, selection, limits = [0.0] * 6, [1, 0, 0, 0, 0, 0], [0.1] * 6

        def command(_: float) -> tuple[object, float]:
            return self.control.forceMode(frame, selection, wrench, 2, limits), 0.0

        return self.run(seconds, command, self.control.forceModeStop)


@scenario
def streams(host: str, rate_hz: float, *runs: list[Any]) -> Result:
    """Run modes one after another, each a name with its arguments, from the first posture."""
    stream = Stream(host, rate_hz)
    results = {}
    for mode, *arguments in runs:
        results[mode] = getattr(stream, mode)(*arguments)
        stream.control.moveJ(list(START), 3.0, 20.0)
    stream.control.stopScript()
    return results


@scenario
def streams_first(host: str, rate_hz: float, *runs: list[Any]) -> Result:
    """Run the same under SCHED_FIFO, if granted: other work of the machine then delays nothing."""
    with contextlib.suppress(OSError):
        # Below the emulator: a client that waits for it must not block it.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))
    return streams(host, rate_hz, *runs)


@scenario
def latency(host: str, times: int) -> Result:
    """Measure the time from a call of servoJ until a state shows that the target moves, and until RTDE has it."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    waits = []
    control.servoJ(list(START), *NO_TIMES, PERIOD_S, 0.03, 2000)
    for number in range(times):
        q = [START[0] + 0.02 * (1 - number % 2), *START[1:]]
        # The previous step has decayed to 0.1 rad/s²; calls fall everywhere in the control cycle.
        time.sleep(0.2 + number % 8 * 0.00025)
        begin = time.perf_counter()
        control.servoJ(q, *NO_TIMES, PERIOD_S, 0.03, 2000)
        while abs(receive.getTargetQdd()[0]) < 5.0 and time.perf_counter() - begin < 1.0:
            time.sleep(0.0001)
        waits.append(time.perf_counter() - begin)
    control.servoStop()
    control.stopScript()
    return {"p50_s": float(np.median(waits)), "min_s": min(waits), "max_s": max(waits)}
