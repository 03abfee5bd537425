"""Emulated bus over a socket: raw bytes in both directions, like ser2net."""

import contextlib
import socket
from pathlib import Path
from typing import Final

RECEIVE: Final = 4096


class StreamLine:
    """Server for one client at a time; a second client is disconnected at once.

    Args:
        listening: Listening socket.
        address: Address for display.
        baud: Rate of the emulated wire in bit/s, because a client states none.
    """

    def __init__(self, listening: socket.socket, address: str, baud: int) -> None:
        self.baud = baud
        self.is_plugged = True
        self._listening = listening
        self._listening.setblocking(False)
        self._client: socket.socket | None = None
        self.address = address

    def readers(self) -> list[int]:
        """Descriptors to wait for."""
        client = [] if self._client is None else [self._client.fileno()]
        return [self._listening.fileno(), *client]

    def read(self, descriptor: int) -> bytes:
        """Return received bytes; empty after a connect or disconnect."""
        if descriptor == self._listening.fileno():
            self._accept()
        elif self._client is not None and descriptor == self._client.fileno():
            with contextlib.suppress(BlockingIOError):
                received = b""
                with contextlib.suppress(ConnectionError):
                    received = self._client.recv(RECEIVE)
                if not received:
                    self.hang_up()
                return received
        return b""

    def write(self, sent: bytes) -> int:
        """Return the number of bytes that the client accepts without blocking."""
        if self._client is None:
            return 0
        try:
            return self._client.send(sent)
        except BlockingIOError:
            return 0
        except ConnectionError:
            self.hang_up()
            return 0

    def hang_up(self) -> None:
        """Close the connection, if any."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        """Close the connection and the listening socket."""
        self.hang_up()
        self._listening.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listening.accept()
            self._forget_gone()
            if self._client is not None or not self.is_plugged:
                client.close()
                return
            client.setblocking(False)
            if client.family != socket.AF_UNIX:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client

    def _forget_gone(self) -> None:
        """Detect a closed connection, which may be read after the next one begins."""
        if self._client is not None:
            with contextlib.suppress(BlockingIOError):
                received = b""
                with contextlib.suppress(ConnectionError):
                    received = self._client.recv(1, socket.MSG_PEEK)
                if not received:
                    self.hang_up()


class TcpLine(StreamLine):
    """Line over TCP.

    Args:
        address: Listening address, `HOST:PORT`; port 0 selects a free one.
        baud: Rate of the emulated wire.

    Raises:
        ValueError: The address has another form.
        OSError: The address cannot be used.
    """

    def __init__(self, address: str, baud: int) -> None:
        host, _, port = address.rpartition(":")
        if not (host and port.isdecimal() and int(port) <= 65535):
            message = f"tcp = {address}: must be HOST:PORT with a port of 0 to 65535"
            raise ValueError(message)
        listening = socket.create_server((host, int(port)))
        super().__init__(listening, f"{host}:{listening.getsockname()[1]}", baud)


class UnixLine(StreamLine):
    """Line over a Unix socket, which `DynamixelBus` accepts as a port.

    Args:
        path: Path of the socket; it must not exist.
        baud: Rate of the emulated wire.

    Raises:
        OSError: The path cannot be used.
    """

    def __init__(self, path: Path, baud: int) -> None:
        listening = socket.socket(socket.AF_UNIX)
        try:
            listening.bind(str(path))
            listening.listen(1)
        except OSError as error:
            listening.close()
            message = f"socket = {path}: {error.strerror or error}: must be a path that is free"
            raise OSError(message) from None
        self._path = path
        super().__init__(listening, str(path), baud)

    def close(self) -> None:
        """Close, and remove the socket file."""
        super().close()
        self._path.unlink(missing_ok=True)
