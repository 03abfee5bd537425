"""Recognises the control script of ur_rtde among what clients upload."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from haptether.slave.ur_emulator.script_error import ScriptError

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.program import Steps
    from haptether.slave.ur_emulator.script_functions import ScriptFunctions

MARKS: Final = ("def process_cmd(", "def rtde_cmd(", "read_input_integer_reg(0)")
"""What only this script has."""
CONTROL_SCRIPT_NAME: Final = "rtde_control"
CONTROL_SCRIPT: Final = "\n".join((f"def {CONTROL_SCRIPT_NAME}():", *(f"  {mark}" for mark in MARKS), "end"))
"""What stands for the script where the controller has it on its disk."""
OFFSET: Final = re.compile(r"# int register offset\s*(\d+)")
"""The client puts the number behind the comment that marks its place, on a line of its own."""
PATH: Final = re.compile(r"def exec_move_path\(\):(.*?)^\s*end\s*$", re.MULTILINE | re.DOTALL)
NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
MOVE: Final = re.compile(
    rf"(movej|movel)\((p?)\[([^\]]*)\]\s*,\s*a=({NUMBER})\s*,\s*v=({NUMBER})\s*,\s*r=({NUMBER})\s*\)"
)
PROGRESS: Final = re.compile(r"signal_async_progress\((\d+)\)")


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
    offset = OFFSET.search(text)
    path = PATH.search(text)
    return Upload(int(offset[1]) if offset else 0, tuple(_steps(path[1])) if path else ())


def _steps(body: str) -> Iterator[PathMove | int]:
    for line in body.splitlines():
        line = line.strip()  # noqa: PLW2901
        if found := PROGRESS.match(line):
            yield int(found[1])
        elif line.startswith("move"):
            move = MOVE.match(line)
            numbers = tuple(float(part) for part in move[3].split(",")) if move else ()
            if move is None or len(numbers) != 6:
                message = f"movePath: {line!r} cannot be read"
                raise ScriptError(message)
            yield PathMove(move[1] == "movel", move[2] == "p", numbers, float(move[4]), float(move[5]))
