"""A million garbled bytes on a bus, to servos and to a client: memory does not grow, and later packets are read."""

import contextlib
import os
import random
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.dynamixel.emulated import BAUD, emulated_bus

from haptether.dynamixel import DynamixelBus, SyncRead
from haptether.dynamixel.emulator.protocol import HEADER, MAX_PACKET, InstructionReader, crc16, status

BYTES = 1_000_000
PIECE = 64
MAX_GROWTH = 3 * BYTES // 4
"""Largest growth of memory in bytes; observed are 0.07 and 0.34 MB, because the interpreter also allocates."""


def instruction(servo_id: int, body: bytes) -> bytes:
    packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def garbled(seed: int, packet: bytes) -> Iterator[bytes]:
    """Yield noise, headers with wrong lengths, packets with a wrong bit, and some valid packets."""
    made, source = 0, random.Random(seed)
    while made < BYTES:
        kind, noise = source.randrange(4), source.randbytes(source.randrange(1, PIECE))
        if kind == 0:
            noise = HEADER + noise
        elif kind == 1:
            broken = bytearray(packet)
            broken[source.randrange(len(packet))] ^= 1 << source.randrange(8)
            noise = bytes(broken) + noise
        elif kind == 2:
            noise = packet + noise
        made += len(noise)
        yield noise


def resident(process: int) -> int:
    """Return the resident memory of a process in bytes."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def test_servo_buffers_less_than_a_packet_of_garbled_bytes() -> None:
    reader = InstructionReader()
    found = 0
    for piece in garbled(1, instruction(1, b"\x01")):
        found += len(reader.receive(piece, 0.0))
        assert len(reader._waiting) < MAX_PACKET + 2 * PIECE
    assert found > 1000
    assert reader.dropped > BYTES // 4


@pytest.mark.live
def test_a_process_of_servos_that_is_fed_garbled_bytes_stays_as_it_is() -> None:
    with emulated_bus("--servos", "1=XL330-M288") as emulated:
        emulated.status()
        line = os.open(emulated.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            before, end_s = resident(emulated.process.pid), time.monotonic() + 60.0
            # The packet reads the model, so that an accidentally valid one sets nothing.
            for piece in garbled(2, instruction(1, b"\x02\x00\x00\x02\x00")):
                left = piece
                while left:
                    with contextlib.suppress(BlockingIOError):
                        left = left[os.write(line, left) :]
                    with contextlib.suppress(BlockingIOError):
                        os.read(line, 4096)
                    assert time.monotonic() < end_s
        finally:
            os.close(line)
        assert emulated.status()["dropped_bytes"] > BYTES // 4
        assert resident(emulated.process.pid) - before < MAX_GROWTH
        # The rest of a packet is dropped after a silence.
        time.sleep(0.3)
        bus = DynamixelBus(emulated.port, baud=BAUD, timeout_s=0.2)
        assert bus.ping(1) == (1200, 52)
        bus.close()


@pytest.mark.live
def test_a_client_that_is_fed_garbled_bytes_stays_as_it_is_and_takes_none_for_a_value() -> None:
    adapter, terminal = os.openpty()
    tty.setraw(terminal)
    os.set_blocking(adapter, False)
    fed, over = [0], threading.Event()

    def feed() -> None:
        # Answers of another servo are valid packets, but not answers to this request.
        for piece in garbled(3, status(9, 0, bytes(10))):
            left = piece
            while left and not over.is_set():
                try:
                    left = left[os.write(adapter, left) :]
                except BlockingIOError:
                    time.sleep(1e-4)
                with contextlib.suppress(BlockingIOError):
                    os.read(adapter, 4096)
            fed[0] += len(piece)
        over.set()

    feeder = threading.Thread(target=feed, daemon=True)
    try:
        bus = DynamixelBus(os.ttyname(terminal), baud=BAUD, timeout_s=0.002)
        read = SyncRead(126, 10, [1, 2], fast=False)
        feeder.start()
        before, end_s, failed = resident(os.getpid()), time.monotonic() + 60.0, 0
        while not over.is_set():
            with contextlib.suppress(RuntimeError, OSError):
                bus.sync_read(read)
                pytest.fail("a value was made of noise")
            with contextlib.suppress(RuntimeError, OSError):
                bus.read(1, 132, 4)
                pytest.fail("a value was made of noise")
            failed += 2
            assert time.monotonic() < end_s
        assert fed[0] >= BYTES
        assert failed >= 2
        assert resident(os.getpid()) - before < MAX_GROWTH
        bus.close()
    finally:
        over.set()
        feeder.join(5.0)
        os.close(terminal)
        os.close(adapter)
