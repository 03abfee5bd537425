"""The command line: `haptether demo | paper | simulate | sweep | master | slave | netsim | ...`, one file a command.

`entry.py` lists the commands. Commands of one kind share a folder with their common code: `scene/`, `live/`, `netsim/`;
code for commands of every kind is in `shared/`.
"""

from haptether.cli.interrupts import INTERRUPTS, open_standard_streams

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: "Sequence[str] | None" = None) -> int:
    """Run one command and return its exit status."""
    if arguments is None:
        # Only the process of the command may change signals and streams, not a process that calls `main`.
        INTERRUPTS.begin()
        open_standard_streams()
    from haptether.cli.entry import main as run

    try:
        status = run(arguments)
    except SystemExit as end:
        INTERRUPTS.status = end.code
        raise
    INTERRUPTS.status = status
    return status
