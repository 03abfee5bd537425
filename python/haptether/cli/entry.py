"""Entry of every command: parsing, one-line errors, exit status.

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
from haptether.printed import SEE_ABOVE, forget, shortened

PURPOSES = {
    "see it": CommandTable(
        {
            "demo": "demo:Demo",
            "try": "view.trial.command:Try",
            "console": "view.console:Console",
            "view": "view.view:View",
            "watch": "view.watch:Watch",
        }
    ),
    "run it": CommandTable(
        {
            "setup": "setup.command:Setup",
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
            "cite": "scene.cite:Cite",
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
            "dynamixel": "dynamixel:Dynamixel",
        }
    ),
    "extend it": CommandTable(
        {
            "new-driver": "new.driver:NewDriver",
            "new-controller": "new.controller:NewController",
            "new-impairment": "new.impairment:NewImpairment",
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
"""Commands by purpose."""
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
"""Groups of commands."""


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
"""128 + SIGPIPE, as for a tool that the signal ends: the reader of the output has gone."""
MIN_COLUMNS = 40
LONG_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.])(?<=[\d.]{30})")
"""More digits than a number needs: nobody counts the zeros of 1e300."""

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
"""Commands that run on, and end, even if nobody reads their output."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    _print_all_characters()
    # Files are readable by their user alone: recordings show the motion of a hand.
    before = os.umask(0o077)
    try:
        try:
            status = _main(arguments)
        except SystemExit as end:
            # `--help` exits with 0.
            if end.code not in {None, 0} or not has_lost_output():
                raise
            status = 0
        if status == 0 and has_lost_output():
            return complain(OSError("standard output: is closed, must be open: nothing is written there"), FAILED)
        return status
    except BrokenPipeError as error:
        # The reader of the error message has gone.
        return _unwritten(error)
    finally:
        os.umask(before)


def _print_all_characters() -> None:
    """Print a question mark for characters that the encoding lacks; reports and tables are written as bytes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def _main(arguments: Sequence[str]) -> int:
    _use_width()
    forget()
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
        # The reader of the version, of help or of a completion script has gone.
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
        # An interrupt within code that was compiled from text, such as a dataclass, makes CPython end by the signal
        # even if the exception is caught. Running further code of this kind resets that.
        exec("")
    return status


def _picture_style(style: Any) -> contextlib.AbstractContextManager[None]:  # noqa: ANN401  # an option, if any
    """Return the context in which a command draws."""
    if style is None:
        return contextlib.nullcontext()
    from haptether.view.style.figure import picture_style

    return picture_style(style)


def _status(command: Command) -> int:
    try:
        with _picture_style(getattr(command, "style", None)):
            status = command.run()
        # Flush here, where a failed write is reported.
        sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ValueError, OSError, RuntimeError, ImportError, MemoryError) as error:
        if INTERRUPTS.seen:
            # After Ctrl-C a call may fail with another exception.
            return INTERRUPTED
        if isinstance(error, BrokenPipeError) and (_is_closed(sys.stdout) or _is_closed(sys.stderr)):
            return _unwritten(error)
        status = BAD_REQUEST if isinstance(error, ValueError) else FAILED
        try:
            sys.stdout.flush()
        except OSError:
            # Python would try to write the rest of the buffer again at exit.
            _discard(sys.stdout)
        remedy = busy_port_remedy(error, command)
        return complain(error, status, debug=getattr(command, "debug", False), remedy=remedy)
    return status


def _is_closed(stream: TextIO) -> bool:
    """Return true if the reader has gone, so that writing raises `BrokenPipeError`; false for a queued stream."""
    if isinstance(getattr(stream, "buffer", None), QueuedBuffer):
        return False
    poll = select.poll()
    # Errors are reported for any event mask.
    poll.register(stream.fileno(), 0)
    return bool(poll.poll(0))


def _unwritten(error: OSError) -> int:
    """Return the status for an output that cannot be written, and keep Python from trying again at exit."""
    _discard(sys.stdout)
    if isinstance(error, BrokenPipeError):
        # Either pipe may be closed, or both, as after 2>&1.
        _discard(sys.stderr)
        return CLOSED_PIPE
    return complain(error, FAILED)


def _discard(stream: TextIO) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _use_width() -> None:
    """Use the width of the terminal, at least `MIN_COLUMNS`, even if COLUMNS is smaller.

    At width 0 tables are empty; at a few columns the parser does not end.
    """
    columns = shutil.get_terminal_size().columns
    if columns < MIN_COLUMNS or not os.environ.get("COLUMNS", "1").lstrip("0").isdecimal():
        os.environ["COLUMNS"] = str(max(MIN_COLUMNS, columns))


def _delivered(command: Command, output: QueuedOutput, status: int) -> int:
    """Return the status of a command whose result may not have been read."""
    is_result = str(getattr(command, "json", None)) == "-"
    # An output that was closed before the command began is unwanted, unless it is the result.
    is_delivered = output.delivered and sys.__stdout__ is not None
    if status == 0 and (output.error is not None or (is_result and not is_delivered)):
        return CLOSED_PIPE if isinstance(output.error, BrokenPipeError) else FAILED
    return status


def _let_go_of_output() -> None:
    """Keep Python from waiting at exit for a reader of the remaining output."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            if not select.select([], [stream], [], 0.0)[1]:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def name_of(arguments: Sequence[str]) -> str:
    """Return the name of a command as it is called, with its group."""
    return " ".join(arguments[: 2 if arguments[0] in GROUPS else 1])


def parse(arguments: Sequence[str]) -> Command:
    """Return the command that the arguments request.

    Raises:
        SystemExit: Status 2 for invalid arguments, 0 after help.
        ValueError: No such command.
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
    # The parser repeats arguments verbatim.
    safe = all(argument.isprintable() for argument in arguments)
    named = commands.get(arguments[0]) if arguments else None
    # If a command is named, only that one is parsed: unknown options are not looked for in other commands.
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
        # Flush here, where a failed write is reported.
        sys.stdout.flush()
        raise
    return command


def refuse_repeated(command: type[Any], arguments: Sequence[str]) -> None:
    """Refuse an option that is given twice: the parser would silently take the last for most of them.

    Raises:
        ValueError: An option is given twice; the message names both.
    """
    options = list(arguments[: arguments.index("--")] if "--" in arguments else arguments)
    if not {"--help", "-h"}.isdisjoint(options):
        return
    given: dict[str, str] = {}
    single: set[str] | None = None
    for argument, after in zip(options, [*options[1:], "--"], strict=False):
        name, equals, _ = argument.partition("=")
        # An option without a value is refused by the parser.
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
    """Return true if an option takes one value or one list: not a switch, and not an appending option."""
    is_switch = getattr(hint, "__origin__", hint) is bool
    return not is_switch and tyro.conf.UseAppendAction not in getattr(hint, "__metadata__", ())


def union_of(commands: Mapping[str, type[Any]]) -> Any:  # noqa: ANN401  # put together at run time, without a static type
    """Return the commands as one type that the parser chooses from."""
    return Union[  # noqa: UP007
        tuple(
            Annotated[command, tyro.conf.subcommand(name, description=summary(command))]
            for name, command in commands.items()
        )
    ]


def with_help(arguments: Sequence[str]) -> Sequence[str]:
    """Rewrite `haptether help X` as `haptether X --help`."""
    return [*arguments[1:], "--help"] if arguments and arguments[0] == "help" else arguments


def check_command(arguments: Sequence[str], commands: Mapping[str, type[Any]]) -> None:
    """Refuse an unknown command.

    Raises:
        ValueError: No such command; the message names the nearest.
    """
    if arguments and not arguments[0].startswith("-") and arguments[0] not in commands:
        from haptether.bridge.scene.errors import closest

        message = f"{arguments[0][:80]}: no such command: {closest(arguments[0], commands)}"
        raise ValueError(message)


def complete(arguments: Sequence[str]) -> int:
    """Print the script by which a shell completes commands and flags.

    Raises:
        ValueError: An unknown shell.
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
    """Rewrite `--port PORT` of a dynamixel command as its first positional argument."""
    changed = list(arguments)
    for place, argument in enumerate(changed[1:], start=1):
        name, equals, port = argument.partition("=")
        if name != "--port":
            continue
        given = [port] if equals else changed[place + 1 : place + 2]
        return [*changed[:1], *given, *changed[1:place], *changed[place + (1 if equals else 2) :]]
    return changed


def with_backward(arguments: Sequence[str]) -> list[str]:
    """Rewrite each `--backward.key value` of a netsim command as `--backward-set key=value`.

    Raises:
        ValueError: A setting is given twice.
    """
    return _with_assignments(arguments, BACKWARD, "--backward-set", ())


def with_overrides(arguments: Sequence[str]) -> list[str]:
    """Rewrite each `--table.key value` of a command that runs a scene as `--set table.key=value`.

    Several values after one `--set`, `--vary` or `--compare` get one option each; for a command that opens a driver the
    values after `--options` do.

    Raises:
        ValueError: A field is given twice.
    """
    if arguments and arguments[0] in SCENE_COMMANDS:
        return _with_assignments(arguments, TABLE_KEY, "--set", ("--set", "--vary", "--compare"))
    if arguments and arguments[0] in DRIVER_COMMANDS:
        return _with_assignments(arguments, None, "--options", ("--options",))
    return _with_assignments(arguments, None, "--set", ())


SCENE_COMMANDS = {"simulate", "sweep", "view", "check", "evaluate", "falsify", "thresholds", "cite"}
DRIVER_COMMANDS = {"check-device", "identify"}
TABLE_KEY = re.compile(r"--(.*\..*)", re.DOTALL)
BACKWARD = re.compile(r"--backward\.(.*)", re.DOTALL)


def _with_assignments(
    arguments: Sequence[str], key: re.Pattern[str] | None, option: str, repeated: Sequence[str]
) -> list[str]:
    """Rewrite options that match `key` as assignments after `option`; put one of `repeated` before each value."""
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
    """Fold the paragraphs of a text to the width of the terminal; keep a command to be copied on one line."""
    width = shutil.get_terminal_size().columns
    paragraphs = text.split("\n\n")
    return "\n\n".join(
        paragraph
        if paragraph.startswith(("haptether ", " ")) or all(len(line) <= width for line in paragraph.splitlines())
        else textwrap.fill(" ".join(paragraph.split()), width, break_long_words=False, break_on_hyphens=False)
        for paragraph in paragraphs
    )


def complain(error: Exception, status: int, *, debug: bool = False, remedy: str = "") -> int:
    """Print an error in one line, after its traceback if requested; return `status`."""
    if debug:
        lines = "".join(traceback.format_exception(error)).splitlines()
        print("\n".join(printable(line) for line in lines), file=sys.stderr)
    said = shortened(str(error))
    if not debug and said != SEE_ABOVE:
        # The source line of a driver's error is for those who mend the driver.
        said = shortened(getattr(error, "brief", str(error)))
    if said == SEE_ABOVE:
        said = f"failed: {said}"
    text = said or ("no memory was left" if isinstance(error, MemoryError) else type(error).__name__)
    if isinstance(error, OSError) and error.strerror and text.startswith("[Errno"):
        text = error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    if getattr(error, "errno", None) == errno.EBADF or text.endswith(f"(os error {errno.EBADF})"):
        text += ": something in this process, as a driver or a library, has closed its files and sockets"
    text = LONG_NUMBER.sub(lambda number: repr(float(number[0])), " ".join(f"{text}{remedy}".split()))
    print(f"haptether: {printable(text)}", file=sys.stderr)
    return status
