"""What every command shares: parsing, one-line errors, exit status.

Exit status: 0 success, 1 a failed run, 2 a bad request, 130 interrupted.
"""

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from haptether import __version__
from haptether.cli.demo import Demo
from haptether.cli.master import Master
from haptether.cli.netsim import Netsim
from haptether.cli.paper import Paper
from haptether.cli.slave import Slave

type_of_command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Paper, tyro.conf.subcommand("paper")]
    | Annotated[Master, tyro.conf.subcommand("master")]
    | Annotated[Slave, tyro.conf.subcommand("slave")]
    | Annotated[Netsim, tyro.conf.subcommand("netsim")]
)

DESCRIPTION = """Bilateral teleoperation bridge that keeps a hand safe when the remote end pushes back.

Start with `haptether demo`: it runs slave, network and master as processes on this machine, lets a simulated
hand press a remote wall, shoves the remote arm, lets the hand go, and shows what each safety controller makes
of it."""

FAILED, BAD_REQUEST, INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and gives its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) in (["--version"], ["-V"]):
        print(f"haptether {__version__}")
        return 0
    try:
        command = tyro.cli(
            type_of_command,  # type: ignore[arg-type]  # a union of commands is what tyro takes
            prog="haptether",
            description=DESCRIPTION,
            args=list(arguments),
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff),
        )
        return command.run()
    except ValueError as error:
        return complain(error, BAD_REQUEST)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output is gone: nothing is left to say, and Python must not try at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (OSError, RuntimeError, ImportError) as error:
        return complain(error, FAILED)


def complain(error: Exception, status: int) -> int:
    """Says what is wrong in one line."""
    print(f"haptether: {' '.join(str(error).split())}", file=sys.stderr)
    return status
