"""What every command shares: parsing, one-line errors, exit status.

Exit status: 0 success, 1 a failed run, 2 a bad request, 130 interrupted.
"""

import inspect
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Protocol, Union

import tyro

from haptether import __version__
from haptether.cli.check_link import CheckLink
from haptether.cli.demo import Demo
from haptether.cli.explain import Explain
from haptether.cli.keygen import Keygen
from haptether.cli.list import List
from haptether.cli.master import Master
from haptether.cli.netsim import NETSIM_COMMANDS, Netsim
from haptether.cli.paper import Paper
from haptether.cli.raven import Raven
from haptether.cli.simulate import Simulate
from haptether.cli.slave import Slave
from haptether.cli.sweep import Sweep
from haptether.cli.ur_emulator import UrEmulator


class Command(Protocol):
    """What one command is."""

    def run(self) -> int:
        """Does it and gives the exit status."""


COMMANDS: dict[str, type[Any]] = {
    "demo": Demo,
    "paper": Paper,
    "raven": Raven,
    "simulate": Simulate,
    "sweep": Sweep,
    "master": Master,
    "slave": Slave,
    "netsim": Netsim,
    "ur-emulator": UrEmulator,
    "check-link": CheckLink,
    "explain": Explain,
    "keygen": Keygen,
    "list": List,
}
GROUPS: dict[str, dict[str, type[Command]]] = {"netsim": NETSIM_COMMANDS}
"""Commands that only name others."""


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
        return parse(arguments).run()
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


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for.

    Raises:
        SystemExit: With 2 for arguments that do not fit, and with 0 once help was given.
    """
    if arguments and arguments[0] in GROUPS:
        group = COMMANDS[arguments[0]]
        return _parsed(GROUPS[arguments[0]], f"haptether {arguments[0]}", group, with_backward(arguments[1:]))
    return _parsed(COMMANDS, "haptether", None, with_overrides(arguments))


def _parsed(
    commands: "dict[str, type[Command]]", prog: str, group: "type[object] | None", arguments: Sequence[str]
) -> Command:
    # A union that is put together at run time has no static type.
    union: Any = Union[  # noqa: UP007
        tuple(
            Annotated[command, tyro.conf.subcommand(name, description=summary(command))]
            for name, command in commands.items()
        )
    ]
    try:
        command: Command = tyro.cli(
            union,
            prog=prog,
            description=DESCRIPTION if group is None else summary(group),
            args=arguments,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    except SystemExit as ended:
        told = commands[arguments[0]] if arguments and arguments[0] in commands else group
        if ended.code == 0 and told is not None:
            # The parser would fold the examples into one paragraph.
            print(f"\n{(inspect.getdoc(told) or '').partition(chr(10))[2].strip()}")
        raise
    return command


def with_backward(arguments: Sequence[str]) -> list[str]:
    """The arguments with each `--backward.key value` as `--backward-set key=value`."""
    plain: list[str] = []
    waiting = list(arguments)
    while waiting:
        argument = waiting.pop(0)
        name, equals, value = argument.partition("=")
        if name.startswith("--backward."):
            if not equals:
                value = waiting.pop(0) if waiting else ""
            plain += ["--backward-set", f"{name.removeprefix('--backward.')}={value}"]
        else:
            plain.append(argument)
    return plain


SCENE_COMMANDS = {"simulate", "sweep"}


def with_overrides(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command that runs a scene with each `--table.key value` as `--set table.key=value`.

    Several values after one `--set` or `--vary` get one each.
    """
    if not arguments or arguments[0] not in SCENE_COMMANDS:
        return list(arguments)
    plain: list[str] = []
    waiting = list(arguments)
    while waiting:
        argument = waiting.pop(0)
        name, equals, value = argument.partition("=")
        if name.startswith("--") and "." in name:
            if not equals:
                value = waiting.pop(0) if waiting else ""
            plain += ["--set", f"{name.removeprefix('--')}={value}"]
        elif argument in {"--set", "--vary"} and waiting:
            plain += [argument, waiting.pop(0)]
            while waiting and _is_assignment(waiting[0]):
                plain += [argument, waiting.pop(0)]
        else:
            plain.append(argument)
    return plain


def _is_assignment(argument: str) -> bool:
    return "=" in argument and not argument.startswith("-")


def summary(command: type[object]) -> str:
    """The first line of what a command says of itself."""
    return (inspect.getdoc(command) or "").partition("\n")[0]


def complain(error: Exception, status: int) -> int:
    """Says what is wrong in one line."""
    print(f"haptether: {' '.join(str(error).split())}", file=sys.stderr)
    return status
