"""Record of a trial: aims, and a scene for each run that repeats in virtual time what a person did."""

import math
import queue
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from msgspec.structs import replace

from haptether.bridge import (
    AimsTable,
    PusherTable,
    Scene,
    TelemetryChange,
    TelemetryEnd,
    TelemetryHello,
    TelemetryMessage,
    TelemetrySample,
    override_scene,
    save_scene,
)
from haptether.cli.view.trial.bridges import run_name
from haptether.netsim import DelayChange
from haptether.private_file import write_private
from haptether.view.trial.hand import EXPIRES_S, OVER_S, Aim, Push
from haptether.view.trial.server import Choice, Network

AFTER_S = 2.0
"""Time in s in a scene after the last act."""
LONGEST_S = 3600.0
"""Time in s from the start of a run up to which acts are recorded."""
CLOSE_S = 5.0
"""Timeout in s of the files at the end; a disk may hang."""
AXES = "xyz"


class Recorded(Protocol):
    """Used part of `TrialBridges`."""

    @property
    def runs(self) -> int:
        """Number of starts."""

    @property
    def choice(self) -> Choice:
        """Settings of the newest start."""

    @property
    def network(self) -> Network:
        """Network at present."""

    def changes(self, pair: str, choice: Choice) -> tuple[str, ...]:
        """Return the changes of the scene by which a pair runs."""


class PairRun:
    """Acts of a person in one run of a pair; times in s since the loop of its master began, unless stated otherwise.

    Args:
        name: Name of the files.
        key: Number of the start, and process of the master.
        changes: Changes of the scene.
        periods_s: Periods in s of master and slave.
        network: Network at the start.
    """

    def __init__(self, name: str, key: tuple[int, int], changes: tuple[str, ...], periods_s: tuple[float, float],
                 network: Network) -> None:  # fmt: skip
        self.name = name
        self.key = key
        self.changes = changes
        self.periods_s = periods_s
        self.network = network
        self.aims: list[tuple[float, Aim]] = []
        self.clutch: list[list[float]] = []
        """Times of press and release; a clutch that is still closed has the press only."""
        self.engaged_s: float | None = None
        """First engagement in s since the slave's loop began."""
        self.pushes: list[tuple[float, Push]] = []
        """Time in s since the slave's loop began."""
        self.heard_s = 0.0
        """Time of the newest message of the master."""
        self.delays: list[DelayChange] = []
        """Changes of the delay after the first aim."""
        self.has_other_network = False
        """True if jitter or loss changed after the first aim."""
        self.is_full = False
        """True if an act after `LONGEST_S` was not recorded."""

    def took(self, asked: Aim | Push, ticks: int) -> None:
        """Take an aim or a push with the ticks of the side that accepted it."""
        master_s, slave_s = self.periods_s
        at_s = ticks * (master_s if isinstance(asked, Aim) else slave_s)
        if at_s > LONGEST_S:
            self.is_full = True
        elif isinstance(asked, Aim):
            self.aims.append((at_s, asked))
        else:
            self.pushes.append((at_s, asked))

    def opened(self, after_s: float) -> None:
        """Open a closed hand this time after its last aim, unless silence has opened it before."""
        if self.aims and self.aims[-1][1].strength_n > 0.0 and after_s < EXPIRES_S:
            at_s, aim = self.aims[-1]
            self.aims.append((at_s + after_s, replace(aim, strength_n=0.0)))

    def changed(self, network: Network) -> None:
        """Take a change of the network; before the first aim it is the network of the scene."""
        if not self.aims:
            self.network = network
            return
        others = network.jitter_s, network.loss
        self.has_other_network |= others != (self.network.jitter_s, self.network.loss)
        delay_s = self.delays[-1].delay_s if self.delays else self.network.delay_s
        if network.delay_s != delay_s and self.heard_s <= LONGEST_S:
            self.delays.append(DelayChange(at_s=self.heard_s, delay_s=network.delay_s))

    def take(self, side: str, change: TelemetryChange) -> None:
        """Take a change of a side."""
        at_s = change.time_ns * 1e-9
        if side == "master" and change.signal == "clutch" and at_s <= LONGEST_S:
            if change.to:
                self.clutch.append([at_s])
            elif self.clutch and len(self.clutch[-1]) == 1:
                self.clutch[-1].append(at_s)
        if side == "slave" and change.signal == "state" and change.to == "engaged" and self.engaged_s is None:
            self.engaged_s = at_s


class TrialRecord:
    """Files of a trial: for each run of a pair `PAIR.toml`, `PAIR-aims.csv` and, from the side itself, `PAIR.mcap`.

    Further runs after a restart have a number, `PAIR-2.toml`. Messages and requests come from different threads, which
    never wait for the disk: a thread of its own writes the runs that are over.

    Args:
        bridges: Pairs behind the page.
        scene: Scene of all pairs.
        folder: Folder of the files.
    """

    def __init__(self, bridges: Recorded, scene: Scene, folder: Path) -> None:
        self._bridges = bridges
        self._scene = scene
        self._folder = folder
        self._lock = threading.Lock()
        self._runs: dict[str, PairRun] = {}
        self._over: queue.SimpleQueue[PairRun | None] = queue.SimpleQueue()
        """Runs to be written; None ends the writer."""
        self._writer = threading.Thread(target=self._write_all, name="try-record", daemon=True)
        self._writer.start()

    def took(self, asked: Aim | Push, ticks: dict[str, int]) -> None:
        """Take an aim or a push with the ticks of the sides that accepted it, by pair."""
        with self._lock:
            for pair, at in ticks.items():
                run = self._runs.get(pair)
                # The first aims of a new master may precede its telemetry.
                if run is not None and run.key[0] == self._bridges.runs:
                    run.took(asked, at)

    def opened(self, after_s: float) -> None:
        """Open the hands this time in s after the last aim, because their page has closed."""
        with self._lock:
            for run in self._runs.values():
                run.opened(after_s)

    def hear(self, pair: str, hello: TelemetryHello, message: TelemetryMessage | None) -> None:
        """Take a message of a side, or the start of its run."""
        with self._lock:
            run = self._runs.get(pair)
            if message is None and hello.side == "master":
                bridges = self._bridges
                key = bridges.runs, hello.process
                # A reader that connects again continues the same run.
                if run is None or run.key != key:
                    changes = bridges.changes(pair, bridges.choice)
                    name = run_name(pair, bridges.runs)
                    self._runs[pair] = PairRun(name, key, changes, _periods_s(self._scene), bridges.network)
                    if run is not None:
                        self._over.put(run)
            elif run is not None and isinstance(message, TelemetryChange):
                run.take(hello.side, message)
            elif run is not None and isinstance(message, TelemetrySample) and hello.side == "master":
                run.heard_s = message.time_ns * 1e-9
            elif run is not None and isinstance(message, TelemetryEnd) and hello.side == "master":
                self._over.put(self._runs.pop(pair))

    def change(self, network: Network) -> None:
        """Take a change of the network."""
        with self._lock:
            for run in self._runs.values():
                run.changed(network)

    def close(self) -> None:
        """Write the files of the runs that have not ended; wait for a few seconds at most."""
        with self._lock:
            for run in self._runs.values():
                self._over.put(run)
            self._runs.clear()
        self._over.put(None)
        self._writer.join(CLOSE_S)
        if self._writer.is_alive():
            _report(f"{self._folder}: the disk does not answer: the aims of the last runs are not kept")

    def _write_all(self) -> None:
        while (run := self._over.get()) is not None:
            try:
                self._write(run)
            except Exception as error:  # the other runs must still be written
                _report(f"{run.name}: the aims are not kept: {error}")

    def _write(self, run: PairRun) -> None:
        """Write the files of a run in which a person aimed."""
        if not run.aims:
            return
        file = f"{run.name}-aims.csv"
        write_private(self._folder / file, _csv(run.aims).encode())
        scene = _repeated(override_scene(self._scene, [*run.changes, *_changes(run)]), run, file)
        notes = [f"Acts of a person in `haptether try`, {run.name}"]
        if run.has_other_network:
            notes.append("jitter or loss was changed later")
        if run.is_full:
            notes.append(f"acts after {LONGEST_S:g} s are not recorded")
            _report(f"{run.name}: the scene has the aims of the first {LONGEST_S:g} s: Restart begins another")
        save_scene(scene, self._folder / f"{run.name}.toml", "; ".join(notes) + ".")


def _report(text: str) -> None:
    print(f"record: {text}", file=sys.stderr, flush=True)


def _periods_s(scene: Scene) -> tuple[float, float]:
    """Return the periods in s of master and slave."""
    master_s = scene.run.period_s
    slave_s = None if scene.slave is None else scene.slave.period_s
    return master_s, master_s if slave_s is None else slave_s


def _csv(aims: Iterable[tuple[float, Aim]]) -> str:
    rows: list[str] = []
    for at_s, aim in aims:
        numbers = (at_s, *aim.target, OVER_S, aim.stiffness, aim.damping, aim.strength_n)
        rows.append(",".join(map(repr, numbers)))
        axes = ",".join(AXES[: len(aim.target)])
    return "\n".join([f"time_s,{axes},over_s,stiffness,damping,strength_n", *rows]) + "\n"


def _changes(run: PairRun) -> list[str]:
    """Return the changes of the scene to the clutch and the network of a run."""
    # The loop of the slave begins first, so the time of a push is a bound of its time in the scene.
    acts = (run.aims[-1][0], *(at_s for times in run.clutch for at_s in times), *(at_s for at_s, _ in run.pushes))
    end_s = max(acts) + AFTER_S
    link = run.network
    clutch = [[*times, end_s][:2] for times in run.clutch]
    found: dict[str, Any] = {"run.duration_s": end_s, "operator.clutch": clutch}
    for direction in ("forward", "backward"):
        for name in link.__struct_fields__:
            found[f"link.{direction}.{name}"] = getattr(link, name)
    return [f"{key}={value!r}" for key, value in found.items()]


def _repeated(scene: Scene, run: PairRun, file: str) -> Scene:
    """Return the scene with the aims of a file beside it, the later delays, and the pushes."""
    assert scene.operator is not None
    assert scene.environment is not None
    assert scene.link is not None
    links = (scene.link.forward, scene.link.backward)
    forward, backward = (link and replace(link, timeline=tuple(run.delays) or link.timeline) for link in links)
    return replace(
        scene,
        link=replace(scene.link, forward=forward, backward=backward),
        operator=replace(scene.operator, aims=AimsTable(file=file)),
        environment=replace(scene.environment, pushers=(*scene.environment.pushers, *_pushers(run))),
    )


def _pushers(run: PairRun) -> list[PusherTable]:
    """Return the pushes of a run, whose times count from the engagement; each one ends at the next."""
    if run.engaged_s is None:
        return []
    found: list[PusherTable] = []
    ends_s = [*(at_s for at_s, _ in run.pushes[1:]), math.inf]
    for (at_s, push), end_s in zip(run.pushes, ends_s, strict=False):
        duration_s = min(push.duration_s, end_s - at_s)
        if duration_s > 0.0:
            begun_s = max(0.0, at_s - run.engaged_s)
            found.append(PusherTable(at_s=begun_s, duration_s=duration_s, force_n=push.force))
    return found
