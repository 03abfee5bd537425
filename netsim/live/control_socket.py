"""The control socket of a proxy that runs, and its client."""

import ipaddress
import os
import re
import selectors
import socket
import threading
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
from msgspec import Struct

from haptether.netsim.link.errors import refuse_infinite
from haptether.netsim.live.controlled import Controlled, refused_line

MAX_CONNECTIONS = 4
"""A further one closes the idlest."""
WAITING = 128
"""Connections that wait to be accepted: each is, for the idlest gives way."""
MAX_LINE_BYTES = 2**16
"""Of a request, its end included."""
_MAX_AT_ONCE = 8
"""Requests of a connection that are answered before others have their turn."""
_POLL_S = 0.1
_DISPLACED = f"another program has connected; {MAX_CONNECTIONS} may at once, and this one was the idlest"


class ControlSocket:
    """Listens for requests and answers each by a line, on a thread of its own.

    A Unix socket is its owner's alone, and removed at the end; TCP is that of this machine only.

    Args:
        address: Path of a Unix socket, or `127.0.0.1:PORT`; port 0 lets the system choose.

    Raises:
        ValueError: Another address.
        OSError: An address that cannot be used.
    """

    def __init__(self, address: str) -> None:
        self._at = control_address(address)
        self._listening = _listen(self._at)
        self._made = _identity(self._at)
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Where it listens, with the port that was chosen."""
        if isinstance(self._at.place, str):
            return self._at.text
        host, port = self._listening.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def serve(self, controlled: Controlled) -> None:
        """Begins to answer; before, requests wait."""
        self._thread = threading.Thread(target=self._run, args=(controlled,), name="haptether-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it, which takes up to a second, and removes the socket's file."""
        self._end.set()
        if self._thread is not None:
            self._thread.join()
        self._listening.close()
        # Another may have taken the place.
        if self._made is not None and _identity(self._at) == self._made:
            Path(self._at.text).unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _run(self, controlled: Controlled) -> None:
        # The idlest first.
        clients: list[_Client] = []
        with selectors.DefaultSelector() as selector:

            def end(client: _Client) -> None:
                clients.remove(client)
                selector.unregister(client.socket)
                client.socket.close()

            def serve(client: _Client) -> None:
                answered = client.answered
                if not client.is_served(controlled):
                    end(client)
                elif client.answered != answered:
                    clients.remove(client)
                    clients.append(client)

            selector.register(self._listening, selectors.EVENT_READ)
            while not self._end.is_set():
                has_requests = any(client.has_request for client in clients)
                ready = {key.data for key, _ in selector.select(0.0 if has_requests else _POLL_S)}
                for client in [one for one in clients if one in ready or one.has_request]:
                    serve(client)
                if None not in ready or (accepted := self._accepted()) is None:
                    continue
                if len(clients) == MAX_CONNECTIONS:
                    idlest = clients[0]
                    # A request that has arrived counts.
                    serve(idlest)
                    if idlest in clients:
                        _send(idlest.socket, refused_line(_DISPLACED))
                        end(idlest)
                clients.append(_Client(accepted))
                selector.register(accepted, selectors.EVENT_READ, clients[-1])
        for client in clients:
            client.socket.close()

    def _accepted(self) -> socket.socket | None:
        try:
            client, _ = self._listening.accept()
        except OSError:
            return None
        # A client that does not read its answers is not waited for.
        client.setblocking(False)
        return client


def ask_control(address: str, request: dict[str, Any], *, patience_s: float = 5.0) -> dict[str, Any]:
    """Sends one request to the control socket of a proxy and returns its answer.

    Args:
        address: Path of a Unix socket, or `127.0.0.1:PORT`.
        request: As `Controlled` takes it.
        patience_s: Timeout of the answer, in s.

    Raises:
        ValueError: Another address, or a request that is too long.
        OSError: Nobody answers there.
    """
    at = control_address(address)
    # JSON has no such numbers: they would arrive as null, which puts a setting back.
    refuse_infinite(request)
    line = msgspec.json.encode(request) + b"\n"
    if len(line) > MAX_LINE_BYTES:
        message = f"request: {len(line)} bytes, must be at most {MAX_LINE_BYTES}"
        raise ValueError(message)
    try:
        with socket.socket(at.family, socket.SOCK_STREAM) as client:
            client.settimeout(patience_s)
            client.connect(at.place)
            client.sendall(line)
            with client.makefile("rb") as answers:
                answer = answers.readline()
        decoded: dict[str, Any] = msgspec.json.decode(answer, type=dict[str, Any])
    except (FileNotFoundError, ConnectionRefusedError) as error:
        message = (
            f'control = "{address}": {error.strerror}: no proxy listens there: start one with `haptether netsim proxy'
            f" --control {address} ...`, or give the --control of one that runs"
        )
        raise OSError(message) from None
    except (OSError, msgspec.DecodeError) as error:
        why = error.strerror or error if isinstance(error, OSError) else "no proxy answers there"
        message = (
            f'control = "{address}": {why}; nothing is known to have changed: it may be busy with others, try again'
        )
        raise OSError(message) from None
    return decoded


class ControlAddress(Struct, frozen=True):
    """A Unix socket by its path, or TCP of this machine."""

    family: socket.AddressFamily
    place: str | tuple[str, int]
    text: str


def control_address(text: str) -> ControlAddress:
    """Reads `PATH` or `127.0.0.1:PORT`; a path that looks like an address begins with `./`.

    Raises:
        ValueError: Neither, or an address that others could reach.
    """
    found = re.fullmatch(r"\[?(?P<host>[^/\[\]]+)\]?:(?P<port>\d{1,5})", text)
    if found is None:
        if not text or "\0" in text:
            raise _refused(text)
        return ControlAddress(socket.AF_UNIX, str(Path(text)), text)
    try:
        host = ipaddress.ip_address(found["host"])
    except ValueError:
        raise _refused(text) from None
    port = int(found["port"])
    if not host.is_loopback or port > 65_535:
        raise _refused(text)
    family = socket.AF_INET if host.version == 4 else socket.AF_INET6
    return ControlAddress(family, (str(host), port), text)


def _refused(text: str) -> ValueError:
    return ValueError(f'control = "{text}": must be the path of a Unix socket, or 127.0.0.1:PORT of this machine')


def _listen(at: ControlAddress) -> socket.socket:
    listening = socket.socket(at.family, socket.SOCK_STREAM)
    try:
        if at.family == socket.AF_UNIX:
            _clear(at)
            # From the first moment nobody else's.
            before = os.umask(0o177)
            try:
                listening.bind(at.place)
            finally:
                os.umask(before)
        else:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(at.place)
        listening.listen(WAITING)
    except OSError as error:
        listening.close()
        message = f'control = "{at.text}": {error.strerror or error}'
        raise OSError(message) from None
    listening.setblocking(False)
    return listening


def _clear(at: ControlAddress) -> None:
    """Removes the socket of a proxy that was killed; what else is there stays, and binding fails."""
    path = Path(at.text)
    if not path.is_socket():
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(at.place)
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)


def _identity(at: ControlAddress) -> tuple[int, int] | None:
    if at.family != socket.AF_UNIX:
        return None
    try:
        found = Path(at.text).stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


class _Client:
    """A connection, and the part of its next request that has arrived."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.answered = 0
        """Requests so far."""
        self._waiting = bytearray()

    @property
    def has_request(self) -> bool:
        """True if a whole request has arrived and waits, or a line that is too long for one."""
        return b"\n" in self._waiting or len(self._waiting) >= MAX_LINE_BYTES

    def is_served(self, controlled: Controlled) -> bool:
        """Answers a few of the requests that have arrived; false where the connection is to be closed."""
        if not self.has_request:
            try:
                received = self.socket.recv(MAX_LINE_BYTES)
            except BlockingIOError:
                return True
            except OSError:
                return False
            if not received:
                return False
            self._waiting += received
        for _ in range(_MAX_AT_ONCE):
            if not self.has_request:
                break
            end = self._waiting.find(b"\n")
            if not 0 <= end < MAX_LINE_BYTES:
                _send(self.socket, refused_line(f"request: longer than {MAX_LINE_BYTES} bytes"))
                return False
            answer, goes_on = controlled.answer(bytes(self._waiting[:end]))
            del self._waiting[: end + 1]
            self.answered += 1
            if not _send(self.socket, answer) or not goes_on:
                return False
        return True


def _send(client: socket.socket, answer: dict[str, Any]) -> bool:
    """True if the system took all of it at once, as it does for a client that reads its answers."""
    line = msgspec.json.encode(answer) + b"\n"
    try:
        return client.send(line) == len(line)
    except OSError:
        return False
