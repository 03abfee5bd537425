"""Connections of clients: each takes bytes and gives bytes; none of them owns a socket."""

from collections import deque
from typing import TYPE_CHECKING, Final, Protocol

from haptether.slave.ur_emulator.dashboard import BANNER, Dashboard
from haptether.slave.ur_emulator.robot_messages import runtime_exception
from haptether.slave.ur_emulator.rtde.session import RtdeSession
from haptether.slave.ur_emulator.script.port import ScriptBudget, ScriptReader

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.controller import Controller

LONGEST_LINE: Final = 4096
MAX_MESSAGES: Final = 100
"""That wait for a client; of more only the newest."""

RTDE, DASHBOARD, SCRIPT = "rtde", "dashboard", "script"
PORTS: Final = {30004: RTDE, 29999: DASHBOARD, 30001: SCRIPT, 30002: SCRIPT, 30003: SCRIPT}
"""Fixed by the protocol: clients have no setting for them."""


class Peer(Protocol):
    """One connection."""

    kind: str

    def greeting(self) -> bytes:
        """What is sent first."""

    def receive(self, came: bytes) -> tuple[bytes, bool]:
        """The answer to what arrived, and whether the connection stays open.

        Raises:
            ValueError: It is not what this port speaks.
        """

    def package(self, cycles: int) -> bytes | None:
        """What is to be sent after so many control cycles."""

    def close(self) -> None:
        """It has ended."""


class RtdePeer:
    """A client of RTDE."""

    kind = RTDE

    def __init__(self, controller: "Controller", number: int) -> None:
        self._session = RtdeSession(
            number,
            controller.version.rate_hz,
            lambda: controller.reported_version,
            controller.inputs,
            controller.outputs,
            controller.output_types,
            lambda text: controller.tell(f"RTDE client: {text}"),
        )

    def greeting(self) -> bytes:
        """Nothing: clients take the first frame for the answer to their first request."""
        return b""

    def receive(self, came: bytes) -> tuple[bytes, bool]:
        """See `Peer`."""
        return self._session.receive(came), True

    def package(self, cycles: int) -> bytes | None:
        """See `Peer`."""
        return self._session.package(cycles)

    def close(self) -> None:
        """See `Peer`."""
        self._session.close()


class DashboardPeer:
    """A client of the dashboard server."""

    kind = DASHBOARD

    def __init__(self, dashboard: Dashboard) -> None:
        self._dashboard = dashboard
        self._waiting = b""

    def greeting(self) -> bytes:
        """See `Peer`."""
        return f"{BANNER}\n".encode()

    def receive(self, came: bytes) -> tuple[bytes, bool]:
        """See `Peer`."""
        *lines, self._waiting = (self._waiting + came).split(b"\n")
        if len(self._waiting) > LONGEST_LINE:
            message = f"line of {len(self._waiting)} bytes: must be at most {LONGEST_LINE}"
            raise ValueError(message)
        answers = bytearray()
        for line in lines:
            said, stays = self._dashboard.answer(line.decode("utf-8", "replace"))
            answers += f"{said}\n".encode()
            if not stays:
                return bytes(answers), False
        return bytes(answers), True

    def package(self, cycles: int) -> bytes | None:  # noqa: ARG002
        """See `Peer`."""
        return None

    def close(self) -> None:
        """See `Peer`."""


class ScriptPeer:
    """A client of one of the script interfaces; it is sent what stopped its scripts, and nothing else."""

    kind = SCRIPT

    def __init__(self, controller: "Controller", held: ScriptBudget) -> None:
        self._controller = controller
        self._reader = ScriptReader(held, self._failed)
        self._messages: deque[bytes] = deque(maxlen=MAX_MESSAGES)

    def greeting(self) -> bytes:
        """See `Peer`."""
        return b""

    def receive(self, came: bytes) -> tuple[bytes, bool]:
        """See `Peer`."""
        for submitted in self._reader.receive(came):
            self._controller.submit(submitted)
        return b"", True

    def package(self, cycles: int) -> bytes | None:  # noqa: ARG002
        """See `Peer`."""
        return self._messages.popleft() if self._messages else None

    def close(self) -> None:
        """See `Peer`."""
        self._reader.close()

    def _failed(self, error: str) -> None:
        self._messages.append(runtime_exception(error, self._controller.timestamp))


class Reception:
    """Makes a peer for each connection that is accepted."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._dashboard = Dashboard(controller)
        self._held = ScriptBudget()
        self._accepted = 0

    def peer(self, port: int) -> Peer:
        """The peer of a new connection to a port."""
        self._accepted += 1
        kind = PORTS[port]
        if kind == RTDE:
            return RtdePeer(self._controller, self._accepted)
        return DashboardPeer(self._dashboard) if kind == DASHBOARD else ScriptPeer(self._controller, self._held)
