"""Reading what a live loop sends of itself while it runs."""

import contextlib
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

import msgspec

from haptether.bridge.flight import Cause

SCHEMA = 1
MAX_LINE = 1 << 20
"""Bytes of the longest line that is read."""
LARGEST = 1e300
"""Numbers of a sample are below it."""


class TelemetrySignal(msgspec.Struct, frozen=True, kw_only=True):
    """A signal of the samples."""

    name: str
    kind: str
    """"axes", "number", "bits", "count", "name" or "flag"."""
    size: int
    """Number of axes; 1 of all else."""
    meaning: str
    """What it is, with its unit."""


class TelemetryHello(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="hello"):
    """Whose samples these are."""

    schema: int
    side: str
    """"master" or "slave"."""
    security: str
    """"insecure" if frames are in plain sight."""
    version: str = ""
    """Of the Haptether that sends."""
    process: int = 0
    """Number of its process, for the signals that press the clutch and acknowledge."""
    scene: dict[str, Any] | None = None
    """What was set, table by table, defaults and presets filled in; none where it is longer than 256 KiB."""
    signals: list[TelemetrySignal]


class TelemetryLink(msgspec.Struct, frozen=True, kw_only=True):
    """Frames of the link, since the run began; of one tick each, not all of the same."""

    sent: int = 0
    fresh: int = 0
    """That were newer than all before when they arrived."""
    late: int = 0
    """That arrived after a newer one, or so late that they were not looked at."""
    missing: int = 0
    """Of the peer's that have not arrived up to the newest one."""


class TelemetrySample(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="sample"):
    """The ticks of 1/60 s; what was no finite number is None."""

    time_ns: int
    """Of the last tick, since the run began."""
    ticks: int
    dropped: int
    """Records that did not reach the sender's thread, since the run began."""
    unsent_changes: int
    """Changes beyond 256 in one sample, since the run began."""
    link: TelemetryLink = TelemetryLink()
    signals: dict[str, Any]
    """`[min, max, last]` of a number, one such list for each axis of "axes", `[those of any tick, those of the last]`
    of "bits", the last one of all else."""


class TelemetryChange(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="change"):
    """A name, a flag or a set of bits that is another than at the tick before."""

    time_ns: int
    signal: str
    from_: str | int | bool = msgspec.field(name="from")
    to: str | int | bool


class TelemetryCause(Cause, frozen=True, kw_only=True, tag_field="kind", tag="cause"):
    """Why the two sides are not coupled, from `time_ns` on."""

    time_ns: int


class TelemetryCleared(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="cleared"):
    """The cause that was sent last is over."""

    time_ns: int


class TelemetryLost(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="lost"):
    """This reader was too slow for samples of so many ticks."""

    ticks: int


class TelemetryInvalid(msgspec.Struct, frozen=True, kw_only=True):
    """The reader has left out what is no valid telemetry; no loop sends this."""

    text: str
    """The part that was left out, and why."""


class TelemetryEnd(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="end"):
    """The loop has ended in good order; without it, it failed or was killed, or this reader was too slow."""

    time_ns: int


class _Refused(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="refused"):
    """Why this reader gets nothing."""

    text: str


_Message = (
    TelemetryHello
    | TelemetrySample
    | TelemetryChange
    | TelemetryCause
    | TelemetryCleared
    | TelemetryLost
    | TelemetryEnd
)
_Sent = _Message | _Refused
TelemetryMessage = _Message | TelemetryInvalid
_CHANGED: dict[str, type] = {"bits": int, "name": str, "flag": bool}
"""Kinds of signals whose changes are sent, and the type of their values."""
_OWNERS = frozenset({0, os.geteuid()})
"""Users whose telemetry is read: this one, and root."""


class TelemetryReader:
    """What a loop sends, line by line: iterates over messages until the loop or the connection ends.

    A line, or a signal of a sample, that is not valid is left out, and a `TelemetryInvalid` says so.

    Args:
        path: The socket of `--telemetry` or `telemetry=`.
        timeout_s: How long to wait for each message, in s; a loop sends 60 samples a second.

    Raises:
        OSError: Nobody sends there; as `TimeoutError`, no whole message came in time; as `ConnectionError`, 16 programs
            read already, or the run was over before it began to send; as `PermissionError`, another user sends there.
        ValueError: What is sent is no telemetry, or of another version.
    """

    def __init__(self, path: str | os.PathLike[str], *, timeout_s: float = 5.0) -> None:
        self._path = os.fspath(path)
        self._timeout_s = timeout_s
        self._decoder: msgspec.json.Decoder[_Sent] = msgspec.json.Decoder(_Sent)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._received = bytearray()
        try:
            self._socket.settimeout(timeout_s)
            self._socket.connect(self._path)
            _check_owner(self._socket, self._path)
            line = self._line()
            if line is None:
                message = f"{self._path}: closed before it said what it sends"
                raise ConnectionError(message)
            hello = self._decoded(line)
            if not isinstance(hello, TelemetryHello):
                message = f"{self._path}: sends no telemetry of Haptether"
                raise ValueError(message)
            if hello.schema != SCHEMA:
                message = f"{self._path}: schema = {hello.schema}, must be {SCHEMA}"
                raise ValueError(message)
        except BaseException:
            self._socket.close()
            raise
        self.hello = hello
        self._signals = {signal.name: signal for signal in hello.signals}

    def __iter__(self) -> Iterator[TelemetryMessage]:
        while (line := self._line()) is not None:
            try:
                message = self._decoded(line)
            except ValueError as error:
                yield TelemetryInvalid(text=str(error).removeprefix(f"{self._path}: "))
                continue
            invalid = self._invalid(message)
            if invalid:
                names = ", ".join(f"{name[:40]} = {str(value)[:40]}" for name, value in list(invalid.items())[:4])
                more = f" and {len(invalid) - 4} more signals" if len(invalid) > 4 else ""
                yield TelemetryInvalid(text=f"not as its first line describes it: {names}{more}")
                if not isinstance(message, TelemetrySample):
                    continue
                valid = {name: value for name, value in message.signals.items() if name not in invalid}
                message = msgspec.structs.replace(message, signals=valid)
            yield message

    def _invalid(self, message: TelemetryMessage) -> dict[str, Any]:
        """Signals of a sample or a change that are not as the hello describes them; a missing one as None."""
        match message:
            case TelemetrySample(signals=values):
                names = dict.fromkeys((*self._signals, *values))
                return {name: values.get(name) for name in names if not self._is_valid(name, values.get(name))}
            case TelemetryChange(signal=name, from_=before, to=now):
                signal = self._signals.get(name)
                kind = _CHANGED.get("" if signal is None else signal.kind)
                return {} if kind is not None and type(before) is type(now) is kind else {name: now}
            case _:
                return {}

    def _is_valid(self, name: str, value: object) -> bool:
        signal = self._signals.get(name)
        if signal is None or signal.kind not in _VALID:
            return False
        if signal.kind in _LISTED:
            size = _LISTED[signal.kind] or signal.size
            return isinstance(value, list) and len(value) == size and all(map(_VALID[signal.kind], value))
        return _VALID[signal.kind](value)

    def close(self) -> None:
        """Ends the connection, of a thread that waits for a message, too; the loop does not notice."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _line(self) -> bytes | None:
        """The next line; none at the end, where half a line counts for nothing."""
        begin = 0
        until_s = time.monotonic() + self._timeout_s
        while (end := self._received.find(b"\n", begin)) < 0:
            begin = len(self._received)
            if begin > MAX_LINE:
                message = f"{self._path}: a line of more than {MAX_LINE} bytes"
                raise ValueError(message)
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                message = f"{self._path}: no whole message within {self._timeout_s} s"
                raise TimeoutError(message)
            self._socket.settimeout(left_s)
            received = self._socket.recv(1 << 16)
            if not received:
                return None
            self._received += received
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        return line

    def _decoded(self, line: bytes) -> TelemetryMessage:
        try:
            message = self._decoder.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            text = f"{self._path}: no line of telemetry ({error})"
            raise ValueError(text) from None
        if isinstance(message, _Refused):
            text = f"{self._path}: {message.text}"
            raise ConnectionError(text)
        return message


def _is_range(value: object) -> bool:
    """True for `[min, max, last]` of numbers, each None where it was not finite."""
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(number is None or (type(number) in {float, int} and abs(number) < LARGEST) for number in value)
    )


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < 1 << 64


_VALID: dict[str, Callable[[object], bool]] = {
    "axes": _is_range,
    "number": _is_range,
    "bits": _is_count,
    "count": _is_count,
    "name": lambda value: isinstance(value, str),
    "flag": lambda value: isinstance(value, bool),
}
"""Check of a value of each kind; of each item for the kinds in `_LISTED`."""
_LISTED = {"axes": 0, "bits": 2}
"""Kinds whose values are lists, and their length; 0 for the size of the signal."""


def _check_owner(connected: socket.socket, path: str) -> None:
    """Refuses a socket of another user, who may have put it where a side of this user is expected.

    Raises:
        PermissionError: With the user who listens there.
    """
    _, owner, _ = struct.unpack("3i", connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    if owner not in _OWNERS:
        message = f"{path}: is the socket of user {owner}: must be yours or root's; name another path"
        raise PermissionError(message)
