"""Process of an emulated controller: only this module has sockets and a clock."""

import select
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from haptether.slave.ur_emulator.connections import GRIPPER_PORT, PORTS, Outbox, Peer, PeerFactory

if TYPE_CHECKING:
    from haptether.control_channel import ControlChannel
    from haptether.slave.ur_emulator.connections import Faults
    from haptether.slave.ur_emulator.controller import Controller

MAX_CONNECTIONS: Final = 64
SEND_BUFFER: Final = 1 << 16
"""Bytes of a socket's buffer; limits the old data that a slow reader gets."""
SERVING_SHARE: Final = 0.4
"""Share of a control period for clients. SCHED_FIFO stops a process that never sleeps for 50 ms each second."""
RECEIVE: Final = 512
"""Bytes read at once from a connection: any answer to them takes less than a millisecond."""
MAX_OUTBOX: Final = 1 << 16
"""Bytes that may wait for a client; above this, nothing more is read from it."""
MAX_PACKAGE_AGE_S: Final = 0.02
"""Age of a state above which a newer one replaces it: a stall of the machine loses packages."""
MAX_CATCH_UP_S: Final = 0.5
"""Longest time made up for after a stall."""


class Connection:
    """Socket with its protocol and outbox."""

    def __init__(self, endpoint: socket.socket, peer: Peer, number: int) -> None:
        self.socket = endpoint
        self.peer = peer
        self.number = number
        self.outbox = Outbox()
        self.closing = False

    def fileno(self) -> int:
        """Return the file descriptor, for `select`."""
        return self.socket.fileno()


class Server:
    """Listens on the ports of a controller and of its gripper, and runs its control cycles at absolute times.

    `select.select` waits to the microsecond; epoll rounds up to a millisecond, half a control cycle.

    Args:
        controller: The controller.
        faults: Network faults.
        host: Address of this machine.
        gripper_port: Port of the URCap server if the controller has a gripper; 0 for any free port.

    Raises:
        OSError: A port cannot be used; the message names it.
    """

    def __init__(self, controller: "Controller", faults: "Faults", host: str, gripper_port: int = GRIPPER_PORT) -> None:
        self.controller = controller
        self.faults = faults
        self.host = host
        self.channel: ControlChannel | None = None
        """Another input of the loop."""
        self.lost_s = 0.0
        """Time that was not made up for."""
        self.late_cycles = 0
        """Control cycles that began more than a period late."""
        self.worst_late_s = 0.0
        self.busiest_s = 0.0
        """Longest control cycle, packages included."""
        self._peers = PeerFactory(controller)
        self._connections: list[Connection] = []
        self._accepted = 0
        self._skipped = 0
        self._served_s = 0.0
        """Time spent on clients in this control cycle."""
        self._first = 0
        """Count of rounds: each round serves another connection first, in case time is short."""
        self.gripper_port: int | None = None
        """Port of the URCap server; None without a gripper."""
        self._listening: dict[socket.socket, int] = {}
        """Protocol port of each listening socket."""
        try:
            for port in PORTS:
                self._listening[_listen(host, port)] = port
            if controller.gripper is not None:
                listening = _listen(host, gripper_port)
                self._listening[listening] = GRIPPER_PORT
                self.gripper_port = int(listening.getsockname()[1])
        except OSError:
            self.close()
            raise

    def figures(self) -> dict[str, Any]:
        """Timing and connections, for `status`."""
        return {
            "connections": [connection.peer.kind for connection in self._connections],
            "late_cycles": self.late_cycles,
            "worst_late_s": self.worst_late_s,
            "busiest_s": self.busiest_s,
            "lost_s": self.lost_s,
            "skipped_packages": self._skipped + sum(c.outbox.skipped for c in self._connections),
        }

    def reset_lateness(self) -> None:
        """Reset the figures of lateness."""
        self.lost_s = self.worst_late_s = self.busiest_s = 0.0
        self.late_cycles = 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until `stopped`."""
        period_s = self.controller.period_s
        due_s = time.monotonic() + period_s
        while not stopped():
            self._wait(due_s)
            now_s = time.monotonic()
            if now_s < due_s:
                continue
            due_s = self._cycles(due_s, now_s)

    def close(self) -> None:
        """Close all sockets."""
        for connection in self._connections.copy():
            self._drop(connection)
        for listening in self._listening:
            listening.close()
        self._listening = {}

    # ---------------------------------------------------------------------------------------------------- cycle

    def _cycles(self, due_s: float, now_s: float) -> float:
        """Run the control cycles that are due; return the time of the next one."""
        controller, period_s = self.controller, self.controller.period_s
        late_s = now_s - due_s
        self.worst_late_s = max(self.worst_late_s, late_s)
        self.late_cycles += late_s > period_s
        if late_s > MAX_CATCH_UP_S:
            # Whole periods keep the phase.
            lost = int((late_s - MAX_CATCH_UP_S) / period_s) * period_s
            self.lost_s += lost
            due_s += lost
        cycles = unsent = 0
        self._served_s = 0.0
        while due_s <= now_s:
            controller.cycle()
            cycles += 1
            unsent += 1
            due_s += period_s
            # Only the newest of several old states is sent.
            if now_s - due_s < MAX_PACKAGE_AGE_S:
                if not self.faults.is_frozen(now_s):
                    self._send_packages(unsent, now_s)
                unsent = 0
        self.busiest_s = max(self.busiest_s, (time.monotonic() - now_s) / cycles)
        return due_s

    def _send_packages(self, cycles: int, now_s: float) -> None:
        for kind in self.faults.take_dropping():
            for connection in [c for c in self._connections if c.peer.kind == kind]:
                self._drop(connection)
        for connection in self._connections.copy():
            outbox = connection.outbox
            package = connection.peer.package(cycles)
            if package is not None:
                outbox.package(package, self.faults.due_s(connection.number, now_s), now_s)
            outbox.release(now_s)
            if outbox.ready:
                self._flush(connection, now_s)
            if outbox.is_stalled(now_s):
                self.controller.write_log(f"{connection.peer.kind} client reads nothing: connection closed")
                self._drop(connection)

    # -------------------------------------------------------------------------------------------------- sockets

    def _wait(self, due_s: float) -> None:
        """Serve sockets until the next control cycle is due."""
        now_s = time.monotonic()
        if self._served_s > SERVING_SHARE * self.controller.period_s:
            time.sleep(max(0.0, due_s - now_s))
            return
        channel = self.channel.readers() if self.channel is not None else []
        frozen = self.faults.is_frozen(now_s)
        # A client that does not read its answers is not read either.
        served = [c for c in self._connections if len(c.outbox.ready) < MAX_OUTBOX]
        sockets: list[socket.socket | Connection] = [] if frozen else [*self._listening, *served]
        blocked = [] if frozen else [c for c in self._connections if c.outbox.ready]
        readable, writable, _ = select.select([*channel, *sockets], blocked, [], max(0.0, due_s - now_s))
        if not (readable or writable):
            return
        begun_s = time.monotonic()
        self._first += 1
        first = self._first % len(readable) if readable else 0
        for ready in (*readable[first:], *readable[:first]):
            now_s = time.monotonic()
            spent_s = self._served_s + now_s - begun_s
            if spent_s > SERVING_SHARE * self.controller.period_s and ready is not readable[first]:
                # The others wait for the next round.
                break
            if isinstance(ready, int):
                if self.channel is not None:
                    self.channel.serve(ready)
            elif isinstance(ready, Connection):
                self._read(ready, now_s)
            else:
                self._accept(ready)
        for connection in writable:
            self._flush(connection, time.monotonic())
        self._served_s += time.monotonic() - begun_s

    def _accept(self, listening: socket.socket) -> None:
        try:
            endpoint, _ = listening.accept()
        except OSError:
            # The client is already gone.
            return
        if self.faults.refusing or len(self._connections) >= MAX_CONNECTIONS:
            endpoint.close()
            return
        endpoint.setblocking(False)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._accepted += 1
        connection = Connection(endpoint, self._peers.peer(self._listening[listening]), self._accepted)
        self._connections.append(connection)
        connection.outbox.answer(connection.peer.greeting())
        self._flush(connection, time.monotonic())

    def _read(self, connection: Connection, now_s: float) -> None:
        if connection not in self._connections:
            return
        try:
            received = connection.socket.recv(RECEIVE)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self._drop(connection)
            return
        try:
            answer, stays_open = connection.peer.receive(received)
        except ValueError as error:
            self.controller.write_log(f"{connection.peer.kind} client: {error}")
            self._drop(connection)
            return
        connection.closing = not stays_open
        while True:
            connection.outbox.answer(answer)
            self._flush(connection, now_s)
            # Each reply has its own call: clients take the result of one call for one answer.
            if not (answer := connection.peer.more()):
                return

    def _flush(self, connection: Connection, now_s: float) -> None:
        if connection not in self._connections:
            return
        if connection.outbox.ready:
            try:
                count = connection.socket.send(connection.outbox.ready)
            except BlockingIOError:
                count = 0
            except OSError:
                self._drop(connection)
                return
            connection.outbox.sent(count, now_s)
        if connection.closing and not connection.outbox.ready:
            self._drop(connection)

    def _drop(self, connection: Connection) -> None:
        if connection in self._connections:
            self._connections.remove(connection)
            self._skipped += connection.outbox.skipped
            connection.peer.close()
            connection.socket.close()


def _listen(host: str, port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(16)
    except OSError as error:
        listening.close()
        message = f"{host}:{port}: {error.strerror or error}"
        raise OSError(message) from None
    listening.setblocking(False)
    return listening
