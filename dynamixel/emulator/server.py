"""Process of an emulated bus: pseudo-terminal, TCP port and clock."""

import fcntl
import os
import select
import struct
import termios
import time
import tty
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.control_channel import ControlChannel
    from haptether.dynamixel.emulator.bus import Bus
    from haptether.dynamixel.emulator.tcp import StreamLine

RECEIVE: Final = 4096
WATCH_S: Final = 0.01
"""Largest interval in s between servo updates, for watchdogs and limits."""
BITS_PER_BYTE: Final = 10
"""Includes start and stop bit."""
TCGETS2: Final = 0x802C542A
"""Requests `struct termios2`, which holds rates as numbers. Source: Linux, asm-generic/ioctls.h."""
TERMIOS2: Final = struct.Struct("4I20B2I")


class Server:
    """Server of a bus behind a pseudo-terminal, like a USB adapter.

    Args:
        bus: Bus with the servos.
        link: Path of a symbolic link to the terminal, whose name changes on each plug; by default none.
        wire_time: True to delay answers by the wire time of instruction and answer at the client's rate, plus the
            return delays; False answers at once.
        latency_s: Latency timer of the adapter in s, added to each answer.
        any_rate: True to accept every client rate.
        tcp: Second access to the same bus.

    Raises:
        OSError: The terminal or the link cannot be created.
        ValueError: The latency is invalid.
    """

    def __init__(
        self,
        bus: "Bus",
        *,
        link: Path | None = None,
        wire_time: bool = False,
        latency_s: float = 0.0,
        any_rate: bool = False,
        tcp: "StreamLine | None" = None,
    ) -> None:
        if not 0.0 <= latency_s <= 1.0:
            message = f"latency_s = {latency_s:g}: must be 0 to 1 s"
            raise ValueError(message)
        self.bus = bus
        self.channel: ControlChannel | None = None
        """Additional input of its loop."""
        self.port: str | None = None
        """Path of the terminal; None while unplugged."""
        self._link = link
        self._wire_time = wire_time
        self._latency_s = latency_s
        self._any_rate = any_rate
        self._tcp = tcp
        self._descriptors: tuple[int, int] | None = None
        self._due: list[tuple[float, bytes, Callable[[bytes], int]]] = []
        """Pending answers: time, bytes, recipient."""
        self._free_s = 0.0
        """Time at which the line is free."""
        self._lost_bytes = 0
        self.plug()

    def plug(self) -> str:
        """Create a terminal if needed; return its path, or that of the link."""
        if self._descriptors is None:
            # Keep the other end open, because reading fails without a client.
            adapter, terminal = os.openpty()
            try:
                tty.setraw(terminal)
                os.set_blocking(adapter, False)
                self.port = os.ttyname(terminal)
                if self._link is not None:
                    _link(self._link, self.port)
            except OSError:
                os.close(adapter)
                os.close(terminal)
                raise
            self._descriptors = adapter, terminal
            if self._tcp is not None:
                self._tcp.is_plugged = True
        return str(self._link or self.port)

    def unplug(self) -> None:
        """Remove the terminal; a client then reads an error."""
        if self._descriptors is not None:
            if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.port:
                self._link.unlink()
            for descriptor in self._descriptors:
                os.close(descriptor)
            self._descriptors = self.port = None
            self._due = []
            if self._tcp is not None:
                self._tcp.is_plugged = False
                self._tcp.hang_up()

    def figures(self) -> dict[str, Any]:
        """Return the terminal data for `status`."""
        tcp = None if self._tcp is None else self._tcp.address
        return {"port": self.port, "baud": self._client_baud(), "tcp": tcp, "lost_bytes": self._lost_bytes}

    def run(self, stopped: "Callable[[], bool]") -> None:
        """Serve until `stopped` returns True."""
        while not stopped():
            self._wait()
            now_s = time.monotonic()
            self._send(now_s)
            self.bus.advance(now_s)

    def close(self) -> None:
        """Remove terminal, link and port."""
        self.unplug()
        if self._tcp is not None:
            self._tcp.close()

    def _wait(self) -> None:
        channel = self.channel.readers() if self.channel is not None else []
        terminal = [] if self._descriptors is None else [self._descriptors[0]]
        tcp = [] if self._tcp is None else self._tcp.readers()
        now_s = time.monotonic()
        until_s = min([now_s + WATCH_S, *(due for due, *_ in self._due)])
        readable, _, _ = select.select([*channel, *terminal, *tcp], [], [], max(0.0, until_s - now_s))
        for descriptor in readable:
            if self._tcp is not None and descriptor in tcp:
                received = self._tcp.read(descriptor)
                self._take(received, self._tcp.baud, self._tcp.write, understood=True)
            elif descriptor not in terminal:
                if self.channel is not None:
                    self.channel.serve(descriptor)
            elif self._descriptors is not None and descriptor == self._descriptors[0]:
                # A control line may have unplugged it meanwhile.
                self._read(descriptor)

    def _read(self, descriptor: int) -> None:
        try:
            received = os.read(descriptor, RECEIVE)
        except OSError:
            return
        self._take(received, self._client_baud(), self._write, understood=self._any_rate)

    def _take(self, received: bytes, baud: int | None, write: "Callable[[bytes], int]", *, understood: bool) -> None:
        """Pass client bytes to the servos, and queue their answers."""
        if not received:
            return
        now_s = time.monotonic()
        answers = self.bus.receive(received, now_s, None if understood else baud)
        end_s = now_s
        if self._wire_time and baud:
            end_s = max(now_s, self._free_s) + BITS_PER_BYTE * len(received) / baud
        for answer in answers:
            if self._wire_time and baud:
                end_s += answer.delay_s + BITS_PER_BYTE * len(answer.sent) / baud
            self._due.append((end_s + self._latency_s, answer.sent, write))
        self._free_s = end_s
        self._send(time.monotonic())

    def _send(self, now_s: float) -> None:
        while self._due and self._due[0][0] <= now_s:
            _, sent, write = self._due.pop(0)
            # As with an adapter, a client that does not read loses data.
            self._lost_bytes += len(sent) - write(sent)

    def _write(self, sent: bytes) -> int:
        if self._descriptors is None:
            return 0
        try:
            return os.write(self._descriptors[0], sent)
        except BlockingIOError:
            return 0

    def _client_baud(self) -> int | None:
        if self._descriptors is None:
            return None
        try:
            answer = fcntl.ioctl(self._descriptors[0], TCGETS2, bytes(TERMIOS2.size))
        except OSError:
            # Rate outside this interface: use the codes.
            codes = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[1:].isdecimal()}
            return codes.get(termios.tcgetattr(self._descriptors[0])[5])
        return int(TERMIOS2.unpack(answer)[-1])


def _link(path: Path, port: str) -> None:
    """Create the link, replacing a dangling one of a killed emulator.

    Raises:
        FileExistsError: The path is a link in use, such as that of another emulator, or another file.
    """
    if path.is_symlink():
        if path.exists():
            message = f"{path}: leads to {path.readlink()}, which is in use: name another, or remove it"
            raise FileExistsError(message)
        path.unlink()
    try:
        path.symlink_to(port)
    except FileExistsError:
        message = f"{path}: exists and is no symbolic link: name another, or remove it"
        raise FileExistsError(message) from None
