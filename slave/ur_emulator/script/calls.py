"""Programs that are no control script: calls with literal arguments, one line after another, without control flow."""

import ast
import re
import warnings
from collections.abc import Callable, Generator, Iterator
from typing import TYPE_CHECKING, Any, Final

from haptether.slave.ur_emulator.script_arguments import (
    ANYTHING,
    BOOLEAN,
    INTEGER,
    MAX_LINE,
    MAX_SHOWN,
    NUMBER,
    POSE,
    SIX,
    TARGET,
    THREE,
    Kind,
    Pose,
    Signature,
    Six,
    literal,
)
from haptether.slave.ur_emulator.script_error import ScriptError

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.digital_outputs import DigitalOutputs
    from haptether.slave.ur_emulator.registers import Registers
    from haptether.slave.ur_emulator.script.functions import ScriptFunctions
    from haptether.slave.ur_emulator.script.program import Steps
    from haptether.slave.ur_emulator.setup import Setup

POSE_LITERAL: Final = re.compile(r"\bp\s*\[")
MAX_CALLS: Final = 5000
"""Of a program."""
CALLS_PER_CYCLE: Final = 8
"""That are read in a control cycle: some 0.3 ms of it."""

Call = Callable[[], "Steps | None"]


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
"""What each function takes."""


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
        self._functions: dict[str, Callable[..., Steps | None]] = {
            "movej": self._movej,
            "movel": self._movel,
            "stopj": lambda a=2.0: do.stopj(a),
            "stopl": lambda a=20.0: do.stopl(a),
            "speedj": lambda qd, a=0.5, t=0.0: do.speedj(qd, a, t),
            "speedl": lambda xd, a=0.5, t=0.0: do.speedl(xd, a, t),
            "servoj": lambda q, a=0.0, v=0.0, t=0.002, lookahead_time=0.1, gain=300.0: do.servoj(  # noqa: ARG005
                q, t, lookahead_time, gain
            ),
            "sleep": do.sleep,
            "sync": lambda: do.sleep(0.0),
            "textmsg": lambda s1, s2="": tell(f"textmsg: {s1}{s2}"),
            "popup": lambda s, **_: tell(f"popup: {s}"),
            "set_tcp": lambda pose, tcp_name="": do.robot.set_tcp(pose),  # noqa: ARG005
            "set_payload": lambda m, cog=(0.0, 0.0, 0.0): setup.set_payload(m, cog),
            "zero_ftsensor": do.robot.sensing.zero,
            "end_force_mode": do.robot.end_force_mode,
            "protective_stop": lambda: setup.protective_stop("protective_stop() of the program"),
            "set_digital_out": lambda n, b: digital.set(n, on=b),
            "set_standard_digital_out": lambda n, b: digital.set(n, on=b),
            "set_configurable_digital_out": lambda n, b: digital.set(8 + n, on=b),
            "set_tool_digital_out": lambda n, b: digital.set(16 + n, on=b),
            "write_output_integer_register": registers.write_integer,
            "write_output_float_register": registers.write_double,
        }

    def read(self, text: str) -> "Generator[None, None, Steps]":
        """Reads a program, a few calls at each step; gives what runs it.

        Raises:
            ScriptError: A line that is none of these calls, or too many of them.
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
        """The program, ready to run.

        Raises:
            ScriptError: A line that is none of these calls, or too many of them.
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
        return self._do.movej(self._do.inverse(q.numbers) if isinstance(q, Pose) else q, a, v)

    def _movel(self, pose: "Pose | Six", a: float = 1.2, v: float = 0.25, t: float = 0.0, r: float = 0.0) -> "Steps":  # noqa: ARG002
        return self._do.movel(pose.numbers if isinstance(pose, Pose) else self._do.arm.pose(pose), a, v)


def _statements(text: str) -> Iterator[str]:
    lines = text.splitlines()
    if len(lines) > 1:
        lines = lines[1:-1]
    for line in lines:
        bare = line.strip()
        if bare and not bare.startswith("#"):
            yield bare


def _parsed(line: str) -> tuple[str, list[object], dict[str, object]]:
    """Name, arguments and named arguments of a call.

    Raises:
        ScriptError: It is none, or its arguments are no literals.
    """
    if len(line) > MAX_LINE:
        message = f"{line[:MAX_SHOWN]!r}: line of {len(line)} characters: must have at most {MAX_LINE}"
        raise ScriptError(message)
    try:
        with warnings.catch_warnings():
            # Python would print the client's escapes to the screen.
            warnings.simplefilter("ignore")
            # `p[...]` is a list to Python; the movements that care see which it was.
            call = ast.parse(POSE_LITERAL.sub(f"{POSE}[", line), mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
            raise ValueError
        named = {word.arg: literal(word.value) for word in call.keywords if word.arg is not None}
        if len(named) != len(call.keywords):
            raise ValueError
        return call.func.id, [literal(node) for node in call.args], named
    except (SyntaxError, ValueError, TypeError, ArithmeticError, RecursionError, MemoryError):
        raise ScriptError(_unknown(line)) from None


def _unknown(line: str) -> str:
    return f"{line[:MAX_SHOWN]!r}: the emulator knows only calls of its own functions with literal, finite arguments"
