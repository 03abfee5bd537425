"""A server of an emulated gripper on a thread of this process, with misbehaviours."""

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

from haptether.slave import GripperSample, RobotiqGripper
from haptether.slave.ur_emulator import EmulatedGripper
from haptether.slave.ur_emulator.gripper.port import answered

Misbehaviour = Callable[[socket.socket, bytes], bytes | None]
"""Returns the bytes that replace the reply to a request; None if it sends them itself, or sends nothing."""
POLL_S = 0.02


class Served:
    """Serve a gripper until `close`.

    Args:
        of: The gripper, which moves by the clock of this process.
    """

    def __init__(self, of: EmulatedGripper) -> None:
        self.gripper = of
        self.requests: list[str] = []
        self.misbehaves: Misbehaviour | None = None
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        self._begun_s = time.monotonic()
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    @property
    def settings(self) -> list[str]:
        """Return the SET requests."""
        return [request for request in self.requests if request.startswith("SET")]

    def close(self) -> None:
        self._ended.set()
        with contextlib.suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for thread in self._threads:
            thread.join(5.0)

    def _accept(self) -> None:
        while not self._ended.is_set():
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(connection,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(POLL_S)
        waiting = b""
        with connection, contextlib.suppress(OSError):
            while not self._ended.is_set():
                try:
                    received = connection.recv(512)
                except TimeoutError:
                    continue
                if not received:
                    return
                *lines, waiting = (waiting + received).split(b"\n")
                for line in lines:
                    reply = self._reply(connection, line)
                    if reply is not None:
                        connection.sendall(reply)

    def _reply(self, connection: socket.socket, line: bytes) -> bytes | None:
        if self.misbehaves is not None:
            return self.misbehaves(connection, line)
        with self._lock:
            self.requests.append(line.decode())
            self.gripper.advance(time.monotonic() - self._begun_s)
            return answered(self.gripper, line, bare=False)


@contextlib.contextmanager
def served(of: EmulatedGripper) -> Iterator[Served]:
    server = Served(of)
    try:
        yield server
    finally:
        server.close()


# --------------------------------------------------------------------------------------------------- misbehaviours


def silent(_connection: socket.socket, _line: bytes) -> None:
    """Send nothing."""


def closing(connection: socket.socket, _line: bytes) -> None:
    """End the connection."""
    connection.shutdown(socket.SHUT_RDWR)
    raise ConnectionError


def resetting(connection: socket.socket, _line: bytes) -> None:
    """Reset the connection, like a crashed program."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()
    raise ConnectionError


def another_protocol(_connection: socket.socket, _line: bytes) -> bytes:
    return b"HTTP/1.1 400 Bad Request\r\n\r\n"


def bare(_connection: socket.socket, _line: bytes) -> bytes:
    """Reply with digits alone, as URScript expects."""
    return b"3"


def half(_connection: socket.socket, line: bytes) -> bytes:
    """Send only the first part of a reply."""
    return line.removeprefix(b"GET ") + b" " if line.startswith(b"GET") else b"ac"


def out_of_range(_connection: socket.socket, line: bytes) -> bytes:
    return line.removeprefix(b"GET ") + b" 999"


def of_another_request(_connection: socket.socket, _line: bytes) -> bytes:
    return b"NCY 3"


def endless(connection: socket.socket, _line: bytes) -> None:
    """Send bytes without end."""
    with contextlib.suppress(TimeoutError):
        while True:
            connection.sendall(b" " * 4096)


def dribbling(connection: socket.socket, _line: bytes) -> None:
    """Send empty lines and never a reply."""
    for _ in range(100):
        connection.sendall(b"\n")
        time.sleep(0.05)


def volunteering(connection: socket.socket, line: bytes) -> None:
    """Send a value that was not requested, shortly after the reply."""
    # The values of jaws that hold 40 mm.
    values = {b"POS": b"123", b"OBJ": b"2", b"STA": b"3"}
    variable = line.removeprefix(b"GET ")
    connection.sendall(variable + b" " + values.get(variable, b"0") if line.startswith(b"GET") else b"ack")
    time.sleep(0.01)
    connection.sendall(b"GRIPPER READY")


MISBEHAVIOURS: tuple[tuple[Misbehaviour, str], ...] = (
    (silent, "silence: no reply to "),
    (half, "silence: no reply to "),
    (dribbling, "silence: no reply to "),
    (closing, "connection lost: "),
    (resetting, "connection lost: "),
    (another_protocol, "malformed reply: "),
    (bare, "malformed reply: "),
    (out_of_range, "malformed reply: "),
    (of_another_request, "malformed reply: "),
    (endless, "malformed reply: "),
    (volunteering, "malformed reply: "),
)
"""Each misbehaviour with the fault that it must cause."""


def until(of: RobotiqGripper, holds: Callable[[GripperSample], bool]) -> GripperSample:
    """Return the first sample that meets a condition."""
    end_s = time.monotonic() + 10.0
    while not holds(sample := of.read()):
        assert time.monotonic() < end_s, sample
        time.sleep(0.005)
    return sample
