"""Protocol 2.0 of a servo: parse instructions, encode answers.

Independent of the crate's codec, so that each tests the other.

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
"""Silence in s after which an incomplete packet is dropped."""


class Code(IntEnum):
    """Instruction code."""

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
    """Reason of a refusal, the low seven bits of the error byte."""

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
    """Return the CRC-16 with polynomial 0x8005, most significant bit first, continued from `crc`."""
    for byte in packet:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def stuffed(body: bytes) -> bytes:
    """Stuff the bytes from the instruction on: FD after each FF FF FD."""
    return body.replace(MARK, MARK + b"\xfd")


def unstuffed(body: bytes) -> bytes:
    """Remove stuffing; a mark without a following FD, as the vendor's client sends it, stays."""
    return body.replace(MARK + b"\xfd", MARK)


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the status packet of one servo."""
    body = stuffed(bytes((STATUS, error)) + parameters)
    packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def fast_header(lengths: list[int]) -> bytes:
    """Return the header of a fast read, sent by the first servo; its length covers the parts of all."""
    total = 1 + sum(length + 4 for length in lengths)
    return HEADER + bytes((BROADCAST,)) + total.to_bytes(2, "little") + bytes((STATUS,))


@dataclass(frozen=True, slots=True)
class Instruction:
    """Packet that was received completely.

    Args:
        id: Servo id, or `BROADCAST`.
        code: Instruction code, possibly unknown to Protocol 2.0.
        parameters: Parameters without stuffing.
        valid: True if its checksum is valid.
        size: Bytes on the wire.
    """

    id: int
    code: int
    parameters: bytes
    valid: bool
    size: int


class InstructionReader:
    """Parser of instructions; it uses the length field, so that missing stuffing does no harm."""

    def __init__(self) -> None:
        self._waiting = b""
        self._last_s = 0.0
        self.unstuffed = 0
        """Packets with an unstuffed mark inside."""
        self.dropped = 0
        """Bytes outside any packet."""

    def receive(self, received: bytes, now_s: float) -> list[Instruction]:
        """Return the instructions completed by these bytes."""
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
                # The end may be a partial header.
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
