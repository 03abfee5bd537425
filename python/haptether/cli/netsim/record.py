"""`haptether netsim record`."""

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.netsim import Recording

MIN_PROGRESS_S = 2.0
"""Time in s; a measurement that takes no longer shows no progress bar."""


@dataclass(frozen=True, kw_only=True)
class Record(FileOptions):
    """Measure a real network to a `haptether netsim echo` and back, and write a file that netsim replays.

    The probes leave at a constant rate, each is answered, and the answer tells when the probe arrived. Only the round
    trip is certain. Its split into the two ways assumes that the quickest probes take the same time both ways.

    `sample` and `proxy` replay the file with --trace, a scene with `trace = { file = "network.csv" }` in [link.forward]
    and [link.backward]; each direction takes the delays of its own.

    Examples:

    haptether netsim record 192.0.2.7:9200 --rate 500 --duration-s 60 --csv network.csv

    haptether netsim sample --trace network.csv --packets 30000 --rate 500 --plot network.png
    """

    peer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="HOST:PORT")]
    """Address of the echo."""
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 1000.0
    """Probes per second, at most 1000."""
    duration_s: Annotated[float, tyro.conf.arg(metavar="S")] = 10.0
    """Duration in s."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="PATH.csv")] = None
    """Write time_s, forward_delay_s, backward_delay_s, a row per probe; an empty cell is a loss."""
    no_realtime: bool = False
    """Do not ask for real-time scheduling."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the summary as JSON; - for standard output."""

    def run(self) -> int:
        """Measure the network and print the findings."""
        from haptether.cli.shared.output import check_target, write_report
        from haptether.netsim import record
        from haptether.private_file import begin_private

        check_target(self.csv, self.json, force=self.force)
        if str(self.csv) == "-":
            message = "csv = -: must be a file: netsim replays it"
            raise ValueError(message)
        with _progress(self.peer, self.duration_s):
            recording = record(self.peer, rate_hz=self.rate, duration_s=self.duration_s, realtime=not self.no_realtime)
        if self.csv is not None:
            begin_private(self.csv)
            recording.write_csv(self.csv)
        figures = summarised(recording)
        self._print(figures, recording.peer)
        report = {
            "peer": self.peer,
            "address": recording.peer,
            "rate_hz": self.rate,
            "duration_s": self.duration_s,
            **figures,
        }
        write_report(self.json, report)
        return 0

    def _print(self, figures: "dict[str, float | int | None]", address: str) -> None:
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.table import Column, Rows

        def ms(name: str) -> str:
            value = figures[name]
            return "-" if value is None else f"{value * 1e3:.3f} ms"

        def lost(direction: str) -> str:
            count, sent = figures[f"lost_{direction}"] or 0, figures[f"sent_{direction}"] or 0
            return f"{count} of {sent}" + (f" ({count / sent:.2%})" if sent else "")

        console = screen(self.json)
        labels = ("round trip", "forward (estimated)", "backward (estimated)")
        table = Rows(f"{figures['probes']} probes", *(Column(label, numbers=True) for label in labels))
        for percent in ("p50", "p99"):
            paths = ("round_trip", "forward", "backward")
            table.add(percent, *(ms(f"{path}_{percent}_s") for path in paths))
        table.add("lost", "", lost("forward"), lost("backward"))
        table.add("worst gap", ms("worst_gap_s"), "", "")
        console.print(table)
        shortest = ms("shortest_s")
        lines = [
            f"only the sum of both ways is certain; taken to be alike where the round trip was shortest, {shortest},",
            "each may be wrong by up to half of that",
            f"probes went to {address} and left up to {ms('latest_s')} late",
        ]
        if self.csv is not None:
            lines.append(f"replay it: haptether netsim sample --trace {self.csv}, or in a scene's [link.forward] and "
                         f'[link.backward]: trace = {{ file = "{self.csv}" }}')  # fmt: skip
        for line in lines:
            console.print_item(line)


def summarised(recording: "Recording") -> "dict[str, float | int | None]":
    """Return the figures of a measurement; `None` where nothing arrived."""
    import numpy as np

    forward, backward = recording.forward_delay_s, recording.backward_delay_s
    answered = ~(np.isnan(forward) | np.isnan(backward))
    of_paths = {
        "round_trip": (forward + backward)[answered],
        "forward": forward[answered],
        "backward": backward[answered],
    }
    arrivals = np.sort((recording.time_s + forward + backward)[answered])
    sent = len(recording)
    return {
        "probes": sent,
        **{
            f"{path}_{name}_s": float(np.quantile(delays, share)) if delays.size else None
            for path, delays in of_paths.items()
            for name, share in (("p50", 0.5), ("p99", 0.99))
        },
        "sent_forward": sent,
        "lost_forward": recording.lost_forward,
        "sent_backward": sent - recording.lost_forward,
        "lost_backward": recording.lost_backward,
        "worst_gap_s": float(np.diff(arrivals).max()) if arrivals.size > 1 else None,
        "shortest_s": recording.shortest_s,
        "offset_s": recording.offset_s,
        "drift": recording.drift,
        "latest_s": recording.latest_s,
    }


@contextlib.contextmanager
def _progress(peer: str, duration_s: float) -> Iterator[None]:
    """Show the progress of a measurement that runs in this thread."""
    if not MIN_PROGRESS_S < duration_s < float("inf"):
        yield
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from haptether.cli.shared.screen import Screen

    text = TextColumn("{task.description}", markup=False)
    bar = Progress(text, BarColumn(), TimeRemainingColumn(), console=Screen(stderr=True))
    ended = threading.Event()
    begun = time.monotonic()

    def follow() -> None:
        # After this time a refusal has been raised.
        if ended.wait(1.0):
            return
        with bar:
            task = bar.add_task(f"measuring the way to {peer} and back", total=duration_s)
            while not ended.wait(0.2):
                bar.update(task, completed=time.monotonic() - begun)

    following = threading.Thread(target=follow, name="haptether-progress", daemon=True)
    following.start()
    try:
        yield
    finally:
        ended.set()
        following.join()
