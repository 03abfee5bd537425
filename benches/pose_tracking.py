"""How well a UR arm follows poses under each command: errors of position and orientation, and the fastest joint.

The driver leads the emulated controller over the real ur_rtde. First along a figure in space in which the tool turns
by 60 degrees to and fro; then through a turn of 1 rad that takes joint 5 from 0.5 rad through zero, where the wrist is
singular: about the axis of joint 5, and beside it, where joint 4 must go round.

Errors are those of the measured tool from what was commanded in the same moment, so that what is late counts: lookahead
and transport times the speed. Joints are held to the largest speed of the model.
"""

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np

from _programs import HAPTETHER, running
from _report import bench_options, print_table, table_file, write_json
from haptether.slave import UrKinematics, UrSlave, ur_model
from ur.figures import Path, apart, figure, turn

EXAMPLE = "example: python benches/pose_tracking.py --mode servoj --json -"
HOST = "127.0.3.95"
VERSION = "5.26"
MODEL = ur_model("ur5e")
START = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
BENT = 0.5
"""Angle of joint 5 in rad before its singularity."""
MODES = ("servoj", "servol", "speedl", "direct-torque")
PATHS = ("figure", "singularity", "beside it")
OPTIONS = {"max_angular_speed": 2.0, "watchdog_hz": 5.0}
"""A shared machine may stall for longer than the default watchdog's 100 ms."""
SETTLE_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Measurements of a mode along a path."""

    mode: str
    path: str
    seconds: float
    """Seconds of motion, until the end or the fault."""
    worst_m: float
    worst_rad: float
    p95_m: float
    """95 % of the samples are below; occasional stalls of the machine do not change it."""
    p95_rad: float
    end_rad: float
    speed: float
    """Largest command in m/s, and in rad/s."""
    angular_speed: float
    latency_s: float | None
    fastest_joint: float
    """Largest speed of a joint as a share of its limit."""
    joint_5: tuple[float, float]
    """Start and end angle in rad."""
    worst_gap_s: float
    """Longest time between two samples."""
    fault: str


@contextmanager
def emulated(host: str, start: tuple[float, ...]) -> Iterator[None]:
    """Run a controller in its own process."""
    command = (*HAPTETHER, "ur-emulator", "--host", host, "--version", VERSION, "--control", "-")
    with running(*command, "--start", *map(str, start)):
        # The first cycles have passed by then.
        time.sleep(SETTLE_S)
        yield


def begin_of(name: str) -> tuple[float, ...]:
    """Return the initial joint angles of a path."""
    return START if name == "figure" else (*START[:4], BENT, START[5])


def path_of(name: str, home: tuple[float, ...]) -> tuple[Path, float]:
    """Return a path from a pose of the controller, and its seconds."""
    if name == "figure":
        return figure(home, amplitude_m=0.05, angle=math.radians(60.0), period_s=8.0), 9.0
    _, jacobian = UrKinematics(MODEL).forward_and_jacobian(begin_of(name))
    axis = -(jacobian[3:, 4] + (0.3 if name == "beside it" else 0.0) * jacobian[3:, 3])
    return turn(home, axis=(axis / np.linalg.norm(axis)).tolist(), angle=2.0 * BENT, speed=0.8), 2.6


def measure(mode: str, name: str, host: str) -> Row:
    """Lead an emulated arm along a path."""
    with emulated(host, begin_of(name)):
        arm = UrSlave(host=host, mode=mode, axes=3, **OPTIONS)
        arm.open()
        try:
            return _led(arm, mode, name)
        finally:
            arm.close()


def _led(arm: UrSlave, mode: str, name: str) -> Row:
    for _ in range(50):
        arm.read()
    home = arm._state.pose
    path, seconds = path_of(name, home)
    rows, q5, fault = [], [], ""
    begun_s = before_s = time.monotonic()
    while (now_s := time.monotonic()) - begun_s < seconds:
        sample = arm.read()
        now_s = time.monotonic()
        wanted = path(now_s - begun_s)
        state = arm._state
        rows.append((
            *apart(state.pose, wanted),
            math.hypot(*wanted.velocity),
            math.hypot(*wanted.angular_velocity),
            max(abs(rate) / most for rate, most in zip(state.qd, MODEL.max_speed, strict=True)),
            now_s - before_s,
        ))  # fmt: skip
        q5.append(state.q[4])
        before_s = now_s
        if sample.fault is not None:
            fault = sample.fault
            break
        arm.write(wanted.position, wanted.velocity, wanted.orientation, wanted.angular_velocity)
    latency_s = arm.latency_s
    arm.stop()
    for _ in range(50):
        arm.read()
    metres, radians, speed, angular_speed, joints, gaps = np.array(rows).T
    return Row(
        mode=mode,
        path=name,
        seconds=now_s - begun_s,
        worst_m=float(metres.max()),
        worst_rad=float(radians.max()),
        p95_m=float(np.quantile(metres, 0.95)),
        p95_rad=float(np.quantile(radians, 0.95)),
        end_rad=float(radians[-1]),
        speed=float(speed.max()),
        angular_speed=float(angular_speed.max()),
        latency_s=latency_s,
        fastest_joint=float(joints.max()),
        joint_5=(q5[0], q5[-1]),
        worst_gap_s=float(gaps[1:].max()),
        fault=fault,
    )


def main() -> int:
    """Measure all rows."""
    line = bench_options(__doc__, EXAMPLE)
    line.add_argument("--mode", choices=MODES, action="append", help="this one alone; may be given again")
    line.add_argument("--path", choices=PATHS, action="append", help="this one alone; may be given again")
    line.add_argument("--host", default=HOST, help=f"address of the emulated controller (default {HOST})")
    arguments = line.parse_args()
    rows = [measure(mode, path, arguments.host) for mode in arguments.mode or MODES for path in arguments.path or PATHS]
    heads = ("mode", "path", "m", "95 %", "rad", "95 %", "at the end", "fastest joint", "joint 5", "worst gap", "fault")
    lines = (
        (row.mode, row.path, f"{1e3 * row.worst_m:.1f} mm", f"{1e3 * row.p95_m:.1f} mm", f"{row.worst_rad:.3f}",
         f"{row.p95_rad:.3f}", f"{row.end_rad:.3f} rad", f"{100 * row.fastest_joint:.0f} %",
         f"{row.joint_5[0]:.2f} to {row.joint_5[1]:.2f}", f"{1e3 * row.worst_gap_s:.1f} ms", row.fault)
        for row in rows
    )  # fmt: skip
    print_table(heads, lines, table_file(arguments.json))
    write_json(arguments.json, [asdict(row) for row in rows])
    return 0


if __name__ == "__main__":
    sys.exit(main())
