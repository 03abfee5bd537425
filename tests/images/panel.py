"""The terminal panel of a hand that is pushed, as a picture."""

import io
import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console, RenderableType
from tests.view.console.browser import chromium

from haptether.bridge import TelemetryReader
from haptether.view import SideState, panel

BEGIN_S, SHOWN_S = 30.0, 2.9
"""Time in s that both sides may take to begin, and time shown: the hand has let go just before."""


def photograph_panel(path: Path) -> None:
    """Write a PNG of `haptether watch` on a live master."""
    with TemporaryDirectory() as folder:
        socket, key = Path(folder) / "master.sock", Path(folder) / "arm.key"
        haptether = (sys.executable, "-m", "haptether")
        subprocess.run([*haptether, "keygen", str(key)], check=True, stdout=subprocess.DEVNULL)
        slave = subprocess.Popen(
            [*haptether, "slave", "--scene", "remote_push", "--listen", "127.0.0.1:0", "--key", str(key),
             "--duration-s", "60"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        try:
            assert slave.stdout is not None
            listens = re.search(r"listens on ([\d.]+:\d+)", slave.stdout.readline())
            assert listens is not None
            address = listens[1]
            master = subprocess.Popen(
                [*haptether, "master", "--scene", "remote_push", "--peer", address, "--key", str(key),
                 "--telemetry", str(socket), "--duration-s", "8"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            try:
                until_s = time.monotonic() + BEGIN_S
                while not socket.exists():
                    assert time.monotonic() < until_s
                    time.sleep(0.05)
                photograph(panel(watched(socket)), path)
            finally:
                master.terminate()
                master.wait(BEGIN_S)
        finally:
            slave.terminate()
            slave.wait(BEGIN_S)
            if slave.stdout is not None:
                slave.stdout.close()


def watched(socket: Path) -> SideState:
    """Return the state of a side at `SHOWN_S`."""
    with TelemetryReader(socket) as reader:
        state = SideState(reader.hello)
        for message in reader:
            state.take(message)
            if getattr(message, "time_ns", 0) > SHOWN_S * 1e9:
                break
    return state


def photograph(shown: RenderableType, path: Path) -> None:
    """Write Rich output as PNG."""
    screen = Console(record=True, width=80, file=io.StringIO(), force_terminal=True)
    screen.print(shown)
    drawn = screen.export_svg(title="haptether watch")
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1020, "height": 800})
        page.set_content(f"<body style='margin:0;width:1000px'>{drawn}</body>")
        page.locator("svg").first.screenshot(path=path)
