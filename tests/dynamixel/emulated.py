"""An emulated bus as a process, its control line, and the vendor's client on its port."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from dynamixel_sdk import PacketHandler, PortHandler, port_handler  # type: ignore[import-untyped]
from tests.ur.emulated import START_S, Emulated, process_of

BAUD = 4_000_000
# The client waits this long for an answer beyond its bytes. Its default is 2 n + 2 ms; a loaded test machine may need
# more than 34 ms.
port_handler.LATENCY_TIMER = 150


class EmulatedBus(Emulated):
    """A running bus."""

    @property
    def port(self) -> str:
        """Path of its terminal."""
        return self.host

    def as_new(self) -> "EmulatedBus":
        """Reset the bus behind a new terminal, so that no client of an earlier test has it open."""
        self.do("unplug")
        self.do("reset")
        self.host = self.do("plug")
        return self

    def servo(self, servo_id: int) -> dict[str, Any]:
        """Return the state of one servo."""
        servos: list[dict[str, Any]] = self.status()["servos"]
        return next(servo for servo in servos if servo["id"] == servo_id)


@contextmanager
def emulated_bus(*arguments: str) -> Iterator[EmulatedBus]:
    """Run `haptether dynamixel-emulator` with its control line on standard input, and end it in any case."""
    command = [sys.executable, "-m", "haptether", "dynamixel-emulator", "--control", "-", *arguments]
    with process_of(command) as process:
        emulated = EmulatedBus(process, "")
        headline = emulated.line(START_S)
        emulated.host = headline.partition(" on ")[2].partition(" at ")[0]
        assert emulated.host.startswith("/"), headline
        yield emulated


class VendorClient:
    """dynamixel-sdk on a port, with the names that tests use."""

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self.port = PortHandler(port)
        assert self.port.openPort()
        assert self.port.setBaudRate(baud)
        self.packets = PacketHandler(2.0)

    def close(self) -> None:
        self.port.closePort()

    def read(self, servo_id: int, address: int, size: int) -> tuple[int, int, int]:
        """Return value, result of the transfer, error byte."""
        read = {1: self.packets.read1ByteTxRx, 2: self.packets.read2ByteTxRx, 4: self.packets.read4ByteTxRx}[size]
        value, result, error = read(self.port, servo_id, address)
        return int(value), int(result), int(error)

    def write(self, servo_id: int, address: int, size: int, value: int) -> tuple[int, int]:
        """Return result of the transfer, error byte."""
        write = {1: self.packets.write1ByteTxRx, 2: self.packets.write2ByteTxRx, 4: self.packets.write4ByteTxRx}[size]
        result, error = write(self.port, servo_id, address, value % (1 << (8 * size)))
        return int(result), int(error)


@contextmanager
def vendor_client(port: str, baud: int = BAUD) -> Iterator[VendorClient]:
    client = VendorClient(port, baud)
    try:
        yield client
    finally:
        client.close()
