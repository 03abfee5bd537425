"""`haptether console`."""

import contextlib
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.view.connecting import WaitOptions
from haptether.extras import require

if TYPE_CHECKING:
    from haptether.cli.shared.stop import Stopped

LONG_S = "1000000"
"""Time in s for which the sides of a scene wait for a person."""


@dataclass(frozen=True, kw_only=True)
class Console(WaitOptions):
    """Show running sides in a browser, and stop, engage and scale them from there.

    The page is for this machine alone, at the printed address; it needs no network. It shows the telemetry of the sides
    and sends requests to their control sockets: STOP (also space and Esc), Engage, which must be pressed and held for a
    second, Release clutch, Acknowledge, and the scales of force and position. The loops never wait for the page:
    closing or stalling it changes nothing.

    With --scene it starts both sides of a scene as processes of this machine, and ends them with itself. Nothing
    engages until somebody holds Engage.

    Examples:

    haptether console --scene remote_push

    haptether master --peer 127.0.0.1:9000 --key arm.key --telemetry /tmp/m.sock --control /tmp/m.ctl

    haptether console --connect /tmp/m.sock --control /tmp/m.ctl
    """

    connect: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="PATH")] = ()
    """Socket of --telemetry of a running side; may be given twice. Without it and --scene, the sides that run here."""
    control: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="PATH")] = ()
    """Socket of --control of a running side; without it the page only shows. May be given twice."""
    flight: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="PATH")] = ()
    """File of --flight of a running side: the page says why it held or stopped. May be given twice."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Start the sides of a scene to try it out, a shipped one or a TOML file."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Change the scene, as in `haptether simulate`; may be given often."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = 0
    """Port of the page on 127.0.0.1; by default a free one."""

    def run(self) -> int:
        """Serve the page until Ctrl-C.

        Raises:
            ValueError: Nothing to show, or too much.
            OSError: The port is taken, or nobody listens at a path.
            RuntimeError: A side of the scene did not start, or the extra is not installed.
        """
        from haptether.cli.shared.stop import Stopped
        from haptether.cli.view.connecting import checked_wait_s, sides_here, wait_for

        connect = self.connect
        if self.scene is None and not connect and not (connect := sides_here()):
            message = "--connect, --scene: give one of the two, or start a side: none of this user runs here"
            raise ValueError(message)
        if self.scene is not None and connect:
            message = "--connect, --scene: give one of the two"
            raise ValueError(message)
        if self.scene is not None and (self.control or self.flight):
            message = f"--{'control' if self.control else 'flight'}: the sides of --scene have their own: leave it out"
            raise ValueError(message)
        if self.scene is None and self.set:
            message = f"set = {self.set[0]}: changes a scene: --scene must name one"
            raise ValueError(message)
        most = max(map(len, (connect, self.control, self.flight)))
        if most > 2:
            message = f"--connect, --control, --flight: {most} sides, must be at most 2"
            raise ValueError(message)
        if not 0 <= self.port <= 65535:
            message = f"port = {self.port}: must be 0 to 65535"
            raise ValueError(message)
        require("the console", "starlette", "uvicorn", "websockets", extra="console")
        with Stopped() as stopped, contextlib.ExitStack() as stack:
            if self.scene is None:
                until_s = time.monotonic() + checked_wait_s(self.wait_s)
                for option, paths in (("telemetry", connect), ("control", self.control)):
                    for path in paths:
                        wait_for(path, option, until_s)
                self._serve(connect, self.control, self.flight, stopped)
            else:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="haptether-console-")))
                self._start(folder, stack, stopped)
                sides = ("master", "slave")
                telemetry, control, flight = (
                    [folder / f"{side}.{kind}" for side in sides] for kind in ("sock", "ctl", "flight")
                )
                self._serve(telemetry, control, flight, stopped)
        return 0

    def _serve(self, telemetry: Sequence[Path], control: Sequence[Path], flight: Sequence[Path],
               stopped: "Stopped") -> None:  # fmt: skip
        from haptether.view.console.server import Console as Server

        server = Server(telemetry, control, flight=flight, port=self.port)
        print(f"console on {server.address}", flush=True)
        print("Ctrl-C ends it; the address is the key to it: show it to nobody", flush=True)
        server.serve(lambda: bool(stopped))

    def _start(self, folder: Path, stack: contextlib.ExitStack, stopped: "Stopped") -> None:
        """Start slave and master of the scene on loopback, with a key of this run."""
        from haptether.bridge import write_key
        from haptether.cli.live.sides import live_scene
        from haptether.studies.processes import Interrupted, child_process

        # An invalid scene is reported here in one line, not by a process that fails to start.
        scene = live_scene(self, ())
        assert self.scene is not None
        assert scene is not None
        assert scene.slave is not None
        jaws = scene.slave.gripper
        named = {
            "master.driver": scene.master.driver,
            "slave.device": scene.slave.device,
            "slave.gripper.device": None if jaws is None else jaws.device,
        }
        for key_of, device in named.items():
            if device not in {None, "simulated"}:
                # The driver's announcement before it exerts is for a person, and nobody reads the output of these
                # processes.
                message = (
                    f"{key_of} = {device}: the console starts models only: start slave and master in terminals, with"
                    " --telemetry and --control, and give their sockets to --connect and --control"
                )
                raise ValueError(message)
        os.chmod(folder, 0o700)  # noqa: PTH101
        key = folder / "console.key"
        write_key(key)
        common = ["--key", str(key), "--scene", self.scene, "--keep-s", "60", "--patience-s", LONG_S]
        for change in self.set:
            common += ["--set", change]

        def sockets(side: str) -> list[str]:
            return ["--telemetry", str(folder / f"{side}.sock"), "--control", str(folder / f"{side}.ctl"),
                    "--flight", str(folder / f"{side}.flight")]  # fmt: skip

        try:
            slave = stack.enter_context(child_process("slave", "--listen", "127.0.0.1:0", *common, *sockets("slave")))
            address = slave.headline(stopped).rsplit(" ", 1)[-1]
            master = stack.enter_context(
                child_process("master", "--peer", address, "--clutch", "open", *common, *sockets("master"))
            )
            master.headline(stopped)
        except Interrupted:
            raise KeyboardInterrupt from None
