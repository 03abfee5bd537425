"""The command line: `haptether demo | paper | simulate | sweep | master | slave | netsim | ...`, one file a command.

`entry.py` lists the commands. Those of one kind share a folder with what only they need: `scene/`, `live/`,
`netsim/`; what commands of every kind need is in `shared/`.
"""

from haptether.cli.interrupts import INTERRUPTS, open_standard_streams

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: "Sequence[str] | None" = None) -> int:
    """Run one command and return its exit status."""
    if arguments is None:
        # A process of its own: in somebody else's, signals and streams are theirs.
        INTERRUPTS.begin()
        open_standard_streams()
    from haptether.cli.entry import main as run

    return run(arguments)
