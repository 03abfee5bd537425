"""Client connections without their sockets: protocols, waiting bytes, and network faults."""

import math
import random
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from haptether.slave.ur_emulator.dashboard import BANNER, Dashboard
from haptether.slave.ur_emulator.gripper.port import MAX_REQUEST, SETTLED, answered, is_request
from haptether.slave.ur_emulator.rtde.session import RtdeSession
from haptether.slave.ur_emulator.script.port import ScriptBudget, ScriptReader, runtime_exception

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.controller import Controller
    from haptether.slave.ur_emulator.gripper.gripper import EmulatedGripper

MAX_LINE: Final = 4096
"""Longest line in bytes."""
MAX_MESSAGES: Final = 100
"""Robot messages that wait for a client; above this number the oldest are lost."""
READ_TIMEOUT_S: Final = 1.0
"""Time that a client may read nothing before its connection is closed."""

RTDE, DASHBOARD, SCRIPT, GRIPPER = "rtde", "dashboard", "script", "gripper"
PORTS: Final = {30004: RTDE, 29999: DASHBOARD, 30001: SCRIPT, 30002: SCRIPT, 30003: SCRIPT}
"""Ports fixed by the protocol: clients have no setting for them."""
GRIPPER_PORT: Final = 63352
"""Port of the URCap server; clients have a setting for it."""
KINDS: Final = frozenset({RTDE, DASHBOARD, SCRIPT, GRIPPER})


class Peer:
    """Protocol of one connection."""

    kind: str

    def greeting(self) -> bytes:
        """Return the bytes to send first: none if clients take them for the answer to their first request."""
        return b""

    def receive(self, received: bytes) -> tuple[bytes, bool]:
        """Return the answer to received bytes, and True if the connection stays open.

        Raises:
            ValueError: Bytes break the protocol.
        """
        raise NotImplementedError

    def more(self) -> bytes:
        """Return a further answer to received bytes, to be sent on its own; empty if there is none."""
        return b""

    def package(self, cycles: int) -> bytes | None:  # noqa: ARG002
        """Return the data package or message that is due after `cycles` control cycles, if any."""
        return None

    def close(self) -> None:
        """Free the resources of the connection."""


class RtdePeer(Peer):
    """RTDE client."""

    kind = RTDE

    def __init__(self, controller: "Controller", number: int) -> None:
        self._session = RtdeSession(
            number,
            controller.version.rate_hz,
            lambda: controller.reported_version,
            controller.inputs,
            controller.outputs,
            controller.output_types,
            lambda text: controller.write_log(f"RTDE client: {text}"),
        )

    def receive(self, received: bytes) -> tuple[bytes, bool]:
        """See `Peer`."""
        return self._session.receive(received), True

    def package(self, cycles: int) -> bytes | None:
        """See `Peer`."""
        return self._session.package(cycles)

    def close(self) -> None:
        """See `Peer`."""
        self._session.close()


class DashboardPeer(Peer):
    """Dashboard client."""

    kind = DASHBOARD

    def __init__(self, dashboard: Dashboard) -> None:
        self._dashboard = dashboard
        self._waiting = b""

    def greeting(self) -> bytes:
        """See `Peer`."""
        return f"{BANNER}\n".encode()

    def receive(self, received: bytes) -> tuple[bytes, bool]:
        """See `Peer`."""
        *lines, self._waiting = (self._waiting + received).split(b"\n")
        if len(self._waiting) > MAX_LINE:
            message = f"line of {len(self._waiting)} bytes: must be at most {MAX_LINE}"
            raise ValueError(message)
        answers = bytearray()
        for line in lines:
            answer, stays_open = self._dashboard.answer(line.decode("utf-8", "replace"))
            answers += f"{answer}\n".encode()
            if not stays_open:
                return bytes(answers), False
        return bytes(answers), True


class ScriptPeer(Peer):
    """Client of a script interface; it gets only the errors of its scripts."""

    kind = SCRIPT

    def __init__(self, controller: "Controller", held: ScriptBudget) -> None:
        self._controller = controller
        self._reader = ScriptReader(held, self._failed)
        self._messages: deque[bytes] = deque(maxlen=MAX_MESSAGES)

    def receive(self, received: bytes) -> tuple[bytes, bool]:
        """See `Peer`."""
        for submitted in self._reader.receive(received):
            self._controller.submit(submitted)
        return b"", True

    def package(self, cycles: int) -> bytes | None:  # noqa: ARG002
        """See `Peer`."""
        return self._messages.popleft() if self._messages else None

    def close(self) -> None:
        """See `Peer`."""
        self._reader.clear()

    def _failed(self, error: str) -> None:
        self._messages.append(runtime_exception(error, self._controller.timestamp))


class GripperPeer(Peer):
    """Client of the URCap server."""

    kind = GRIPPER

    def __init__(self, gripper: "EmulatedGripper") -> None:
        self._gripper = gripper
        self._waiting = b""
        self._waited = 0
        """Control cycles since the last received bytes."""

    def receive(self, received: bytes) -> tuple[bytes, bool]:
        """See `Peer`; returns one reply, `more` returns the next ones."""
        self._waiting += received
        self._waited = 0
        answer = self.more()
        if not answer and len(self._waiting) > MAX_REQUEST:
            message = f"request of {len(self._waiting)} bytes without an end: must be at most {MAX_REQUEST}"
            raise ValueError(message)
        return answer, True

    def more(self) -> bytes:
        """See `Peer`."""
        while b"\n" in self._waiting:
            line, _, self._waiting = self._waiting.partition(b"\n")
            # A line feed alone is the rest of an end of line.
            if (request := line.strip()) and not self._gripper.silent:
                return answered(self._gripper, request, bare=False)
        return b""

    def package(self, cycles: int) -> bytes | None:
        """See `Peer`: the reply to a request without an end of line."""
        if not self._waiting:
            return None
        self._waited += cycles
        if self._waited < SETTLED or not is_request(self._waiting):
            return None
        request, self._waiting = self._waiting, b""
        return None if self._gripper.silent else answered(self._gripper, request, bare=True)


class PeerFactory:
    """Creates the peer of each accepted connection."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._dashboard = Dashboard(controller)
        self._held = ScriptBudget()
        self._accepted = 0

    def peer(self, port: int) -> Peer:
        """Return the peer of a new connection to a port."""
        self._accepted += 1
        kind = GRIPPER if port == GRIPPER_PORT else PORTS[port]
        if kind == RTDE:
            return RtdePeer(self._controller, self._accepted)
        if kind == GRIPPER:
            assert self._controller.gripper is not None
            return GripperPeer(self._controller.gripper)
        return DashboardPeer(self._dashboard) if kind == DASHBOARD else ScriptPeer(self._controller, self._held)


class Outbox:
    """Bytes to send on one connection; data packages may be held back, and are skipped while others wait.

    Times are arguments, in s.
    """

    def __init__(self) -> None:
        self.ready = bytearray()
        self.skipped = 0
        """Data packages that were never sent."""
        self._held: deque[tuple[float, bytes]] = deque()
        self._stalled_at_s: float | None = None

    def answer(self, packed: bytes) -> None:
        """Add bytes that must be sent at once."""
        self.ready += packed

    def package(self, packed: bytes, due_s: float, now_s: float) -> None:
        """Add a data package that leaves at `due_s`; it is skipped if an older one still waits."""
        if due_s > now_s or self._held:
            self._held.append((due_s, packed))
        elif self.ready:
            self.skipped += 1
        else:
            self.ready += packed

    def release(self, now_s: float) -> None:
        """Release the packages that are due."""
        while self._held and self._held[0][0] <= now_s:
            self.ready += self._held.popleft()[1]

    def sent(self, count: int, now_s: float) -> None:
        """Remove the bytes that the socket has taken."""
        del self.ready[:count]
        if not self.ready or count:
            self._stalled_at_s = None if not self.ready else now_s
        elif self._stalled_at_s is None:
            self._stalled_at_s = now_s

    def is_stalled(self, now_s: float) -> bool:
        """Return True if the client has read nothing for too long."""
        return self._stalled_at_s is not None and now_s - self._stalled_at_s > READ_TIMEOUT_S


@dataclass(slots=True)
class Faults:
    """Network faults on command; the controller has those of the arm. Times are arguments, in s."""

    seed: int = 0
    refusing: bool = False
    """True to close new connections at once."""
    late_s: float = 0.0
    """Delay of data packages."""
    jitter_s: float = 0.0
    """Largest additional delay, uniform; packages keep their order."""
    dropping: set[str] = field(default_factory=set)
    """Kinds of connections to close."""
    _frozen_until_s: float = -math.inf
    _random: random.Random = field(init=False)
    _last_due_s: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def reset(self) -> None:
        """End all faults."""
        self.refusing = False
        self.late_s = self.jitter_s = 0.0
        self.thaw()

    def freeze(self, now_s: float, duration_s: float = math.inf) -> None:
        """Stop reading, sending and accepting for a time, as if the network were gone; the arm continues."""
        self._frozen_until_s = now_s + duration_s

    def thaw(self) -> None:
        """End `freeze`."""
        self._frozen_until_s = -math.inf

    def is_frozen(self, now_s: float) -> bool:
        """Return True if nothing is read, sent or accepted."""
        return now_s < self._frozen_until_s

    def due_s(self, connection: int, now_s: float) -> float:
        """Return the time at which a package of now may leave."""
        if self.late_s == 0.0 and self.jitter_s == 0.0:
            # Packages that are already late stay ahead: the outbox keeps the order.
            return now_s
        due = now_s + self.late_s + self.jitter_s * self._random.random()
        due = max(due, self._last_due_s.get(connection, due))
        self._last_due_s[connection] = due
        return due

    def take_dropping(self) -> set[str]:
        """Return the kinds of connections to close now."""
        kinds, self.dropping = self.dropping, set()
        return kinds
