"""Two live sides and a console in this process."""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.scene.two_sides import two_sides

from haptether.bridge import LiveMaster, LiveSlave, Scene, override_scene, scene_json
from haptether.view.console.server import Console


@dataclass
class Served:
    """The running sides and their console."""

    master: LiveMaster
    slave: LiveSlave
    console: Console
    folder: Path
    console_stopped: threading.Event = field(default_factory=threading.Event)

    @property
    def token(self) -> str:
        return self.console.address.rstrip("/").rpartition("/")[2]


@contextlib.contextmanager
def served(folder: Path, *, controlled: bool = True, of: Scene | None = None) -> Iterator[Served]:
    """Yield two sides whose start presses nothing, and the console that shows them."""
    scene = scene_json(override_scene(of or two_sides(), ["operator.clutch=once"]))
    slave = LiveSlave(
        scene, listen="127.0.0.1:0", run_id=2, insecure=True, telemetry=folder / "s.sock", control=folder / "s.ctl"
    )
    master = LiveMaster(
        scene, peer=slave.address, run_id=1, insecure=True, started_s=time.monotonic() - 10.0,
        telemetry=folder / "m.sock", control=folder / "m.ctl",
    )  # fmt: skip
    control = [folder / "m.ctl", folder / "s.ctl"] if controlled else []
    console = Console([folder / "m.sock", folder / "s.sock"], control, flight=[folder / "m.flight"])
    runs = Served(master, slave, console, folder)
    thread = threading.Thread(target=console.serve, args=(runs.console_stopped.is_set,))
    thread.start()
    try:
        wait_for(lambda: master.is_answered)
        yield runs
    finally:
        runs.console_stopped.set()
        thread.join(20.0)
        for side in (master, slave):
            # A test may have finished one of them.
            with contextlib.suppress(RuntimeError):
                side.finish()
    assert not thread.is_alive()


def wait_for(condition: Callable[[], bool], within_s: float = 30.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def http(port: int, method: str, path: str, headers: dict[str, str]) -> tuple[int, dict[str, str], bytes]:
    """Send a request with exactly these headers; return status, headers and body."""
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items()), "Connection: close"]
    with socket.create_connection(("127.0.0.1", port), 10.0) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        received = b""
        while more := connection.recv(1 << 16):
            received += more
    head, _, body = received.partition(b"\r\n\r\n")
    first, *rest = head.decode().split("\r\n")
    fields = dict(line.lower().split(": ", 1) for line in rest)
    return int(first.split()[1]), fields, body


def stop_answers(body: bytes) -> dict[str, dict[str, object]]:
    return dict(json.loads(body))
