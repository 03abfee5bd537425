"""Arms behind their drivers in the view, while they run: an emulated UR at the robot, emulated servos at the hand."""

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.ur.emulated import emulator

from haptether.bridge import TelemetryReader
from haptether.dynamixel.description import ArmDescription, ArmKinematics, load_arm
from haptether.slave import ur_model
from haptether.view import LiveDescription
from haptether.view.scene3d.arm import GRIPPER_M, link_frames

# The drivers run real-time loops.
pytestmark = pytest.mark.alone

LONGEST_S = 40.0
SAMPLES = 20
"""Number of samples, a third of a second: the first ones may precede the torque of the arm."""
HANGING_RAD = (0.0, 1.59, -0.03, -2.23, -1.57, 0.0)
"""Posture that needs no support before the arm has torque."""
SIGNS = (1, 1, -1, 1, 1, 1)
LEADER = f"""
schema = 1

[master]
kind = "joints"
axes = 6
mass_kg = [0.02, 0.03, 0.02, 0.003, 0.003, 0.002]
friction = "axis"
driver = "dynamixel"

[master.options]
port = "PORT"
arm = "gello-ur"
offsets = [0, 0, 0, 0, 0, 0]
signs = {list(SIGNS)}
verify_watchdog = false

[slave]

[safety]
controllers = ["wsc"]
"""


@contextmanager
def side(socket: Path, *arguments: str) -> Iterator[TelemetryReader]:
    """Run a side as a process, and read its telemetry."""
    command = [sys.executable, "-m", "haptether", *arguments, "--insecure", "--telemetry", str(socket),
               "--patience-s", str(LONGEST_S)]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            until_s = time.monotonic() + LONGEST_S
            while True:
                try:
                    reader = TelemetryReader(socket)
                    break
                except (FileNotFoundError, ConnectionRefusedError):
                    assert process.poll() is None, process.stderr and process.stderr.read()
                    assert time.monotonic() < until_s
                    time.sleep(0.05)
            with reader:
                yield reader
        finally:
            process.terminate()
            try:
                process.wait(LONGEST_S)
            finally:
                process.kill()


def followed(reader: TelemetryReader, *, arm: str = "", leader: str = "") -> LiveDescription:
    live = LiveDescription(reader.hello, arm=arm, leader=leader)
    follow(live, reader)
    return live


def follow(live: LiveDescription, reader: TelemetryReader) -> None:
    samples = 0
    for message in reader:
        live.take(message, reader.hello.side, received_s=time.monotonic())
        samples += "Sample" in type(message).__name__
        if samples >= SAMPLES:
            break


def place(live: LiveDescription, part: str) -> Sequence[float]:
    pose = live.at_now().poses[part]
    assert pose is not None
    return list(pose[:3, 3])


def test_a_ur_stands_as_its_controller_says(tmp_path: Path) -> None:
    pytest.importorskip("rtde_control", reason="the extra ur is not installed")
    gripper = ("--gripper", "2f-85", "--gripper-object-mm", "40", "--gripper-active")
    with (
        emulator(*gripper) as controller,
        side(
            tmp_path / "slave.sock", "slave", "--scene", "ur_pick", "--listen", "127.0.0.1:0",
            "--set", f"slave.options.tool=[0, 0, {GRIPPER_M}, 0, 0, 0]",
            "--set", f"slave.options.host={controller.host}", "--set", f"slave.gripper.options.host={controller.host}",
        ) as reader,
    ):  # fmt: skip
        live = followed(reader, arm="ur5e")
        status = controller.status()
    frames = link_frames(ur_model("ur5e"), np.array(status["q"]))
    assert place(live, "gripper") == pytest.approx((frames[-1] @ [0.0, 0.0, GRIPPER_M, 1.0])[:3], abs=2e-3)
    elbow = live.description.part("link 3 length").pose(live.time_s)
    assert elbow is not None
    assert elbow[:3, 3][2] == pytest.approx(frames[2][2, 3], abs=2e-2)
    assert not any("chosen" in note for note in live.description.notes)
    assert any("between the jaws" in note for note in live.description.notes)


def tip_of(arm: ArmDescription, bus: EmulatedBus) -> Sequence[float]:
    servos = {servo["id"]: servo for servo in bus.status()["servos"]}
    q = [sign * servos[joint.servo]["position_rad"] for joint, sign in zip(arm.joints, SIGNS, strict=True)]
    tip, _, _ = ArmKinematics(arm).state(q, [0.0] * len(q))
    return list(tip)


def test_a_leader_of_servos_stands_as_its_bus_says(tmp_path: Path) -> None:
    arm = load_arm("gello-ur")
    with emulated_bus("--arm", "gello-ur", "--start", *map(str, HANGING_RAD)) as bus:
        (tmp_path / "leader.toml").write_text(LEADER.replace("PORT", bus.port))
        with side(
            tmp_path / "master.sock", "master", "--scene", str(tmp_path / "leader.toml"), "--peer", "127.0.0.1:9"
        ) as reader:
            live = followed(reader, leader="gello-ur")
            until_s = time.monotonic() + LONGEST_S
            # The arm sinks, as nobody holds it: a moving arm is elsewhere before the bus answers.
            while True:
                before, q = tip_of(arm, bus), place(live, "handle")
                if np.allclose(before, tip_of(arm, bus), atol=5e-4) and np.allclose(q, before, atol=2e-3):
                    break
                assert time.monotonic() < until_s, (before, q)
                follow(live, reader)
    assert {arrow.name for arrow in live.description.arrows} >= {f"hand torque {n + 1}" for n in range(6)}
