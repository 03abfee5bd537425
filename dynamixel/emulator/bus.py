"""Emulated servos on one bus: answers, their order, and faults on command."""

import random
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from haptether.dynamixel.emulator.protocol import (
    BROADCAST,
    MAX_ID,
    MAX_PACKET,
    Code,
    ErrorNumber,
    Instruction,
    InstructionReader,
    crc16,
    fast_header,
    status,
)
from haptether.dynamixel.emulator.servo import REBOOT_S, Servo

if TYPE_CHECKING:
    from haptether.dynamixel.emulator.load import ArmLoad

CLEAR_TURNS: Final = b"\x01\x44\x58\x4c\x22"
"""Required parameters of a Clear instruction."""
LOG_LINES: Final = 1000
OVERHEAD: Final = 8
"""Bytes of a fast answer before the part of the first servo."""


@dataclass(slots=True)
class Faults:
    """Faults of the next answers."""

    drop: int = 0
    """Number of answers that lose one byte."""
    corrupt: int = 0
    """Number of answers with one wrong bit."""
    mute: int = 0
    """Number of suppressed answers."""

    def reset(self) -> None:
        """Clear all faults."""
        self.drop = self.corrupt = self.mute = 0


@dataclass(frozen=True, slots=True)
class Answer:
    """Bytes for the client.

    Args:
        sent: Bytes sent.
        delay_s: Return delay of the servos that sent them.
    """

    sent: bytes
    delay_s: float


class Bus:
    """Servos on the same bus.

    Args:
        servos: Servos with distinct ids.
        seed: Seed for the choice of lost or wrong bytes.
        load: Load of an arm that they move, if any.

    Raises:
        ValueError: No servo, or duplicate ids.
    """

    def __init__(self, servos: Iterable[Servo], seed: int = 0, load: "ArmLoad | None" = None) -> None:
        self.servos = list(servos)
        self._load = load
        ids = [servo.id for servo in self.servos]
        if not ids:
            message = "servos: must be at least one"
            raise ValueError(message)
        if len(set(ids)) < len(ids):
            twice = next(servo_id for servo_id in ids if ids.count(servo_id) > 1)
            message = f"id {twice} is given twice: each servo must have its own"
            raise ValueError(message)
        self.faults = Faults()
        self.reader = InstructionReader()
        self.instructions = 0
        """Number of received instructions with a valid checksum."""
        self.refused = 0
        """Number of received instructions with an invalid checksum."""
        self.log: deque[str] = deque(maxlen=LOG_LINES)
        self._random = random.Random(seed)
        self._hearing: list[Servo] = []
        """Servos that understand the current instruction."""
        self._obeying: dict[int, list[Servo]] = {}
        """The same servos by the ids that they obey: own and shadow ids."""
        self._handlers: dict[int, Callable[[Instruction, float], list[Answer]]] = {
            Code.PING: self._ping,
            Code.READ: self._read,
            Code.WRITE: lambda i, now_s: self._write(i, lambda servo, at, raw: servo.write(at, raw, now_s)),
            Code.REG_WRITE: lambda i, _now_s: self._write(i, lambda servo, at, raw: servo.register(at, raw)),
            Code.ACTION: lambda i, now_s: self._each(i, lambda servo: servo.act(now_s)),
            # Refused, because ids and rates of an arm must not change.
            Code.FACTORY_RESET: lambda i, _now_s: self._each(i, lambda _servo: ErrorNumber.RESULT_FAIL),
            Code.REBOOT: self._reboot,
            Code.CLEAR: lambda i, _now_s: self._each(i, lambda servo: _clear(servo, i.parameters)),
            Code.SYNC_READ: self._sync_read,
            Code.FAST_SYNC_READ: self._sync_read,
            Code.SYNC_WRITE: self._sync_write,
            Code.BULK_READ: self._bulk_read,
            Code.FAST_BULK_READ: self._bulk_read,
            Code.BULK_WRITE: self._bulk_write,
        }

    # ------------------------------------------------------------------------------------------------ over time

    def advance(self, now_s: float) -> None:
        """Advance all servos to a time."""
        if self._load is not None:
            self._load.advance(now_s)
        for servo in self.servos:
            servo.move(now_s)

    def receive(self, received: bytes, now_s: float, baud: int | None = None) -> list[Answer]:
        """Return the answers of the servos to received bytes.

        Args:
            received: Received bytes.
            now_s: Time in s.
            baud: Rate of the bytes in bit/s; servos at another rate ignore them. None matches every servo.
        """
        answers = []
        for instruction in self.reader.receive(received, now_s):
            self._hearing = [s for s in self.servos if s.is_listening(now_s) and baud in {None, s.baud}]
            self._obeying = {}
            for servo in self._hearing:
                for servo_id in {servo.id, _shadow(servo)}:
                    self._obeying.setdefault(servo_id, []).append(servo)
            answers += self._handle(instruction, now_s)
        return answers

    def brown_out(self, silent_s: float, now_s: float) -> None:
        """Cut the supply of all servos for a time in s; they restart."""
        for servo in self.servos:
            servo.reboot(now_s, silent_s)
        self.write_log(f"brown-out of {silent_s:g} s")

    def servo(self, servo_id: int) -> Servo:
        """Return a servo by id.

        Raises:
            ValueError: The id does not exist.
        """
        for servo in self.servos:
            if servo.id == servo_id:
                return servo
        message = f"id {servo_id}: must be one of {', '.join(str(servo.id) for servo in self.servos)}"
        raise ValueError(message)

    def figures(self) -> dict[str, Any]:
        """Return the state of bus and servos."""
        return {
            "instructions": self.instructions,
            "refused_instructions": self.refused,
            "dropped_bytes": self.reader.dropped,
            "unstuffed": self.reader.unstuffed,
            "servos": [servo.figures() for servo in self.servos],
        }

    def write_log(self, line: str) -> None:
        """Append a line to the log."""
        self.log.append(line)

    # --------------------------------------------------------------------------------------------- instructions

    def _handle(self, instruction: Instruction, now_s: float) -> list[Answer]:
        self.advance(now_s)
        if not instruction.valid:
            self.refused += 1
            self.write_log(f"wrong CRC of an instruction for id {instruction.id}")
            return self._answered(self._each(instruction, lambda _servo: ErrorNumber.CRC))
        self.instructions += 1
        for servo in self._hearing:
            servo.heard(now_s)
        handler = self._handlers.get(instruction.code)
        if handler is None:
            return self._answered(self._each(instruction, lambda _servo: ErrorNumber.INSTRUCTION))
        return self._answered(handler(instruction, now_s))

    def _answered(self, answers: list[Answer]) -> list[Answer]:
        """Apply the commanded faults to answers."""
        out = []
        for answer in answers:
            sent = bytearray(answer.sent)
            if self.faults.mute:
                self.faults.mute -= 1
                continue
            if self.faults.drop:
                self.faults.drop -= 1
                del sent[self._random.randrange(len(sent))]
            if self.faults.corrupt:
                self.faults.corrupt -= 1
                sent[self._random.randrange(len(sent))] ^= 1 << self._random.randrange(8)
            out.append(Answer(bytes(sent), answer.delay_s))
        return out

    def _addressed(self, instruction: Instruction) -> list[Servo]:
        """Return the addressed servos: all, or those with this id or shadow id."""
        if instruction.id == BROADCAST:
            return self._hearing
        return self._obeying.get(instruction.id, [])

    def _each(self, instruction: Instruction, do: Callable[[Servo], ErrorNumber]) -> list[Answer]:
        """Apply an action to each addressed servo, and return the answer of the servo with the id.

        A changed id or return level takes effect from the next instruction on.
        """
        before = [(servo, servo.id, servo.return_level) for servo in self._addressed(instruction)]
        answers = []
        for servo, servo_id, level in before:
            error = do(servo)
            if servo_id == instruction.id and level >= 2 and not servo.silent:
                answers.append(Answer(status(servo_id, error | servo.alert), servo.return_delay_s))
        return answers

    def _ping(self, instruction: Instruction, _now_s: float) -> list[Answer]:
        pinged = sorted(self._addressed(instruction), key=lambda servo: servo.id)
        return [
            Answer(
                status(
                    servo.id,
                    servo.alert,
                    servo.model.number.to_bytes(2, "little") + bytes((servo.value("Firmware Version"),)),
                ),
                servo.return_delay_s,
            )
            for servo in pinged
            if not servo.silent and instruction.id in {BROADCAST, servo.id}
        ]

    def _read(self, instruction: Instruction, _now_s: float) -> list[Answer]:
        servo = self._answering(instruction.id)
        if servo is None:
            return []
        if len(instruction.parameters) != 4:
            return [_answer(servo, ErrorNumber.DATA_LENGTH)]
        error, found = servo.read(*_span(instruction.parameters))
        return [_answer(servo, error, found)]

    def _write(self, instruction: Instruction, do: Callable[[Servo, int, bytes], ErrorNumber]) -> list[Answer]:
        if len(instruction.parameters) < 3:
            return self._each(instruction, lambda _servo: ErrorNumber.DATA_LENGTH)
        address = int.from_bytes(instruction.parameters[:2], "little")
        return self._each(instruction, lambda servo: do(servo, address, instruction.parameters[2:]))

    def _reboot(self, instruction: Instruction, now_s: float) -> list[Answer]:
        answers = self._each(instruction, lambda _servo: ErrorNumber.NONE)
        for servo in self._addressed(instruction):
            servo.reboot(now_s, REBOOT_S)
        return answers

    def _sync_read(self, instruction: Instruction, _now_s: float) -> list[Answer]:
        parameters = instruction.parameters
        if instruction.id != BROADCAST or len(parameters) < 5:
            return []
        address, length = _span(parameters)
        reads = [(servo_id, address, length) for servo_id in parameters[4:]]
        return self._read_all(reads, instruction.code == Code.FAST_SYNC_READ)

    def _bulk_read(self, instruction: Instruction, _now_s: float) -> list[Answer]:
        parameters = instruction.parameters
        if instruction.id != BROADCAST or not parameters or len(parameters) % 5:
            return []
        reads = [(parameters[at], *_span(parameters[at + 1 : at + 5])) for at in range(0, len(parameters), 5)]
        return self._read_all(reads, instruction.code == Code.FAST_BULK_READ)

    def _read_all(self, reads: list[tuple[int, int, int]], fast: bool) -> list[Answer]:
        """Return the answers of several servos; each waits for the previous one, so none follows a silent servo."""
        answers = []
        sent = b""
        delay_s = 0.0
        if fast and sum(length + 4 for _, _, length in reads) + OVERHEAD > MAX_PACKET:
            return []
        for index, (servo_id, address, length) in enumerate(reads):
            servo = self._answering(servo_id)
            if servo is None or (fast and not servo.knows_fast_reads):
                break
            error, found = servo.read(address, length)
            if not fast:
                answers.append(_answer(servo, error, found))
                continue
            if index == 0:
                sent = fast_header([one[2] for one in reads])
                delay_s = servo.return_delay_s
            # A refusing servo sends a part of the expected length.
            sent += bytes((error | servo.alert, servo.id)) + found.ljust(length, b"\0")
            sent += crc16(sent).to_bytes(2, "little")
        return [Answer(sent, delay_s)] if sent else answers

    def _sync_write(self, instruction: Instruction, now_s: float) -> list[Answer]:
        parameters = instruction.parameters
        if instruction.id == BROADCAST and len(parameters) > 4:
            address, length = _span(parameters)
            share = length + 1
            if len(parameters[4:]) % share == 0:
                for at in range(4, len(parameters), share):
                    self._set(parameters[at], address, parameters[at + 1 : at + share], now_s)
        return []

    def _bulk_write(self, instruction: Instruction, now_s: float) -> list[Answer]:
        rest = instruction.parameters if instruction.id == BROADCAST else b""
        while len(rest) > 5:
            address, length = _span(rest[1:5])
            self._set(rest[0], address, rest[5 : 5 + length], now_s)
            rest = rest[5 + length :]
        return []

    def _set(self, servo_id: int, address: int, written: bytes, now_s: float) -> None:
        for servo in self._obeying.get(servo_id, []):
            error = servo.write(address, written, now_s)
            if error != ErrorNumber.NONE:
                # The client is not informed.
                self.write_log(f"id {servo.id} refused a write to {address}: {error.name.lower()}")

    def _answering(self, servo_id: int) -> Servo | None:
        """Return the servo with an id if it answers reads."""
        for servo in self._obeying.get(servo_id, []):
            if servo.id == servo_id and not servo.silent and servo.return_level >= 1:
                return servo
        return None


def _answer(servo: Servo, error: ErrorNumber, parameters: bytes = b"") -> Answer:
    return Answer(status(servo.id, error | servo.alert, parameters), servo.return_delay_s)


def _span(parameters: bytes) -> tuple[int, int]:
    return int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")


def _shadow(servo: Servo) -> int:
    shadow = servo.value("Secondary(Shadow) ID")
    return shadow if shadow <= MAX_ID else servo.id


def _clear(servo: Servo, parameters: bytes) -> ErrorNumber:
    return servo.clear_turns() if parameters == CLEAR_TURNS else ErrorNumber.DATA_RANGE
