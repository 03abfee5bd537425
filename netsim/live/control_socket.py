"""Control socket of a running proxy, and its client."""

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
"""Connection limit; a further connection closes the idlest one."""
WAITING = 128
"""Listen backlog; every connection is accepted, because the idlest gives way."""
MAX_LINE_BYTES = 2**16
"""Longest request, including its end of line."""
_MAX_AT_ONCE = 8
"""Requests of a connection answered before other connections are served."""
_POLL_S = 0.1
_DISPLACED = f"another program has connected; {MAX_CONNECTIONS} may at once, and this one was the idlest"


class ControlSocket:
    """Server that answers each request with one line, on a separate thread.

    A Unix socket has mode 0600 and is removed at the end; TCP accepts this machine only.

    Args:
        address: Path of a Unix socket, or `127.0.0.1:PORT`; port 0 lets the system choose.

    Raises:
        ValueError: The address has another form.
        OSError: The address cannot be used.
    """

    def __init__(self, address: str) -> None:
        self._at = control_address(address)
        self._listening = _listen(self._at)
        self._made = _identity(self._at)
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Listening address, with the chosen port."""
        if isinstance(self._at.place, str):
            return self._at.text
        host, port = self._listening.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def serve(self, controlled: Controlled) -> None:
        """Start to answer; earlier requests wait."""
        self._thread = threading.Thread(target=self._run, args=(controlled,), name="haptether-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop within a second, and remove the socket file."""
        self._end.set()
        if self._thread is not None:
            self._thread.join()
        self._listening.close()
        # Another process may have replaced the file.
        if self._made is not None and _identity(self._at) == self._made:
            Path(self._at.text).unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _run(self, controlled: Controlled) -> None:
        # Sorted by activity, the idlest first.
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
                    # Answer a request that has already arrived.
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
        # Do not wait for a client that does not read its answers.
        client.setblocking(False)
        return client


def ask_control(address: str, request: dict[str, Any], *, patience_s: float = 5.0) -> dict[str, Any]:
    """Send one request to the control socket of a proxy and return the answer.

    Args:
        address: Path of a Unix socket, or `127.0.0.1:PORT`.
        request: Request in the form of `Controlled`.
        patience_s: Timeout of the answer in s.

    Raises:
        ValueError: The address has another form, or the request is too long.
        OSError: The proxy does not answer.
    """
    at = control_address(address)
    # JSON would encode them as null, which resets a setting.
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
    """Path of a Unix socket, or a TCP address of this machine."""

    family: socket.AddressFamily
    place: str | tuple[str, int]
    text: str


def control_address(text: str) -> ControlAddress:
    """Parse `PATH` or `127.0.0.1:PORT`; a path that looks like an address must begin with `./`.

    Raises:
        ValueError: The text is neither, or others could reach the address.
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
            # Restrict the mode from creation on.
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
    """Remove the socket of a killed proxy; any other file stays, and binding fails."""
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
    """Connection with the received part of its next request."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.answered = 0
        self._waiting = bytearray()

    @property
    def has_request(self) -> bool:
        """True if a complete request, or an overlong line, is waiting."""
        return b"\n" in self._waiting or len(self._waiting) >= MAX_LINE_BYTES

    def is_served(self, controlled: Controlled) -> bool:
        """Answer some of the received requests; return False to close the connection."""
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
    """Return True if the system accepted the whole answer at once, as for a client that reads."""
    line = msgspec.json.encode(answer) + b"\n"
    try:
        return client.send(line) == len(line)
    except OSError:
        return False
