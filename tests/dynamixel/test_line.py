"""Traffic on the line: deadlines that account for it, and a stop that does not wait for silence."""

import contextlib
import os
import struct
import threading
import time
import tty
from collections.abc import Iterator

import pytest
from tests.dynamixel.emulated import emulated_bus

from haptether.dynamixel import DynamixelBus, SyncRead

pytestmark = pytest.mark.live

SLOW = 57_600
IDS = tuple(range(1, 8))
GOALS = bytes(2 * len(IDS))
ZEROS = bytes(len(IDS))
PATIENCE_S = 5.0


def test_a_deadline_counts_what_was_sent_before() -> None:
    arguments = ("--servos", *(f"{servo_id}=XL330-M288" for servo_id in IDS), "--baud", str(SLOW), "--wire-time")
    with emulated_bus(*arguments) as emulated:
        bus = DynamixelBus(emulated.port, baud=SLOW, timeout_s=0.1)
        try:
            read = SyncRead(126, 10, list(IDS))
            bus.sync_read(read)
            for _ in range(40):
                # Each write takes 6 ms: the answer waits a quarter of a second for all of them.
                bus.sync_write(102, 2, bytes(IDS), GOALS)
            begin = time.monotonic()
            assert len(bus.sync_read(read)) == 10 * len(IDS)
            assert time.monotonic() - begin > 0.15
        finally:
            bus.close()


class Line:
    """The other end of a port, with a device that sends unrequested bytes."""

    def __init__(self) -> None:
        self.adapter, terminal = os.openpty()
        tty.setraw(terminal)
        self.terminal = terminal
        self.port = os.ttyname(terminal)
        self.heard = b""
        self.noisy = True
        self.thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        os.set_blocking(self.adapter, False)
        while self.noisy:
            with contextlib.suppress(BlockingIOError):
                os.write(self.adapter, b"\x55" * 20)
            with contextlib.suppress(BlockingIOError):
                self.heard += os.read(self.adapter, 4096)
            time.sleep(0.001)


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    made.thread.start()
    yield made
    made.noisy = False
    made.thread.join(PATIENCE_S)
    os.close(made.adapter)
    os.close(made.terminal)


def test_a_stop_goes_out_on_a_line_that_is_never_silent(line: Line) -> None:
    bus = DynamixelBus(line.port, baud=4_000_000, timeout_s=0.02)
    with pytest.raises(RuntimeError, match="bytes that nobody asked for arrive without end"):
        # A write to one servo expects an answer, but these bytes are none: the write is not sent.
        bus.write(1, 64, b"\0")
    before = line.heard
    assert before == b""
    bus.stop(102, 2, bytes(IDS), GOALS)
    bus.stop(64, 1, bytes(IDS), ZEROS)
    bus.write(254, 64, b"\0")
    parts = b"".join(struct.pack("<B", servo_id) + b"\0\0" for servo_id in IDS)
    currents = b"\xff\xff\xfd\x00\xfe" + struct.pack("<HBHH", 7 + len(parts), 0x83, 102, 2) + parts
    end = time.monotonic() + PATIENCE_S
    while line.heard.count(b"\xff\xff\xfd\x00") < 7:
        assert time.monotonic() < end, line.heard
        time.sleep(0.01)
    assert line.heard.count(currents) == 3
    torque = bytes((0x83, 64, 0, 1, 0)) + b"".join(bytes((servo_id, 0)) for servo_id in IDS)
    assert line.heard.count(torque) == 3
    bus.close()
