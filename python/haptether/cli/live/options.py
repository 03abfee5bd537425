"""Options of the live commands, with their conversion to keyword arguments of a side and the key of its session."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from haptether.cli.shared.output import FileOptions

Controller = Literal["none", "vfc", "hsc", "wsc", "pc"]

INSECURE = "INSECURE: frames are neither encrypted nor authenticated, anybody who can send can steer"
"""Warning on the screen for a run in the clear."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(FileOptions):
    """Options of both sides: session, scene, real time and files."""

    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Key file of the secure session, the same at both sides; `haptether keygen` makes one."""
    insecure: bool = False
    """Go without a key: frames travel in the clear, and anybody who can send can steer."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Take everything but the network from a scene, the same at both sides, and drive its devices."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Change the scene, as in `haptether simulate`; may be given often."""
    debug: bool = False
    """Show the traceback of the error that ended the run, such as a driver's exception."""
    realtime: Literal["auto", "off", "require"] = "auto"
    """Ask for SCHED_FIFO and locked memory and go on without (auto), do not ask (off), or fail without (require)."""
    priority: Annotated[int, tyro.conf.arg(metavar="1-99")] = 80
    """Priority under SCHED_FIFO."""
    cpu: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processor of the loop; without it the kernel chooses."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="PATH.mcap")] = None
    """Record every tick as MCAP, about 3 GB an hour; ticks that a slow or full disk does not take are dropped and
    counted."""
    min_free_bytes: Annotated[int, tyro.conf.arg(metavar="N")] = 1_000_000_000
    """End only the recording when fewer free bytes than this are left on its disk."""
    flight: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the last states and commands at a stop, at a fault and at the end; `haptether explain` prints them."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON at the end; - for standard output."""
    telemetry: Annotated[Path | None, tyro.conf.arg(metavar="PATH|none")] = None
    """Send samples and events to readers at a Unix socket of this path, or nowhere (none); by default in the user's
    folder of running sides, where `haptether watch` finds it. See docs/telemetry.md."""
    quiet: bool = False
    """Show neither panel nor status line: only problems, remedies and the result."""
    control: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Accept a person's stop, press and scales at a Unix socket of this path, as `haptether console` sends them; see
    docs/console.md."""


def live_arguments(command: LiveOptions, key: bytearray | None) -> dict[str, Any]:
    """Return the common options as keyword arguments of `LiveMaster` and `LiveSlave`.

    Raises:
        ValueError: A number out of its bounds.
    """
    import secrets

    from haptether.cli.shared.output import check_target

    check_target(command.record, force=command.force)
    if str(command.record) == "-":
        message = "record = -: must be a file"
        raise ValueError(message)
    for name, value, minimum, maximum in (
        ("priority", command.priority, 1, 99),
        ("cpu", command.cpu, 0, 1023),
        ("min-free-bytes", command.min_free_bytes, 0, 2**63),
    ):
        if value is not None and not minimum <= value <= maximum:
            message = f"{name} = {value}: must be {minimum} to {maximum}"
            raise ValueError(message)
    return {
        "run_id": secrets.randbits(64),
        "key": key,
        "insecure": command.insecure,
        "realtime": command.realtime,
        "priority": command.priority,
        "cpu": command.cpu,
        "record": command.record,
        "min_free_bytes": command.min_free_bytes,
        "telemetry": telemetry_of(command),
        "control": command.control,
    }


def telemetry_of(command: LiveOptions) -> Path | None:
    """Return the telemetry socket of a side; None for none."""
    from haptether.cli.live.run_folder import default_telemetry

    if command.telemetry is None:
        path = default_telemetry(type(command).__name__.lower())
        if path is None:
            print("note: no telemetry: no folder can be private to you: give --telemetry PATH", file=sys.stderr)
        return path
    return None if str(command.telemetry) == "none" else command.telemetry


def session_key(key: Path | None, *, insecure: bool) -> bytearray | None:
    """Return the key of a secure session; None for a run in the clear.

    Raises:
        ValueError: Both or neither were given, or the file cannot be read or does not hold a key.
    """
    from haptether.bridge import read_key

    if insecure and key is not None:
        message = "--key, --insecure: give one of the two"
        raise ValueError(message)
    if insecure:
        return None
    if key is None:
        message = (
            "--key PATH is missing: `haptether keygen PATH` makes a key, which both sides need; "
            "--insecure goes without, in the clear"
        )
        raise ValueError(message)
    try:
        return read_key(key)
    except OSError as error:
        message = (
            f"--key {key}: cannot be read: {error.strerror}: must be a key file, the same at both sides; "
            "`haptether keygen PATH` makes one"
        )
        raise ValueError(message) from None


def handed_over(key: bytearray | None) -> None:
    """Wipe a key once the live side has its copy."""
    from haptether.bridge import wipe_key

    if key is not None:
        wipe_key(key)


def marked(headline: str, *, insecure: bool) -> str:
    """Return a headline that warns of a run in the clear."""
    return f"{headline} ({INSECURE})" if insecure else headline
