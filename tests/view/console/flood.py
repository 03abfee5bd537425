"""Connections that occupy a server and send nothing useful."""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

LISTENS = "0A"
"""State of a listening socket in /proc/net/tcp."""


@contextlib.contextmanager
def flood(port: int, count: int, sent: bytes) -> Iterator[list[socket.socket]]:
    """Open that many connections, as far as the server accepts them; each sends these bytes."""
    opened: list[socket.socket] = []
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            one = stack.enter_context(socket.socket())
            one.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                one.connect(("127.0.0.1", port))
            opened.append(one)
        send(opened, sent)
        yield opened


def send(opened: list[socket.socket], sent: bytes) -> None:
    """Send the same bytes on each open connection."""
    for one in opened:
        with contextlib.suppress(OSError):
            one.send(sent)


def held(port: int) -> int:
    """Count the connections that a server of this machine has accepted at a port and not closed."""
    count = 0
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, local, _, state, *rest = line.split()
        # A connection in the backlog, or a closed one, has no inode.
        count += int(local.rpartition(":")[2], 16) == port and state != LISTENS and rest[5] != "0"
    return count
