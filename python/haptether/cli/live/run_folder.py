"""The folder of this user in which sides that run have their telemetry, unless it is given another place."""

import contextlib
import os
import socket
import stat
import tempfile
import time
from pathlib import Path

from haptether.private_file import refuse_link

MAX_PATH = 107
"""Bytes of the path of a Unix socket; Linux, `struct sockaddr_un`."""
LONGEST_NAME = "master-4194304.sock"
"""Longest name of a socket: Linux has no larger process number."""

STALE_S = 60.0
"""Until a socket at which nobody listens was left behind, and not just made by a process that is not seen from here."""


def run_folder() -> Path | None:
    """`$XDG_RUNTIME_DIR/haptether`, or a folder of this user among temporary files; none where none can be private.

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
    """Where a side of this process sends its telemetry; none where there is no private folder."""
    folder = run_folder()
    return None if folder is None else folder / f"{side}-{os.getpid()}.sock"


def running_sides() -> list[Path]:
    """Sockets of the run folder at which somebody sends; those that killed runs have left behind are removed."""
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
    """Whether the process that the name of a socket ends with is there: it may be about to listen."""
    number = path.stem.rpartition("-")[2]
    return number.isdecimal() and Path(f"/proc/{number}").exists()
