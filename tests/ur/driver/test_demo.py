"""The demonstration with a UR arm in the loop, as processes: emulated controller, ur-rtde, slave, network, master."""

import json
import os
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from tests.live.sides import Never
from tests.ur.stalls import STALL_S, Stalls, unheld

from haptether.bridge import load_scene
from haptether.studies import DemoScene, PickScene, run_demo, run_pick

pytestmark = pytest.mark.live

pytest.importorskip("rtde_control", reason="the extra ur is not installed")

Array = npt.NDArray[np.float64]
COMMAND = [sys.executable, "-m", "haptether"]
START_S = 40.0
ATTEMPTS = 3
STALLED = f"this machine stalled a loop in each of {ATTEMPTS} runs"


@pytest.mark.sampled(1)
@pytest.mark.timeout(200)
@pytest.mark.parametrize("slave", ["simulated", "ur"])
def test_something_is_picked_up_turned_and_put_down(slave: Literal["simulated", "ur"], tmp_path: Path) -> None:
    """The hand carries the object 100 mm aside and turns it by 60 degrees; so do arm, wrist and gripper."""
    scene = PickScene(slave=slave)
    result = unheld(lambda: run_pick(scene, tmp_path, lambda *_: None, Never()), pytest.skip)
    assert result.is_done, result
    assert result.lifted_m == pytest.approx(0.06, abs=2e-3)


@pytest.mark.timeout(200)
def test_a_push_of_an_emulated_tool_reaches_the_hand_damped(tmp_path: Path) -> None:
    scene = DemoScene(slave="ur", delay_s=0.02, jitter_s=0.0, loss=0.0)
    # A run that receives nothing from the controller for 0.1 s ends in a fault, as required. After a hold both sides
    # engage at their current places, which changes the press on the wall.
    result = unheld(lambda: run_demo(scene, "hsc", tmp_path, lambda *_: None, Never()), pytest.skip)
    assert result.final_state in {"engaged", "stale"}
    # 65 mm of target behind 300 and 100 N/m in series, plus the share of the push that does not bend the hand.
    assert result.force_at_release_n == pytest.approx(6.0, abs=0.3)
    # On a quiet machine 2.8 m/s without a controller, 0.22 with HSC.
    assert result.peak_hand_speed is not None
    assert 0.05 < result.peak_hand_speed < 0.6
    assert result.trips_before_release == 0


@pytest.fixture
def running() -> Iterator[list[subprocess.Popen[str]]]:
    children: list[subprocess.Popen[str]] = []
    yield children
    for child in reversed(children):
        if child.poll() is None:
            child.send_signal(signal.SIGTERM)
            try:
                child.wait(10.0)
            except subprocess.TimeoutExpired:
                child.kill()
        child.communicate()


def started(running: list[subprocess.Popen[str]], says: str, *arguments: str) -> str:
    """Start a command; return the line that reports it ready."""
    child = subprocess.Popen(
        [*COMMAND, *arguments],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip
    running.append(child)
    assert child.stdout is not None
    said = []
    for line in child.stdout:
        said.append(line)
        if says in line:
            return line
    pytest.fail("".join(said))


def peg(folder: Path, running: list[subprocess.Popen[str]]) -> tuple[dict[str, Any], Array, Array]:
    """Run the scene with all its processes; return the master's result, and its force and position over the ticks."""
    host = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
    started(running, "listening on", "ur-emulator", "--host", host, "--scene", "ur_peg", "--duration-s", "60")
    line = started(
        running, "slave listens on", "slave", "--listen", "127.0.0.1:0", "--insecure", "--scene", "ur_peg",
        "--set", f"slave.options.host={host}", "--patience-s", "30", "--duration-s", "30",
    )  # fmt: skip
    address = re.search(r"listens on (\S+:\d+)", line)
    assert address
    trace, result = folder / "m.npz", folder / "m.json"
    result.unlink(missing_ok=True)
    master = subprocess.run(
        [*COMMAND, "master", "--peer", address[1], "--insecure", "--scene", "ur_peg", "--duration-s", "3.0",
         "--trace", str(trace), "--json", str(result)],
        capture_output=True, text=True, timeout=START_S, check=False,
    )  # fmt: skip
    assert result.exists(), master.stderr
    with np.load(trace) as arrays:
        return json.loads(result.read_text()), arrays["device_force"], arrays["position"]


@pytest.mark.thorough
@pytest.mark.timeout(200)
def test_a_peg_meets_table_and_wall_on_three_axes(tmp_path: Path, running: list[subprocess.Popen[str]]) -> None:
    for _ in range(ATTEMPTS):
        with Stalls() as stalls:
            result, force, x = peg(tmp_path, running)
        if result["holds"] == 0 and result["final_state"] in {"engaged", "stale"}:
            break
        assert stalls.worst_s > STALL_S, result
    else:
        pytest.skip(STALLED)
    scene = load_scene("ur_peg")
    assert scene.operator is not None
    targets = np.array([leg.end for leg in scene.operator.legs])
    # In series, 300 N/m of the hand and 150 N/m of the box give 100 N/m over the target's depth in the box.
    deep = -targets[-1][2], targets[-1][1] - 0.04
    settled = force[-200:].mean(axis=0)
    assert settled[2] == pytest.approx(100.0 * deep[0], abs=0.4)
    assert settled[1] == pytest.approx(-100.0 * deep[1], abs=0.5)
    assert abs(settled[0]) < 0.3
    # The peg is drawn along the table, whose friction of 0.1 opposes the motion.
    drawn = (x[:, 1] > 0.01) & (x[:, 1] < 0.035) & (force[:, 2] > 1.0)
    assert drawn.any()
    assert -1.5 < np.median(force[drawn, 1]) < 0.0
