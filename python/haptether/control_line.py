"""Commands of an emulator's control line: one-line commands with one-line answers."""

import math
from collections.abc import Callable
from typing import Final, TypeAlias

MAX_COUNT: Final = 1_000_000

Command: TypeAlias = Callable[[list[str], float], str | None]
"""Arguments and the time of the process in s; returns a result, if any."""


class CommandLine:
    """Commands of an operator or a test, by name.

    Args:
        commands: Commands besides `help` and `quit`. A ValueError or an OSError of a command is its answer.
    """

    def __init__(self, commands: dict[str, Command]) -> None:
        self.quit = False
        """True if the process must end."""
        self._commands: dict[str, Command] = {
            "help": lambda _a, _t: " ".join(sorted(self._commands)),
            "quit": self._quit,
            **commands,
        }

    def answer(self, line: str, now_s: float) -> str:
        """Return the answer to a line: `ok`, `ok RESULT`, or `error: WHY`.

        Args:
            line: Command with its arguments.
            now_s: Time of the process in s.
        """
        name, *arguments = line.split() or [""]
        command = self._commands.get(name)
        if command is None:
            shown = repr(name) if name else "an empty line"
            return f"error: {shown}: must be one of {' '.join(sorted(self._commands))}"
        try:
            result = command(arguments, now_s)
        except (ValueError, OSError) as error:
            return f"error: {name}: {error}"
        return f"ok {result}" if result else "ok"

    def _quit(self, _arguments: list[str], _now_s: float) -> None:
        self.quit = True


def refuse(message: str) -> None:
    """Raise a ValueError."""
    raise ValueError(message)


def numbers(arguments: list[str], count: int, largest: float = math.inf) -> list[float]:
    """Parse finite numbers with a magnitude of at most `largest`.

    Raises:
        ValueError: Another count, or an argument that is no such number.
    """
    try:
        parsed = [float(argument) for argument in arguments]
    except ValueError:
        parsed = []
    if len(parsed) != count or not all(math.isfinite(number) and abs(number) <= largest for number in parsed):
        plural = "s" if count > 1 else ""
        allowed = f"finite number{plural}" if largest == math.inf else f"number{plural} of at most {largest:g}"
        refuse(f"{' '.join(arguments)!r}: must be {count} {allowed}")
    return parsed


def whole(arguments: list[str], default: int, least: int = 1) -> int:
    """Parse a whole number from `least` to a million.

    Raises:
        ValueError: No such number.
    """
    (number,) = numbers(arguments or [str(default)], 1)
    if number != int(number) or not least <= number <= MAX_COUNT:
        refuse(f"{number:g}: must be a whole number, {least} to {MAX_COUNT}")
    return int(number)


def is_on(arguments: list[str]) -> bool:
    """Parse `on` or `off`.

    Raises:
        ValueError: Neither.
    """
    if arguments not in (["on"], ["off"]):
        refuse("must be on or off")
    return arguments == ["on"]
