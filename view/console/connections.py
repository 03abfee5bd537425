"""Connections of the console: few at a time, and little time for one without the token."""

import math
from typing import Any, Protocol

MAX_UNKNOWN = 64
"""Connections without the token; a further one closes the oldest."""
MAX_KNOWN = 32
"""Connections that have shown the token, pages among them; a further one closes that whose time is up first."""
TOKEN_S = 2.0
"""From a connection to the end of its first request, with the token."""
REQUEST_S = 10.0
"""From a request with the token to the next; a page that is open has no such limit."""


class Connection(Protocol):
    """As much of a transport of `asyncio` as counts here."""

    def abort(self) -> None:
        """Closes it, whatever its peer does."""

    def get_extra_info(self, name: str) -> Any:  # noqa: ANN401  # as there
        """Its `socket` above all."""


class Connections:
    """The open connections, each with the time at which it is closed.

    Nobody without the token keeps a page out: where there are too many, the oldest without it is closed. Times are in
    s, on any clock that does not go back.
    """

    def __init__(self) -> None:
        self._unknown: dict[Connection, float] = {}
        self._known: dict[Connection, float] = {}

    def add(self, connection: Connection, now_s: float) -> None:
        """Takes a new one, which has not shown the token."""
        self._close_first(self._unknown, MAX_UNKNOWN)
        self._unknown[connection] = now_s + TOKEN_S

    def admit(self, connection: Connection, now_s: float) -> None:
        """Takes note of a request with the token, or that the page at it has ended."""
        self._unknown.pop(connection, None)
        if connection not in self._known:
            self._close_first(self._known, MAX_KNOWN)
        self._known[connection] = now_s + REQUEST_S

    def keep(self, connection: Connection) -> None:
        """Takes note that a page is open at it."""
        self._known[connection] = math.inf

    def close_late(self, now_s: float) -> None:
        """Closes those whose time is up; `math.inf` closes all."""
        for connections in (self._unknown, self._known):
            for connection in [one for one, until_s in connections.items() if until_s <= now_s]:
                _end(connections, connection)

    def _close_first(self, connections: dict[Connection, float], most: int) -> None:
        """Makes room for another."""
        if len(connections) < most:
            return
        for connection in [one for one in connections if not _is_open(one)]:
            del connections[connection]
        while len(connections) >= most:
            _end(connections, min(connections, key=connections.__getitem__))


def _end(connections: dict[Connection, float], connection: Connection) -> None:
    del connections[connection]
    # It does not wait for a peer that does not read.
    connection.abort()


def _is_open(connection: Connection) -> bool:
    """True while it holds a descriptor: until its peer has taken all that was sent."""
    return bool(connection.get_extra_info("socket").fileno() >= 0)
