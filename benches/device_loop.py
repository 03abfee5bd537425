"""Cost of a driver in Python: a loop stepped from Python and the native loop, alternately in the same run.

Both run the master of the same scene under the same policy. They send to a socket that nobody reads and wait for the
same absolute deadlines, 1 ms apart. The stepped loop reads its device by a call into Python and back.

Two figures: how late each loop wakes, and how long a step takes from Python, conversions included, beside a call that
does nothing.
"""

import socket
import sys
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from _report import add_number, bench_options, print_table, table_file, write_json
from haptether.bridge import LiveMaster, MasterLoop, MasterRun, load_scene, scene_json
from haptether.master import MasterSample

EXAMPLE = "example: python benches/device_loop.py --rounds 4 --json -"
STEPS = 5_000


class Still:
    """Device at rest."""

    paces = False

    def open(self) -> None:
        """Do nothing."""

    def read(self) -> MasterSample:
        """Return the rest position."""
        return MasterSample(0.0)

    def write(self, force: tuple[float, ...]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def scene() -> bytes:
    """Return a one-axis scene with two controllers whose clutch is never pressed."""
    return scene_json(load_scene("remote_push", ["safety.controllers=[hsc, wsc]", "operator.clutch=[]"]))


def wakes(who: str, peer: str, seconds: float) -> npt.NDArray[np.float64]:
    """Return the overshoots in us of one run."""
    how: dict[str, Any] = {"peer": peer, "run_id": 1, "insecure": True, "patience_s": seconds}
    if who == "native":
        master: LiveMaster | MasterRun = LiveMaster(scene(), **how)
    else:
        master = MasterRun(Still(), MasterLoop(scene(), **how))
    while not master.finished:
        time.sleep(0.1)
    trace, _ = master.finish()
    return trace.overshoot_s[100:] * 1e6


def call_us(peer: str) -> tuple[float, float]:
    """Return the median time in us of a step, and of an extension call that does nothing."""
    loop = MasterLoop(scene(), peer=peer, run_id=1, insecure=True, realtime="off", keep_s=1.0)
    loop.begin()
    step, nothing = loop.step, loop.press_clutch
    took = np.empty((2, STEPS))
    for number in range(STEPS):
        # Samples that arrive within a period are held back.
        loop.wait()
        begun = time.perf_counter_ns()
        step(0.0)
        between = time.perf_counter_ns()
        nothing()
        took[:, number] = between - begun, time.perf_counter_ns() - between
    loop.finish()
    of_step, of_nothing = (float(np.median(row)) / 1e3 for row in took)
    return of_step, of_nothing


def main() -> int:
    """Measure and print the table."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--rounds", 4, "turns of each")
    add_number(options, "--seconds", 5.0, "of each turn", least=0.1)
    arguments = options.parse_args()
    out = table_file(arguments.json)
    pooled: dict[str, list[npt.NDArray[np.float64]]] = {"native": [], "python": []}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        peer = f"127.0.0.1:{sink.getsockname()[1]}"
        for number in range(arguments.rounds):
            order = ("native", "python") if number % 2 == 0 else ("python", "native")
            for who in order:
                pooled[who].append(wakes(who, peer, arguments.seconds))
        of_step, of_nothing = call_us(peer)
    report: dict[str, float] = {"turn_us": of_step, "empty_call_us": of_nothing}
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
    for who, runs in pooled.items():
        late = np.concatenate(runs)
        report |= {f"{who}_{name}_us": float(np.quantile(late, share)) for name, share in shares.items()}
    rows = [(who, *(f"{report[f'{who}_{name}_us']:.1f}" for name in shares)) for who in pooled]
    print_table(("wakes late, us", "p50", "p99", "p99.9"), rows, out)
    print(f"\na turn from Python takes {of_step:.1f} us, a call that does nothing {of_nothing:.2f} us", file=out)
    write_json(arguments.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
