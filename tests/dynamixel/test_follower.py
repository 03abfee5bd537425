"""The driver of an arm of servos as a slave, on an emulated bus."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus

from haptether.dynamixel.arm import ArmRefusedError
from haptether.slave import SlaveDevice, SlaveSample
from haptether.slave.dynamixel.driver import DynamixelSlave

pytestmark = pytest.mark.live

PATIENCE_S = 10.0
ARM = """
[[servo]]
id = 1
model = "XM430-W350"
[[servo]]
id = 2
model = "XL330-M288"
sign = -1
offset_rad = 0.5
low_rad = -1.0
high_rad = 1.0
"""


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", "1=XM430-W350", "2=XL330-M288", "--start", "0.3", "0.5") as running:
        yield running


def opened(
    emulated: EmulatedBus,
    tmp_path: Path,
    **options: Any,  # noqa: ANN401  # options of the driver
) -> closing[DynamixelSlave]:
    arm = tmp_path / "arm.toml"
    arm.write_text(ARM)
    patient = {"timeout_s": 0.1, "watchdog_s": 0.5, "ramp_s": 0.2, "release_s": 0.0, "verify_watchdog": False}
    driver = DynamixelSlave(port=emulated.port, arm=str(arm), **{**patient, **options})
    driver.open()
    return closing(driver)


def led(driver: DynamixelSlave, goal: tuple[float, ...], holds: Callable[[SlaveSample], bool]) -> SlaveSample:
    """Command a goal until a sample meets the condition."""
    end = time.monotonic() + PATIENCE_S
    while not holds(sample := driver.read()):
        driver.write(goal, (0.0,) * len(goal))
        assert time.monotonic() < end, sample
        time.sleep(0.002)
    return sample


def without_torque(emulated: EmulatedBus) -> None:
    """Wait until no servo has torque: no answer confirms a stop."""
    end = time.monotonic() + PATIENCE_S
    while any(servo["torque"] for servo in emulated.status()["servos"]):
        assert time.monotonic() < end
        time.sleep(0.01)


def near(goal: tuple[float, ...]) -> Callable[[SlaveSample], bool]:
    return lambda sample: all(abs(a - b) < 0.02 for a, b in zip(sample.position, goal, strict=True))  # type: ignore[arg-type]


def test_it_is_found_by_its_name() -> None:
    (found,) = entry_points(group="haptether.slaves", name="dynamixel")
    assert found.load() is DynamixelSlave
    assert DynamixelSlave.kinds == ("joints",)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"port": "/dev/null"}, "options: arm is missing: must be the file of the arm"),
        ({"port": "/dev/null", "arm": "/nowhere.toml", "mode": "pwm"}, "mode = 'pwm': must be one of"),
        (
            {"port": "/dev/null", "arm": "/nowhere.toml"},
            "arm = '/nowhere.toml': No such file or directory: must be",
        ),
        ({"port": "/dev/null", "arm": "A", "coulomb": [0.1]}, "must have 2 numbers, one of each joint"),
        ({"port": "/dev/null", "arm": "A", "max_speed": math.nan}, "max_speed = nan: must be finite"),
        ({"port": "/dev/null", "arm": "A", "speed": 1}, "is no option"),
        ({"port": "/dev/null", "arm": "B"}, "servo 1: sign = 2: must be 1 or -1"),
        ({"port": "/dev/null", "arm": "C"}, "XL430-W250 must have one of 4"),
    ],
)
def test_options_that_cannot_be(tmp_path: Path, options: dict[str, Any], said: str) -> None:
    texts = {"A": ARM, "B": ARM.replace("sign = -1", "sign = 1").replace("id = 1\n", "id = 1\nsign = 2\n"),
             "C": ARM.replace("XM430-W350", "XL430-W250")}  # fmt: skip
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    if options.get("arm") in texts:
        options = {**options, "arm": str(tmp_path / options["arm"])}
    with pytest.raises(ValueError, match=said):
        DynamixelSlave(**options)


@pytest.mark.parametrize("mode", ["current-position", "position"])
def test_joints_follow_within_limits_and_speed(emulated: EmulatedBus, tmp_path: Path, mode: str) -> None:
    with opened(emulated, tmp_path, mode=mode, max_jump=0.5, start="ramp", max_speed=2.0) as driver:
        assert isinstance(driver, SlaveDevice)
        assert driver.axes == 2
        sample = driver.read()
        # q = sign (p - offset).
        assert sample.position == pytest.approx([0.3, 0.0], abs=2e-3)
        begin = time.monotonic()
        led(driver, (1.3, -0.4), near((1.3, -0.4)))
        assert time.monotonic() - begin > 0.4
        assert emulated.servo(2)["position_rad"] == pytest.approx(0.9, abs=0.03)
        # A goal beyond the limit is held at the limit.
        led(driver, (1.3, -3.0), near((1.3, -1.0)))
        driver.stop()
        time.sleep(0.05)
        assert driver.read().position == pytest.approx([1.3, -1.0], abs=0.03)
        assert driver.read().fault is None


def test_what_blocks_a_joint_lets_it_go_no_further_than_its_lag(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path, max_speed=2.0, max_jump=0.5, start="ramp", max_lag=0.2) as driver:

        def pressed(seconds: float) -> float:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                driver.read()
                driver.write((1.5, 0.0), (0.0, 0.0))
            return float(emulated.servo(1)["position_rad"])

        def freed() -> float:
            emulated.do("stops 1 off")
            time.sleep(0.3)
            return float(emulated.servo(1)["position_rad"])

        led(driver, (0.3, 0.0), near((0.3, 0.0)))
        emulated.do("stops 1 -1 0.4")
        # Press for much longer than the motion to the goal takes.
        blocked = pressed(1.5)
        assert blocked == pytest.approx(0.4, abs=0.02)
        # Without a new command the arm moves by the allowed lag and the servo's overshoot.
        assert freed() == pytest.approx(blocked + 0.2, abs=0.04)
        emulated.do("stops 1 -1 0.7")
        blocked = pressed(0.5)
        driver.stop()
        assert freed() == pytest.approx(blocked + 0.05, abs=0.04)


def test_a_first_command_far_away_is_refused(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as driver:
        led(driver, (0.35, 0.0), near((0.35, 0.0)))
        driver.stop()
        driver.write((0.8, 0.0), (0.0, 0.0))
        fault = str(driver.read().fault)
        assert fault.startswith("misaligned start: the first command has joint 1 0.4"), fault
        # The arm holds its joints, so that nothing falls.
        assert [servo["torque"] for servo in emulated.status()["servos"]] == [True, True]
        driver.write((0.35, 0.0), (0.0, 0.0))
        assert driver.read().fault == fault
        assert driver.read().position == pytest.approx([0.35, 0.0], abs=0.03)
        driver.acknowledge()
        assert driver.read().fault is None
        led(driver, (0.4, 0.0), near((0.4, 0.0)))


def test_a_number_that_is_none_is_not_obeyed(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as driver:
        led(driver, (0.3, 0.0), near((0.3, 0.0)))
        driver.write((math.nan, 0.0), (0.0, 0.0))
        assert "an angle was commanded that is no number" in str(driver.read().fault)
        assert [servo["torque"] for servo in emulated.status()["servos"]] == [True, True]


def test_a_push_is_felt_with_its_sign(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path, coulomb=[0.08, 0.01]) as driver:
        led(driver, (0.3, 0.0), near((0.3, 0.0)))
        emulated.do("push 1 0.4")
        emulated.do("push 2 0.05")
        # The second joint has a negative sign.
        sample = led(driver, (0.3, 0.0), lambda s: s.force[0] > 0.2 and s.force[1] < -0.02)  # type: ignore[index]
        assert sample.force[0] < 0.5  # type: ignore[index]


def test_a_fault_keeps_the_last_place_and_no_force(emulated: EmulatedBus, tmp_path: Path) -> None:
    with opened(emulated, tmp_path) as driver:
        led(driver, (0.3, 0.0), near((0.3, 0.0)))
        emulated.do("hardware-error 2 overload")
        sample = led(driver, (0.3, 0.0), lambda s: s.fault is not None)
        assert str(sample.fault).startswith("overload: servo 2: take the load off")
        assert list(sample.force) == [0.0, 0.0]  # type: ignore[arg-type]
        assert all(map(math.isfinite, sample.position))  # type: ignore[arg-type]
        without_torque(emulated)
        # After an acknowledgement by a person who has seen it, the servo restarts.
        driver.acknowledge()
        led(driver, (0.3, 0.0), lambda s: s.fault is None)
        assert [servo["torque"] for servo in emulated.status()["servos"]] == [True, True]


def test_an_unready_arm_is_refused(emulated: EmulatedBus, tmp_path: Path) -> None:
    emulated.do("place 2 2.0")
    with pytest.raises(ArmRefusedError, match=r"servo 2: stands at -1\.500 rad of -1\.000"), opened(emulated, tmp_path):
        pass
