"""A process forked while sides run, as by a library of a driver: it ends, and the sides continue."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

FORKING = """
import os, sys, time
from pathlib import Path
from haptether.bridge import LiveMaster, LiveSlave, load_scene, override_scene, scene_json
folder, how = Path(sys.argv[1]), sys.argv[2]
scene = scene_json(override_scene(load_scene("remote_push"), ["run.duration_s=60"]))
sockets = {name: folder / name for name in ("s.sock", "s.ctl", "m.sock", "m.ctl")}
slave = LiveSlave(scene, listen="127.0.0.1:0", run_id=2, insecure=True, record=folder / "s.mcap",
                  telemetry=sockets["s.sock"], control=sockets["s.ctl"])
master = LiveMaster(scene, peer=slave.address, run_id=1, insecure=True, record=folder / "m.mcap",
                    telemetry=sockets["m.sock"], control=sockets["m.ctl"])
child = os.fork()
if child == 0:
    if how == "finish":
        for side in (master, slave):
            try:
                side.finish()
            except RuntimeError:
                pass
    elif how == "delete":
        del master, slave
    sys.exit(0)
end_s = time.monotonic() + 20.0
while not (ended := os.waitpid(child, os.WNOHANG))[0] and time.monotonic() < end_s:
    time.sleep(0.01)
if not ended[0]:
    os.kill(child, 9)
    os.waitpid(child, 0)
print("hangs" if not ended[0] else os.waitstatus_to_exitcode(ended[1]), all(map(Path.is_socket, sockets.values())))
print(all(not side.finished for side in (master, slave)))
master.finish()
slave.finish()
# On a busy machine the end does not wait for the threads that remove the files.
end_s = time.monotonic() + 20.0
while (left := any(map(Path.exists, sockets.values()))) and time.monotonic() < end_s:
    time.sleep(0.01)
print(not left)
"""


@pytest.mark.timeout(90)
@pytest.mark.parametrize("how", ["exit", "finish", "delete"])
def test_a_forked_child_ends_and_the_sides_go_on(how: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", FORKING, str(tmp_path), how]
    seen = subprocess.run(command, capture_output=True, text=True, timeout=80, check=False)
    assert seen.stdout.split() == ["0", "True", "True", "True"], seen.stdout + seen.stderr
