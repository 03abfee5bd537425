"""Programs of calls with literal arguments, one per line, without control flow: all except the control script.

Source: Universal Robots, "The URScript Programming Language".
"""

import ast
import math
import operator
import re
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from haptether.slave.ur_emulator.robot.kinematics import Six
from haptether.slave.ur_emulator.script.program import ScriptError

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.rtde.variables import ClientSettings
    from haptether.slave.ur_emulator.script.functions import ScriptFunctions
    from haptether.slave.ur_emulator.script.program import Registers, Setup, Steps

POSE_LITERAL: Final = re.compile(r"\bp\s*\[")
MAX_CALLS: Final = 5000
"""Calls of a program."""
CALLS_PER_CYCLE: Final = 8
"""Calls parsed in a control cycle; takes about 0.3 ms."""
MAX_LINE: Final = 4096
"""Characters of a call; its syntax tree takes 1000 times as much memory."""
MAX_SHOWN: Final = 80
"""Characters of a line or an argument in a message."""
ARITHMETIC: Final[dict[type[ast.operator], Callable[[Any, Any], object]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
POSE: Final = "_pose"
"""Replaces the `p` of a literal `p[...]`, which Python does not have."""

Call = Callable[[], "Steps | None"]


# ------------------------------------------------------------------------------------------------------ arguments


class Pose:
    """Literal `p[...]`."""

    def __init__(self, numbers: Six) -> None:
        self.numbers = numbers

    def __iter__(self) -> Iterator[float]:
        return iter(self.numbers)

    def __str__(self) -> str:
        return f"p{list(self.numbers)}"


@dataclass(frozen=True, slots=True)
class Kind:
    """Kind of an argument: its name and its conversion."""

    name: str
    converted: Callable[[object], object]
    """Raises `ValueError` or `TypeError` for a value of another kind."""


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
    """Parameters of a function, in order; those with a default may be omitted."""

    kinds: Mapping[str, Kind]
    optional: frozenset[str] = frozenset()

    def bound(self, name: str, arguments: Sequence[object], named: Mapping[str, object]) -> dict[str, Any]:
        """Return the arguments by name, each converted to its kind.

        Raises:
            ScriptError: Arguments are too many, too few, unknown, given twice, or of another kind.
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
        return {key: self._converted(name, key, value) for key, value in given.items()}

    def _converted(self, name: str, key: str, value: object) -> object:
        kind = self.kinds[key]
        try:
            return kind.converted(value)
        except (TypeError, ValueError, OverflowError):
            message = f"{name}: {key} = {str(value)[:MAX_SHOWN]}: must be {kind.name}"
            raise ScriptError(message) from None


def literal(node: ast.expr) -> object:
    """Return the value of a literal, or of sums, differences, products and quotients of numbers.

    Raises:
        ValueError: No literal, a number that is not finite, or a text without an encoding in UTF-8.
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
        # Numbers only: a text times a number could take any amount of memory.
        return _finite(ARITHMETIC[type(node.op)](_operand(node.left), _operand(node.right)))
    raise ValueError


def _operand(node: ast.expr) -> float:
    value = literal(node)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return value


def _encodable(value: object) -> object:
    if isinstance(value, str):
        # An escape such as `\ud800` raises a ValueError.
        value.encode()
    return value


def _finite(value: object) -> object:
    if isinstance(value, int | float) and not math.isfinite(value):
        raise ValueError
    return value


# ------------------------------------------------------------------------------------------------------- programs


def _takes(optional: str = "", **kinds: Kind) -> Signature:
    return Signature(kinds, frozenset(optional.split()))


SIGNATURES: Final = {
    "movej": _takes("a v t r", q=TARGET, a=NUMBER, v=NUMBER, t=NUMBER, r=NUMBER),
    "movel": _takes("a v t r", pose=TARGET, a=NUMBER, v=NUMBER, t=NUMBER, r=NUMBER),
    "stopj": _takes("a", a=NUMBER),
    "stopl": _takes("a", a=NUMBER),
    "speedj": _takes("a t", qd=SIX, a=NUMBER, t=NUMBER),
    "speedl": _takes("a t", xd=SIX, a=NUMBER, t=NUMBER),
    "servoj": _takes(
        "a v t lookahead_time gain", q=SIX, a=NUMBER, v=NUMBER, t=NUMBER, lookahead_time=NUMBER, gain=NUMBER
    ),
    "sleep": _takes(time_s=NUMBER),
    "sync": _takes(),
    "textmsg": _takes("s2", s1=ANYTHING, s2=ANYTHING),
    "popup": _takes(
        "title warning error blocking", s=ANYTHING, title=ANYTHING, warning=BOOLEAN, error=BOOLEAN, blocking=BOOLEAN
    ),
    "set_tcp": _takes("tcp_name", pose=SIX, tcp_name=ANYTHING),
    "set_payload": _takes("cog", m=NUMBER, cog=THREE),
    "zero_ftsensor": _takes(),
    "end_force_mode": _takes(),
    "protective_stop": _takes(),
    "set_digital_out": _takes(n=INTEGER, b=BOOLEAN),
    "set_standard_digital_out": _takes(n=INTEGER, b=BOOLEAN),
    "set_configurable_digital_out": _takes(n=INTEGER, b=BOOLEAN),
    "set_tool_digital_out": _takes(n=INTEGER, b=BOOLEAN),
    "write_output_integer_register": _takes(number=INTEGER, value=INTEGER),
    "write_output_float_register": _takes(number=INTEGER, value=NUMBER),
}
"""Parameters of each function."""


class CallProgram:
    """Reads and runs a program of calls.

    Args:
        functions: Functions of URScript.
        registers: Registers without an offset.
        setup: Settings of the program.
        client_settings: The digital outputs.
        log: Receives lines for the log.
    """

    def __init__(
        self,
        functions: "ScriptFunctions",
        registers: "Registers",
        setup: "Setup",
        client_settings: "ClientSettings",
        log: Callable[[str], None],
    ) -> None:
        self._script = functions
        self._functions: dict[str, Callable[..., Steps | None]] = {
            "movej": self._movej,
            "movel": self._movel,
            "stopj": lambda a=2.0: functions.stopj(a),
            "stopl": lambda a=20.0: functions.stopl(a),
            "speedj": lambda qd, a=0.5, t=0.0: functions.speedj(qd, a, t),
            "speedl": lambda xd, a=0.5, t=0.0: functions.speedl(xd, a, t),
            "servoj": lambda q, a=0.0, v=0.0, t=0.002, lookahead_time=0.1, gain=300.0: functions.servoj(  # noqa: ARG005
                q, t, lookahead_time, gain
            ),
            "sleep": functions.sleep,
            "sync": lambda: functions.sleep(0.0),
            "textmsg": lambda s1, s2="": log(f"textmsg: {s1}{s2}"),
            "popup": lambda s, **_: log(f"popup: {s}"),
            "set_tcp": lambda pose, tcp_name="": functions.robot.set_tcp(pose),  # noqa: ARG005
            "set_payload": lambda m, cog=(0.0, 0.0, 0.0): setup.set_payload(m, cog),
            "zero_ftsensor": functions.robot.sensing.zero,
            "end_force_mode": functions.robot.end_force_mode,
            "protective_stop": lambda: setup.protective_stop("protective_stop() of the program"),
            "set_digital_out": lambda n, b: client_settings.set(n, on=b),
            "set_standard_digital_out": lambda n, b: client_settings.set(n, on=b),
            "set_configurable_digital_out": lambda n, b: client_settings.set(8 + n, on=b),
            "set_tool_digital_out": lambda n, b: client_settings.set(16 + n, on=b),
            "write_output_integer_register": registers.write_integer,
            "write_output_float_register": registers.write_double,
        }

    def read(self, text: str) -> "Generator[None, None, Steps]":
        """Parse a program, a few calls at each step; return its steps.

        Raises:
            ScriptError: A line is not a known call, or there are too many.
        """
        calls: list[Call] = []
        for line in _statements(text):
            if len(calls) >= MAX_CALLS:
                message = f"more than {MAX_CALLS} calls"
                raise ScriptError(message)
            calls.append(self._call(line))
            if len(calls) % CALLS_PER_CYCLE == 0:
                yield
        return self._run(calls)

    def steps(self, text: str) -> "Steps":
        """Return the program, ready to run.

        Raises:
            ScriptError: A line is not a known call, or there are too many.
        """
        reading = self.read(text)
        while True:
            try:
                next(reading)
            except StopIteration as read:
                steps: Steps = read.value
                return steps

    def _run(self, calls: list[Call]) -> "Steps":
        for call in calls:
            steps = call()
            if steps is not None:
                yield from steps

    def _call(self, line: str) -> Call:
        name, arguments, named = _parsed(line)
        function, signature = self._functions.get(name), SIGNATURES.get(name)
        if function is None or signature is None:
            raise ScriptError(_unknown(line))
        bound: dict[str, Any] = signature.bound(name, arguments, named)

        def call() -> "Steps | None":
            try:
                return function(**bound)
            except (TypeError, ValueError, ArithmeticError) as error:
                message = f"{line[:MAX_SHOWN]!r}: {error}"
                raise ScriptError(message) from None

        return call

    def _movej(self, q: "Pose | Six", a: float = 1.4, v: float = 1.05, t: float = 0.0, r: float = 0.0) -> "Steps":  # noqa: ARG002
        return self._script.movej(self._script.inverse(q.numbers) if isinstance(q, Pose) else q, a, v)

    def _movel(self, pose: "Pose | Six", a: float = 1.2, v: float = 0.25, t: float = 0.0, r: float = 0.0) -> "Steps":  # noqa: ARG002
        return self._script.movel(pose.numbers if isinstance(pose, Pose) else self._script.arm.pose(pose), a, v)


def _statements(text: str) -> Iterator[str]:
    lines = text.splitlines()
    if len(lines) > 1:
        lines = lines[1:-1]
    for line in lines:
        bare = line.strip()
        if bare and not bare.startswith("#"):
            yield bare


def _parsed(line: str) -> tuple[str, list[object], dict[str, object]]:
    """Return name, arguments and named arguments of a call.

    Raises:
        ScriptError: The line is not a call, or its arguments are not literals.
    """
    if len(line) > MAX_LINE:
        message = f"{line[:MAX_SHOWN]!r}: line of {len(line)} characters: must have at most {MAX_LINE}"
        raise ScriptError(message)
    try:
        with warnings.catch_warnings():
            # Python would print the client's escapes on the screen.
            warnings.simplefilter("ignore")
            # `p[...]` becomes a subscript, which `literal` reads as a `Pose`.
            call = ast.parse(POSE_LITERAL.sub(f"{POSE}[", line), mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
            raise ValueError
        named = {keyword.arg: literal(keyword.value) for keyword in call.keywords if keyword.arg is not None}
        if len(named) != len(call.keywords):
            raise ValueError
        return call.func.id, [literal(node) for node in call.args], named
    except (SyntaxError, ValueError, TypeError, ArithmeticError, RecursionError, MemoryError):
        raise ScriptError(_unknown(line)) from None


def _unknown(line: str) -> str:
    return f"{line[:MAX_SHOWN]!r}: the emulator knows only calls of its own functions with literal, finite arguments"
