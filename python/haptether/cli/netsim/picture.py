"""The picture of `haptether netsim sample`."""

from pathlib import Path

import numpy as np

from haptether.netsim import Verdicts
from haptether.private_file import private_file

MAX_POINTS = 5000


def draw_sample(verdicts: Verdicts, path: Path) -> None:
    """Delays over time with what was lost, and how often each delay occurs."""
    from matplotlib.figure import Figure

    packets = verdicts.packets
    arrived = packets.t_out_ns >= 0
    sent_s = packets.t_in_ns * 1e-9
    delay_ms = (packets.t_out_ns - packets.t_in_ns) * 1e-6
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    over_time, often = figure.subplots(1, 2, width_ratios=(2, 1), sharey=True)
    first = slice(0, MAX_POINTS)
    over_time.plot(sent_s[first][arrived[first]], delay_ms[first][arrived[first]], ".", markersize=2)
    top = float(delay_ms[arrived].max()) if arrived.any() else 1.0
    lost = sent_s[first][~arrived[first]]
    over_time.plot(lost, np.full(lost.size, 1.04 * top), "|", color="tab:red", label=f"lost ({(~arrived).mean():.2%})")
    over_time.set(xlabel="sent [s]", ylabel="one-way delay [ms]")
    over_time.legend(loc="center right")
    often.hist(delay_ms[arrived], bins=100, orientation="horizontal")
    often.set(xlabel="packets", xscale="log")
    with private_file(path) as file:
        figure.savefig(file, dpi=120, format=path.suffix[1:] or "png")
