"""The processes and the page of `haptether try` in this process, and what a test asks of them."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.live.control_client import Control

from haptether.bridge import load_scene
from haptether.cli.view.trial.bridges import TrialBridges
from haptether.cli.view.trial.record import TrialRecord
from haptether.view.trial.server import Choice, Network, Trial

NAMES = ("left", "right")
CHOICE = Choice(controllers={"left": "none", "right": "wsc"})


POLL_S = 0.05
"""Time in s between two looks: the server runs in this process, and its aims must not wait for them."""


def wait_until(condition: Callable[[], bool], within_s: float = 30.0) -> None:
    """Wait for a condition, looking rarely."""
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(POLL_S)


class Running:
    """Stop request that never comes, for the start of the processes."""

    def __bool__(self) -> bool:
        return False

    def sleep(self, seconds: float) -> None:
        threading.Event().wait(seconds)


@dataclass
class Tried:
    """Running pairs and their page."""

    trial: Trial
    bridges: TrialBridges

    @property
    def token(self) -> str:
        return self.trial.address.rstrip("/").rpartition("/")[2]

    def status(self, pair: str, side: str) -> dict[str, Any]:
        """Return the status of a side."""
        (path,) = (
            path for one in self.bridges.pairs if one.name == pair for path in one.control if f".{side}." in path.name
        )
        with Control(path) as control:
            return control.ask("status")

    def states(self) -> set[str]:
        """Return the states of all four sides."""
        return {self.status(pair, side)["state"] for pair in NAMES for side in ("master", "slave")}

    def positions(self) -> dict[str, float]:
        """Return the newest positions of both styluses in m."""
        found = {}
        for feed in self.trial.feeds:
            values = feed.summary().get("values", [])
            if feed.side == "master":
                found[feed.id.partition(".")[0]] = next(
                    one["values"][0] for one in values if one["label"] == "position [m]"
                )
        return found


@contextlib.contextmanager
def tried(folder: Path, record: Path | None = None, choice: Choice = CHOICE) -> Iterator[Tried]:
    """Yield both pairs, disengaged, and the server of their page."""
    network = Network(delay_s=0.02, jitter_s=0.001, loss=0.0)
    ended = threading.Event()
    with TrialBridges(
        "try", (), network, names=NAMES, folder=folder, record=record, stopped=Running()
    ) as bridges:  # fmt: skip
        bridges.start(choice)
        kept = None if record is None else TrialRecord(bridges, load_scene("try"), record)
        trial = Trial(bridges, choice, network, record=kept)
        thread = threading.Thread(target=trial.serve, args=(ended.is_set,))
        thread.start()
        try:
            runs = Tried(trial, bridges)
            wait_until(lambda: all(feed.summary().get("time_s", 0.0) > 0.0 for feed in trial.feeds))
            yield runs
        finally:
            ended.set()
            thread.join(20.0)
            if kept is not None:
                kept.close()
    assert not thread.is_alive()
