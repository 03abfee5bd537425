"""The bus of a driver over a Unix socket instead of a serial port."""

import struct
from pathlib import Path

import pytest
from tests.dynamixel.emulated import emulated_bus

from haptether.cli import main
from haptether.dynamixel import DynamixelBus, SyncRead
from haptether.dynamixel.arm import ArmSettings, FaultKind, ServoArm, ServoSettings

pytestmark = pytest.mark.live

SERVOS = ("--servos", "1=XM430-W350", "2=XL330-M288", "--start", "0.3", "0.5")


def test_it_is_a_bus_like_that_on_a_terminal(tmp_path: Path) -> None:
    path = tmp_path / "bus"
    with emulated_bus(*SERVOS, "--socket", str(path)) as emulated:
        for _ in range(2):
            bus = DynamixelBus(str(path), baud=4_000_000, timeout_s=0.1)
            assert bus.ping(1)[0] == 1020
            bus.write(1, 65, b"\1")
            # Bytes that arrive before an instruction are not an answer to it.
            emulated.do("corrupt 1")
            with pytest.raises((RuntimeError, TimeoutError)):
                bus.read(1, 65, 1)
            assert bus.read(1, 65, 1) == b"\1"
            places = [place for *_, place in struct.iter_unpack("<hii", bus.sync_read(SyncRead(126, 10, [1, 2])))]
            assert places == pytest.approx([2048 + 0.3 / 1.5339808e-3, 2048 + 0.5 / 1.5339808e-3], abs=1.0)
            with pytest.raises(OSError, match=r"."):
                DynamixelBus(str(path), baud=4_000_000, timeout_s=0.1).ping(1)
            bus.close()
        with DynamixelBusOn(emulated.port) as bus:
            assert bus.read(1, 65, 1) == b"\1"
    assert not path.exists()


class DynamixelBusOn:
    """A bus that is closed with the block."""

    def __init__(self, port: str) -> None:
        self.bus = DynamixelBus(port, baud=4_000_000, timeout_s=0.1)

    def __enter__(self) -> DynamixelBus:
        return self.bus

    def __exit__(self, *_: object) -> None:
        self.bus.close()


def test_an_arm_whose_socket_ends_is_unplugged(tmp_path: Path) -> None:
    path = tmp_path / "bus"
    with emulated_bus(*SERVOS, "--socket", str(path)) as emulated:
        servos = (ServoSettings(servo_id=1, model="XM430-W350"), ServoSettings(servo_id=2, model="XL330-M288"))
        arm = ServoArm(
            ArmSettings(port=str(path), servos=servos, timeout_s=0.1, watchdog_s=0.5, verify_watchdog=False, ramp_s=0.0)
        )
        arm.open()
        try:
            assert arm.read()
            emulated.do("unplug")
            while arm.fault is None:
                arm.read()
            assert arm.fault_kind == FaultKind.UNPLUGGED
        finally:
            arm.close()


@pytest.mark.parametrize(
    ("more", "said"),
    [(("--tcp", "127.0.0.1:0"), "beside --tcp: must be one of the two"), ((), "must be a path that is free")],
)
def test_what_cannot_be_is_refused(
    tmp_path: Path, more: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "taken"
    path.touch()
    assert main(["dynamixel-emulator", "--duration-s", "1", "--socket", str(path), *more]) != 0
    assert said in capsys.readouterr().err
    assert path.is_file()
