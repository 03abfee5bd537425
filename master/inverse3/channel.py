"""WebSocket to the service without a thread: frames are read on request with a timeout."""

import contextlib
import socket
import time
from typing import Final

from haptether.extras import missing

try:
    from websockets.client import ClientProtocol
    from websockets.exceptions import WebSocketException
    from websockets.frames import Frame, Opcode
    from websockets.protocol import State
    from websockets.uri import parse_uri
except ImportError as error:
    raise missing("the driver inverse3", "websockets", error) from None

CONNECT_S: Final = 2.0
RECEIVE: Final = 512
"""Bytes per read; as pings of 2 bytes they take 1 ms, while 64 KiB would take 0.2 s or more."""
DRAIN_S: Final = 0.002
"""Additional time in s for bytes that have already arrived."""
MAX_FRAME: Final = 1 << 20


class ChannelError(ConnectionError):
    """Unusable connection."""


class Channel:
    """Connection to the service; for one thread.

    Args:
        host: Host of the service.
        port: Port of the service.

    Raises:
        ChannelError: The connection fails, or the peer does not speak WebSocket.
    """

    def __init__(self, host: str, port: int) -> None:
        self._protocol = ClientProtocol(parse_uri(f"ws://{host}:{port}/"), max_size=MAX_FRAME)
        self._frames: list[bytes] = []
        self._partial = bytearray()
        end_s = time.monotonic() + CONNECT_S
        try:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        except OSError as error:
            message = f"{host}:{port}: {error.strerror or error}"
            raise ChannelError(message) from None
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._protocol.send_request(self._protocol.connect())
            self._flush()
            while self._protocol.state is State.CONNECTING:
                self._receive(max(0.0, end_s - time.monotonic()))
        except (OSError, WebSocketException) as error:
            self._socket.close()
            message = f"{host}:{port}: no WebSocket: {error or type(error).__name__}"
            raise ChannelError(message) from None
        if self._protocol.state is not State.OPEN:
            self._socket.close()
            message = f"{host}:{port}: no WebSocket: {self._protocol.handshake_exc}"
            raise ChannelError(message)

    def send(self, message: bytes) -> None:
        """Send a text frame.

        Raises:
            ChannelError: The connection is lost, or accepts no data.
        """
        try:
            self._protocol.send_text(message)
            self._flush()
        except (OSError, WebSocketException) as error:
            raise ChannelError(_text(error)) from None

    def frame(self, limit_s: float) -> bytes | None:
        """Return the next frame, or None after a timeout in s, whatever else arrives; 0 does not wait.

        Raises:
            ChannelError: The connection is lost.
        """
        return None if self.peek(limit_s) is None else self._frames.pop(0)

    def peek(self, limit_s: float) -> bytes | None:
        """Return the next frame as `frame` does, and leave it there.

        Raises:
            ChannelError: The connection is lost.
        """
        end_s = time.monotonic() + limit_s
        while not self._frames and (left_s := end_s - time.monotonic()) > -DRAIN_S:
            try:
                self._receive(max(0.0, left_s))
            except (TimeoutError, BlockingIOError):
                return None
            except (OSError, WebSocketException) as error:
                raise ChannelError(_text(error)) from None
        return self._frames[0] if self._frames else None

    def send_last(self, message: bytes) -> None:
        """Send a text frame before `close`, even if received data was not WebSocket."""
        with contextlib.suppress(OSError):
            self._socket.settimeout(0.0)
            self._socket.send(Frame(Opcode.TEXT, message).serialize(mask=True))

    def close(self, wait_s: float = 0.0) -> None:
        """Send a close frame, and wait at most a time in s for the peer's close.

        Closing a socket with unread bytes resets it, which may lose the last sent data.
        """
        with contextlib.suppress(OSError, WebSocketException):
            self._protocol.send_close()
            self._flush()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            end_s = time.monotonic() + wait_s
            while (left_s := end_s - time.monotonic()) > 0.0:
                self._socket.settimeout(left_s)
                if not self._socket.recv(RECEIVE):
                    break
        self._socket.close()

    def _flush(self) -> None:
        sent = b"".join(self._protocol.data_to_send())
        if sent:
            # If the socket buffer is full, the service does not read.
            self._socket.settimeout(0.0)
            if self._socket.send(sent) != len(sent):
                message = "the service does not read"
                raise BrokenPipeError(message)

    def _receive(self, limit_s: float) -> None:
        self._socket.settimeout(limit_s)
        received = self._socket.recv(RECEIVE)
        if not received:
            message = "closed by the service"
            raise ConnectionError(message)
        self._protocol.receive_data(received)
        for frame in self._protocol.events_received():
            if isinstance(frame, Frame):
                self._take(frame)
        if self._protocol.parser_exc is not None:
            # A parser error need not be an OSError.
            message = f"no WebSocket: {self._protocol.parser_exc}"
            raise ConnectionError(message)
        if self._protocol.state in {State.CLOSING, State.CLOSED}:
            message = "closed by the service"
            raise ConnectionError(message)
        # Answer a ping.
        self._flush()

    def _take(self, frame: Frame) -> None:
        if frame.opcode in {Opcode.TEXT, Opcode.BINARY, Opcode.CONT}:
            self._partial += frame.data
            if len(self._partial) > MAX_FRAME:
                message = f"a message of more than {MAX_FRAME} bytes"
                raise ConnectionError(message)
            if frame.fin:
                self._frames.append(bytes(self._partial))
                self._partial.clear()


def _text(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) and error.strerror else str(error)) or type(error).__name__
