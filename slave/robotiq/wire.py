"""The connection to the URCap's server: each call within a time limit, each failure by name."""

import contextlib
import socket
import time
from typing import Final

from haptether.slave.robotiq.protocol import MAX_REPLY, MAX_SHOWN, MalformedReplyError, Progress, Request, parsed

CONNECT_S: Final = 2.0
SETTLE_S: Final = 0.002
"""After which a number that could have had more digits has none: a reply is one segment."""
SEE_URCAP: Final = "is the arm on, in this network, and the Robotiq URCap installed, its gripper found on the pendant?"


class WireError(RuntimeError):
    """The connection cannot be used any more; begins with the name of the fault."""


class Wire:
    """A connection, for one thread; `close` ends what another thread does with it.

    Args:
        host: An IPv4 address.
        port: Of the server.
        limit_s: How long a reply may take, in s.

    Raises:
        WireError: Nobody takes the connection.
    """

    def __init__(self, host: str, port: int, limit_s: float) -> None:
        self._limit_s = limit_s
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            message = f"no connection: {host}:{port}: {error.strerror or error}: {SEE_URCAP}"
            raise WireError(message) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exchange(self, request: Request) -> int | None:
        """Sends a request and waits for its reply; the value that it has, if any.

        Raises:
            WireError: No reply, or something else.
        """
        end_s = time.monotonic() + self._limit_s
        try:
            self._discard_line_end()
            self._socket.settimeout(self._limit_s)
            self._socket.sendall(request.text)
            return self._reply(request, end_s)
        except TimeoutError:
            message = f"silence: no reply to {request.shown} within {self._limit_s:g} s: {SEE_URCAP}"
        except MalformedReplyError as error:
            message = f"malformed reply: {error}: does another program speak on this port?"
        except OSError as error:
            message = f"connection lost: {request.shown}: {error.strerror or error}: see the network and the controller"
        self.close()
        raise WireError(message)

    def close(self) -> None:
        """Ends the connection; a second time does nothing."""
        with contextlib.suppress(OSError):
            # Whoever waits for a reply wakes up.
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _reply(self, request: Request, end_s: float) -> int | None:
        received, value, progress = b"", None, Progress.PARTIAL
        while progress is not Progress.WHOLE:
            settles = progress is Progress.OPEN
            part = self._received(SETTLE_S if settles else end_s - time.monotonic())
            if part is None:
                if settles:
                    break
                raise TimeoutError
            received += part
            progress, value = parsed(received, request.reads)
        return value

    def _discard_line_end(self) -> None:
        """What still comes of the reply before may be an end of line, nothing else."""
        late = self._received(0.0)
        if late is not None and late.strip():
            message = f"{late[:MAX_SHOWN]!r}: nothing was asked"
            raise MalformedReplyError(message)

    def _received(self, limit_s: float) -> bytes | None:
        """What comes within a time in s; none where nothing does."""
        self._socket.settimeout(max(0.0, limit_s))
        try:
            part = self._socket.recv(MAX_REPLY + 1)
        except (TimeoutError, BlockingIOError):
            return None
        if not part:
            message = "closed by the other side"
            raise ConnectionError(message)
        return part
