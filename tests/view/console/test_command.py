"""`haptether console` itself: its refusals, and the sides of a scene that start and end with it."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.live.control_client import Control
from tests.soak.console import children, command
from tests.view.console.served import http

from haptether.bridge import TelemetryReader, TelemetrySample
from haptether.cli.view.console import Console

pytestmark = pytest.mark.live

PATH = Path("side")


@pytest.mark.parametrize(
    ("console", "said"),
    [
        (Console(), "--connect, --scene: give one of the two"),
        (Console(connect=(PATH,), scene="remote_push"), "--connect, --scene: give one of the two"),
        (Console(control=(PATH,), scene="remote_push"), "--control: the sides of --scene have their own"),
        (Console(connect=(PATH,), set=("run.period_s=1",)), "--scene must name one"),
        (Console(flight=(PATH,), scene="remote_push"), "--flight: the sides of --scene have their own"),
        (Console(connect=(PATH, PATH, PATH)), "3 sides, must be at most 2"),
        (Console(connect=(PATH,), port=70000), "port = 70000: must be 0 to 65535"),
        (Console(scene="no_scene"), "no_scene"),
        (Console(scene="remote_push", set=("slave.device=ur",)), "slave.device = ur: the console starts models only"),
    ],
)
def test_what_cannot_be_is_refused(
    console: Console, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A folder in which no side of another test runs.
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(ValueError, match=re.escape(said)):
        console.run()


def test_the_sides_of_a_scene_wait_for_a_person_and_end_with_it() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "haptether", "console", "--scene", "remote_push"], stdout=subprocess.PIPE, text=True
    ) as console:
        try:
            assert console.stdout is not None
            address = console.stdout.readline().split()[-1]
            found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)(/[\w-]{32}/)", address)
            assert found is not None, address
            status, _, page = http(int(found[1]), "GET", found[2], {"Host": f"127.0.0.1:{found[1]}"})
            assert (status, b"STOP" in page) == (200, True)
            sides = children(console.pid)[1:]
            (master,) = (pid for pid in sides if "haptether master" in command(pid))
            paths = re.findall(r"\S+master\.(?:sock|ctl)", command(master))
            time.sleep(1.0)
            with TelemetryReader(paths[0]) as telemetry:
                sample = next(message for message in telemetry if isinstance(message, TelemetrySample))
            # The peer has answered long ago, and the clutch is open.
            assert (sample.signals["state"], sample.signals["clutch"]) == ("disengaged", False)
            with Control(Path(paths[1])) as control:
                assert control.ask("status")["side"] == "master"
        finally:
            console.send_signal(signal.SIGTERM)
        assert console.wait(20.0) == 0
    assert len(sides) == 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in sides)
    assert not Path(paths[0]).parent.exists()
