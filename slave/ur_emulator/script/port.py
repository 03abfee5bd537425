"""Script interfaces (30001, 30002, 30003): splits text into programs and single lines, and reports their errors.

Source: Universal Robots, "Client Interfaces", robot message of type 10 (runtime exception).
"""

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

MAX_PROGRAM: Final = 2_000_000
"""Bytes of a program; that of ur_rtde has about 50 kB."""
MAX_HELD: Final = 8_000_000
"""Bytes of all programs without an end together."""
BEGINS: Final = re.compile(r"(def|sec)\s+(\w+)\s*\(\s*\)\s*:")
ENDS: Final = b"end"
"""Last line of a program: nothing before it, only space after it."""
MAX_FIRST_LINE: Final = 200
"""Characters of a line that are searched for the start of a program."""

ROBOT_MESSAGE, RUNTIME_EXCEPTION, CONTROLLER = 20, 10, -2
HEAD: Final = struct.Struct(">iBQbbii")
"""Size, type, time stamp in us, source, type of the message, line and column of the script."""
MAX_TEXT: Final = 1000
"""Bytes of a text."""


def ignored(_error: str) -> None:
    """Report an error to no client."""


@dataclass(frozen=True, slots=True)
class Submitted:
    """Program, or a single line without a name."""

    name: str
    text: str
    secondary: bool = False
    """True if it runs beside the running program (`sec`)."""
    failed: Callable[[str], None] = field(default=ignored, compare=False)
    """Receives the reason of a refusal, or the error that stopped it."""


class ScriptBudget:
    """Bytes of programs without an end that all connections hold together."""

    def __init__(self, limit: int = MAX_HELD) -> None:
        self.limit = limit
        self.bytes = 0

    def add(self, count: int) -> None:
        """Add to the bytes that are held, or subtract.

        Raises:
            ValueError: The sum exceeds the limit.
        """
        if self.bytes + count > self.limit:
            message = f"scripts without an end hold {self.bytes + count} bytes: must be at most {self.limit} together"
            raise ValueError(message)
        self.bytes += count


class ScriptReader:
    """Splits the text of one connection, which may arrive in any number of pieces.

    Args:
        held: Bytes that all connections hold together.
        failed: Receives errors of the programs.
    """

    def __init__(self, held: ScriptBudget | None = None, failed: Callable[[str], None] = ignored) -> None:
        self._budget = held or ScriptBudget()
        self._failed = failed
        self._waiting = bytearray()
        """Bytes of the program or line without an end."""
        self._line = 0
        """Start of its last line."""
        self._is_program = False

    def receive(self, received: bytes) -> Iterator[Submitted]:
        """Yield the complete programs and lines.

        Raises:
            ValueError: A program or a line has no end.
        """
        for piece in _lines(received):
            if (size := len(self._waiting) + len(piece)) > MAX_PROGRAM:
                message = f"script of {size} bytes without an end: must be at most {MAX_PROGRAM}"
                raise ValueError(message)
            self._budget.add(len(piece))
            self._waiting += piece
            if piece.endswith(b"\n") and (submitted := self._ended()) is not None:
                yield submitted

    def clear(self) -> None:
        """Free the bytes of the connection."""
        self._budget.add(-len(self._waiting))
        self._waiting, self._line, self._is_program = bytearray(), 0, False

    def _ended(self) -> Submitted | None:
        """Return the program or single line that an end of line completes, if any."""
        line = bytes(self._waiting[self._line :]).rstrip(b"\r\n")
        if not self._is_program:
            text = line.decode("utf-8", "replace")
            if BEGINS.match(text[:MAX_FIRST_LINE]):
                self._is_program, self._line = True, len(self._waiting)
                return None
            self.clear()
            text = text.strip()
            return Submitted("", text, failed=self._failed) if text and not text.startswith("#") else None
        self._line = len(self._waiting)
        if line.rstrip() != ENDS:
            return None
        text = self._waiting.decode("utf-8", "replace").replace("\r\n", "\n").removesuffix("\n")
        self.clear()
        begun = BEGINS.match(text)
        assert begun is not None
        kind, name = begun.groups()
        return Submitted(name, text, secondary=kind == "sec", failed=self._failed)


def _lines(received: bytes) -> Iterator[bytes]:
    """Yield lines with their end; a carriage return alone ends none."""
    begin = 0
    while (end := received.find(b"\n", begin)) >= 0:
        yield received[begin : end + 1]
        begin = end + 1
    if begin < len(received):
        yield received[begin:]


def runtime_exception(text: str, timestamp_s: float) -> bytes:
    """Return the robot message of a script error, at an unknown line: at most MAX_TEXT bytes of whole characters."""
    # Characters that UTF-8 cannot encode are escaped.
    encoded = text[:MAX_TEXT].encode("utf-8", "backslashreplace")[:MAX_TEXT]
    packed = encoded.decode("utf-8", "ignore").encode()
    stamp_us = int(1e6 * timestamp_s)
    return HEAD.pack(HEAD.size + len(packed), ROBOT_MESSAGE, stamp_us, CONTROLLER, RUNTIME_EXCEPTION, -1, -1) + packed
