"""Processes of `haptether try`: per pair a slave, a network and a master as processes of this machine."""

import contextlib
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from types import TracebackType
from typing import Self, get_args

from haptether.bridge import write_key
from haptether.cli.live.options import Controller
from haptether.netsim import ask_control
from haptether.studies.processes import Process, StopRequest, child_process
from haptether.view.console.pair import Pair
from haptether.view.trial.server import Choice, Network

SIDES = ("slave", "master")
LONG_S = "1000000"
"""Time in s for which the sides wait for a person."""
KEPT_S = "60"
"""Time in s at the end of a run that a side keeps."""
PATIENCE_S = 2.0
"""Timeout in s of a proxy's answer."""


class TrialBridges:
    """Pairs of processes, ended with the context.

    A proxy runs until the end; a restart replaces the sides behind it at the same addresses and sockets.

    Args:
        scene: Shipped scene or TOML file.
        changes: Changes of the scene, `KEY=VALUE`.
        network: First network.
        names: Names of the pairs.
        folder: Folder of sockets and key, private to its owner.
        record: Folder of the recordings, `PAIR.mcap`, then `PAIR-2.mcap`; None without them.
        stopped: Polled; a stop ends a start.
    """

    def __init__(self, scene: str, changes: Sequence[str], network: Network, *, names: tuple[str, ...], folder: Path,
                 record: Path | None, stopped: StopRequest) -> None:  # fmt: skip
        self._scene = ("--scene", scene, *(word for change in changes for word in ("--set", change)))
        self.network = network
        """Network at present."""
        self.choice = Choice()
        """Settings of the newest start."""
        self._names = names
        self._folder = folder
        self._record = record
        self._stopped = stopped
        self._proxies = contextlib.ExitStack()
        self._sides = contextlib.ExitStack()
        self._running: list[Process] = []
        self._addresses: dict[str, tuple[str, str]] = {}
        """Addresses of slave and proxy by pair."""
        self._starting = threading.Lock()
        # A child ends with the thread that started it, so these threads live as long as the context.
        self._threads = ThreadPoolExecutor(len(names))
        self.runs = 0
        """Number of starts."""
        write_key(self._key)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._starting:
            self._end_sides()
            self._proxies.close()
        self._threads.shutdown()

    @property
    def _key(self) -> Path:
        return self._folder / "try.key"

    @property
    def controllers(self) -> tuple[str, ...]:
        """Possible controllers of a pair."""
        return get_args(Controller)

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """Pairs with their sockets."""
        return tuple(
            Pair(
                name=name,
                **{
                    kind: [self._folder / f"{name}.{side}.{suffix}" for side in SIDES]
                    for kind, suffix in (("telemetry", "sock"), ("control", "ctl"), ("flight", "flight"))
                },
            )
            for name in self._names
        )

    def changes(self, pair: str, choice: Choice) -> tuple[str, ...]:
        """Return the changes of the scene by which a pair runs, in addition to those given."""
        controller = choice.controllers[pair]
        return (
            f"environment.objects.0.contact.stiffness={choice.wall_stiffness}",
            f"safety.controllers={'[]' if controller == 'none' else f'[{chr(34)}{controller}{chr(34)}]'}",
        )

    def start(self, choice: Choice) -> None:
        """End the sides of all pairs, and start them; their clutches are open.

        Raises:
            Interrupted: A stop was requested.
            RuntimeError: A side did not start.
        """
        with self._starting:
            self._end_sides()
            self.runs += 1
            self.choice = choice
            try:
                starts = [self._threads.submit(self._start, name, choice) for name in self._names]
                # After an error, another pair must start no process that would not be ended.
                wait(starts)
                for started in starts:
                    started.result()
            except BaseException:
                self._end_sides()
                raise

    def _end_sides(self) -> None:
        # All at once, then each is waited for.
        for process in self._running:
            process.process.terminate()
        self._running.clear()
        self._sides.close()

    def _start(self, pair: str, choice: Choice) -> None:
        """Start the sides of one pair, and at first its proxy between them."""
        changes = [word for change in self.changes(pair, choice) for word in ("--set", change)]

        def side(name: str, *arguments: str) -> Process:
            at = self._folder / f"{pair}.{name}"
            options = [
                "--key", str(self._key), *self._scene, *changes, "--keep-s", KEPT_S, "--patience-s", LONG_S,
                "--telemetry", f"{at}.sock", "--control", f"{at}.ctl", "--flight", f"{at}.flight", "--force",
            ]  # fmt: skip
            if self._record is not None and name == "master":
                options += ["--record", str(self.recording(pair))]
            process = self._sides.enter_context(child_process(name, *options, *arguments))
            self._running.append(process)
            return process

        listen = self._addresses[pair][0] if pair in self._addresses else "127.0.0.1:0"
        slave = side("slave", "--listen", listen)
        if pair in self._addresses:
            # Both load at the same time.
            master = side("master", "--peer", self._addresses[pair][1], "--clutch", "open")
            slave.headline(self._stopped)
            master.headline(self._stopped)
            return
        address = slave.headline(self._stopped).rsplit(" ", 1)[-1]
        network = self.network
        proxy = self._proxies.enter_context(child_process(
            "netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", address,
            "--control", str(self._proxy(pair)), "--delay-s", str(network.delay_s),
            "--jitter-s", str(network.jitter_s), "--loss", str(network.loss), "--seed", "1",
        ))  # fmt: skip
        self._addresses[pair] = address, proxy.headline(self._stopped).split(",")[0].rsplit(" ", 1)[-1]
        side("master", "--peer", self._addresses[pair][1], "--clutch", "open").headline(self._stopped)

    def recording(self, pair: str) -> Path:
        """Return the recording of the running master of a pair."""
        assert self._record is not None
        return self._record / f"{run_name(pair, self.runs)}.mcap"

    def _proxy(self, pair: str) -> Path:
        return self._folder / f"{pair}.net"

    def change(self, network: Network) -> None:
        """Change the network of all pairs; after an error all keep their network.

        Raises:
            OSError: A proxy does not answer.
            ValueError: A proxy refuses the settings.
        """
        try:
            for name in self._names:
                self._change(name, network)
        except (OSError, ValueError):
            for name in self._names:
                with contextlib.suppress(OSError, ValueError):
                    self._change(name, self.network)
            raise
        self.network = network

    def _change(self, pair: str, network: Network) -> None:
        link = {"delay_s": network.delay_s, "jitter_s": network.jitter_s, "loss": network.loss}
        answer = ask_control(str(self._proxy(pair)), {"forward": link, "backward": link}, patience_s=PATIENCE_S)
        if not answer["ok"]:
            raise ValueError(answer["error"])


def run_name(pair: str, run: int) -> str:
    """Return the name of the files of a run, counted from 1."""
    return pair if run == 1 else f"{pair}-{run}"
