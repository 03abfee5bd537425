"""Limits on the console's connections, with a short timeout for connections without the token."""

import math
from typing import Any, Protocol

MAX_UNKNOWN = 64
"""Limit of connections without the token; a further one closes the oldest."""
MAX_KNOWN = 32
"""Limit of connections with the token, pages included; a further one closes the one that expires first."""
TOKEN_S = 2.0
"""Timeout in s from the connection to the end of its first request with the token."""
REQUEST_S = 10.0
"""Timeout in s between two requests with the token; an open page has none."""


class Connection(Protocol):
    """Used part of an `asyncio` transport."""

    def abort(self) -> None:
        """Close the connection regardless of the peer."""

    def get_extra_info(self, name: str) -> Any:  # noqa: ANN401  # as there
        """Return extra information, mainly the `socket`."""


class Connections:
    """Open connections, each with its expiry time.

    Connections without the token cannot exclude a page, because the oldest of them is closed first. Times are in s on
    any monotonic clock.
    """

    def __init__(self) -> None:
        self._unknown: dict[Connection, float] = {}
        self._known: dict[Connection, float] = {}

    def add(self, connection: Connection, now_s: float) -> None:
        """Add a connection that has not shown the token."""
        self._close_first(self._unknown, MAX_UNKNOWN)
        self._unknown[connection] = now_s + TOKEN_S

    def admit(self, connection: Connection, now_s: float) -> None:
        """Record a request with the token, or the end of a page."""
        self._unknown.pop(connection, None)
        if connection not in self._known:
            self._close_first(self._known, MAX_KNOWN)
        self._known[connection] = now_s + REQUEST_S

    def keep(self, connection: Connection) -> None:
        """Mark the connection of an open page."""
        self._known[connection] = math.inf

    def close_late(self, now_s: float) -> None:
        """Close expired connections; `math.inf` closes all."""
        for connections in (self._unknown, self._known):
            for connection in [one for one, until_s in connections.items() if until_s <= now_s]:
                _end(connections, connection)

    def _close_first(self, connections: dict[Connection, float], most: int) -> None:
        """Make room for another connection."""
        if len(connections) < most:
            return
        for connection in [one for one in connections if not _is_open(one)]:
            del connections[connection]
        while len(connections) >= most:
            _end(connections, min(connections, key=connections.__getitem__))


def _end(connections: dict[Connection, float], connection: Connection) -> None:
    del connections[connection]
    # Does not wait for a peer that does not read.
    connection.abort()


def _is_open(connection: Connection) -> bool:
    """Return True while the transport holds a descriptor, that is until the peer has read everything."""
    return bool(connection.get_extra_info("socket").fileno() >= 0)
