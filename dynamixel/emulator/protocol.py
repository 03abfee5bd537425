"""Protocol 2.0 as a servo speaks it: instructions out of bytes, answers into bytes.

It shares nothing with the codec of the crate, so that the two are a test of each other.

Source: ROBOTIS e-Manual, Protocol 2.0.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

HEADER: Final = b"\xff\xff\xfd\x00"
MARK: Final = b"\xff\xff\xfd"
BROADCAST: Final = 0xFE
MAX_ID: Final = 252
MAX_PACKET: Final = 1024
STATUS: Final = 0x55
ALERT: Final = 0x80
SILENCE_S: Final = 0.1
"""After so long without a byte, what was begun is no packet any more."""


class Code(IntEnum):
    """What an instruction asks for."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class ErrorNumber(IntEnum):
    """Why a servo refuses, the low seven bits of the error byte."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x8005) & 0xFFFF if crc & 0x8000 else crc << 1
        table.append(crc)
    return tuple(table)


_TABLE: Final = _crc_table()


def crc16(packet: bytes, crc: int = 0) -> int:
    """CRC-16 of polynomial 0x8005, most significant bit first, of `packet` after bytes of which it was `crc`."""
    for byte in packet:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def stuffed(body: bytes) -> bytes:
    """The bytes from the instruction on, with FD after each FF FF FD."""
    return body.replace(MARK, MARK + b"\xfd")


def unstuffed(body: bytes) -> bytes:
    """The bytes without stuffing; a mark that is not followed by FD stays, as the vendor's client sends it."""
    return body.replace(MARK + b"\xfd", MARK)


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """The packet in which one servo answers."""
    body = stuffed(bytes((STATUS, error)) + parameters)
    packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def fast_header(lengths: list[int]) -> bytes:
    """What the first servo of a fast read sends before its part: the length is that of the parts of all."""
    total = 1 + sum(length + 4 for length in lengths)
    return HEADER + bytes((BROADCAST,)) + total.to_bytes(2, "little") + bytes((STATUS,))


@dataclass(frozen=True, slots=True)
class Instruction:
    """A packet that was received whole.

    Args:
        id: The servo, or `BROADCAST`.
        code: What is asked for; also one that Protocol 2.0 does not have.
        parameters: Without stuffing.
        valid: Whether its checksum is right.
        size: Bytes on the wire.
    """

    id: int
    code: int
    parameters: bytes
    valid: bool
    size: int


class InstructionReader:
    """Turns bytes into instructions; goes by the length, so that stuffing that a client leaves out costs nothing."""

    def __init__(self) -> None:
        self._waiting = b""
        self._last_s = 0.0
        self.unstuffed = 0
        """Packets with a mark inside that its sender did not stuff."""
        self.dropped = 0
        """Bytes that belonged to no packet."""

    def receive(self, received: bytes, now_s: float) -> list[Instruction]:
        """The instructions that are complete with these bytes."""
        if now_s - self._last_s > SILENCE_S:
            self.dropped += len(self._waiting)
            self._waiting = b""
        self._last_s = now_s
        self._waiting += received
        found = []
        while (instruction := self._next()) is not None:
            found.append(instruction)
        return found

    def _next(self) -> Instruction | None:
        while True:
            begin = self._waiting.find(HEADER)
            if begin < 0:
                # The end may be the beginning of a header.
                keep = next((n for n in (3, 2, 1) if self._waiting.endswith(HEADER[:n])), 0)
                begin = len(self._waiting) - keep
                self._drop(begin)
                return None
            self._drop(begin)
            if len(self._waiting) < 7:
                return None
            size = 7 + int.from_bytes(self._waiting[5:7], "little")
            if not 10 <= size <= MAX_PACKET:
                self._drop(1)
                continue
            if len(self._waiting) < size:
                return None
            packet, self._waiting = self._waiting[:size], self._waiting[size:]
            raw = packet[7:-2]
            body = unstuffed(raw)
            self.unstuffed += raw.replace(MARK + b"\xfd", b"").count(MARK)
            valid = crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")
            return Instruction(packet[4], body[0], body[1:], valid, size)

    def _drop(self, count: int) -> None:
        self.dropped += count
        self._waiting = self._waiting[count:]
