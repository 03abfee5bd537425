"""Reader of the telemetry that a live loop sends."""

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
"""Longest accepted line in bytes."""
LARGEST = 1e300
"""Upper bound of numbers in a sample."""


class TelemetrySignal(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a signal in the samples."""

    name: str
    kind: str
    """"axes", "number", "bits", "count", "name" or "flag"."""
    size: int
    """Number of axes; 1 for other kinds."""
    meaning: str
    """Meaning and unit."""


class TelemetryHello(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="hello"):
    """Description of the sender."""

    schema: int
    side: str
    """"master" or "slave"."""
    security: str
    """"insecure" if frames are not encrypted."""
    version: str = ""
    """Haptether version of the sender."""
    process: int = 0
    """Process number of the sender, for the signals that press the clutch and acknowledge."""
    scene: dict[str, Any] | None = None
    """Settings by table, with defaults and presets filled in; None above 256 KiB."""
    signals: list[TelemetrySignal]


class TelemetryLink(msgspec.Struct, frozen=True, kw_only=True):
    """Frame counts of the link since the run began; the counts may come from different ticks."""

    sent: int = 0
    fresh: int = 0
    """Frames newer than all before on arrival."""
    late: int = 0
    """Frames that arrived after a newer one, or too late to be read."""
    missing: int = 0
    """Frames of the peer that have not arrived, up to the newest one."""
    coupling: str = ""
    """Coupling in use, which an operator may switch; empty from a sender of an earlier version."""


class TelemetrySample(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="sample"):
    """Ticks of 1/60 s; None stands for a number that was not finite."""

    time_ns: int
    """Time of the last tick since the run began."""
    ticks: int
    dropped: int
    """Records that did not reach the sender's thread since the run began."""
    unsent_changes: int
    """Changes beyond 256 per sample since the run began."""
    link: TelemetryLink = TelemetryLink()
    signals: dict[str, Any]
    """`[min, max, last]` for a number, one such list per axis for "axes", `[any tick, last tick]` for "bits", the last
    value for other kinds.
    """


class TelemetryChange(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="change"):
    """Change of a name, a flag or a bit set between two ticks."""

    time_ns: int
    signal: str
    from_: str | int | bool = msgspec.field(name="from")
    to: str | int | bool


class TelemetryCause(Cause, frozen=True, kw_only=True, tag_field="kind", tag="cause"):
    """Cause of not being coupled, from `time_ns` on."""

    time_ns: int


class TelemetryCleared(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="cleared"):
    """End of the latest cause."""

    time_ns: int


class TelemetryLost(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="lost"):
    """Number of ticks lost because this reader was too slow."""

    ticks: int


class TelemetryInvalid(msgspec.Struct, frozen=True, kw_only=True):
    """Invalid telemetry that the reader skipped; no loop sends this."""

    text: str
    """Skipped part and reason."""


class TelemetryEnd(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="end"):
    """Normal end of the loop; absent if the loop failed or was killed, or this reader was too slow."""

    time_ns: int


class _Refused(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="refused"):
    """Reason why this reader is refused."""

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
"""Message of a side, or a line that is none."""
_CHANGED: dict[str, type] = {"bits": int, "name": str, "flag": bool}
"""Kinds of signals whose changes are sent, and the type of their values."""
_OWNERS = frozenset({0, os.geteuid()})
"""Users whose telemetry is accepted: this user and root."""


class TelemetryReader:
    """Iterator over the messages of a loop, line by line, until the loop or the connection ends.

    An invalid line or signal is skipped and reported by a `TelemetryInvalid`.

    Args:
        path: Socket of `--telemetry` or `telemetry=`.
        timeout_s: Timeout of each message in s; a loop sends 60 samples per second.

    Raises:
        OSError: No sender. `TimeoutError`: no complete message in time. `ConnectionError`: 16 readers are connected, or
            the run ended before it sent. `PermissionError`: the sender is another user.
        ValueError: The data is not telemetry, or has another version.
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
        """Return the signals of a sample or a change that contradict the hello; a missing one as None."""
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
        """Close the connection, also for a thread that waits for a message; the loop is not affected."""
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
        """Return the next line, or None at the end; an incomplete line is dropped."""
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
    """Return True for `[min, max, last]` of numbers, each None if it was not finite."""
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
"""Check of a value of each kind; of each item for kinds in `_LISTED`."""
_LISTED = {"axes": 0, "bits": 2}
"""Kinds whose values are lists, and their length; 0 for the size of the signal."""


def _check_owner(connected: socket.socket, path: str) -> None:
    """Refuse a socket of another user, who may have placed it where a side of this user is expected.

    Raises:
        PermissionError: Names the user who listens there.
    """
    _, owner, _ = struct.unpack("3i", connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    if owner not in _OWNERS:
        message = f"{path}: is the socket of user {owner}: must be yours or root's; name another path"
        raise PermissionError(message)
