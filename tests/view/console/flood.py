"""Connections that keep a server busy and give it nothing."""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

LISTENS = "0A"
"""State of a socket in /proc/net/tcp."""


@contextlib.contextmanager
def flood(port: int, count: int, sent: bytes) -> Iterator[list[socket.socket]]:
    """So many connections, each of which has sent this, as far as the server takes them."""
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
    """Send the same at each that is still open."""
    for one in opened:
        with contextlib.suppress(OSError):
            one.send(sent)


def held(port: int) -> int:
    """How many connections a server of this machine has taken at a port and not closed."""
    count = 0
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, local, _, state, *rest = line.split()
        # One that waits to be accepted, or is gone, has no inode.
        count += int(local.rpartition(":")[2], 16) == port and state != LISTENS and rest[5] != "0"
    return count
