"""`haptether slave` that writes its ticks to a file at its end: `python -m tests.ur.engaging TRACE.npz ARGUMENTS`."""

import sys

import numpy as np

from haptether.bridge import LoopReport, SlaveRun, SlaveTrace
from haptether.cli.entry import main

if __name__ == "__main__":
    path, *arguments = sys.argv[1:]
    finish = SlaveRun.finish

    def traced(run: SlaveRun) -> tuple[SlaveTrace, LoopReport]:
        trace, report = finish(run)
        np.savez(path, time_s=trace.time_s, state=trace.state, overshoot_s=trace.overshoot_s)
        return trace, report

    SlaveRun.finish = traced  # type: ignore[method-assign,assignment]  # the command itself keeps no ticks
    sys.exit(main(["slave", *arguments]))
