"""An emulated bus over a socket: raw bytes either way, as ser2net hands them on."""

import contextlib
import socket
from pathlib import Path
from typing import Final

RECEIVE: Final = 4096


class StreamLine:
    """Listens for one client at a time; one that comes while another is connected is closed at once.

    Args:
        listening: Where.
        address: As it is shown.
        baud: Rate of the wire behind it in bit/s, for a client says none.
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
        """What a client has sent; nothing where one has come or gone."""
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
        """How many bytes the client takes without waiting."""
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
        """Closes the connection, if there is one."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        """Closes the connection and listens no longer."""
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
        """The end of a connection may be read after the beginning of the next."""
        if self._client is not None:
            with contextlib.suppress(BlockingIOError):
                received = b""
                with contextlib.suppress(ConnectionError):
                    received = self._client.recv(1, socket.MSG_PEEK)
                if not received:
                    self.hang_up()


class TcpLine(StreamLine):
    """Over TCP.

    Args:
        address: Where it listens, `HOST:PORT`; port 0 is any free one.
        baud: Of the wire behind it.

    Raises:
        ValueError: No such form of address.
        OSError: An address that cannot be used.
    """

    def __init__(self, address: str, baud: int) -> None:
        host, _, port = address.rpartition(":")
        if not (host and port.isdecimal() and int(port) <= 65535):
            message = f"tcp = {address}: must be HOST:PORT with a port of 0 to 65535"
            raise ValueError(message)
        listening = socket.create_server((host, int(port)))
        super().__init__(listening, f"{host}:{listening.getsockname()[1]}", baud)


class UnixLine(StreamLine):
    """Over a Unix socket, which `DynamixelBus` takes for a port.

    Args:
        path: Where it is made; nothing must be there.
        baud: Of the wire behind it.

    Raises:
        OSError: A path that cannot be used.
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
        """As of any; the path is free again."""
        super().close()
        self._path.unlink(missing_ok=True)
