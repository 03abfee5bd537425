"""`haptether try` itself: its refusals, and its processes, which start and end with it."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.soak.console import children, command
from tests.view.console.served import http

from haptether.cli.view.trial.command import Try


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (Try(port=70000), "port = 70000: must be 0 to 65535"),
        (Try(delay_s=0.6), "delay_s = 0.6: must be 0 to 0.5"),
        (Try(jitter_s=-0.1), "jitter_s = -0.1: must be 0 to 0.05"),
        (Try(loss=float("nan")), "loss = nan: must be 0 to 0.5"),
        (Try(wall_stiffness=5.0), "wall_stiffness = 5: must be 10 to 1000"),
        (Try(scene="no_scene"), "no_scene"),
        (Try(scene="paper_wall"), "has no [slave]"),
        (Try(scene="remote_push"), "scene = remote_push: has no [operator.aims]"),
        (Try(set=("environment.objects=[]",)), "has no [[environment.objects]]"),
    ],
)
def test_what_cannot_be_is_refused(given: Try, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        given.run()


def test_a_folder_with_files_is_kept(tmp_path: Path) -> None:
    (tmp_path / "notes").touch()
    with pytest.raises(FileExistsError, match="has files already"):
        Try(record=tmp_path).run()


@pytest.mark.live
def test_six_processes_start_and_end_with_it(tmp_path: Path) -> None:
    record = tmp_path / "record"
    words = [sys.executable, "-m", "haptether", "try", "--record", str(record)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as running:
        try:
            assert running.stdout is not None
            address = running.stdout.readline().split()[-1]
            found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)(/[\w-]{32}/)", address)
            assert found is not None, address
            status, _, page = http(int(found[1]), "GET", found[2], {"Host": f"127.0.0.1:{found[1]}"})
            assert (status, b"STOP" in page, b'src="http' in page) == (200, True, False)
            processes = children(running.pid)[1:]
            commands = sorted(re.findall(r"haptether (master|slave|netsim)", " ".join(map(command, processes))))
            assert commands == ["master", "master", "netsim", "netsim", "slave", "slave"]
        finally:
            running.send_signal(signal.SIGTERM)
        assert running.wait(20.0) == 0
    assert not any(Path(f"/proc/{pid}").exists() for pid in processes)
    # Nobody aimed: there are recordings, but nothing to repeat.
    assert sorted(path.name for path in record.iterdir()) == ["left.mcap", "right.mcap"]
