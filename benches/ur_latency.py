"""How late a UR arm follows under each command, and what servoj's lookahead and gain cost.

The driver leads the emulated controller along a slow wave over the real ur_rtde; the delay is that of the tool's
position behind what was written. It includes the set-point's bounds, the process of the library, RTDE, the control
script, servoj or the position loop, and the model of the joints behind it: a real arm adds its own. Expected for servoj
and servol: the lookahead and 4 to 12 ms of transport. The overshoot of a step is that of
`q'' = gain (q_set - q - lookahead q')`.
"""

import math
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

from _programs import HAPTETHER, running
from _report import bench_options, print_table, table_file, write_json
from haptether.slave import UrSlave

EXAMPLE = "example: python benches/ur_latency.py --seconds 2 --json -"
HOST = "127.0.3.90"
SERVO = ((0.03, 2000.0), (0.03, 1000.0), (0.05, 1000.0), (0.05, 500.0), (0.1, 300.0), (0.2, 100.0))
WAVE_HZ = 0.3
AMPLITUDE_M = 0.03
MAX_TRIES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Measurements with some options."""

    mode: str
    version: str
    options: dict[str, float]
    latency_s: float | None
    period_p50_s: float
    period_p99_s: float
    overshoot: float | None
    """Overshoot of a step in the model of servoj."""


def overshoot(lookahead_s: float, gain: float) -> float:
    """Return `exp(-pi z / sqrt(1 - z^2))` for a step, z = lookahead sqrt(gain) / 2.

    Source: any text on second-order systems.
    """
    damping = 0.5 * lookahead_s * math.sqrt(gain)
    return 0.0 if damping >= 1.0 else math.exp(-math.pi * damping / math.sqrt(1.0 - damping * damping))


def measure(mode: str, version: str, options: dict[str, float], seconds: float) -> Row:
    """Lead an emulated arm for a time in s."""
    with running(*HAPTETHER, "ur-emulator", "--host", HOST, "--version", version, "--control", "-"):
        # The first cycles have passed by then.
        time.sleep(1.0)
        # A shared machine may stall for longer than the default's 100 ms.
        arm = UrSlave(host=HOST, mode=mode, watchdog_hz=5.0, **options)
        arm.open()
        try:
            return Row(
                mode=mode, version=version, options=options, **_led(arm, seconds), overshoot=_model(mode, options)
            )
        finally:
            arm.close()


def _model(mode: str, options: dict[str, float]) -> float | None:
    return overshoot(options["lookahead_time"], options["gain"]) if mode in {"servoj", "servol"} else None


def _led(arm: UrSlave, seconds: float) -> dict[str, Any]:
    home = arm.read().position
    assert isinstance(home, float)
    for _ in range(50):
        arm.read()
    rate = 2.0 * math.pi * WAVE_HZ
    begun_s = before_s = time.monotonic()
    periods = []
    while (t := time.monotonic() - begun_s) < seconds:
        sample = arm.read()
        if sample.fault is not None:
            raise RuntimeError(sample.fault)
        now_s = time.monotonic()
        periods.append(now_s - before_s)
        before_s, t = now_s, now_s - begun_s
        away = AMPLITUDE_M * (1.0 - math.cos(rate * t))
        arm.write((home + away,), (AMPLITUDE_M * rate * math.sin(rate * t),))
    latency_s = arm.latency_s
    arm.stop()
    for _ in range(50):
        arm.read()
    periods.sort()
    return {
        "latency_s": latency_s,
        "period_p50_s": periods[len(periods) // 2],
        "period_p99_s": periods[int(0.99 * len(periods))],
    }


def main() -> int:
    """Measure all rows."""
    line = bench_options(__doc__, EXAMPLE)
    line.add_argument("--seconds", type=float, default=5.0, help="of motion for each row")
    arguments = line.parse_args()
    modes = [("servoj", "5.11", {"lookahead_time": lookahead_s, "gain": gain}) for lookahead_s, gain in SERVO]
    modes += [
        ("servol", "5.11", {"lookahead_time": 0.05, "gain": 1000.0}),
        ("speedl", "5.11", {"position_gain": 10.0}),
        ("direct-torque", "5.26", {}),
    ]
    rows = []
    for mode, version, options in modes:
        for left in reversed(range(MAX_TRIES)):
            try:
                rows.append(measure(mode, version, options, arguments.seconds))
                break
            except RuntimeError as error:
                # On a machine that stalls for 100 ms the driver stops, as required.
                print(f"{mode} {options}: {error}", file=sys.stderr)
                if not left:
                    raise
    lines = (
        (row.mode, ", ".join(f"{key} {value:g}" for key, value in row.options.items()),
         None if row.latency_s is None else f"{1e3 * row.latency_s:.0f} ms",
         None if row.overshoot is None else f"{100 * row.overshoot:.0f} %",
         f"{1e3 * row.period_p50_s:.2f} ms", f"{1e3 * row.period_p99_s:.2f} ms")
        for row in rows
    )  # fmt: skip
    heads = ("mode", "options", "latency", "overshoot of a step", "period p50", "p99")
    print_table(heads, lines, table_file(arguments.json))
    write_json(arguments.json, [asdict(row) for row in rows])
    return 0


if __name__ == "__main__":
    sys.exit(main())
