"""Script interfaces (30001, 30002, 30003): text comes in, programs and single lines come out."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

LONGEST: Final = 2_000_000
"""Bytes that a program may have; that of ur_rtde has some 50 kB."""
MAX_HELD: Final = 8_000_000
"""Bytes that all programs without an end may have together."""
BEGINS: Final = re.compile(r"(def|sec)\s+(\w+)\s*\(\s*\)\s*:")
ENDS: Final = b"end"
"""The line that ends a program: nothing before it, nothing but space behind it."""
MAX_FIRST_LINE: Final = 200
"""Characters of a line in which a program may begin."""


def nobody(_error: str) -> None:
    """Nobody waits for it."""


@dataclass(frozen=True, slots=True)
class Submitted:
    """A program, or a single line without a name."""

    name: str
    text: str
    secondary: bool = False
    """Whether it runs beside the program that runs (`sec`)."""
    failed: Callable[[str], None] = field(default=nobody, compare=False)
    """Is told why it was refused, or what stopped it."""


class ScriptBudget:
    """Bytes of scripts without an end that all connections hold."""

    def __init__(self, most: int = MAX_HELD) -> None:
        self.most = most
        self.bytes = 0

    def add(self, count: int) -> None:
        """So many more, or fewer.

        Raises:
            ValueError: Too many.
        """
        if self.bytes + count > self.most:
            message = f"scripts without an end hold {self.bytes + count} bytes: must be at most {self.most} together"
            raise ValueError(message)
        self.bytes += count


class ScriptReader:
    """Takes the text of one connection apart, in however many pieces it comes.

    Args:
        held: What all connections hold together.
        failed: Of what is submitted.
    """

    def __init__(self, held: ScriptBudget | None = None, failed: Callable[[str], None] = nobody) -> None:
        self._all = held or ScriptBudget()
        self._failed = failed
        self._waiting = bytearray()
        """Of a program that has begun, or of a line."""
        self._line = 0
        """Where the line that has no end yet begins."""
        self._is_program = False

    def receive(self, came: bytes) -> Iterator[Submitted]:
        """Programs and lines that are complete.

        Raises:
            ValueError: A program or a line without end.
        """
        for piece in _lines(came):
            if (size := len(self._waiting) + len(piece)) > LONGEST:
                message = f"script of {size} bytes without an end: must be at most {LONGEST}"
                raise ValueError(message)
            self._all.add(len(piece))
            self._waiting += piece
            if piece.endswith(b"\n") and (submitted := self._ended()) is not None:
                yield submitted

    def close(self) -> None:
        """It has ended: what it held is free."""
        self._all.add(-len(self._waiting))
        self._waiting = bytearray()

    def _ended(self) -> Submitted | None:
        """A line has ended: what is complete by that."""
        line = bytes(self._waiting[self._line :]).rstrip(b"\r\n")
        if not self._is_program:
            text = line.decode("utf-8", "replace")
            if BEGINS.match(text[:MAX_FIRST_LINE]):
                self._is_program, self._line = True, len(self._waiting)
                return None
            self._forget()
            text = text.strip()
            return Submitted("", text, failed=self._failed) if text and not text.startswith("#") else None
        self._line = len(self._waiting)
        if line.rstrip() != ENDS:
            return None
        text = self._waiting.decode("utf-8", "replace").replace("\r\n", "\n").removesuffix("\n")
        self._forget()
        begun = BEGINS.match(text)
        assert begun is not None
        kind, name = begun.groups()
        return Submitted(name, text, secondary=kind == "sec", failed=self._failed)

    def _forget(self) -> None:
        self._all.add(-len(self._waiting))
        self._waiting, self._line, self._is_program = bytearray(), 0, False


def _lines(came: bytes) -> Iterator[bytes]:
    """Lines with their end; a carriage return alone ends none."""
    begin = 0
    while (end := came.find(b"\n", begin)) >= 0:
        yield came[begin : end + 1]
        begin = end + 1
    if begin < len(came):
        yield came[begin:]
