"""Programs that are no control script: calls with literal arguments, one line after another, without control flow."""

import ast
import math
import operator
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final

from haptether.slave.ur_emulator.script_error import ScriptError

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.digital_outputs import DigitalOutputs
    from haptether.slave.ur_emulator.program import Steps
    from haptether.slave.ur_emulator.registers import Registers
    from haptether.slave.ur_emulator.script_functions import ScriptFunctions
    from haptether.slave.ur_emulator.setup import Setup

POSE: Final = re.compile(r"\bp\s*\[")
ARITHMETIC: Final[dict[type[ast.operator], Callable[[Any, Any], object]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}

Six = tuple[float, ...]


class ScriptLines:
    """Runs such a program.

    Args:
        do: What URScript can do.
        registers: Those without an offset.
        setup: What a program sets up.
        digital: The digital outputs.
        tell: Takes lines for the log.
    """

    def __init__(
        self,
        do: "ScriptFunctions",
        registers: "Registers",
        setup: "Setup",
        digital: "DigitalOutputs",
        tell: Callable[[str], None],
    ) -> None:
        self._do = do
        self._registers = registers
        self._setup = setup
        self._digital = digital
        self._tell = tell
        self._functions: dict[str, Callable[..., Steps | None]] = {
            "movej": self._movej,
            "movel": self._movel,
            "stopj": lambda a=2.0: do.stopj(a),
            "stopl": lambda a=20.0: do.stopl(a),
            "speedj": lambda qd, a=0.5, t=0.0: do.speedj(_six("speedj", qd), a, t),
            "speedl": lambda xd, a=0.5, t=0.0: do.speedl(_six("speedl", xd), a, t),
            "servoj": lambda q, a=0.0, v=0.0, t=0.002, lookahead_time=0.1, gain=300.0: do.servoj(  # noqa: ARG005
                _six("servoj", q), t, lookahead_time, gain
            ),
            "sleep": do.sleep,
            "sync": lambda: do.sleep(0.0),
            "textmsg": lambda *parts: tell(f"textmsg: {''.join(map(str, parts))}"),
            "popup": lambda text, *_rest, **_more: tell(f"popup: {text}"),
            "set_tcp": lambda pose: do.robot.set_tcp(_six("set_tcp", pose)),
            "set_payload": lambda m, cog=(0.0, 0.0, 0.0): setup.set_payload(float(m), tuple(cog)),
            "zero_ftsensor": do.robot.sensing.zero,
            "end_force_mode": do.robot.end_force_mode,
            "protective_stop": lambda: setup.protective_stop("protective_stop() of the program"),
            "set_digital_out": lambda n, b: digital.set(int(n), on=bool(b)),
            "set_standard_digital_out": lambda n, b: digital.set(int(n), on=bool(b)),
            "set_configurable_digital_out": lambda n, b: digital.set(8 + int(n), on=bool(b)),
            "set_tool_digital_out": lambda n, b: digital.set(16 + int(n), on=bool(b)),
            "write_output_integer_register": lambda n, value: registers.write_integer(int(n), int(value)),
            "write_output_float_register": lambda n, value: registers.write_double(int(n), float(value)),
        }

    def steps(self, text: str) -> "Steps":
        """The program, ready to run.

        Raises:
            ScriptError: A line that is none of these calls.
        """
        return self._run([self._call(line) for line in _statements(text)])

    def _run(self, calls: list[Callable[[], "Steps | None"]]) -> "Steps":
        for call in calls:
            steps = call()
            if steps is not None:
                yield from steps

    def _call(self, line: str) -> Callable[[], "Steps | None"]:
        # `p[...]` is a list to Python; the movements that care see which it was.
        text = POSE.sub("_pose[", line)
        try:
            parsed = ast.parse(text, mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            parsed = None
        if not (isinstance(parsed, ast.Call) and isinstance(parsed.func, ast.Name)):
            raise ScriptError(_unknown(line))
        function = self._functions.get(parsed.func.id)
        if function is None:
            raise ScriptError(_unknown(line))
        arguments = [_literal(node, line) for node in parsed.args]
        named = {word.arg: _literal(word.value, line) for word in parsed.keywords if word.arg is not None}

        def call() -> "Steps | None":
            try:
                return function(*arguments, **named)
            except (TypeError, ValueError, OverflowError) as error:
                message = f"{line[:80]!r}: {error}"
                raise ScriptError(message) from None

        return call

    def _movej(self, target: object, a: float = 1.4, v: float = 1.05, t: float = 0.0, r: float = 0.0) -> "Steps":  # noqa: ARG002
        q = self._do.inverse(target.numbers) if isinstance(target, Pose) else _six("movej", target)
        return self._do.movej(q, a, v)

    def _movel(self, target: object, a: float = 1.2, v: float = 0.25, t: float = 0.0, r: float = 0.0) -> "Steps":  # noqa: ARG002
        pose = target.numbers if isinstance(target, Pose) else self._do.arm.pose(_six("movel", target))
        return self._do.movel(pose, a, v)


class Pose:
    """A literal `p[...]`."""

    def __init__(self, numbers: Six) -> None:
        self.numbers = numbers

    def __iter__(self) -> Iterator[float]:
        return iter(self.numbers)

    def __str__(self) -> str:
        return f"p{list(self.numbers)}"


def _statements(text: str) -> Iterator[str]:
    lines = text.splitlines()
    if len(lines) > 1:
        lines = lines[1:-1]
    for line in lines:
        bare = line.strip()
        if bare and not bare.startswith("#"):
            yield bare


def _literal(node: ast.expr, line: str) -> object:
    try:
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id == "_pose":
            return Pose(_six("pose", ast.literal_eval(node.slice)))
        if isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
            left, right = _literal(node.left, line), _literal(node.right, line)
            return ARITHMETIC[type(node.op)](left, right)
        literal: object = ast.literal_eval(node)
        return literal
    except (ValueError, TypeError, ArithmeticError):
        raise ScriptError(_unknown(line)) from None


def _six(name: str, values: object) -> Six:
    numbers = tuple(values) if isinstance(values, list | tuple | Pose) else ()
    if len(numbers) != 6 or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
        message = f"{name}: {values!r}: must be six numbers"
        raise ScriptError(message)
    return tuple(map(float, numbers))


def _unknown(line: str) -> str:
    return f"{line[:80]!r}: the emulator knows only calls of its own functions with literal arguments"
