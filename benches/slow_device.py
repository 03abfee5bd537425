"""HSC's trips and the error of V of a device that has a new sample every few ticks of a loop at 1 kHz.

A hand strokes against a remote wall of 100 N/m with 5 cm at 0.8 Hz and a tremor of 9 Hz; the encoder has 23 um. The
layer gets the last sample at each tick, as a driver gives it that does not wait for a new one.

No requirement: `check-device` refuses all rows but the first.
"""

import sys
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from _report import add_number, bench_options, print_table, table_file, write_json
from haptether.safety import DeviceModel, Renewal, SafetyLayer, SafetySettings

EXAMPLE = "example: python benches/slow_device.py --json -"
PARTS = ((0.05, 5.0, 0.0), (0.0003, 2.0 * np.pi * 9.0, 1.0))
"""Amplitude in m, frequency in rad/s, phase."""
STIFFNESS, QUANTUM_M, PERIOD_S, SETTLED_S = 100.0, 2.3e-5, 1e-3, 1.0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Figures of one device."""

    every_ms: float
    renewal: float | None
    """As `Renewal` measures it."""
    velocity_error: float
    """RMS, in m/s."""
    trips: int
    tripped: float
    """Share of the time under intervention."""


def hand(time_s: Array) -> tuple[Array, Array]:
    """Position in m and velocity in m/s."""
    x = sum(a * np.sin(w * time_s + p) for a, w, p in PARTS)
    v = sum(a * w * np.cos(w * time_s + p) for a, w, p in PARTS)
    return np.asarray(x), np.asarray(v)


def measured(every_ms: float, seconds: float) -> Row:
    """The layer over a run with one device."""
    time_s = np.asarray(np.arange(round(seconds / PERIOD_S)) * PERIOD_S, dtype=np.float64)
    every_s = every_ms * 1e-3
    sampled_s = np.floor(time_s / every_s + 1e-9) * every_s
    x = np.round(hand(sampled_s)[0] / QUANTUM_M) * QUANTUM_M
    renewal = Renewal()
    for position in x.tolist():
        renewal.step((position,))
    layer = SafetyLayer(DeviceModel.phantom_desktop(), SafetySettings(["hsc"]), period_s=PERIOD_S)
    ticks = layer.run(x, -np.maximum(0.0, STIFFNESS * hand(time_s)[0]))
    settled = slice(round(SETTLED_S / PERIOD_S), None)
    error = ticks.velocity[settled] - hand(time_s)[1][settled]
    on = ticks.tripped[settled] > 0
    rms, trips = float(np.sqrt(np.mean(error**2))), int(np.sum(on[1:] & ~on[:-1]))
    return Row(every_ms, renewal.total_share, rms, trips, float(on.mean()))


def main() -> int:
    """Print the table."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--seconds", 60.0, "of each run", least=5.0, most=600.0)
    arguments = options.parse_args()
    rows = [measured(every_ms, arguments.seconds) for every_ms in (1.0, 1.25, 2.0, 4.0, 8.0)]
    first = rows[0]
    print_table(
        ("sample each ms", "renewal", "V error m/s", "times", "trips", "times", "on"),
        (
            (f"{row.every_ms:g}", row.renewal and f"{row.renewal:.2f}", f"{row.velocity_error:.4f}",
             f"{row.velocity_error / first.velocity_error:.1f}", row.trips,
             f"{row.trips / max(first.trips, 1):.1f}", f"{row.tripped:.1%}")
            for row in rows
        ),
        table_file(arguments.json),
    )  # fmt: skip
    write_json(arguments.json, {"rows": [asdict(row) for row in rows]})
    return 0


if __name__ == "__main__":
    sys.exit(main())
