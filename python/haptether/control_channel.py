"""Control channel of a running process: one-line commands with one-line answers."""

import contextlib
import os
import socket
import sys
import time
from pathlib import Path
from typing import Final, Protocol

from haptether.printable import printable

MAX_LINE: Final = 4096
STDIN: Final = "-"
SEND_TIMEOUT_S: Final = 1.0
"""Timeout of an answer in s; a client that does not read must not block the process for longer."""


class Answering(Protocol):
    """Handler of control lines."""

    quit: bool
    """True if the process must end."""

    def answer(self, line: str, now_s: float) -> str:
        """Return the answer to a line at a process time in s."""


class ControlChannel:
    """Standard input, or connections to a socket of this machine; `readers` and `serve` fit a loop over `select`.

    Args:
        place: `-` for standard input and output, `127.0.0.1:PORT`, or the path of a Unix socket.
        line: Handler of the lines. The end of standard input means `quit`, because the parent process is gone.

    Raises:
        ValueError: The address has another form.
        OSError: The address cannot be used.
    """

    def __init__(self, place: str, line: Answering) -> None:
        self.address = place
        self._line = line
        self._path: Path | None = None
        self._waiting: dict[int, bytes] = {}
        self._clients: list[socket.socket] = []
        self._listening: socket.socket | None = None
        if place != STDIN:
            self._listening = self._listen(place)

    def readers(self) -> list[int]:
        """Descriptors to wait for."""
        if self._listening is None:
            return [] if sys.stdin.closed else [sys.stdin.fileno()]
        return [self._listening.fileno(), *(client.fileno() for client in self._clients)]

    def serve(self, descriptor: int) -> None:
        """Read lines from a descriptor and answer them."""
        if self._listening is None:
            self._serve_stdin()
        elif descriptor == self._listening.fileno():
            with contextlib.suppress(OSError):
                client, _ = self._listening.accept()
                client.settimeout(SEND_TIMEOUT_S)
                self._clients.append(client)
        else:
            for client in [client for client in self._clients if client.fileno() == descriptor]:
                self._serve_client(client)

    def close(self) -> None:
        """Close all sockets, and remove the file of a Unix socket."""
        for endpoint in (*self._clients, *((self._listening,) if self._listening else ())):
            endpoint.close()
        self._clients = []
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _serve_stdin(self) -> None:
        received = os.read(sys.stdin.fileno(), MAX_LINE)
        if not received:
            sys.stdin.close()
            self._line.quit = True
            return
        for answer in self._answers(-1, received):
            print(answer, flush=True)

    def _serve_client(self, client: socket.socket) -> None:
        key = client.fileno()
        try:
            received = client.recv(MAX_LINE)
            for answer in self._answers(key, received):
                client.sendall(f"{answer}\n".encode("utf-8", "backslashreplace"))
        except OSError:
            received = b""
        if not received:
            self._waiting.pop(key, None)
            self._clients.remove(client)
            client.close()

    def _answers(self, key: int, received: bytes) -> list[str]:
        *lines, rest = (self._waiting.get(key, b"") + received).split(b"\n")
        # Drop an overlong line.
        self._waiting[key] = rest if len(rest) <= MAX_LINE else b""
        # Standard output may be a terminal, which would execute escape sequences repeated by an answer.
        return [
            printable(self._line.answer(line.decode("utf-8", "replace").strip(), time.monotonic())) for line in lines
        ]

    def _listen(self, place: str) -> socket.socket:
        host, colon, port = place.rpartition(":")
        if colon and port.isdigit():
            if not host.startswith("127."):
                message = f"control = {place!r}: must be -, 127.0.0.1:PORT or the path of a socket"
                raise ValueError(message)
            listening = socket.create_server((host, int(port)))
            self.address = f"{host}:{listening.getsockname()[1]}"
        else:
            listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            # Restrict access to this user from creation on.
            before = os.umask(0o177)
            try:
                listening.bind(place)
            except OSError:
                listening.close()
                raise
            finally:
                os.umask(before)
            listening.listen()
            self._path = Path(place)
        listening.setblocking(False)
        return listening
