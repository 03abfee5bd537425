"""Arguments of a call in a script: literals, and of the kind that the function takes.

Source: Universal Robots, "The URScript Programming Language".
"""

import ast
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from haptether.slave.ur_emulator.script_error import ScriptError

MAX_LINE: Final = 4096
"""Characters of a call: what it is parsed to takes 1000 times as much memory."""
MAX_SHOWN: Final = 80
"""Characters of a line or of an argument in a message."""
ARITHMETIC: Final[dict[type[ast.operator], Callable[[Any, Any], object]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
POSE: Final = "_pose"
"""What stands for the `p` of a literal `p[...]`, which Python does not have."""

Six = tuple[float, ...]


class Pose:
    """A literal `p[...]`."""

    def __init__(self, numbers: Six) -> None:
        self.numbers = numbers

    def __iter__(self) -> Iterator[float]:
        return iter(self.numbers)

    def __str__(self) -> str:
        return f"p{list(self.numbers)}"


@dataclass(frozen=True, slots=True)
class Kind:
    """What an argument must be, and what it is made of it."""

    name: str
    of: Callable[[object], object]
    """Raises `ValueError` or `TypeError` for what is not of the kind."""


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _integer(value: object) -> int:
    number = _number(value)
    if number != int(number):
        raise ValueError
    return int(number)


def _boolean(value: object) -> bool:
    if not isinstance(value, bool | int | float):
        raise TypeError
    return bool(value)


def _numbers(value: object, count: int) -> Six:
    if not isinstance(value, list | Pose):
        raise TypeError
    numbers = tuple(map(_number, value))
    if len(numbers) != count:
        raise ValueError
    return numbers


def _target(value: object) -> "Pose | Six":
    return value if isinstance(value, Pose) else _numbers(value, 6)


NUMBER: Final = Kind("a finite number", _number)
INTEGER: Final = Kind("a whole number", _integer)
BOOLEAN: Final = Kind("True or False", _boolean)
THREE: Final = Kind("three numbers", lambda value: _numbers(value, 3))
SIX: Final = Kind("six numbers", lambda value: _numbers(value, 6))
TARGET: Final = Kind("six numbers or a pose", _target)
ANYTHING: Final = Kind("a literal", lambda value: value)


@dataclass(frozen=True, slots=True)
class Signature:
    """What a function takes, in order; those with a default may be left out."""

    kinds: Mapping[str, Kind]
    optional: frozenset[str] = frozenset()

    def bound(self, name: str, arguments: Sequence[object], named: Mapping[str, object]) -> dict[str, Any]:
        """The arguments by name, each of its kind.

        Raises:
            ScriptError: Too many, too few, unknown, given twice, or of another kind.
        """
        takes = ", ".join(self.kinds) or "nothing"
        if len(arguments) > len(self.kinds):
            message = f"{name}: {len(arguments)} arguments: takes {takes}"
            raise ScriptError(message)
        given = dict(zip(self.kinds, arguments, strict=False))
        for key, value in named.items():
            if key not in self.kinds or key in given:
                message = f"{name}: {key}: {'is given twice' if key in given else 'is unknown'}: takes {takes}"
                raise ScriptError(message)
            given[key] = value
        missing = [key for key in self.kinds if key not in given and key not in self.optional]
        if missing:
            message = f"{name}: {', '.join(missing)} missing: takes {takes}"
            raise ScriptError(message)
        return {key: self._of_kind(name, key, value) for key, value in given.items()}

    def _of_kind(self, name: str, key: str, value: object) -> object:
        kind = self.kinds[key]
        try:
            return kind.of(value)
        except (TypeError, ValueError, OverflowError):
            message = f"{name}: {key} = {str(value)[:MAX_SHOWN]}: must be {kind.name}"
            raise ScriptError(message) from None


def literal(node: ast.expr) -> object:
    """The value of a literal, or of sums, differences, products and quotients of numbers.

    Raises:
        ValueError: It is none, a number of it is not finite, or a text of it has no encoding in UTF-8.
    """
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float | str):
        return _encodable(_finite(node.value))
    if isinstance(node, ast.Constant) and node.value is None:
        return None
    if isinstance(node, ast.List):
        return [literal(part) for part in node.elts]
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id == POSE:
        inside = node.slice
        return Pose(_numbers([literal(part) for part in inside.elts] if isinstance(inside, ast.Tuple) else [], 6))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        value = _operand(node.operand)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        # Of numbers only: a text times a number would take as much memory as the number says.
        return _finite(ARITHMETIC[type(node.op)](_operand(node.left), _operand(node.right)))
    raise ValueError


def _operand(node: ast.expr) -> float:
    value = literal(node)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return value


def _encodable(value: object) -> object:
    if isinstance(value, str):
        # Of an escape such as `\ud800`; it raises a ValueError.
        value.encode()
    return value


def _finite(value: object) -> object:
    if isinstance(value, int | float) and not math.isfinite(value):
        raise ValueError
    return value
