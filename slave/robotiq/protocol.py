r"""Text protocol of the URCap's server: one request, one reply.

`SET POS 100 SPE 255 FOR 10 GTO 1\n` is answered by `ack`, `GET POS\n` by `POS 100`. Replies have no end of line, so a
number with fewer than the maximum digits could continue; only a pause marks its end. A request without an end of line
gets another kind of reply (bare digits, for URScript), so none is sent here.

Source: wuphilipp/gello_software and pyrobotiqur 0.2.2, clients of it; Robotiq, 2F-85 and 2F-140 instruction manual, for
the meaning of the values.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple

MAX_REPLY: Final = 64
"""Longest reply of this server in bytes."""
MAX_SHOWN: Final = 24
"""Longest part of a malformed reply in an error, in bytes."""
ACK: Final = b"ack"
MAX_VALUE: Final = {
    "ACT": 1, "GTO": 1, "ATR": 1, "FOR": 255, "SPE": 255, "POS": 255, "PRE": 255,
    "STA": 3, "OBJ": 3, "FLT": 15, "SID": 255,
}  # fmt: skip
"""Used variables with their largest values."""

RESET, ACTIVATING, ACTIVE = 0, 1, 3
"""Values of STA; 2 is unused."""
MOVING, CONTACT_OPENING, CONTACT_CLOSING, ARRIVED = range(4)
"""Values of OBJ; undefined without GTO, and outdated until PRE echoes the request."""
CONTACT: Final = frozenset({CONTACT_OPENING, CONTACT_CLOSING})
REACTIVATION: Final = frozenset({5, 7, *range(10, 16)})
"""FLT values that only an activation clears."""

CLEAR: Final = "clear the jaws of hands and parts, then open the driver with activate = true"
FAULTS: Final = {
    5: ("it must be activated before it moves", CLEAR),
    7: ("the activation bit is not set", CLEAR),
    8: ("it is too hot", "let it cool down, with less force or fewer cycles"),
    9: ("the URCap has not reached it for a second", "see its cable, and that nothing else uses the tool's RS-485"),
    10: ("its voltage is too low", f"see its supply and cable; {CLEAR}"),
    11: ("its automatic release runs", "wait until the jaws are open"),
    12: ("an internal fault", f"power it off and on; {CLEAR}"),
    13: ("its activation failed", f"see that nothing is between the jaws; {CLEAR}"),
    14: ("its motor drew too much current", f"see what blocks the jaws; {CLEAR}"),
    15: ("its automatic release has ended", CLEAR),
}
"""Meaning and remedy of each FLT value."""


class MalformedReplyError(ValueError):
    """Bytes that are not a reply to the request."""


class Request(NamedTuple):
    """One line to the server."""

    text: bytes
    reads: str | None = None
    """Variable whose value is the reply; None if the reply is `ack`."""

    @property
    def shown(self) -> str:
        """Return the request without its end of line."""
        return self.text.decode().strip()


def get(variable: str) -> Request:
    """Return a request for a value."""
    return Request(f"GET {variable}\n".encode(), variable)


def set_(values: Mapping[str, int]) -> Request:
    """Return a request that sets variables at once."""
    pairs = " ".join(f"{variable} {value}" for variable, value in values.items())
    return Request(f"SET {pairs}\n".encode())


class Progress(Enum):
    """Completeness of a reply."""

    PARTIAL = "more must follow"
    OPEN = "more may follow"
    WHOLE = "nothing may follow"


def parsed(received: bytes, reads: str | None) -> tuple[Progress, int | None]:
    """Parse the bytes since a request; return their completeness and current value.

    Args:
        received: All received bytes; a leading end of line belongs to the previous reply.
        reads: See `Request`.

    Raises:
        MalformedReplyError: The bytes cannot become a valid reply.
    """
    text = received.lstrip()
    if len(received) > MAX_REPLY:
        raise _malformed(received, reads, f"more than {MAX_REPLY} bytes")
    if reads is None:
        if text.rstrip() == ACK:
            return Progress.WHOLE, None
        if ACK.startswith(text):
            return Progress.PARTIAL, None
        raise _malformed(received, reads, "must be 'ack'")
    head = f"{reads} ".encode()
    if head.startswith(text):
        return Progress.PARTIAL, None
    digits = text.removeprefix(head)
    number = digits.rstrip()
    largest = MAX_VALUE[reads]
    width = len(str(largest))
    if not text.startswith(head) or not number.isdigit() or len(number) > width or int(number) > largest:
        raise _malformed(received, reads, f"must be '{reads} N', N of 0 to {largest}")
    ended = len(number) == width or len(digits) > len(number)
    return (Progress.WHOLE if ended else Progress.OPEN), int(number)


def fault_text(flt: int) -> str:
    """Return the name and remedy of an FLT value."""
    what, remedy = FAULTS.get(flt, ("a fault that the manual does not name", "see the gripper's own software"))
    return f"FLT {flt}: {what}: {remedy}"


def _malformed(received: bytes, reads: str | None, why: str) -> MalformedReplyError:
    shown = f"{received[:MAX_SHOWN]!r}{'...' if len(received) > MAX_SHOWN else ''}"
    return MalformedReplyError(f"reply to {'SET' if reads is None else f'GET {reads}'}: {shown}: {why}")
