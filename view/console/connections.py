"""Connections of the console: limited in number, and limited in time without the token."""

import math
from typing import Any, Protocol

MAX_UNKNOWN = 64
"""Connections without the token; one more closes the oldest."""
MAX_KNOWN = 32
"""Connections that have shown the token, pages included; one more closes the one with the earliest deadline."""
TOKEN_S = 2.0
"""Time from a connection to the end of its first request, token included."""
REQUEST_S = 10.0
"""Time from a request with the token to the next; an open page has no limit."""


class Connection(Protocol):
    """The part of an `asyncio` transport used here."""

    def abort(self) -> None:
        """Close at once, whatever the peer does."""

    def get_extra_info(self, name: str) -> Any:  # noqa: ANN401  # same signature as asyncio
        """Transport information, here the `socket`."""


class Connections:
    """The open connections, each with its deadline.

    Clients without the token cannot keep a page out: above the limit, the oldest of them is closed. Times are in s, on
    any monotonic clock.
    """

    def __init__(self) -> None:
        self._unknown: dict[Connection, float] = {}
        self._known: dict[Connection, float] = {}

    def add(self, connection: Connection, now_s: float) -> None:
        """Add a new connection, which has not shown the token."""
        self._close_first(self._unknown, MAX_UNKNOWN)
        self._unknown[connection] = now_s + TOKEN_S

    def admit(self, connection: Connection, now_s: float) -> None:
        """Note a request with the token, or the end of the page on this connection."""
        self._unknown.pop(connection, None)
        if connection not in self._known:
            self._close_first(self._known, MAX_KNOWN)
        self._known[connection] = now_s + REQUEST_S

    def keep(self, connection: Connection) -> None:
        """Note that a page is open on this connection."""
        self._known[connection] = math.inf

    def close_late(self, now_s: float) -> None:
        """Close connections past their deadline; `math.inf` closes all."""
        for connections in (self._unknown, self._known):
            for connection in [one for one, until_s in connections.items() if until_s <= now_s]:
                _end(connections, connection)

    def _close_first(self, connections: dict[Connection, float], most: int) -> None:
        if len(connections) < most:
            return
        for connection in [one for one in connections if not _is_open(one)]:
            del connections[connection]
        while len(connections) >= most:
            _end(connections, min(connections, key=connections.__getitem__))


def _end(connections: dict[Connection, float], connection: Connection) -> None:
    del connections[connection]
    # Abort does not wait for a peer that does not read.
    connection.abort()


def _is_open(connection: Connection) -> bool:
    """True while it holds a descriptor, that is until the peer has taken all data."""
    return bool(connection.get_extra_info("socket").fileno() >= 0)
