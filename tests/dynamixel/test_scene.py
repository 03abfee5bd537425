"""Two joints of emulated servos in a scene: the commands `slave` and `master`, and the end of both."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.dynamixel.emulated import emulated_bus
from tests.ur.stalls import anew_after_stalls

pytestmark = pytest.mark.live

PATIENCE_S = 60.0
SCENE = """
schema = 1
[run]
duration_s = 3.0
period_s = 0.002
[master]
axes = 2
kind = "joints"
mass_kg = [0.01, 0.01]
viscous = [0.05, 0.05]
friction = "axis"
[operator]
stiffness = 5.0
damping = 0.3
start = [0.3, 0.0]
legs = [{ duration_s = 0.8, end = [0.6, 0.2] }]
[slave]
period_s = 0.002
device = "dynamixel"
options = { port = "PORT", arm = "ARM", timeout_s = 0.1, watchdog_s = 0.5, release_s = 0.0, verify_watchdog = false }
"""
ARM = """
[[servo]]
id = 1
model = "XM430-W350"
[[servo]]
id = 2
model = "XL330-M288"
sign = -1
"""


@anew_after_stalls
def test_joints_lead_servos(tmp_path: Path) -> None:
    scene, arm, ended = tmp_path / "scene.toml", tmp_path / "arm.toml", tmp_path / "slave.json"
    arm.write_text(ARM)
    command = [sys.executable, "-m", "haptether"]
    with emulated_bus("--servos", "1=XM430-W350", "2=XL330-M288", "--start", "0.3", "0.0") as emulated:
        scene.write_text(SCENE.replace("PORT", emulated.port).replace("ARM", str(arm)))
        slave = subprocess.Popen(
            [*command, "slave", "--listen", "127.0.0.1:0", "--insecure", "--scene", str(scene), "--json", str(ended),
             "--force"],
            stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert slave.stderr is not None
            line = ""
            while "listens on" not in line:
                line = slave.stderr.readline()
                assert line, "it ended"
            address = line.split("listens on ")[1].split()[0].rstrip(",")
            master = subprocess.run(
                [*command, "master", "--peer", address, "--insecure", "--scene", str(scene), "--duration-s", "3"],
                capture_output=True, text=True, timeout=PATIENCE_S, check=False,
            )  # fmt: skip
            assert master.returncode == 0, master.stderr
            assert "master: engaged" in master.stderr
            held = emulated.status()["servos"]
            os.kill(slave.pid, signal.SIGINT)
            _, said = slave.communicate(timeout=PATIENCE_S)
        finally:
            slave.kill()
            slave.wait()
            if slave.stderr is not None:
                slave.stderr.close()
        # The arm leads by the motion of the hand; the second servo has a negative sign.
        assert held[0]["position_rad"] == pytest.approx(0.6, abs=0.1)
        assert held[1]["position_rad"] == pytest.approx(-0.2, abs=0.1)
        assert [servo["torque"] for servo in held] == [True, True]
        assert "KEEP" not in said
        assert [servo["torque"] for servo in emulated.status()["servos"]] == [False, False]
        assert json.loads(ended.read_text())["final_state"]
