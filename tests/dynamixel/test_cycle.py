"""Duration of a cycle on the bus; a faster loop is refused with that number."""

from pathlib import Path

import pytest
from tests.dynamixel.emulated import emulated_bus

from haptether.bridge import DeviceError
from haptether.bridge.devices.open import DeviceNotes, opened
from haptether.dynamixel import OperatingMode
from haptether.dynamixel.arm import ArmSettings, ServoSettings, write_calibration
from haptether.dynamixel.arm.cycle import cycle_s
from haptether.slave.dynamixel.driver import DynamixelSlave


def servos(count: int, mode: OperatingMode = OperatingMode.CURRENT) -> tuple[ServoSettings, ...]:
    return tuple(ServoSettings(servo_id=1 + index, model="XM430-W350", mode=mode) for index in range(count))


@pytest.mark.parametrize(
    ("baud", "fast", "expected_ms"),
    # 178 and 144 bytes for six servos.
    [(57_600, False, 30.90), (57_600, True, 25.0), (1_000_000, False, 1.78), (4_000_000, True, 0.36)],
)
def test_the_bytes_of_six_servos(baud: int, fast: bool, expected_ms: float) -> None:
    settings = ArmSettings(port="/dev/null", servos=servos(6), baud=baud)
    assert cycle_s(settings, fast=fast) == pytest.approx(1e-3 * expected_ms, abs=5e-6)
    assert cycle_s(settings, fast=fast, return_delay_s=5e-4) == pytest.approx(1e-3 * expected_ms + 3e-3, abs=5e-6)


def test_positions_are_longer_than_currents() -> None:
    both = (*servos(2), ServoSettings(servo_id=3, model="XM430-W350", mode=OperatingMode.CURRENT_BASED_POSITION))
    of = [cycle_s(ArmSettings(port="/dev/null", servos=one), fast=True) for one in (both[:2], both)]
    # The request, the answer and a write of its own.
    assert of[1] - of[0] == pytest.approx(10 * (1 + 14 + 19) / 4_000_000)


@pytest.mark.live
@pytest.mark.parametrize(("period_s", "is_refused"), [(1e-3, True), (0.012, True), (0.02, False)])
def test_the_factory_rate_is_refused_with_the_number(tmp_path: Path, period_s: float, is_refused: bool) -> None:
    arm = tmp_path / "arm.toml"
    names = ("1=XM430-W350", "2=XM430-W350")
    write_calibration(arm, 57_600, servos(2))
    with emulated_bus("--servos", *names, "--baud", "57600") as emulated:
        driver = DynamixelSlave(
            port=emulated.port, arm=str(arm), verify_watchdog=False, timeout_s=0.1, ramp_s=0.0, release_s=0.0
        )
        if is_refused:
            with (
                pytest.raises(
                    DeviceError, match=rf"period_s = {period_s:g}: .* takes 1\d\.\d ms: must be at least 0\.01"
                ),
                opened(driver, DeviceNotes(), "period_s", period_s),
            ):
                pytest.fail("it must not be driven")
        else:
            with opened(driver, DeviceNotes(), "period_s", period_s):
                assert driver.cycle_s == pytest.approx(0.0132, abs=1e-4)
        assert not any(servo["torque"] for servo in emulated.status()["servos"])
