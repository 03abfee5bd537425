"""`haptether try`."""

import contextlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from haptether.cli.shared.output import FileOptions
from haptether.extras import require

Controller = Literal["none", "vfc", "hsc", "wsc", "pc"]
NAMES = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class Try(FileOptions):
    """Feel your way around without a device: a mouse is the hand on two bridges at once, and lets go of both.

    The page is for this machine alone, at the printed address; it needs no network. The pointer is where the hand wants
    to be, and the button is its grip; touch, arrow keys with G, and a gamepad do the same. Behind the page run two
    bridges, each a slave, a network and a master as processes: the same hand on both, by default without a controller
    on the left and with WSC on the right. Nothing engages until somebody holds Engage for a second.

    With --record, a folder gets the recording of every tick, the aims of the hand, and a scene that repeats in virtual
    time what the person did.

    Examples:

    haptether try

    haptether try --right hsc --delay-s 0.2

    haptether try --record out/try

    haptether simulate out/try/left.toml
    """

    left: Controller = "none"
    """Controller of the left bridge."""
    right: Controller = "wsc"
    """Controller of the right bridge."""
    wall_stiffness: float = 100.0
    """Stiffness of the wall in N/m, 10 to 1000."""
    delay_s: float = 0.05
    """Delay each way in s, 0 to 0.5."""
    jitter_s: float = 0.005
    """Standard deviation of the delay in s, 0 to 0.05."""
    loss: float = 0.01
    """Share of packets lost, 0 to 0.5."""
    scene: Annotated[str, tyro.conf.arg(metavar="SCENE")] = "try"
    """A scene with [operator.aims] and an object, a shipped one or a TOML file."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Change the scene, as in `haptether simulate`; may be given often."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Keep recordings and aims in this folder, empty or new."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = 0
    """Port of the page on 127.0.0.1; by default a free one."""

    def run(self) -> int:
        """Serve the page until Ctrl-C.

        Raises:
            ValueError: An option or the scene is not valid.
            OSError: The port is taken, or the folder is not empty.
            RuntimeError: A side did not start, or the extra is not installed.
        """
        from haptether.cli.live.sides import live_scene
        from haptether.cli.shared.stop import Stopped
        from haptether.cli.view.trial.bridges import TrialBridges
        from haptether.cli.view.trial.record import TrialRecord
        from haptether.studies.processes import Interrupted
        from haptether.view.trial.server import (
            MAX_DELAY_S,
            MAX_JITTER_S,
            MAX_LOSS,
            MAX_WALL,
            MIN_WALL,
            Choice,
            Network,
            Trial,
        )

        require("the page", "starlette", "uvicorn", "websockets", extra="console")
        if not 0 <= self.port <= 65535:
            message = f"port = {self.port}: must be 0 to 65535"
            raise ValueError(message)
        for name, value, low, high in (
            ("wall_stiffness", self.wall_stiffness, MIN_WALL, MAX_WALL),
            ("delay_s", self.delay_s, 0.0, MAX_DELAY_S),
            ("jitter_s", self.jitter_s, 0.0, MAX_JITTER_S),
            ("loss", self.loss, 0.0, MAX_LOSS),
        ):
            if not low <= value <= high:
                message = f"{name} = {value:g}: must be {low:g} to {high:g}"
                raise ValueError(message)
        network = Network(delay_s=self.delay_s, jitter_s=self.jitter_s, loss=self.loss)
        controllers: dict[str, str] = dict(zip(NAMES, (self.left, self.right), strict=True))
        choice = Choice(wall_stiffness=self.wall_stiffness, controllers=controllers)
        # An invalid scene is reported here in one line, not by a process that fails to start.
        scene = live_scene(self, ())
        assert scene is not None
        if scene.operator is None or scene.operator.aims is None:
            message = (
                f"scene = {self.scene}: has no [operator.aims]: a page aims only a hand that the scene leaves to it"
            )
            raise ValueError(message)
        if scene.environment is None or not scene.environment.objects:
            message = f"scene = {self.scene}: has no [[environment.objects]], whose stiffness the page sets"
            raise ValueError(message)
        self._make_folder()
        with Stopped() as stopped, contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="haptether-try-")))
            try:
                bridges = stack.enter_context(TrialBridges(
                    self.scene, self.set, network, names=NAMES, folder=folder, record=self.record, stopped=stopped
                ))  # fmt: skip
                bridges.start(choice)
            except Interrupted:
                raise KeyboardInterrupt from None
            record = None if self.record is None else TrialRecord(bridges, scene, self.record)
            server = Trial(bridges, choice, network, record=record, port=self.port)
            print(f"try it on {server.address}", flush=True)
            print("Ctrl-C ends it; the address is the key to it: show it to nobody", flush=True)
            try:
                server.serve(lambda: bool(stopped))
            finally:
                if record is not None:
                    record.close()
        return 0

    def _make_folder(self) -> None:
        """Make the folder of the recordings.

        Raises:
            FileExistsError: The folder is not empty, and `--force` was not given.
        """
        if self.record is None:
            return
        self.record.mkdir(parents=True, exist_ok=True)
        if not self.force and any(self.record.iterdir()):
            message = f"{self.record}: has files already: --force replaces those of an earlier trial, or give another"
            raise FileExistsError(message)
