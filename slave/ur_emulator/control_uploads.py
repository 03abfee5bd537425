"""Recognises the control script of ur_rtde among what clients upload."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from haptether.slave.ur_emulator.script_arguments import MAX_SHOWN
from haptether.slave.ur_emulator.script_error import ScriptError

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.script.functions import ScriptFunctions
    from haptether.slave.ur_emulator.script.program import Steps

MARKS: Final = ("def process_cmd(", "def rtde_cmd(", "read_input_integer_reg(0)")
"""What only this script has."""
CONTROL_SCRIPT_NAME: Final = "rtde_control"
CONTROL_SCRIPT: Final = "\n".join((f"def {CONTROL_SCRIPT_NAME}():", *(f"  {mark}" for mark in MARKS), "end"))
"""What stands for the script where the controller has it on its disk."""
OFFSET: Final = re.compile(r"# int register offset\s*(\d{1,2})\b")
"""The client puts the number behind the comment that marks its place, on a line of its own."""
OFFSETS: Final = (0, 24)
"""Where the client's registers begin."""
PATH: Final = "def exec_move_path():"
PATH_ENDS: Final = re.compile(r"^[ \t]*end[ \t\r]*$", re.MULTILINE)
"""Nothing of it goes over the end of a line, and it is looked for once: else a text could take minutes."""
MAX_WAYPOINTS: Final = 5000
MAX_MOVE: Final = 1000
"""Characters of a move in a path."""
NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
MOVE: Final = re.compile(
    rf"(movej|movel)\((p?)\[([^\]]*)\]\s*,\s*a=({NUMBER})\s*,\s*v=({NUMBER})\s*,\s*r=({NUMBER})\s*\)"
)
PROGRESS: Final = re.compile(r"signal_async_progress\((\d{1,9})\)")


@dataclass(frozen=True, slots=True)
class PathMove:
    """A move to a waypoint."""

    straight: bool
    is_pose: bool
    target: tuple[float, ...]
    acceleration: float
    speed: float


@dataclass(frozen=True, slots=True)
class Upload:
    """What differs from one upload of the control script to another."""

    offset: int
    path: tuple[PathMove | int, ...] = ()
    """Moves of a path, and the progress that is told between them."""

    def move_path(self, do: "ScriptFunctions", progress: Callable[[int], None]) -> "Steps":
        """The injected moves, one after another; every one ends at rest, whatever its blend radius."""
        for step in self.path:
            if isinstance(step, int):
                progress(step)
                continue
            target = step.target
            if step.straight:
                pose = target if step.is_pose else do.arm.pose(target)
                yield from do.movel(pose, step.acceleration, step.speed)
            else:
                q = do.inverse(target) if step.is_pose else target
                yield from do.movej(q, step.acceleration, step.speed)


def recognised(text: str) -> Upload | None:
    """What an upload of the control script says, or None for any other program.

    Raises:
        ScriptError: A path with a move that cannot be read.
    """
    if not all(mark in text for mark in MARKS):
        return None
    found = OFFSET.search(text)
    offset = int(found[1]) if found else 0
    if offset not in OFFSETS:
        message = f"registers from {offset} on: must be from 0 or 24 on"
        raise ScriptError(message)
    begin = text.find(PATH)
    end = PATH_ENDS.search(text, begin) if begin >= 0 else None
    return Upload(offset, tuple(_steps(text[begin + len(PATH) : end.start()])) if end else ())


def _numbers(text: str) -> tuple[float, ...]:
    """Finite numbers between commas; none where one is not."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()


def _steps(body: str) -> Iterator[PathMove | int]:
    moves = 0
    for line in body.splitlines():
        line = line.strip()[: MAX_MOVE + 1]  # noqa: PLW2901
        if found := PROGRESS.match(line):
            yield int(found[1])
        elif line.startswith("move"):
            move = MOVE.match(line) if len(line) <= MAX_MOVE else None
            numbers = _numbers(move[3]) if move else ()
            if move is None or len(numbers) != 6:
                message = f"movePath: {line[:MAX_SHOWN]!r} cannot be read"
                raise ScriptError(message)
            moves += 1
            if moves > MAX_WAYPOINTS:
                message = f"movePath: more than {MAX_WAYPOINTS} waypoints"
                raise ScriptError(message)
            yield PathMove(move[1] == "movel", move[2] == "p", numbers, float(move[4]), float(move[5]))
