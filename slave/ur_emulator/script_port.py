"""Script interfaces (30001, 30002, 30003): text comes in, programs and single lines come out."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

LONGEST: Final = 2_000_000
"""Bytes that a program may have; that of ur_rtde has some 50 kB."""
BEGINS: Final = re.compile(r"(def|sec)\s+(\w+)\s*\(\s*\)\s*:")
ENDS: Final = "end"
"""The line that ends a program: nothing before it, nothing but space behind it."""


@dataclass(frozen=True, slots=True)
class Submitted:
    """A program, or a single line without a name."""

    name: str
    text: str
    secondary: bool = False
    """Whether it runs beside the program that runs (`sec`)."""


class ScriptReader:
    """Takes the text of one connection apart, in however many pieces it comes."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self._program: list[str] = []
        self._size = 0

    def receive(self, came: bytes) -> Iterator[Submitted]:
        """Programs and lines that are complete.

        Raises:
            ValueError: A program without end.
        """
        waiting = self._waiting
        waiting += came
        *lines, rest = waiting.split(b"\n")
        self._waiting = bytearray(rest)
        if self._size + len(rest) > LONGEST:
            message = f"script of {self._size + len(rest)} bytes without an end: must be at most {LONGEST}"
            raise ValueError(message)
        for line in lines:
            if (submitted := self._line(line.decode("utf-8", "replace").rstrip("\r"))) is not None:
                yield submitted

    def _line(self, line: str) -> Submitted | None:
        if not self._program:
            if BEGINS.match(line):
                self._program, self._size = [line], len(line)
                return None
            text = line.strip()
            return Submitted("", text) if text and not text.startswith("#") else None
        self._program.append(line)
        self._size += len(line) + 1
        if line.rstrip() != ENDS:
            return None
        text, self._program, self._size = "\n".join(self._program), [], 0
        kind, name = BEGINS.match(text).groups()  # type: ignore[union-attr]  # it began so
        return Submitted(name, text, secondary=kind == "sec")
