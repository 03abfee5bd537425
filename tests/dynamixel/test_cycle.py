"""Duration of a cycle on the bus; a faster loop is refused with that number."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.dynamixel.emulated import emulated_bus

from haptether.bridge import DeviceError
from haptether.bridge.devices.open import DeviceNotes, check_period, opened
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


@given(st.floats(1e-5, 10.0))
def test_the_number_of_a_refusal_is_accepted(cycle_s: float) -> None:
    def refusal(period_s: float) -> str:
        try:
            check_period(SimpleNamespace(cycle_s=cycle_s, paces=False), "period_s", period_s)
        except DeviceError as error:
            return str(error)
        return ""

    message = refusal(0.5 * cycle_s)
    least_s = float(message.partition("must be at least ")[2].partition(";")[0])
    assert least_s == pytest.approx(cycle_s, rel=0.011)
    assert 1e-3 * float(message.partition("takes ")[2].partition(" ms")[0]) == pytest.approx(least_s, rel=1e-9)
    assert refusal(least_s) == ""


@pytest.mark.live
@pytest.mark.parametrize("baud", [57_600, 1_000_000])
def test_a_refused_period_is_no_fault_of_a_servo(tmp_path: Path, capfd: pytest.CaptureFixture[str], baud: int) -> None:
    arm = tmp_path / "arm.toml"
    write_calibration(arm, baud, servos(2))
    with emulated_bus("--servos", "1=XM430-W350", "2=XM430-W350", "--baud", str(baud)) as emulated:
        driver = DynamixelSlave(port=emulated.port, arm=str(arm), verify_watchdog=False, timeout_s=0.1)
        with pytest.raises(DeviceError, match="a cycle on the bus"), opened(driver, DeviceNotes(), "period_s", 1e-4):
            pytest.fail("it must not be driven")
        assert not any(servo["torque"] for servo in emulated.status()["servos"])
    assert "fault" not in capfd.readouterr().err


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
