"""Where control lines come from: standard input, or connections to a socket of this machine."""

import contextlib
import os
import socket
import sys
import time
from pathlib import Path
from typing import Final

from haptether.printable import printable
from haptether.slave.ur_emulator.connections import LONGEST_LINE
from haptether.slave.ur_emulator.control import ControlLine

STDIN: Final = "-"
PATIENCE_S: Final = 1.0
"""How long an answer waits for somebody who does not read; they must not stop the arm for longer."""


class ControlChannel:
    """Lines in, answers out; `fileno` and `serve` are for a loop over `select`.

    Args:
        place: `-` for standard input and output, `127.0.0.1:PORT`, or the path of a Unix socket.
        line: Answers the lines. The end of standard input is `quit`: whoever started this process is gone.

    Raises:
        ValueError: Another place.
        OSError: A place that cannot be used.
    """

    def __init__(self, place: str, line: ControlLine) -> None:
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
        """Reads what has come on a descriptor and answers it."""
        if self._listening is None:
            self._serve_stdin()
        elif descriptor == self._listening.fileno():
            with contextlib.suppress(OSError):
                client, _ = self._listening.accept()
                client.settimeout(PATIENCE_S)
                self._clients.append(client)
        else:
            for client in [client for client in self._clients if client.fileno() == descriptor]:
                self._serve_client(client)

    def close(self) -> None:
        """Ends it, and removes the socket's file."""
        for endpoint in (*self._clients, *((self._listening,) if self._listening else ())):
            endpoint.close()
        self._clients = []
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _serve_stdin(self) -> None:
        came = os.read(sys.stdin.fileno(), LONGEST_LINE)
        if not came:
            sys.stdin.close()
            self._line.quit = True
            return
        for answer in self._answers(-1, came):
            print(answer, flush=True)

    def _serve_client(self, client: socket.socket) -> None:
        key = client.fileno()
        try:
            came = client.recv(LONGEST_LINE)
            for answer in self._answers(key, came):
                client.sendall(f"{answer}\n".encode("utf-8", "backslashreplace"))
        except OSError:
            came = b""
        if not came:
            self._waiting.pop(key, None)
            self._clients.remove(client)
            client.close()

    def _answers(self, key: int, came: bytes) -> list[str]:
        *lines, rest = (self._waiting.get(key, b"") + came).split(b"\n")
        # What has no end is no line.
        self._waiting[key] = rest if len(rest) <= LONGEST_LINE else b""
        # Standard output may be a terminal, which takes what a line repeats for commands.
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
            # From the first moment nobody else's.
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
