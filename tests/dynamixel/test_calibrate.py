"""`haptether dynamixel find` and `calibrate`, with an emulated arm that answers like a person."""

import contextlib
import math
import os
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.ur.emulated import Emulated

from haptether.dynamixel import DynamixelBus
from haptether.dynamixel.arm import ServoSettings, read_calibration, write_calibration
from haptether.dynamixel.arm.guide import FoundServo, Guide, calibrated
from haptether.dynamixel.control_table import CENTRE, RAD_PER_TICK

pytestmark = pytest.mark.live

PATIENCE_S = 60.0
TURN = 2.0 * math.pi
POSE = (0.0, -math.pi / 2)
OFFSETS = (math.pi / 2, math.pi)
SIGNS = (1, -1)


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", "1=XM430-W350", "2=XL330-M288", "--baud", "1000000") as running:
        yield running


class Calibration:
    """The command, and the emulated person who answers it."""

    def __init__(
        self, emulated: EmulatedBus, path: Path, *arguments: str, ids: tuple[str, ...] = ("1", "2"), yes: bool = True
    ) -> None:
        command = [
            sys.executable, "-m", "haptether", "dynamixel", "calibrate", emulated.port, str(path),
            *(("--ids", *ids) if ids else ()), *(("--yes",) if yes else ()), *arguments,
        ]  # fmt: skip
        self.emulated = emulated
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        self.said = Emulated(self.process, "")

    def until(self, begin: str) -> list[str]:
        """Return the lines up to the first with this prefix."""
        lines = [self.said.line(PATIENCE_S)]
        while not lines[-1].startswith(begin):
            lines.append(self.said.line(PATIENCE_S))
        return lines

    def enter(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(b"\n")
        self.process.stdin.flush()

    def place(self, *angles: float) -> None:
        """Place the joints at these angles, with the offsets and directions to be found."""
        for servo_id, q, offset, sign in zip((1, 2), angles, OFFSETS, SIGNS, strict=True):
            self.emulated.do(f"place {servo_id} {sign * q + offset}")

    def end(self) -> tuple[int, str]:
        try:
            out, _ = self.process.communicate(timeout=PATIENCE_S)
            return self.process.returncode, out.decode()
        finally:
            self.close()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()


def guided(emulated: EmulatedBus, path: Path, *arguments: str, beside: float = 0.0) -> tuple[int, str]:
    """Run a calibration from start to end."""
    run = Calibration(emulated, path, *arguments, "--pose", *map(str, POSE))
    try:
        run.until("hold the arm")
        run.enter()
        run.until("put the arm into the pose (0, -1.5708)")
        run.place(POSE[0] + beside, POSE[1] - beside)
        run.enter()
        run.until("turn joint 1")
        # First the wrong joint, then a too small turn, then the requested turn.
        run.place(POSE[0] + beside, POSE[1] - beside + 0.4)
        run.enter()
        run.until("joint 2 (servo 2) moved instead: once more")
        run.until("turn joint 1")
        run.place(POSE[0] + beside + 0.1, POSE[1] - beside + 0.4)
        run.enter()
        run.until("it moved 0.10 rad: must be 0.2 at least")
        run.until("turn joint 1")
        run.place(POSE[0] + beside + 0.5, POSE[1] - beside + 0.4)
        run.enter()
        run.until("turn joint 2")
        run.place(POSE[0] + beside + 0.5, POSE[1] - beside + 0.8)
        run.enter()
        run.until("move each joint")
        # Cross the end of the turn of each servo.
        for q1, q2 in ((-1.0, -2.0), (0.5, -1.0), (2.0, 0.0), (2.5, 0.5)):
            run.place(q1, q2)
            at_least_one_read()
        run.enter()
        return run.end()
    finally:
        run.close()


class HeldArm:
    """Two joints that a person turns to the next place at each Enter."""

    def __init__(self, *places: tuple[float, float]) -> None:
        self.said: list[str] = []
        self._places = iter(places)
        self._place = 0.0, 0.0
        servos = [FoundServo(baud=1_000_000, servo_id=servo_id, number=1020, firmware=52) for servo_id in (1, 2)]
        self.guide = Guide(self, servos, self.said.append, self._enter)  # type: ignore[arg-type]  # the used part

    def sync_read(self, _read: object) -> bytes:
        return np.rint(np.array(self._place) / RAD_PER_TICK + CENTRE).astype("<i4").tobytes()

    def _enter(self, _patience_s: float) -> str:
        self._place = next(self._places)
        return ""


@pytest.mark.parametrize(
    ("tries", "refusals"),
    [
        # The first turn is too small; the person turns on, or back to the start first.
        ([(0.15, 0.0), (0.35, 0.0)], ["it moved 0.15 rad"]),
        ([(0.15, 0.0), (0.21, 0.0)], ["it moved 0.15 rad"]),
        # Another joint moves along; both return, and then the joint turns less far than before.
        ([(0.5, 0.4), (0.25, 0.0)], ["joint 2 (servo 2) moved instead"]),
        # The other joint stays in place.
        ([(0.5, 0.4), (0.3, 0.4)], ["joint 2 (servo 2) moved instead"]),
        ([(0.5, 0.4), (0.1, 0.0), (0.3, 0.0)], ["joint 2 (servo 2) moved instead", "it moved 0.10 rad"]),
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_joint_counts_from_where_it_stood_when_it_was_asked_for(
    tries: list[tuple[float, float]], refusals: list[str], sign: int
) -> None:
    turned = [(sign * first, second) for first, second in tries]
    last = turned[-1]
    arm = HeldArm(*turned, (last[0], last[1] + 0.3))
    assert arm.guide.directions() == [sign, 1]
    refused = [line for line in arm.said if "once more" in line]
    assert len(refused) == len(refusals)
    assert all(line.startswith(begin) for line, begin in zip(refused, refusals, strict=True))
    asked = {float(line.split(" rad or more")[0].split()[-1]) for line in arm.said if line.startswith("turn joint")}
    accepted = {float(line.split("must be ")[1].split()[0]) for line in refused if "must be " in line}
    assert accepted <= asked
    assert len(asked) == 1


def at_least_one_read() -> None:
    time.sleep(0.3)


def test_a_guided_calibration(emulated: EmulatedBus, tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    status, said = guided(emulated, path)
    assert status == 0, said
    baud, (first, second) = read_calibration(path)
    assert baud == 1_000_000
    assert (first.servo_id, first.model, first.sign) == (1, "XM430-W350", 1)
    assert (second.servo_id, second.model, second.sign) == (2, "XL330-M288", -1)
    # The limits settle whole turns.
    assert math.remainder(first.offset_rad - OFFSETS[0], TURN) == pytest.approx(0.0, abs=3e-3)
    assert math.remainder(second.offset_rad - OFFSETS[1], TURN) == pytest.approx(0.0, abs=3e-3)
    assert (first.low_rad, first.high_rad) == pytest.approx((-0.95, 2.45), abs=0.01)
    assert (second.low_rad, second.high_rad) == pytest.approx((-1.95, 0.45), abs=0.01)


def test_offsets_rounded_to_quarter_turns(emulated: EmulatedBus, tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    status, said = guided(emulated, path, "--round", beside=0.08)
    assert status == 0, said
    _, servos = read_calibration(path)
    for servo, offset in zip(servos, OFFSETS, strict=True):
        assert math.remainder(servo.offset_rad - offset, TURN) == pytest.approx(0.0, abs=1e-5)
    assert "rad rounded away" in said


def test_a_pipe_is_nobody(emulated: EmulatedBus, tmp_path: Path) -> None:
    run = Calibration(emulated, tmp_path / "arm.toml", yes=False)
    run.enter()
    status, said = run.end()
    assert status == 2
    assert "a person must say yes on the terminal, and there is none: give --yes" in said
    assert not (tmp_path / "arm.toml").exists()


def test_a_file_is_not_replaced_unasked(emulated: EmulatedBus, tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text("mine")
    run = Calibration(emulated, path)
    status, said = run.end()
    assert status == 1
    assert "is there already: --force replaces it" in said
    assert path.read_text() == "mine"


def test_nobody_there(emulated: EmulatedBus, tmp_path: Path) -> None:
    bus = DynamixelBus(emulated.port, baud=1_000_000, timeout_s=0.1)
    bus.write(1, 64, b"\1")
    bus.close()
    status, said = Calibration(emulated, tmp_path / "arm.toml").end()
    assert status == 1
    assert "standard input has ended: a person must answer" in said
    # Nobody has confirmed that the arm is held.
    assert emulated.servo(1)["torque"] is True
    assert not (tmp_path / "arm.toml").exists()


def test_the_torque_ends_after_enter_and_what_loses_it_is_said_before(emulated: EmulatedBus, tmp_path: Path) -> None:
    bus = DynamixelBus(emulated.port, baud=1_000_000, timeout_s=0.1)
    for servo_id in (1, 2):
        bus.write(servo_id, 64, b"\1")
    bus.close()
    # The second servo drives a gripper, which the calibration of the arm leaves out.
    run = Calibration(emulated, tmp_path / "arm.toml", ids=("1",))
    try:
        before = run.until("hold the arm")
        assert "EVERY servo on this bus loses its torque, that of a gripper, too" in before[-1]
        assert not any("no torque" in line for line in before)
        assert all(emulated.servo(servo_id)["torque"] for servo_id in (1, 2))
        run.enter()
        assert run.until("no torque")[-1] == "no torque: servo 1, verified"
        assert not any(emulated.servo(servo_id)["torque"] for servo_id in (1, 2))
    finally:
        run.close()


@pytest.mark.parametrize(
    "arguments",
    [["PORT", "--ids", "2", "1", "9"], ["--ids", "2", "1", "9", "--port", "PORT"], ["--port=PORT", "--ids", "2", "1"]],
)
def test_find(arguments: list[str], emulated: EmulatedBus) -> None:
    command = [
        sys.executable,
        "-m",
        "haptether",
        "dynamixel",
        "find",
        *(each.replace("PORT", emulated.port) for each in arguments),
    ]
    found = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert found.returncode == 0, found.stderr
    assert found.stdout.splitlines() == [
        "id 2: XL330-M288, firmware 52, 1000000 bit/s",
        "id 1: XM430-W350, firmware 52, 1000000 bit/s",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("baud = 5\n[[servo]]\nid = 1\nmodel = 'XM430-W350'\n", "baud = 5: must be one of 9600"),
        ("[[servo]]\nid = 1\nmodel = 'XM430'\n", "servo 1: model = 'XM430': must be one of"),
        ("[[servo]]\nid = 1\nmodel = 'XM430-W350'\ncolour = 1\n", "unknown field `colour`"),
        ("[[servo]]\nid = 1\nmodel = 'XM430-W350'\noffset_rad = nan\n", "offset_rad"),
        ("[[servo", "arm.toml"),
        ("[[joints]]\n", "describes an arm .links, masses.: must be a file of `haptether dynamixel calibrate`"),
    ],
)
def test_files_that_are_none(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_calibration(path)


def test_a_file_comes_back(tmp_path: Path) -> None:
    servos = (
        ServoSettings(servo_id=4, model="XL330-M288", sign=-1, offset_rad=1.25, low_rad=-1.0, high_rad=9.0, cap_a=0.5),
        ServoSettings(servo_id=2, model="XM430-W350", near_rad=0.5),
    )
    path = tmp_path / "arm.toml"
    write_calibration(path, 57_600, servos)
    baud, found = read_calibration(path)
    assert baud == 57_600
    assert [(s.servo_id, s.model, s.sign, s.cap_a, s.near_rad) for s in found] == [
        (4, "XL330-M288", -1, 0.5, None), (2, "XM430-W350", 1, None, 0.5),
    ]  # fmt: skip
    assert found[0].offset_rad == 1.25
    assert (found[1].low_rad, found[1].high_rad) == pytest.approx((-math.pi, math.pi), abs=1e-4)


def test_a_file_that_cannot_be_written_leaves_the_one_that_is_there(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text("what was there")
    with pytest.raises(ValueError, match="baud = 5"):
        write_calibration(path, 5, (ServoSettings(servo_id=1, model="XM430-W350"),))
    assert [file.name for file in tmp_path.iterdir()] == ["arm.toml"]
    assert path.read_text() == "what was there"


def test_where_the_file_cannot_be_the_arm_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "arm.toml"
    command = [
        sys.executable,
        "-m",
        "haptether",
        "dynamixel",
        "calibrate",
        str(tmp_path / "no-port"),
        str(path),
        "--yes",
    ]
    said = subprocess.run(command, check=False, capture_output=True, text=True, timeout=PATIENCE_S)
    assert said.returncode == 2
    assert f"{path}: its folder must be one that can be written to" in said.stderr


def test_a_joint_of_several_turns_says_where_it_is_to_be() -> None:
    found = [FoundServo(baud=1_000_000, servo_id=1, number=1020, firmware=52)]
    (one,), _ = calibrated(
        found, (0.3,), np.array([2.0]), [-1], (np.array([-4.0]), np.array([6.0])), rounded=False, margin_rad=0.0
    )
    # p = 2 is q = 0.3 with sign -1: offset 2.3, and q from 2.3 - 6 to 2.3 + 4.
    assert one.offset_rad == pytest.approx(2.3)
    assert (one.low_rad, one.high_rad) == pytest.approx((-3.7, 6.3))
    assert one.near_rad == pytest.approx(0.3)
    with pytest.raises(ValueError, match=r"joint 1 .servo 1. was moved 0\.010 rad: must be more than twice"):
        calibrated(found, (0.0,), np.zeros(1), [1], (np.zeros(1), np.full(1, 0.01)), rounded=True, margin_rad=0.05)


def test_what_was_typed_before_a_question_is_no_answer_to_it(emulated: EmulatedBus, tmp_path: Path) -> None:
    run = Calibration(emulated, tmp_path / "arm.toml")
    try:
        run.until("hold the arm")
        assert run.process.stdin is not None
        run.process.stdin.write(b"\n\n\n")
        run.process.stdin.flush()
        run.until("put the arm into the pose")
        # The two surplus Enters do not confirm the pose: the command waits for a new one.
        with pytest.raises(TimeoutError):
            run.said.line(0.5)
        run.enter()
        run.until("turn joint 1")
    finally:
        run.close()


def test_answers_without_end_are_nobodys(emulated: EmulatedBus, tmp_path: Path) -> None:
    command = (
        f"yes '' | {sys.executable} -m haptether dynamixel calibrate {emulated.port} {tmp_path}/arm.toml --ids 1 2"
        " --yes"
    )
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 1
    assert "standard input does not wait for questions" in done.stderr
    assert not (tmp_path / "arm.toml").exists()


ONE = (ServoSettings(servo_id=1, model="XM430-W350"),)


def test_a_link_to_a_file_stays_and_the_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    file, link = tmp_path / "kept" / "arm.toml", tmp_path / "link.toml"
    link.symlink_to(file)
    # The link first points to a missing file, then to an existing one.
    for baud in (57_600, 1_000_000):
        write_calibration(link, baud, ONE)
        assert link.is_symlink()
        assert not file.is_symlink()
        assert read_calibration(file)[0] == baud
    assert [one.name for one in file.parent.iterdir()] == ["arm.toml"]


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_the_mode_is_that_of_any_new_file_or_of_the_one_before(tmp_path: Path, mask: int) -> None:
    path = tmp_path / "arm.toml"
    before = os.umask(mask)
    try:
        write_calibration(path, 57_600, ONE)
        assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask
        path.chmod(0o640)
        write_calibration(path, 57_600, ONE)
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
    finally:
        os.umask(before)


def test_file_and_folder_are_synchronised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, seen = tmp_path / "arm.toml", list[tuple[bool, bool]]()

    def fsync(descriptor: int) -> None:
        seen.append((stat.S_ISDIR(os.fstat(descriptor).st_mode), path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_calibration(path, 57_600, ONE)
    # The file is synchronised before the rename, its folder after it.
    assert seen == [(False, False), (True, True)]
