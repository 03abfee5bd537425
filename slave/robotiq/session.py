"""State machine of a gripper's requests and replies; time is an argument."""

from collections import deque
from collections.abc import Mapping
from typing import Final, NamedTuple

from haptether.slave.gripper import GripperCommand, GripperSample
from haptether.slave.robotiq.models import Scale
from haptether.slave.robotiq.protocol import (
    ACTIVE,
    CLEAR,
    CONTACT,
    CONTACT_CLOSING,
    CONTACT_OPENING,
    MOVING,
    Request,
    fault_text,
    get,
    set_,
)

NS: Final = 1_000_000_000
BUSY: Final = 3.0
"""Smallest interval of position requests and commands in round trips: the server has other clients, commands must pass
at once, and a stream of them must not hide a fault.
"""
AVERAGED: Final = 8
"""Averaging length of the round trip."""
TURNS: Final = {"POS": 1, "OBJ": 2, "FLT": 5, "STA": 10}
"""Interval of each variable's reads in position periods."""
RESENT_NS: Final = 300_000_000
"""Time in ns after which a request without echo is sent again; a request right after GTO may be dropped."""
ECHOED_NS: Final = 1_000_000_000
MAX_ECHOES: Final = 256
GIVES: Final = 2
"""Motion in counts that is allowed for jaws on an object."""
HELD_GIVES: Final = 10
"""Same while they must hold; 4 mm on a 2F-85, beyond it they are stopped."""
STALL_NS: Final = 200_000_000
"""Standing time in ns of commanded jaws that indicates an object; the slowest move 10 counts meanwhile."""
VELOCITY_NS: Final = 100_000_000
"""Velocity window in ns; one count per 20 ms is 0.2 /s."""
START: Final = ("STA", "FLT", "POS", "PRE", "OBJ", "GTO", "FOR")
"""Variables read at the start of a session."""


class Order(NamedTuple):
    """Latest order for the gripper."""

    number: int
    """Unique number of the order."""
    move: GripperCommand | None
    """Command, or None to hold."""


class Session:
    """Connection to an active gripper.

    Args:
        scale: Scale of the gripper.
        rate_hz: Largest rate of position reads.
        values: Read values of `START`.
        order: Last order that must not be executed any more.
        now_ns: Time in ns.
    """

    def __init__(
        self, scale: Scale, rate_hz: float, values: Mapping[str, int], order: Order | None, now_ns: int
    ) -> None:
        self.fault: str | None = None
        """Latched fault."""
        self._scale = scale
        self._least_ns = round(NS / rate_hz)
        self._round_trip_ns = 0.0
        self._position = values["POS"]
        self._going = values["GTO"] == 1
        self._contact = values["OBJ"] if self._going and values["OBJ"] in CONTACT else None
        """Contact value of OBJ if there is an object, otherwise None."""
        self._contact_at: int | None = self._position
        """Position at the first read after OBJ showed contact; None before it."""
        self._moves = self._going and values["OBJ"] == MOVING
        self._holding = False
        self._sent_on: int | None = None
        """Contact that a standstill now would indicate, by the commanded direction, or None."""
        self._stands_at, self._stands_ns = self._position, now_ns
        """Start of the current standstill under a command in one direction."""
        self._force_n = scale.force_n(values["FOR"])
        self._done = -1 if order is None else order.number
        self._sent: dict[str, int] | None = None
        """Latest request; None before the first of this session."""
        self._sent_ns = now_ns
        self._echoes: deque[tuple[int, int]] = deque(maxlen=MAX_ECHOES)
        """Requested positions without echo in PRE, with sending times, newest last."""
        self._unread = False
        """True if OBJ has not been read since PRE echoed the latest request."""
        self._read_ns = dict.fromkeys((*TURNS, "PRE"), now_ns - NS)
        self._positions = deque([(now_ns, self._position)], maxlen=64)

    # ------------------------------------------------------------------------------------------------- requests

    def due(self, order: Order | None, now_ns: int) -> Request | None:
        """Return the due request, or None; its reply must be reported before the next one."""
        request = self._setting(order, now_ns)
        if request is not None:
            return request
        wanted_ns, variable = min((self._due_ns(variable), variable) for variable in self._read)
        if wanted_ns > now_ns:
            return None
        self._read_ns[variable] = now_ns
        return get(variable)

    def wait_ns(self, order: Order | None, now_ns: int) -> int:
        """Return the time in ns until a request is due, without a newer order."""
        due_ns = min(map(self._due_ns, self._read))
        if order is not None and order.number != self._done:
            due_ns = min(due_ns, self._sent_ns + self._period_ns)
        return max(0, due_ns - now_ns)

    @property
    def round_trip_s(self) -> float:
        """Average time in s from a request to its reply."""
        return self._round_trip_ns / NS

    @property
    def _period_ns(self) -> int:
        return max(self._least_ns, round(BUSY * self._round_trip_ns))

    @property
    def _read(self) -> tuple[str, ...]:
        return (*TURNS, "PRE") if self._echoes else tuple(TURNS)

    def _due_ns(self, variable: str) -> int:
        often = variable == "PRE" or (variable == "OBJ" and (self._unread or self._moves))
        return self._read_ns[variable] + (1 if often else TURNS[variable]) * self._period_ns

    def _setting(self, order: Order | None, now_ns: int) -> Request | None:
        if order is not None and (order.move is None or self.fault is not None):
            # Do not execute after a fault an order that precedes it.
            self._done = order.number
            self._holding = True
        if self.fault is not None:
            return self._stop()
        if order is not None and order.move is not None and order.number != self._done:
            if now_ns - self._sent_ns < self._period_ns:
                return None
            self._done = order.number
            wanted = self._scale.request(order.move)
            self._holding = False
            return None if self._going and wanted == self._sent else self._go(wanted, now_ns)
        if self._holding:
            # Repeatedly, because the object may disappear later.
            return self._stop()
        if self._echoes and self._sent is not None and now_ns - self._sent_ns >= RESENT_NS:
            self._sent_ns = now_ns
            return set_({**self._sent, "GTO": 1})
        return None

    def _go(self, wanted: dict[str, int], now_ns: int) -> Request:
        before = self._sent if self._going else None
        self._sent, self._sent_ns, self._going = wanted, now_ns, True
        self._force_n = self._scale.force_n(wanted["FOR"])
        if before is not None and before["POS"] == wanted["POS"]:
            # A repeated position would be taken for the start of a motion.
            return set_({variable: value for variable, value in wanted.items() if value != before[variable]})
        self._echoes.append((now_ns, wanted["POS"]))
        self._unread = True
        return set_({**wanted, "GTO": 1})

    def _stop(self) -> Request | None:
        """Return GTO 0 unless the jaws rest; pressing jaws keep their force."""
        if not self._may_move:
            return None
        self._going = self._unread = self._moves = False
        self._contact = None
        self._echoes.clear()
        return set_({"GTO": 0})

    @property
    def _may_move(self) -> bool:
        if not self._going or (self._contact is not None and self._presses(self._contact)):
            return False
        # The reaction to a request without echo is unknown.
        return self._unread or self._moves

    def _presses(self, contact: int) -> bool:
        """Return True if the latest request presses against the contact."""
        requested = self._position if self._sent is None else self._sent["POS"]
        return requested >= self._position if contact == CONTACT_CLOSING else requested <= self._position

    # -------------------------------------------------------------------------------------------------- replies

    def replied(self, request: Request, value: int | None, sent_ns: int, now_ns: int) -> None:
        """Take the reply to a request that was sent at a time in ns."""
        self._round_trip_ns += (now_ns - sent_ns - self._round_trip_ns) / AVERAGED
        if request.reads is None or value is None:
            return
        match request.reads:
            case "POS":
                self._look_at_position(value, now_ns)
            case "PRE":
                self._look_at_echo(value, now_ns)
            case "OBJ":
                self._look_at_jaws(value)
            case "FLT" if value != 0:
                self.latch(fault_text(value))
            case "STA" if value != ACTIVE:
                self.latch(f"not active: STA {value}: it lost power, or another program has reset it: {CLEAR}")
            case _:
                pass

    def latch(self, fault: str) -> None:
        """Latch a fault; the first one stays until `acknowledge`."""
        self.fault = self.fault or fault

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault; a persistent one reappears with the next readings."""
        self.fault = None
        self._echoes.clear()

    def _look_at_position(self, value: int, now_ns: int) -> None:
        self._position = value
        self._positions.append((now_ns, value))
        gives = HELD_GIVES if self._holding else GIVES
        if self._contact is not None and self._contact_at is None:
            # A position before OBJ may belong to moving jaws.
            self._contact_at = value
        if self._contact is not None and (
            (self._contact_at is not None and abs(value - self._contact_at) > gives) or not self._presses(self._contact)
        ):
            self._contact = None
        opened, closed = self._scale.counts
        aim = value if self._sent is None or not self._going else min(max(self._sent["POS"], opened), closed)
        sent_on = None if abs(aim - value) <= GIVES else (CONTACT_CLOSING if aim > value else CONTACT_OPENING)
        if sent_on != self._sent_on or abs(value - self._stands_at) > 1:
            self._sent_on, self._stands_at, self._stands_ns = sent_on, value, now_ns
        elif sent_on is not None and self._unread and now_ns - self._stands_ns >= STALL_NS:
            # Each request of a stream resets OBJ to 0, so a standstill indicates contact.
            self._contact, self._contact_at = sent_on, value

    def _look_at_jaws(self, value: int) -> None:
        if not self._going:
            return
        if value == MOVING:
            # Also for pressing jaws, until the new request shows the same contact; their position decides.
            self._moves = True
        elif value in CONTACT and (not self._echoes or self._presses(value)):
            if value != self._contact:
                self._contact, self._contact_at = value, None
            elif self._contact_at is not None:
                self._contact_at = self._position
        elif not self._echoes:
            self._contact = None
        if not self._echoes:
            self._unread = False
            self._moves = value == MOVING

    def _look_at_echo(self, value: int, now_ns: int) -> None:
        shown = next((n for n, (_, position) in reversed([*enumerate(self._echoes)]) if position == value), -1)
        for _ in range(shown + 1):
            self._echoes.popleft()
        if self._echoes and now_ns - self._echoes[0][0] > ECHOED_NS:
            self.latch(
                f"request not taken: PRE {value} for {ECHOED_NS / NS:g} s after POS {self._echoes[0][1]}:"
                " does another program command it, or a camera share its USB?"
            )

    # --------------------------------------------------------------------------------------------------- sample

    def sample(self, now_ns: int) -> GripperSample:
        """Return the known state of the gripper."""
        while len(self._positions) > 2 and now_ns - self._positions[1][0] >= VELOCITY_NS:
            self._positions.popleft()
        (first_ns, first), (last_ns, last) = self._positions[0], self._positions[-1]
        holds = self._contact is not None
        per_s = (last - first) * NS / (last_ns - first_ns) if last_ns > first_ns else 0.0
        return GripperSample(
            position=self._scale.position(self._position),
            velocity=self._scale.velocity(per_s),
            force_n=self._force_n if holds else 0.0,
            holds_object=holds,
            fault=self.fault,
        )
