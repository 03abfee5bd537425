"""The command line: `haptether demo | paper | simulate | sweep | master | slave | netsim`, one file a command."""

from haptether.cli.entry import main

__all__ = ["main"]
