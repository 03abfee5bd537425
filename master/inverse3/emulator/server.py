"""Process of the emulated service: the only module with its two WebSockets and its clock."""

import contextlib
import select
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from haptether.extras import missing

try:
    from websockets.exceptions import WebSocketException
    from websockets.frames import Frame, Opcode
    from websockets.http11 import Request
    from websockets.protocol import State
    from websockets.server import ServerProtocol
except ImportError as error:
    raise missing("the emulated Inverse Service", "websockets", error) from None

if TYPE_CHECKING:
    from haptether.control_channel import ControlChannel
    from haptether.master.inverse3.emulator.service import Service

RECEIVE: Final = 65536
WATCH_S: Final = 0.01
"""Largest interval in s of device updates."""
MAX_MESSAGE: Final = 1 << 16
MAX_CLIENTS: Final = 16


class Client:
    """Connection, and whether it receives events."""

    def __init__(self, connection: socket.socket, *, listens: bool) -> None:
        self.socket = connection
        self.listens = listens
        self.protocol = ServerProtocol(max_size=MAX_MESSAGE)
        self.is_open = False

    def send(self, text: str) -> None:
        """Send a text frame."""
        self.protocol.send_text(text.encode())
        self.flush()

    def flush(self) -> None:
        """Send pending protocol data.

        Raises:
            OSError: The client accepts no more data.
        """
        sent = b"".join(self.protocol.data_to_send())
        if sent and self.socket.send(sent) != len(sent):
            message = "it does not read"
            raise BrokenPipeError(message)


class Server:
    """Server of states at one port and events at another, on this machine.

    Args:
        service: Emulated service.
        host: Listening address.
        port: Port of the states; 0 selects a free one.
        event_port: Port of the events; 0 selects a free one.

    Raises:
        OSError: A port is in use.
    """

    def __init__(self, service: "Service", host: str, port: int, event_port: int) -> None:
        self.service = service
        self.channel: ControlChannel | None = None
        """Additional input of its loop."""
        self._clients: list[Client] = []
        self._due: list[tuple[float, Client, str]] = []
        self._stalled_until_s = 0.0
        self._states = socket.create_server((host, port))
        try:
            self._events = socket.create_server((host, event_port))
        except OSError:
            self._states.close()
            raise
        self.port: int = self._states.getsockname()[1]
        self.event_port: int = self._events.getsockname()[1]

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until `stopped` returns True."""
        while not stopped():
            self._wait()
            now_s = time.monotonic()
            self.service.advance(now_s)
            self._send_due(now_s)
            self._tell()

    def disconnect(self) -> None:
        """Close all connections; new ones are accepted."""
        for client in list(self._clients):
            self._lose(client)

    def figures(self) -> dict[str, Any]:
        """Return the connections for `status`."""
        return {"clients": sum(not client.listens for client in self._clients), "port": self.port}

    def close(self) -> None:
        """Close all sockets."""
        self.disconnect()
        self._states.close()
        self._events.close()

    def _wait(self) -> None:
        now_s = time.monotonic()
        until_s = min([now_s + WATCH_S, *(due_s for due_s, _, _ in self._due)])
        channel = self.channel.readers() if self.channel is not None else []
        own = {client.socket.fileno(): client for client in self._clients}
        listening = [self._states.fileno(), self._events.fileno()]
        readable, _, _ = select.select([*channel, *listening, *own], [], [], max(0.0, until_s - now_s))
        for descriptor in readable:
            if descriptor in own:
                # A message of another client may have closed it.
                if own[descriptor] in self._clients:
                    self._read(own[descriptor])
            elif descriptor in listening:
                self._accept(self._events if descriptor == listening[1] else self._states)
            elif self.channel is not None:
                self.channel.serve(descriptor)

    def _accept(self, listening: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection, _ = listening.accept()
            if len(self._clients) >= MAX_CLIENTS:
                connection.close()
                return
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients.append(Client(connection, listens=listening is self._events))

    def _read(self, client: Client) -> None:
        try:
            received = client.socket.recv(RECEIVE)
            if received:
                client.protocol.receive_data(received)
            else:
                client.protocol.receive_eof()
            for happened in client.protocol.events_received():
                self._take(client, happened)
            client.flush()
        except BlockingIOError:
            return
        except (OSError, WebSocketException):
            self._lose(client)
            return
        ended = client.protocol.parser_exc is not None or client.protocol.state in {State.CLOSING, State.CLOSED}
        if ended or not received:
            self._lose(client)

    def _take(self, client: Client, happened: object) -> None:
        if isinstance(happened, Request):
            client.protocol.send_response(client.protocol.accept(happened))
            client.is_open = client.protocol.state is State.OPEN
            if client.is_open and not client.listens:
                client.send(self.service.first())
        elif isinstance(happened, Frame) and happened.opcode is Opcode.TEXT and not client.listens:
            now_s = time.monotonic()
            faults = self.service.faults
            self._stalled_until_s = max(self._stalled_until_s, now_s + faults.stall_s)
            faults.stall_s = 0.0
            due_s = max(now_s + faults.delay_s, self._stalled_until_s)
            replies = self.service.receive(bytes(happened.data), now_s)
            if due_s > now_s:
                self._due += [(due_s, client, text) for text in replies]
            else:
                for text in replies:
                    client.send(text)

    def _send_due(self, now_s: float) -> None:
        while self._due and self._due[0][0] <= now_s:
            _, client, text = self._due.pop(0)
            self._send(client, text)

    def _tell(self) -> None:
        while self.service.events:
            text = self.service.events.popleft()
            for client in [client for client in self._clients if client.listens and client.is_open]:
                self._send(client, text)

    def _send(self, client: Client, text: str) -> None:
        if client in self._clients:
            try:
                client.send(text)
            except (OSError, WebSocketException):
                self._lose(client)

    def _lose(self, client: Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            client.socket.close()
