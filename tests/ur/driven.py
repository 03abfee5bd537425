"""A hand and a UR arm of the real driver, in one process that can be killed: `python -m tests.ur.driven OPTIONS SCENE`.

Lines on standard input are commands (`ack`, `press`, `end`). Each line on standard output is an event with its time on
the system's monotonic clock, which the watching process shares.
"""

import json
import os
import select
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from haptether.bridge import LiveMaster, SlaveLoop, SlaveRun, load_scene, load_slave, scene_json

if TYPE_CHECKING:
    from collections.abc import Callable

LOOK_S = 0.001
LONGEST_S = 60.0
ENGAGED = 2
LATE = 500
"""Last engaged ticks whose forces are reported."""
MIN_M = 1e-7
"""Smallest distance that counts as motion, in m: above the rounding of an arm at rest."""


class Watched:
    """Both sides, and their reported states."""

    def __init__(self, options: dict[str, Any], overrides: list[str]) -> None:
        self.begun_s = time.monotonic()
        period = "slave.period_s=0.002"
        scene = load_scene("remote_push", [*overrides, period, "environment.pushers=[]", "operator.clutch=once"])
        spec, key = scene_json(scene), os.urandom(32)
        self.device: Any = load_slave("ur", options)
        loop = SlaveLoop(spec, listen="127.0.0.1:0", run_id=1, key=key)
        self.slave = SlaveRun(self.device, loop)
        while not self.slave.ready():
            time.sleep(LOOK_S)
        self.master = LiveMaster(spec, peer=loop.address, run_id=2, key=key)
        self._seen: dict[str, object] = {}

    def look(self) -> None:
        """Report changes."""
        for key, value in (
            ("slave", self.slave.state), ("master", self.master.state), ("fault", self.slave.notes.fault),
            ("recovering", self.device._recovery is not None), ("error", str(self.slave.error or "")),
        ):  # fmt: skip
            if self._seen.get(key) != value:
                self._seen[key] = value
                emit({key: value})

    def command(self, line: str) -> bool:
        """Run the command of a line; return false at the end."""
        commands: dict[str, Callable[[], None]] = {
            "ack": self.slave.acknowledge, "press": self.master.press_clutch, "end": lambda: None
        }  # fmt: skip
        commands[line]()
        return line != "end"

    def end(self) -> dict[str, Any]:
        """End both sides; return figures of the run."""
        begun_s = time.monotonic()
        trace, report = self.slave.finish()
        ended_s = time.monotonic() - begun_s
        near, _ = self.master.finish()
        engaged = trace.command.ravel()[~np.isnan(trace.command.ravel())]
        return {
            "end_s": ended_s,
            "latency_s": self.device.latency_s,
            "reaction_s": reaction_s(trace),
            "ticks": report.ticks,
            "skipped": report.skipped,
            "holds": report.holds,
            "travel_m": float(np.ptp(engaged)) if len(engaged) else 0.0,
            "arm_travel_m": float(np.ptp(trace.position.ravel())) if len(trace) else 0.0,
            "environment_force_n": float(np.abs(trace.environment_force).max(initial=0.0)),
            "device_force_n": float(np.abs(near.device_force).max(initial=0.0)),
            "felt_n": near.rendered_force.ravel()[near.state == ENGAGED][-LATE:].tolist(),
            "pressed_n": trace.environment_force.ravel()[trace.state == ENGAGED][-LATE:].tolist(),
        }


def reaction_s(trace: Any) -> float | None:  # noqa: ANN401  # SlaveTrace of one axis
    """Return the time from the first change of the command to the first motion, in s; None if either stays."""
    commanded, moved = (
        np.flatnonzero(np.abs(x - x[:1]) > MIN_M) for x in (trace.command.ravel(), trace.position.ravel())
    )
    return float(trace.time_s[moved[0]] - trace.time_s[commanded[0]]) if len(commanded) and len(moved) else None


def emit(event: dict[str, Any]) -> None:
    """Print an event for the watching process."""
    print(json.dumps({"at_s": time.monotonic(), **event}), flush=True)


def main() -> None:
    """Run until the end command, or until standard input ends."""
    watched = Watched(json.loads(sys.argv[1]), sys.argv[2:])
    going, waiting, end_s = True, b"", time.monotonic() + LONGEST_S
    while going and time.monotonic() < end_s:
        watched.look()
        if select.select([sys.stdin], [], [], LOOK_S)[0]:
            received = os.read(sys.stdin.fileno(), 4096)
            if not received:
                break
            *lines, waiting = (waiting + received).split(b"\n")
            for line in lines:
                going = watched.command(line.decode()) and going
    emit({"end": watched.end()})
    # Do not wait for threads whose call never returns, nor for the library's destructors.
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
