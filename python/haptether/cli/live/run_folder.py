"""This user's folder for the telemetry sockets of running sides, unless an option names another place."""

import contextlib
import os
import socket
import stat
import tempfile
import time
from pathlib import Path

from haptether.private_file import refuse_link

MAX_PATH = 107
"""Largest length in bytes of the path of a Unix socket; Linux, `struct sockaddr_un`."""
LONGEST_NAME = "master-4194304.sock"
"""Longest name of a socket: Linux has no larger process number."""

STALE_S = 60.0
"""Age in s at which a socket without a listener counts as left behind. A younger one may belong to a process that is
not visible from here."""


def run_folder() -> Path | None:
    """Return `$XDG_RUNTIME_DIR/haptether`, or this user's temporary folder; None if no folder can be private.

    Another user with write access could replace a socket, so only this user may own and enter it. If `$TMPDIR` is too
    long for the path of a socket, the folder is in /tmp.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    own = f"haptether-{os.getuid()}"
    folders = [*([Path(base) / "haptether"] if base else []), Path(tempfile.gettempdir()) / own, Path("/tmp") / own]
    for folder in folders:
        if len(os.fsencode(folder / LONGEST_NAME)) > MAX_PATH:
            continue
        with contextlib.suppress(OSError, ValueError):
            refuse_link(folder)
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
            if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
                return folder
    return None


def default_telemetry(side: str) -> Path | None:
    """Return the telemetry socket of a side of this process; None without a private folder."""
    folder = run_folder()
    return None if folder is None else folder / f"{side}-{os.getpid()}.sock"


def running_sides() -> list[Path]:
    """Return the sockets of the run folder that have a sender, and remove those left behind by killed runs."""
    folder = run_folder()
    found = []
    for path in sorted(folder.glob("*.sock")) if folder is not None else ():
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                probe.settimeout(0.5)
                probe.connect(str(path))
        except ConnectionRefusedError:
            if not _lives(path) and _age_s(path) > STALE_S:
                path.unlink(missing_ok=True)
        except OSError:
            continue
        else:
            found.append(path)
    return found


def _age_s(path: Path) -> float:
    with contextlib.suppress(OSError):
        return time.time() - path.lstat().st_mtime
    return 0.0


def _lives(path: Path) -> bool:
    """Return true if the process whose number ends the socket's name exists: it may be about to listen."""
    number = path.stem.rpartition("-")[2]
    return number.isdecimal() and Path(f"/proc/{number}").exists()
