"""Record of a trial: aims, and a scene for each run that repeats in virtual time what a person did."""

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
    override_scene,
    save_scene,
)
from haptether.cli.view.trial.bridges import run_name
from haptether.private_file import write_private
from haptether.view.trial.hand import OVER_S, Aim, Push
from haptether.view.trial.server import Choice, Network

AFTER_S = 2.0
"""Time in s in a scene after the last aim."""
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
    """Acts of a person in one run of a pair; times in s since the loop of its master began, unless stated otherwise."""

    def __init__(self, name: str, changes: tuple[str, ...], period_s: float, network: Network) -> None:
        self.name = name
        self.changes = changes
        self.period_s = period_s
        self.network = network
        self.aims: list[tuple[float, Aim]] = []
        self.clutch: list[list[float]] = []
        """Times of press and release; a clutch that is still closed has the press only."""
        self.engaged_s: float | None = None
        """First engagement in s since the slave's loop began."""
        self.pushes: list[tuple[float, Push]] = []
        """Time in s since the slave's loop began."""
        self.has_other_network = False


class TrialRecord:
    """Files of a trial: for each run of a pair `PAIR.toml`, `PAIR-aims.csv` and, from the side itself, `PAIR.mcap`.

    Further runs after a restart have a number, `PAIR-2.toml`. Messages and requests come from different threads.

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

    def took(self, asked: Aim | Push, ticks: dict[str, int]) -> None:
        """Take an aim or a push with the ticks of the sides that accepted it, by pair."""
        with self._lock:
            for pair, at in ticks.items():
                if (run := self._runs.get(pair)) is None:
                    continue
                if isinstance(asked, Aim):
                    run.aims.append((at * run.period_s, asked))
                else:
                    run.pushes.append((at * run.period_s, asked))

    def hear(self, pair: str, hello: TelemetryHello, message: TelemetryMessage | None) -> None:
        """Take a message of a side, or the start of its run."""
        with self._lock:
            if message is None and hello.side == "master":
                self._write(pair)
                bridges = self._bridges
                changes = bridges.changes(pair, bridges.choice)
                period_s = self._scene.run.period_s
                self._runs[pair] = PairRun(run_name(pair, bridges.runs), changes, period_s, bridges.network)
            elif (run := self._runs.get(pair)) is not None and isinstance(message, TelemetryChange):
                _take(run, hello.side, message)
            elif isinstance(message, TelemetryEnd) and hello.side == "master":
                self._write(pair)

    def change(self, network: Network) -> None:
        """Take a change of the network."""
        with self._lock:
            for run in self._runs.values():
                run.has_other_network |= bool(run.aims)
                run.network = run.network if run.aims else network

    def close(self) -> None:
        """Write the files of the runs that have not ended."""
        with self._lock:
            for pair in self._runs:
                self._write(pair)

    def _write(self, pair: str) -> None:
        """Write the files of a run in which a person aimed."""
        run = self._runs.get(pair)
        if run is None or not run.aims:
            return
        file = f"{run.name}-aims.csv"
        write_private(self._folder / file, _csv(run.aims).encode())
        scene = _repeated(override_scene(self._scene, [*run.changes, *_changes(run)]), run, file)
        network = "; the delay, jitter or loss was changed later" if run.has_other_network else ""
        comment = f"What a person did in `haptether try`, pair {pair}{network}."
        save_scene(scene, self._folder / f"{run.name}.toml", comment)


def _take(run: PairRun, side: str, change: TelemetryChange) -> None:
    at_s = change.time_ns * 1e-9
    if side == "master" and change.signal == "clutch":
        if change.to:
            run.clutch.append([at_s])
        elif run.clutch and len(run.clutch[-1]) == 1:
            run.clutch[-1].append(at_s)
    if side == "slave" and change.signal == "state" and change.to == "engaged" and run.engaged_s is None:
        run.engaged_s = at_s


def _csv(aims: Iterable[tuple[float, Aim]]) -> str:
    rows: list[str] = []
    for at_s, aim in aims:
        numbers = (at_s, *aim.target, OVER_S, aim.stiffness, aim.damping, aim.strength_n)
        rows.append(",".join(map(repr, numbers)))
        axes = ",".join(AXES[: len(aim.target)])
    return "\n".join([f"time_s,{axes},over_s,stiffness,damping,strength_n", *rows]) + "\n"


def _changes(run: PairRun) -> list[str]:
    """Return the changes of the scene to the clutch and the network of a run."""
    end_s = run.aims[-1][0] + AFTER_S
    link = run.network
    clutch = [[*times, end_s][:2] for times in run.clutch]
    found: dict[str, Any] = {"run.duration_s": end_s, "operator.clutch": clutch}
    for direction in ("forward", "backward"):
        for name in link.__struct_fields__:
            found[f"link.{direction}.{name}"] = getattr(link, name)
    return [f"{key}={value!r}" for key, value in found.items()]


def _repeated(scene: Scene, run: PairRun, file: str) -> Scene:
    """Return the scene with the aims of a file beside it, and the pushes, whose times count from the engagement."""
    assert scene.operator is not None
    assert scene.environment is not None
    begun_s = run.engaged_s
    pushers = () if begun_s is None else tuple(
        PusherTable(at_s=max(0.0, at_s - begun_s), duration_s=push.duration_s, force_n=push.force)
        for at_s, push in run.pushes
    )  # fmt: skip
    return replace(
        scene,
        operator=replace(scene.operator, aims=AimsTable(file=file)),
        environment=replace(scene.environment, pushers=(*scene.environment.pushers, *pushers)),
    )
