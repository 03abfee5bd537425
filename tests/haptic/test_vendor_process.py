"""Both drivers in their commands: checked alone, and with a hand that feels a wall through the whole bridge."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from tests.haptic.standins import built
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import read_recording

pytestmark = pytest.mark.live

COMMAND = [sys.executable, "-m", "haptether"]
SOURCES = {"force-dimension": "force_dimension/dhd.c", "touch": "touch/hd.c"}
CLOSED = {"force-dimension": "dhdClose()", "touch": "hdDisableDevice(0)"}
PATIENT = {"force-dimension": "watchdog_s=0.0318", "touch": "sample_timeout_s=0.018"}
ALONG = {"force-dimension": '["x"]', "touch": '["z"]'}
"""One axis, towards the user."""
MOVES_S = 2.0
"""Time in s from the opening of the device until the hand goes into the wall; both sides have engaged by then."""
# A wall of 100 N/m begins where the two sides engage.
SCENE = """
schema = 1
[master]
driver = "DRIVER"
mass_kg = 0.2
max_force_n = 3.0
options = { library = "LIBRARY", axes = AXES, PATIENT }
[slave]
control = "position"
[[environment.objects]]
contact = { stiffness = 100.0 }
[safety]
controllers = []
"""


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: built(source, tmp_path_factory.mktemp(name)) for name, source in SOURCES.items()}


def environment(tmp_path: Path, **standin: str) -> dict[str, str]:
    """Return the environment of a process whose stand-in writes a new log of calls."""
    (tmp_path / "calls").unlink(missing_ok=True)
    given = {f"STANDIN_{name.upper()}": value for name, value in standin.items()}
    return {**os.environ, "STANDIN_LOG": str(tmp_path / "calls"), **given}


def calls(tmp_path: Path) -> list[str]:
    return (tmp_path / "calls").read_text().splitlines()


@pytest.mark.parametrize("driver", SOURCES)
def test_it_is_listed(driver: str) -> None:
    ended = subprocess.run([*COMMAND, "list", "--json", "-"], capture_output=True, text=True, timeout=60, check=True)
    listed = json.loads(ended.stdout)
    assert driver in listed["[master] driver"]
    assert not listed["cannot be loaded"]


TURNS = {"force-dimension": ["wrist=true", "gripper_open_m=0.03"], "touch": ["orientation=true"]}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", ["linear", "pose"])
@pytest.mark.parametrize("driver", SOURCES)
@anew_after_stalls
def test_check_device_passes_it_and_closes_it_twice(
    driver: str, kind: str, libraries: dict[str, Path], tmp_path: Path
) -> None:
    options = [f"library={libraries[driver]}", PATIENT[driver], *(TURNS[driver] if kind == "pose" else [])]
    given = [word for option in options for word in ("--options", option)]
    ended = subprocess.run(
        [*COMMAND, "check-device", driver, "--duration-s", "1", "--kind", kind, "--json", "-", "--yes", *given],
        env=environment(tmp_path, set="hand_x=0.02;watchdog_slack=50;qw=0.8;qz=0.6"), stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    report = json.loads(ended.stdout)
    assert (report["driver"], report["kind"], report["axes"], report["passed"]) == (driver, kind, 3, True)
    found = {finding["check"]: finding for finding in report["findings"]}
    assert found["close after an exception"]["verdict"] == "pass"
    assert found["zero at begin and end"]["verdict"] == "pass"
    # The loop is at 1 kHz, but a loaded test machine may miss some of it.
    assert report["timing"]["period_p50_s"] == pytest.approx(1e-3, rel=0.2)
    assert calls(tmp_path).count(CLOSED[driver]) == 2
    assert calls(tmp_path)[-1] == CLOSED[driver]


def test_check_device_says_what_is_missing(tmp_path: Path) -> None:
    ended = subprocess.run(
        [*COMMAND, "check-device", "touch", "--duration-s", "1", "--options", f"library={tmp_path}/libHD.so"],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.returncode == 1
    assert "touch: REFUSED  library: no OpenHaptics: looked for " in ended.stderr


class Pair:
    """A slave with a wall, and a master with the driver, as processes.

    Their loops of 1 kHz fault if a loaded machine delays them by 18 ms.
    """

    def __init__(
        self,
        driver: str,
        library: Path,
        tmp_path: Path,
        *,
        duration_s: float | None,
        scene_text: str = SCENE,
        **standin: str,
    ) -> None:
        scene = tmp_path / "scene.toml"
        text = scene_text.replace("DRIVER", driver).replace("LIBRARY", str(library)).replace("AXES", ALONG[driver])
        scene.write_text(text.replace("PATIENT", PATIENT[driver].replace("=", " = ")))
        here = environment(tmp_path, **standin)
        self.slave = subprocess.Popen(
            [*COMMAND, "slave", "--listen", "127.0.0.1:0", "--insecure", "--scene", str(scene), "--patience-s", "20"],
            env=here, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.slave.stderr is not None
        line = ""
        while "listens on" not in line:
            line = self.slave.stderr.readline()
            assert line, "it ended"
        found = re.search(r"listens on ([\d.:]+)", line)
        assert found is not None
        ends = [] if duration_s is None else ["--duration-s", str(duration_s)]
        self.master = subprocess.Popen(
            [*COMMAND, "master", "--peer", found[1], "--insecure", "--scene", str(scene), "--trace",
             str(tmp_path / "master.npz"), "--record", str(tmp_path / "master.mcap"), "--force", *ends],
            env=here, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in (self.master, self.slave):
            process.kill()
            process.wait()
            for stream in (process.stdout, process.stderr):
                if stream is not None:
                    stream.close()


def hand(driver: str, *later: str) -> dict[str, str]:
    """Return settings of the stand-in's critically damped hand, which goes 20 mm into the wall, and later changes."""
    axis = {"force-dimension": "hand_x", "touch": "hand_z"}[driver]
    damping = {"force-dimension": 12.6, "touch": 8.9}[driver]
    return {
        "set": f"hand_b={damping};watchdog_slack=50",
        "after": "|".join([f"{MOVES_S}:{axis}=-0.02", *later]),
    }


def until_in_log(tmp_path: Path, line: str) -> None:
    end_s = time.monotonic() + 30.0
    while not (tmp_path / "calls").exists() or line not in calls(tmp_path):
        assert time.monotonic() < end_s
        time.sleep(0.02)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("driver", SOURCES)
@anew_after_stalls
def test_a_hand_feels_a_wall_through_the_whole_bridge(driver: str, libraries: dict[str, Path], tmp_path: Path) -> None:
    with Pair(driver, libraries[driver], tmp_path, duration_s=4.0, **hand(driver)) as pair:
        _, said = pair.master.communicate(timeout=60)
        assert pair.master.returncode == 0, said
    # The announcement comes before the device is opened: it supports its own weight.
    is_said = "it exerts force by itself" in said.partition(f"{driver}: ok ")[0]
    assert is_said == (driver == "force-dimension")
    trace = np.load(tmp_path / "master.npz")
    position, force = trace["position"].ravel(), trace["device_force"].ravel()
    # The wall fills x < 0 and pushes out. The hand of 200 N/m aims 20 mm inside: two springs in series.
    assert force[-1] == pytest.approx(200.0 * (position[-1] + 0.02), abs=0.15)
    assert force[-1] == pytest.approx(0.02 / (1 / 100 + 1 / 200), abs=0.25)
    assert position[-1] == pytest.approx(-0.02 + force[-1] / 200.0, abs=1e-3)
    # Forces grow from zero.
    assert abs(force[0]) == 0.0
    assert calls(tmp_path)[-1] == CLOSED[driver]


# A gripper holds an object at 0.6 of its stroke; the finger feels a twentieth of its 40 N.
GRIPPING = """
schema = 1
[master]
driver = "DRIVER"
mass_kg = 0.2
options = { library = "LIBRARY", axes = AXES, gripper_open_m = 0.03, PATIENT }
[master.gripper]
travel_m = 0.03
mass_kg = 0.05
[slave.gripper]
speed = 1.8
force_n = 40.0
object = 0.6
[safety]
controllers = []
"""


@anew_after_stalls
def test_a_finger_feels_what_the_gripper_holds(libraries: dict[str, Path], tmp_path: Path) -> None:
    driver = "force-dimension"
    standin = {"set": "watchdog_slack=50", "after": f"{MOVES_S}:finger=0"}
    with Pair(driver, libraries[driver], tmp_path, duration_s=4.5, scene_text=GRIPPING, **standin) as pair:
        _, said = pair.master.communicate(timeout=60)
        assert pair.master.returncode == 0, said
    signals = read_recording(tmp_path / "master.mcap").signals
    # Opening is negative. The finger of 200 N/m aims to be closed, and 2 N hold it 10 of 30 mm open.
    assert signals["trigger_device_force"][-1] == pytest.approx(-2.0, abs=0.05)
    assert signals["trigger"][-1] == pytest.approx(1.0 - 2.0 / 200.0 / 0.03, abs=0.02)
    assert signals["trigger"][100] == pytest.approx(0.0, abs=0.02)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("driver", SOURCES)
@anew_after_stalls
def test_ctrl_c_closes_the_device_without_a_force(driver: str, libraries: dict[str, Path], tmp_path: Path) -> None:
    begun = {"force-dimension": "dhdSetWatchdog(254)", "touch": "hdStartScheduler()"}[driver]
    with Pair(driver, libraries[driver], tmp_path, duration_s=None, **hand(driver)) as pair:
        until_in_log(tmp_path, begun)
        time.sleep(MOVES_S + 0.5)
        pair.master.send_signal(signal.SIGINT)
        _, said = pair.master.communicate(timeout=30)
        assert pair.master.returncode in {0, 130}, said
    ends = {"force-dimension": ["dhdStop()", "dhdSetWatchdog(0)"], "touch": ["callback: done", "hdStopScheduler()"]}
    written = calls(tmp_path)
    assert written[-1] == CLOSED[driver]
    assert all(line in written[-8:] for line in ends[driver])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("driver", SOURCES)
@anew_after_stalls
def test_an_unplugged_device_is_a_fault_of_the_run_and_is_closed(
    driver: str, libraries: dict[str, Path], tmp_path: Path
) -> None:
    with Pair(driver, libraries[driver], tmp_path, duration_s=4.0, **hand(driver, "3:connected=0")) as pair:
        _, said = pair.master.communicate(timeout=60)
        assert pair.master.returncode == 1, said
    assert "the run ended in fault" in said
    assert {"force-dimension": "communication error: see its USB cable", "touch": "communication (0x0302"}[
        driver
    ] in said
    trace = np.load(tmp_path / "master.npz")
    force = trace["device_force"].ravel()
    assert np.abs(force).max() > 0.5
    assert not force[-100:].any()
    assert calls(tmp_path)[-1] == CLOSED[driver]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("driver", SOURCES)
@anew_after_stalls
def test_nothing_of_ours_outlives_a_kill(driver: str, libraries: dict[str, Path], tmp_path: Path) -> None:
    """The force ends by the controller's watchdog, armed with the first force, or by the vendor's driver."""
    with Pair(driver, libraries[driver], tmp_path, duration_s=None, **hand(driver)) as pair:
        until_in_log(tmp_path, {"force-dimension": "dhdSetWatchdog(254)", "touch": "hdStartScheduler()"}[driver])
        time.sleep(MOVES_S + 0.5)
        pair.master.kill()
        pair.master.communicate(timeout=30)
    written = calls(tmp_path)
    assert CLOSED[driver] not in written
    if driver == "force-dimension":
        # The last call of the watchdog armed it.
        assert [line for line in written if line.startswith("dhdSetWatchdog")][-1] == "dhdSetWatchdog(254)"
