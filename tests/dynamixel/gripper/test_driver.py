"""A gripper on the bus of an emulated arm: it grips, and keeps its grip when the arm fails."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.ur.stalls import anew_after_stalls

from haptether.dynamixel.arm import ArmRefusedError
from haptether.slave import Gripper, GripperCommand, GripperSample
from haptether.slave.dynamixel.driver import DynamixelSlave
from haptether.slave.dynamixel.gripper.driver import DynamixelGripper

pytestmark = pytest.mark.live

PATIENCE_S = 10.0
ARM = '[[servo]]\nid = 1\nmodel = "XM430-W350"\n[[servo]]\nid = 2\nmodel = "XL330-M288"\n'
GRIPPER = {
    "id": 7,
    "model": "XL330-M288",
    "open_rad": 0.2,
    "closed_rad": -0.8,
    "lever_m": 0.05,
    "torque_constant": 0.354,
}
"""The torque constant is that of the emulated servo."""
CLOSE = GripperCommand(position=1.0, speed=2.0, force_n=2.0)
OPEN = GripperCommand(position=0.0, speed=2.0, force_n=2.0)


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    """Yield a bus with an object between the jaws, half way."""
    servos = ("--servos", "1=XM430-W350", "2=XL330-M288", "7=XL330-M288", "--start", "0.3", "0.5", "0.2")
    with emulated_bus(*servos, "--stops", "7=0.2:-0.3") as running:
        yield running


class Pair:
    """An arm and its gripper, led as by the loop of a slave."""

    def __init__(self, port: str, arm: Path, **options: Any) -> None:  # noqa: ANN401  # of the gripper
        self.arm = DynamixelSlave(
            port=port, arm=str(arm), timeout_s=0.1, watchdog_s=0.5, lost_after_s=0.3, ramp_s=0.1, release_s=0.0,
            verify_watchdog=False,
        )  # fmt: skip
        self.gripper = DynamixelGripper(**{**GRIPPER, **options})
        self.gripper.attach(self.arm)
        self.gripper.open()
        self.arm.open()

    def until(
        self, holds: Callable[[GripperSample, str | None], bool], command: GripperCommand | None = None
    ) -> GripperSample:
        """Tick until the condition on gripper and arm holds; without a command both are left alone."""
        end = time.monotonic() + PATIENCE_S
        while True:
            arm = self.arm.read()
            sample = self.gripper.read()
            if holds(sample, arm.fault):
                return sample
            assert time.monotonic() < end, (sample, arm)
            if command is not None:
                self.arm.write(tuple(arm.position), (0.0, 0.0))  # type: ignore[arg-type]
                self.gripper.write(command)
            time.sleep(0.002)

    def close(self) -> None:
        self.arm.close()
        self.gripper.close()


@contextmanager
def opened(emulated: EmulatedBus, tmp_path: Path) -> Iterator[Pair]:
    file = tmp_path / "arm.toml"
    file.write_text(ARM)
    pair = Pair(emulated.port, file)
    try:
        yield pair
    finally:
        pair.close()


def grips(sample: GripperSample, fault: str | None) -> bool:
    assert fault is None
    return sample.holds_object


def pressing(emulated: EmulatedBus) -> float:
    """Return the closing current in A: 2 N at 0.05 m with 0.354 N m/A are 0.282 A."""
    servo = emulated.servo(7)
    assert servo["torque"]
    return -float(servo["current_a"])


def test_it_is_found_by_its_name() -> None:
    (found,) = entry_points(group="haptether.grippers", name="dynamixel")
    assert found.load() is DynamixelGripper


def test_it_grips_and_lets_go(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        assert isinstance(pair.gripper, Gripper)
        assert pair.arm.axes == 2
        assert pair.gripper.read().position == pytest.approx(0.0, abs=0.01)
        begin_s = time.monotonic()
        held = pair.until(grips, CLOSE)
        # Half of the way at 2 1/s takes 0.25 s.
        assert time.monotonic() - begin_s > 0.2
        assert held.position == pytest.approx(0.5, abs=0.01)
        assert held.force_n == pytest.approx(2.0, abs=0.05)
        pair.until(lambda sample, _: sample.position < 0.02, OPEN)
        assert not pair.gripper.read().holds_object
        emulated.do("stops 7 off")
        empty = pair.until(lambda sample, _: sample.position > 0.98, CLOSE)
        assert not empty.holds_object


def test_force_follows_the_command(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        pair.until(
            lambda sample, _: abs(sample.force_n - 1.0) < 0.05, GripperCommand(position=1.0, speed=2.0, force_n=1.0)
        )
        # The cap of 0.525 A limits a command of 100 N.
        pair.until(
            lambda sample, _: abs(sample.force_n - 3.717) < 0.05, GripperCommand(position=1.0, speed=2.0, force_n=100.0)
        )


def test_a_hold_keeps_the_force_or_stops_the_jaws(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        slow = GripperCommand(position=1.0, speed=0.3, force_n=2.0)
        pair.until(lambda sample, _: sample.position > 0.1, slow)
        pair.gripper.hold()
        before = pair.until(lambda sample, _: abs(sample.velocity) < 0.01)
        assert before.position < 0.3
        pair.until(grips, CLOSE)
        pair.gripper.hold()
        end_s = time.monotonic() + 0.6
        pair.until(lambda sample, _: grips(sample, None) and time.monotonic() > end_s)
        assert pressing(emulated) == pytest.approx(0.282, abs=0.01)


def test_it_keeps_its_grip_through_the_end_and_the_next_begin(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
    assert pressing(emulated) == pytest.approx(0.282, abs=0.01)
    assert not emulated.servo(1)["torque"]
    with opened(emulated, tmp_path) as pair:
        pair.until(grips)
        assert pressing(emulated) == pytest.approx(0.282, abs=0.01)
    assert pressing(emulated) == pytest.approx(0.282, abs=0.01)


@anew_after_stalls
def test_a_grip_that_is_stronger_than_the_cap_is_let_down_to_it(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
    pair = Pair(emulated.port, tmp_path / "arm.toml", cap_a=0.1)
    try:
        # Nothing has been commanded yet.
        time.sleep(0.1)
        assert pressing(emulated) == pytest.approx(0.1, abs=0.01)
    finally:
        pair.close()


def test_an_arm_that_is_refused_leaves_it_its_grip(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
    emulated.do("temperature 1 79")
    with pytest.raises(ArmRefusedError, match="let it cool down"):
        Pair(emulated.port, tmp_path / "arm.toml")
    assert pressing(emulated) == pytest.approx(0.282, abs=0.01)


def test_a_fault_of_the_arm_ends_its_torque_and_not_the_grip(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        emulated.do("hardware-error 1 overheating")
        sample = pair.until(lambda _, fault: fault is not None)
        pair.gripper.hold()
        assert sample.fault is None
        assert pressing(emulated) == pytest.approx(0.282, abs=0.01)
        assert not emulated.servo(2)["torque"]
        pair.arm.acknowledge()
        pair.until(lambda sample, fault: fault is None and sample.holds_object)
        assert pressing(emulated) == pytest.approx(0.282, abs=0.01)


def test_a_process_that_is_killed_leaves_the_grip_and_ends_the_torque_of_the_joints(
    emulated: EmulatedBus, tmp_path: Path
) -> None:
    (tmp_path / "arm.toml").write_text(ARM)
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from tests.dynamixel.gripper.test_driver import CLOSE, Pair, grips\n"
        "pair = Pair(sys.argv[1], Path(sys.argv[2]))\n"
        "pair.until(grips, CLOSE)\n"
        "print('grips', flush=True)\n"
        "pair.until(lambda *_: False, CLOSE)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, emulated.port, str(tmp_path / "arm.toml")], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[3])])},
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "grips\n"
        finally:
            process.send_signal(signal.SIGKILL)
    end_s = time.monotonic() + PATIENCE_S
    while emulated.servo(1)["bus_watchdog"] != -1:
        assert time.monotonic() < end_s
        time.sleep(0.02)
    time.sleep(0.2)
    assert pressing(emulated) == pytest.approx(0.282, abs=0.01)
    assert emulated.servo(7)["bus_watchdog"] == 0


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("hardware-error 7 overload", "overload: servo 7: take the load off"),
        ("silent 7 on", r"no answer: of servo 7 \(gripper\)"),
    ],
)
def test_its_faults_are_none_of_the_arm_and_are_mended(
    emulated: EmulatedBus, tmp_path: Path, line: str, said: str
) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        emulated.do(line)
        sample = pair.until(lambda sample, _: sample.fault is not None, CLOSE)
        assert said.replace("\\", "") in str(sample.fault)
        # The joints are still led.
        end_s = time.monotonic() + 0.5
        pair.until(lambda _, fault: time.monotonic() > end_s or fault is not None, CLOSE)
        assert pair.arm.read().fault is None
        assert emulated.servo(1)["torque"]
        emulated.do("silent 7 off")
        pair.gripper.acknowledge()
        pair.until(lambda sample, _: sample.fault is None)
        pair.until(grips, CLOSE)


def test_a_fault_that_nobody_was_shown_is_not_acknowledged(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        emulated.do("hardware-error 7 overload")
        end_s = time.monotonic() + PATIENCE_S
        while pair.gripper.servo.fault is None:
            pair.arm.read()
            assert time.monotonic() < end_s
        pair.gripper.acknowledge()
        end_s = time.monotonic() + 1.0
        pair.until(lambda *_: time.monotonic() > end_s)
        assert pair.gripper.read().fault is not None


def test_torque_that_something_else_takes_off_is_a_fault(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        pair.arm.servos._opened.write(7, 64, b"\0")
        sample = pair.until(lambda sample, _: sample.fault is not None, CLOSE)
        assert "torque off: servo 7 (gripper)" in str(sample.fault)


def test_a_hot_servo_is_told_before_it_lets_go(
    emulated: EmulatedBus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        emulated.do("temperature 7 68")
        pair.until(lambda *_: pair.gripper.servo.temperature_c == 68, CLOSE)
        assert "servo 7 is at 68 degC; above 70 degC it lets go" in capsys.readouterr().err
        assert pair.gripper.read().fault is None


@pytest.mark.parametrize(
    ("options", "said"),
    [({"id": 9}, "servo 9: does not answer"), ({"closed_rad": -0.1, "open_rad": -0.8}, "open_rad and closed_rad")],
)
def test_a_gripper_that_cannot_be_is_refused(
    emulated: EmulatedBus, tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    (tmp_path / "arm.toml").write_text(ARM)
    with pytest.raises(ArmRefusedError, match=said):
        Pair(emulated.port, tmp_path / "arm.toml", **options)
    assert not any(servo["torque"] for servo in emulated.status()["servos"])


def test_it_has_an_id_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text(ARM)
    gripper = DynamixelGripper(**{**GRIPPER, "id": 2})
    with pytest.raises(ValueError, match="servo 2 is given twice"):
        gripper.attach(DynamixelSlave(port="/dev/null", arm=str(tmp_path / "arm.toml")))


def test_a_tick_has_one_read_and_one_write(emulated: EmulatedBus, tmp_path: Path) -> None:
    """Looks come ten times a second; one more instruction per tick would double the count."""
    with opened(emulated, tmp_path) as pair:
        pair.until(grips, CLOSE)
        begun = emulated.status()["instructions"]
        begin_s = time.monotonic()
        for index in range(200):
            sample = pair.arm.read()
            pair.arm.write(tuple(sample.position), (0.0, 0.0))  # type: ignore[arg-type]
            goal = 0.9 if index % 2 else 1.0
            pair.gripper.write(GripperCommand(position=goal, speed=2.0, force_n=2.0))
        looks = 30.0 * (time.monotonic() - begin_s)
        # This answer proves that the last write, which nobody answers, has been counted.
        pair.arm.read()
        assert 401 <= emulated.status()["instructions"] - begun <= 411 + looks
