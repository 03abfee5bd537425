"""What every command shares: parsing, one-line errors, exit status.

Exit status: 0 success, 1 a failed run, 2 a bad request, 130 interrupted, 141 a closed pipe.
"""

import contextlib
import errno
import inspect
import io
import os
import re
import select
import shutil
import sys
import textwrap
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from typing import Annotated, Any, TextIO, Union, get_type_hints

import tyro

from haptether import __version__
from haptether.cli.interrupts import INTERRUPTED, INTERRUPTS, has_lost_output
from haptether.cli.overview import overview, summary
from haptether.cli.shared.assignments import refuse_twice
from haptether.cli.shared.busy import busy_port_remedy
from haptether.cli.shared.commands import Command, CommandTable
from haptether.cli.shared.numbers import NUMBERS
from haptether.cli.shared.output import QueuedBuffer, QueuedOutput, queued_output
from haptether.printable import printable

PURPOSES = {
    "see it": CommandTable(
        {"demo": "demo:Demo", "console": "view.console:Console", "view": "view.view:View", "watch": "view.watch:Watch"}
    ),
    "run it": CommandTable(
        {
            "master": "live.master:Master",
            "slave": "live.slave:Slave",
            "check-link": "live.check_link:CheckLink",
            "explain": "live.explain:Explain",
            "keygen": "keygen:Keygen",
        }
    ),
    "ask it": CommandTable(
        {
            "simulate": "scene.simulate:Simulate",
            "sweep": "scene.sweep:Sweep",
            "check": "scene.check:Check",
            "evaluate": "scene.evaluate:Evaluate",
            "thresholds": "scene.thresholds:Thresholds",
            "tune": "recording.tune:Tune",
            "falsify": "scene.falsify:Falsify",
            "paper": "paper:Paper",
            "raven": "raven:Raven",
        }
    ),
    "recordings": CommandTable(
        {
            "info": "recording.info:Info",
            "plot": "recording.plot:Plot",
            "export": "recording.export:Export",
            "replay": "recording.replay:Replay",
            "playback": "recording.playback:Playback",
        }
    ),
    "devices": CommandTable(
        {
            "list": "list:List",
            "check-device": "device.check_device:CheckDevice",
            "identify": "device.identify:Identify",
            "new-driver": "device.new_driver:NewDriver",
            "dynamixel": "dynamixel:Dynamixel",
        }
    ),
    "network": CommandTable({"netsim": "netsim:Netsim"}),
    "emulators": CommandTable(
        {
            "ur-emulator": "emulators.ur:UrEmulator",
            "dynamixel-emulator": "emulators.dynamixel:DynamixelEmulator",
            "inverse3-emulator": "emulators.inverse3:Inverse3Emulator",
        }
    ),
}
"""Commands by what they are for."""
COMMANDS = CommandTable.joined(PURPOSES.values())
GROUPS = {
    "netsim": CommandTable(
        {
            "list": "netsim.list:List",
            "sample": "netsim.sample:Sample",
            "proxy": "netsim.proxy:Proxy",
            "set": "netsim.set:Set",
            "echo": "netsim.echo:Echo",
            "record": "netsim.record:Record",
            "compare": "netsim.compare:Compare",
        }
    ),
    "dynamixel": CommandTable({"find": "dynamixel.find:Find", "calibrate": "dynamixel.calibrate:Calibrate"}),
}
"""Commands that only name others."""


DESCRIPTION = """Bilateral teleoperation bridge that keeps a hand safe when the remote end pushes back.

Start with `haptether demo`: it runs slave, network and master as processes on this machine, lets a simulated
hand press a remote wall, shoves the remote arm, lets the hand go, and shows what each safety controller makes
of it.

Tab completion: `source <(haptether --completion bash)` in bash, the same with zsh in zsh, and
`haptether --completion fish | source` in fish."""
COMPLETION = "--completion"
HELP = ("--help", "-h")
SHELLS = ("bash", "zsh", "fish")

FAILED, BAD_REQUEST = 1, 2
CLOSED_PIPE = 141
"""128 + SIGPIPE, as of a tool that the signal ends: whoever read the output took no more."""
MIN_COLUMNS = 40
LONG_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.])(?<=[\d.]{30})")
"""More digits than a number has: nobody counts the zeros of 1e300."""

NEVER_WAITS = frozenset(
    {
        "master",
        "slave",
        "demo",
        "ur-emulator",
        "dynamixel-emulator",
        "inverse3-emulator",
        "check-link",
        "check-device",
        "identify",
        "netsim proxy",
        "netsim echo",
        "netsim record",
    }
)
"""Commands that go on, and end, whether anybody reads what they print or not."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    _print_all_characters()
    # What a command writes is its user's alone: recordings say what a hand did.
    before = os.umask(0o077)
    try:
        try:
            status = _main(arguments)
        except SystemExit as end:
            # Of help.
            if end.code not in {None, 0} or not has_lost_output():
                raise
            status = 0
        if status == 0 and has_lost_output():
            return complain(OSError("standard output: is closed, must be open: nothing is written there"), FAILED)
        return status
    except BrokenPipeError as error:
        # What is wrong was to be said where nobody listens.
        return _unwritten(error)
    finally:
        os.umask(before)


def _print_all_characters() -> None:
    """Has text streams print a question mark for what their encoding lacks; reports and tables go as bytes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def _main(arguments: Sequence[str]) -> int:
    _use_width()
    try:
        if list(arguments) in (["--version"], ["-V"]):
            print(f"haptether {__version__}", flush=True)
            return 0
        if arguments and arguments[0] == COMPLETION:
            return complete(arguments[1:])
        arguments = with_help(arguments)
        if not arguments or arguments[0] in HELP:
            text = overview(DESCRIPTION, PURPOSES, shutil.get_terminal_size().columns)
            print(text, file=sys.stdout if arguments else sys.stderr, flush=True)
            return 0 if arguments else BAD_REQUEST
        command = parse(arguments)
    except ValueError as error:
        return complain(error, BAD_REQUEST)
    except OSError as error:
        # The version, help or a script for a shell, that nobody takes.
        return _unwritten(error)
    try:
        INTERRUPTS.raising = True
        if name_of(arguments) not in NEVER_WAITS:
            status = _status(command)
        else:
            with queued_output() as output:
                status = _status(command)
            status = _delivered(command, output, status)
    except KeyboardInterrupt:
        status = INTERRUPTED
    finally:
        INTERRUPTS.raising = False
    if status == INTERRUPTED:
        _let_go_of_output()
        # An interrupt within code that was made of text, as dataclasses make theirs, has CPython end by the signal
        # whatever caught it, until the next such code runs.
        exec("")
    return status


def _status(command: Command) -> int:
    try:
        status = command.run()
        # Here, where it is reported if it cannot be written.
        sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ValueError, OSError, RuntimeError, ImportError, MemoryError) as error:
        if INTERRUPTS.seen:
            # What Ctrl-C has cut short may say so in its own way.
            return INTERRUPTED
        if isinstance(error, BrokenPipeError) and (_is_closed(sys.stdout) or _is_closed(sys.stderr)):
            return _unwritten(error)
        status = BAD_REQUEST if isinstance(error, ValueError) else FAILED
        try:
            sys.stdout.flush()
        except OSError:
            # What it still holds would be tried again at exit.
            _discard(sys.stdout)
        remedy = busy_port_remedy(error, command)
        return complain(error, status, debug=getattr(command, "debug", False), remedy=remedy)
    return status


def _is_closed(stream: TextIO) -> bool:
    """Whether its reader has gone away, so that writing raises `BrokenPipeError`; writing to a queued one does not."""
    if isinstance(getattr(stream, "buffer", None), QueuedBuffer):
        return False
    poll = select.poll()
    # Errors are reported whatever is asked for.
    poll.register(stream.fileno(), 0)
    return bool(poll.poll(0))


def _unwritten(error: OSError) -> int:
    """The status where an output takes no more: nothing is left to say there, and Python must not try at exit."""
    _discard(sys.stdout)
    if isinstance(error, BrokenPipeError):
        # Of either, or of both, as after 2>&1.
        _discard(sys.stderr)
        return CLOSED_PIPE
    return complain(error, FAILED)


def _discard(stream: TextIO) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _use_width() -> None:
    """Has text be as wide as the terminal and at least `MIN_COLUMNS`, whatever COLUMNS says.

    At width 0 tables come out empty, at a few columns the parser does not end.
    """
    columns = shutil.get_terminal_size().columns
    if columns < MIN_COLUMNS or not os.environ.get("COLUMNS", "1").lstrip("0").isdecimal():
        os.environ["COLUMNS"] = str(max(MIN_COLUMNS, columns))


def _delivered(command: Command, output: QueuedOutput, status: int) -> int:
    """The status of a command whose result may not have been taken."""
    is_result = str(getattr(command, "json", None)) == "-"
    # Who closed it before such a command began wants none of it, unless it is the result.
    is_delivered = output.delivered and sys.__stdout__ is not None
    if status == 0 and (output.error is not None or (is_result and not is_delivered)):
        return CLOSED_PIPE if isinstance(output.error, BrokenPipeError) else FAILED
    return status


def _let_go_of_output() -> None:
    """Keep Python from waiting at its exit for somebody who reads what is still held back."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            if not select.select([], [stream], [], 0.0)[1]:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def name_of(arguments: Sequence[str]) -> str:
    """The name of a command as it is called, within its group, too."""
    return " ".join(arguments[: 2 if arguments[0] in GROUPS else 1])


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments request.

    Raises:
        SystemExit: With 2 for arguments that do not fit, and with 0 once help was given.
        ValueError: A command that there is not.
    """
    check_command(arguments, COMMANDS)
    if arguments and arguments[0] in GROUPS:
        check_command(arguments[1:], GROUPS[arguments[0]])
        group = COMMANDS[arguments[0]]
        changed = (with_port if arguments[0] == "dynamixel" else with_backward)(arguments[1:])
        return _parsed(GROUPS[arguments[0]], f"haptether {arguments[0]}", group, changed)
    return _parsed(COMMANDS, "haptether", None, with_overrides(arguments))


def _parsed(commands: CommandTable, prog: str, group: "type[object] | None", arguments: Sequence[str]) -> Command:
    printed = io.StringIO()
    # The parser repeats arguments as they are.
    safe = all(argument.isprintable() for argument in arguments)
    named = commands.get(arguments[0]) if arguments else None
    # Of a command that is named no other is parsed: what it does not know is not looked for in theirs.
    if named is not None:
        parsed, prog, arguments = named, f"{prog} {arguments[0]}", arguments[1:]
        description = summary(named)
        refuse_repeated(named, arguments)
    else:
        parsed, description = union_of(commands), DESCRIPTION if group is None else summary(group)
    try:
        with contextlib.nullcontext() if safe else contextlib.redirect_stderr(printed):
            command: Command = tyro.cli(
                parsed,
                prog=prog,
                description=description,
                args=arguments,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
                registry=NUMBERS,
            )
    except SystemExit as ended:
        for line in printed.getvalue().split("\n"):
            if line:
                print(printable(line), file=sys.stderr)
        described = group if named is None else named
        if ended.code == 0 and described is not None:
            # The parser would fold the examples into one paragraph.
            print(f"\n{folded((inspect.getdoc(described) or '').partition(chr(10))[2].strip())}")
        # Here, where it is reported if it cannot be written.
        sys.stdout.flush()
        raise
    return command


def refuse_repeated(command: type[Any], arguments: Sequence[str]) -> None:
    """Refuse an option that is given twice: of most the parser takes the last and says nothing.

    Raises:
        ValueError: With both.
    """
    options = list(arguments[: arguments.index("--")] if "--" in arguments else arguments)
    if not {"--help", "-h"}.isdisjoint(options):
        return
    given: dict[str, str] = {}
    single: set[str] | None = None
    for argument, after in zip(options, [*options[1:], "--"], strict=False):
        name, equals, _ = argument.partition("=")
        # One without a value is refused for that.
        if not name.startswith("--") or (not equals and after.startswith("--")):
            continue
        if single is None:
            single = {
                field for field, hint in get_type_hints(command, include_extras=True).items() if _counts_once(hint)
            }
        field = name[2:].replace("-", "_")
        if field in single:
            refuse_twice(given, field, name)


def _counts_once(hint: object) -> bool:
    """Whether an option of this type has one value, or one list of them: no switch, and nothing that adds up."""
    is_switch = getattr(hint, "__origin__", hint) is bool
    return not is_switch and tyro.conf.UseAppendAction not in getattr(hint, "__metadata__", ())


def union_of(commands: Mapping[str, type[Any]]) -> Any:  # noqa: ANN401  # put together at run time, without a static type
    """The commands as one type that the parser chooses from."""
    return Union[  # noqa: UP007
        tuple(
            Annotated[command, tyro.conf.subcommand(name, description=summary(command))]
            for name, command in commands.items()
        )
    ]


def with_help(arguments: Sequence[str]) -> Sequence[str]:
    """The arguments of `haptether help X` as those of `haptether X --help`."""
    return [*arguments[1:], "--help"] if arguments and arguments[0] == "help" else arguments


def check_command(arguments: Sequence[str], commands: Mapping[str, type[Any]]) -> None:
    """Refuse a command that there is not.

    Raises:
        ValueError: With the nearest.
    """
    if arguments and not arguments[0].startswith("-") and arguments[0] not in commands:
        from haptether.bridge.scene.errors import closest

        message = f"{arguments[0][:80]}: no such command: {closest(arguments[0], commands)}"
        raise ValueError(message)


def complete(arguments: Sequence[str]) -> int:
    """Print the script by which a shell completes commands and flags.

    Raises:
        ValueError: Another shell.
    """
    if list(arguments) not in [[shell] for shell in SHELLS]:
        message = f"{' '.join((COMPLETION, *arguments))}: must be one of {', '.join(SHELLS)}"
        raise ValueError(message)
    nested = {name: make_dataclass(name, [("command", union_of(of))]) for name, of in GROUPS.items()}
    # The parser prints it and exits.
    with contextlib.suppress(SystemExit):
        tyro.cli(
            union_of({**COMMANDS, **nested}),
            prog="haptether",
            args=["--tyro-print-completion", *arguments],
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
            registry=NUMBERS,
        )
    sys.stdout.flush()
    return 0


def with_port(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command of dynamixel with `--port PORT` as the first of those without an option."""
    changed = list(arguments)
    for place, argument in enumerate(changed[1:], start=1):
        name, equals, port = argument.partition("=")
        if name != "--port":
            continue
        given = [port] if equals else changed[place + 1 : place + 2]
        return [*changed[:1], *given, *changed[1:place], *changed[place + (1 if equals else 2) :]]
    return changed


def with_backward(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command of netsim with each `--backward.key value` as `--backward-set key=value`.

    Raises:
        ValueError: One setting twice.
    """
    return _with_assignments(arguments, BACKWARD, "--backward-set", ())


def with_overrides(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command that runs a scene with each `--table.key value` as `--set table.key=value`.

    Several values after one `--set`, `--vary` or `--compare`, and of a command that opens a driver after `--options`,
    get one each.

    Raises:
        ValueError: One field twice.
    """
    if arguments and arguments[0] in SCENE_COMMANDS:
        return _with_assignments(arguments, TABLE_KEY, "--set", ("--set", "--vary", "--compare"))
    if arguments and arguments[0] in DRIVER_COMMANDS:
        return _with_assignments(arguments, None, "--options", ("--options",))
    return _with_assignments(arguments, None, "--set", ())


SCENE_COMMANDS = {"simulate", "sweep", "view", "check", "evaluate", "falsify", "thresholds"}
DRIVER_COMMANDS = {"check-device", "identify"}
TABLE_KEY = re.compile(r"--(.*\..*)", re.DOTALL)
BACKWARD = re.compile(r"--backward\.(.*)", re.DOTALL)


def _with_assignments(
    arguments: Sequence[str], key: re.Pattern[str] | None, option: str, repeated: Sequence[str]
) -> list[str]:
    """Each option of the form `key`, if any, as an assignment after `option`; one of `repeated` before each value."""
    changed: list[str] = []
    waiting = list(arguments)
    given: dict[str, str] = {}

    def note(assignment: str) -> None:
        key = assignment.partition("=")[0]
        refuse_twice(given, key, f"{option} {key.strip()[:80]}")

    while waiting:
        argument = waiting.pop(0)
        name, equals, value = argument.partition("=")
        if key is not None and (found := key.fullmatch(name)):
            if not equals:
                value = waiting.pop(0) if waiting else ""
            changed += [option, f"{found[1]}={value}"]
            refuse_twice(given, found[1], name[:80])
        elif argument in repeated and waiting:
            assignments = [waiting.pop(0)]
            while waiting and "=" in waiting[0] and not waiting[0].startswith("-"):
                assignments.append(waiting.pop(0))
            for assignment in assignments:
                changed += [argument, assignment]
                if argument == option:
                    note(assignment)
        else:
            changed.append(argument)
            if argument == option and waiting:
                changed.append(waiting.pop(0))
                note(changed[-1])
            elif name == option and equals:
                note(value)
    return changed


def folded(text: str) -> str:
    """The paragraphs of a text as wide as the terminal; a command to be copied stays on one line."""
    width = shutil.get_terminal_size().columns
    paragraphs = text.split("\n\n")
    return "\n\n".join(
        paragraph
        if paragraph.startswith(("haptether ", " ")) or all(len(line) <= width for line in paragraph.splitlines())
        else textwrap.fill(" ".join(paragraph.split()), width, break_long_words=False, break_on_hyphens=False)
        for paragraph in paragraphs
    )


def complain(error: Exception, status: int, *, debug: bool = False, remedy: str = "") -> int:
    """Say what is wrong in one line, whatever it repeats; before it the traceback, if requested."""
    if debug:
        lines = "".join(traceback.format_exception(error)).splitlines()
        print("\n".join(printable(line) for line in lines), file=sys.stderr)
    text = str(error) or ("no memory was left" if isinstance(error, MemoryError) else type(error).__name__)
    if isinstance(error, OSError) and error.strerror and text.startswith("[Errno"):
        text = error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    if getattr(error, "errno", None) == errno.EBADF or text.endswith(f"(os error {errno.EBADF})"):
        text += ": something in this process, as a driver or a library, has closed its files and sockets"
    text = LONG_NUMBER.sub(lambda number: repr(float(number[0])), " ".join(f"{text}{remedy}".split()))
    print(f"haptether: {printable(text)}", file=sys.stderr)
    return status
