"""The driver that a command opens, its options, and how it is opened."""

import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from haptether.cli.shared.output import FileOptions
from haptether.printable import printable

if TYPE_CHECKING:
    from haptether.bridge.devices.standalone import StandaloneRun
    from haptether.cli.shared.stop import Stopped

Kind = Literal["linear", "joints", "pose"]

MAX_OPEN_S = 600.0
BLOCKED_S = 2.0
"""A call that has not returned for this time in s ends a run."""


@dataclass(frozen=True, kw_only=True)
class DriverOptions(FileOptions):
    """A driver by its name, and its options."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of the driver, as in `haptether list`."""
    options: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Option of the driver, as in [master.options] and [slave.options] of a scene; may be given often."""
    kind: Kind | None = None
    """Kind of its coordinates, as in a scene; by default the first of the driver's own kinds."""
    period_s: float = 1e-3
    """Period of the loop in s, for a driver that does not pace it."""
    open_s: float = 60.0
    """Longest time in s that it may take to open."""
    debug: bool = False
    """Show the traceback of a driver's exception."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON at the end; - for standard output."""


DrivenPart = Literal["master", "slave", "gripper"]
"""Side that a driver is for."""


def check_options(command: DriverOptions) -> None:
    """Refuse numbers out of their bounds, and a file that cannot be written.

    Raises:
        ValueError: A number out of its bounds.
        OSError: The file cannot be written.
    """
    from haptether.cli.shared.output import check_target

    check_target(command.json, force=command.force)
    for name, value, low, high in (
        ("period-s", command.period_s, 1e-4, 0.1),
        ("open-s", command.open_s, 0.1, MAX_OPEN_S),
    ):
        if not low <= value <= high:
            message = f"{name} = {value:g}: must be between {low:g} and {high:g} s"
            raise ValueError(message)


def side_of(name: str, side: DrivenPart | None) -> DrivenPart:
    """Return the side that a driver is for.

    Raises:
        ValueError: No driver has that name, or several have.
    """
    from difflib import get_close_matches

    from haptether.bridge import GRIPPERS, MASTERS, SLAVES, device_names

    names = {"master": device_names(MASTERS), "slave": device_names(SLAVES), "gripper": device_names(GRIPPERS)}
    if side is not None:
        return side
    has = [of for of, known in names.items() if name in known]
    if len(has) == 1:
        return cast("DrivenPart", has[0])
    if has:
        drivers, flags = (f" {word} ".join(has) for word in ("and a", "or --side"))
        message = f"{name}: a driver of a {drivers}: say which by --side {flags}"
        raise ValueError(message)
    known = sorted({known for of in names.values() for known in of})
    near = get_close_matches(name, known, 1)
    hint = f"did you mean {near[0]}? " if near else ""
    message = f"{name}: no such driver: {hint}there is {', '.join(known) or 'none'} (haptether list)"
    raise ValueError(message)


def driver_options(command: DriverOptions, side: DrivenPart) -> dict[str, Any]:
    """Return the options of the driver, as in `[master.options]` of a scene.

    Raises:
        ValueError: An option without `=`, or a value that is not TOML.
    """
    from haptether.bridge.scene.load import overridden

    table = "slave.gripper" if side == "gripper" else side
    raw: dict[str, Any] = {}
    for option in command.options:
        raw = overridden(raw, f"{table}.options.{option}")
    for key in table.split("."):
        raw = raw.get(key, {})
    options: dict[str, Any] = raw.get("options", {})
    return options


def loaded_device(command: DriverOptions, side: Literal["master", "slave"]) -> object:
    """Return the driver, called with its options.

    Raises:
        ValueError: No such driver, options that it does not have, or a kind that it does not support.
        DeviceError: Its constructor raised an exception.
    """
    from haptether.bridge import load_master, load_slave
    from haptether.bridge.devices.open import POINT_KINDS

    options = driver_options(command, side)
    device = load_master(command.name, options) if side == "master" else load_slave(command.name, options)
    kinds = getattr(device, "kinds", POINT_KINDS)
    if command.kind is not None and isinstance(kinds, tuple | list) and command.kind not in kinds:
        message = f"kind = {command.kind}: {command.name} is a driver of {' or '.join(map(str, kinds))}"
        raise ValueError(message)
    return device


def certain_kind(command: DriverOptions, device: object) -> Kind:
    """Return the kind of a device that is to exert a force; the bounds differ between N and N m.

    Raises:
        ValueError: The driver supports joints and other kinds, and the command does not choose.
    """
    from haptether.bridge.devices.check.report import kind_of
    from haptether.bridge.devices.open import POINT_KINDS

    kinds = getattr(device, "kinds", POINT_KINDS)
    if command.kind is None and isinstance(kinds, tuple | list) and "joints" in kinds and len(kinds) > 1:
        message = (
            f"{command.name}: its driver is of {' or '.join(map(str, kinds))}: say which by --kind, for the bounds"
        )
        raise ValueError(message)
    return command.kind or kind_of(device)


def await_open(command: DriverOptions, run: "StandaloneRun", stopped: "Stopped") -> bool:
    """Wait until a driver is open and return true if it is.

    Raises:
        KeyboardInterrupt: Ctrl-C meanwhile; the driver is closed.
    """
    from haptether.cli.shared.own_force import announce_end, exerts_by_itself
    from haptether.cli.shared.screen import Screen

    end_s = time.monotonic() + command.open_s
    with Screen(stderr=True).status(f"opening {command.name}   (Ctrl-C ends)"):
        while not (run.is_open or run.finished or stopped) and time.monotonic() < end_s:
            time.sleep(0.01)
    if stopped:
        if not run.end() and exerts_by_itself(run.watched.device):
            announce_end(command.name, closed=False)
        raise KeyboardInterrupt
    return run.is_open


def is_over(run: "StandaloneRun") -> bool:
    """Return true if a run has ended, or if a call of its driver has not returned for `BLOCKED_S`."""
    return run.finished or run.blocked_in(BLOCKED_S) is not None


def show_tracebacks(command: DriverOptions, run: "StandaloneRun") -> None:
    """Print the exceptions of a driver's methods on standard error, with `--debug`."""
    if command.debug:
        for error in run.watched.failed.values():
            lines = "".join(traceback.format_exception(error)).splitlines()
            print("\n".join(map(printable, lines)), file=sys.stderr)
