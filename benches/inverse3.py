"""One tick of the driver `inverse3` against the emulated service: `read`, `write`, and whether 1 kHz is kept.

The emulator is a process in Python beside it, whose time is in the waits for a reply.
"""

import contextlib
import os
import re
import sys
import time
from pathlib import Path

import numpy as np

from _programs import HAPTETHER, running
from _report import add_number, bench_options, table_file, write_json
from haptether.master.inverse3 import Inverse3

EXAMPLE = "example: python benches/inverse3.py --ticks 10000 --json -"
PERIOD_S = 1e-3
WARM_UP = 100


def main() -> int:
    """Print p50 and p99 of a tick, and the achieved rate."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--ticks", 10_000, "ticks at 1 kHz")
    chosen = options.parse_args()
    with running(*HAPTETHER, "inverse3-emulator", "--port", "0", "--event-port", "0") as headline:
        ports = re.search(r":(\d+), events on (\d+)", headline)
        assert ports is not None
        with Path(os.devnull).open("w", encoding="utf-8") as unseen, contextlib.redirect_stderr(unseen):
            driver = Inverse3(port=int(ports[1]), event_port=int(ports[2]), grip="wireless", reply_timeout_s=0.015)
            driver.open()
            begun_s = time.perf_counter()
            taken, late = [], 0
            for tick in range(chosen.ticks + WARM_UP):
                due_s = begun_s + tick * PERIOD_S
                time.sleep(max(0.0, due_s - time.perf_counter()))
                before_s = time.perf_counter()
                fault = driver.read().fault
                driver.write((0.5, 0.0, 0.0))
                if fault is not None:
                    driver.close()
                    message = f"tick {tick}: {fault}"
                    raise RuntimeError(message)
                if tick >= WARM_UP:
                    taken.append(1e3 * (time.perf_counter() - before_s))
                    late += time.perf_counter() > due_s + PERIOD_S
            elapsed_s = time.perf_counter() - begun_s
            driver.close()
    report = {
        "ticks": chosen.ticks,
        "p50_ms": float(np.percentile(taken, 50)),
        "p99_ms": float(np.percentile(taken, 99)),
        "late": late,
        "rate_hz": (chosen.ticks + WARM_UP) / elapsed_s,
    }
    out = table_file(chosen.json)
    print(f"{chosen.ticks} ticks at {report['rate_hz']:.1f} Hz, {late} late", file=out)
    print(f"read and write  p50 {report['p50_ms']:.3f} ms, p99 {report['p99_ms']:.3f} ms", file=out)
    write_json(chosen.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
