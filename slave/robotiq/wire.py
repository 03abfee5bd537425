"""Connection to the URCap's server: each call has a timeout, each failure a name."""

import contextlib
import socket
import time
from typing import Final

from haptether.slave.robotiq.protocol import MAX_REPLY, MAX_SHOWN, MalformedReplyError, Progress, Request, parsed

CONNECT_S: Final = 2.0
SETTLE_S: Final = 0.002
"""Pause in s after which a number is complete; a reply is one segment."""
SEE_URCAP: Final = "is the arm on, in this network, and the Robotiq URCap installed, its gripper found on the pendant?"


class WireError(RuntimeError):
    """Unusable connection; the text begins with the name of the fault."""


class Wire:
    """Connection for one thread; `close` interrupts another thread's call.

    Args:
        host: An IPv4 address.
        port: Port of the server.
        limit_s: Timeout of a reply in s.

    Raises:
        WireError: The connection fails.
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
        """Send a request and wait for its reply; return the value, or None.

        Raises:
            WireError: No reply, or a malformed one.
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
        """Close the connection; may be repeated."""
        with contextlib.suppress(OSError):
            # Wake a thread that waits for a reply.
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
        """Accept only an end of line after the previous reply."""
        late = self._received(0.0)
        if late is not None and late.strip():
            message = f"{late[:MAX_SHOWN]!r}: nothing was asked"
            raise MalformedReplyError(message)

    def _received(self, limit_s: float) -> bytes | None:
        """Return data received within a time in s, or None."""
        self._socket.settimeout(max(0.0, limit_s))
        try:
            part = self._socket.recv(MAX_REPLY + 1)
        except (TimeoutError, BlockingIOError):
            return None
        if not part:
            message = "closed by the other side"
            raise ConnectionError(message)
        return part
