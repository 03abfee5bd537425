"""Services of a UR controller without the vendor's library: RTDE queries and the dashboard server.

The constructors of ur_rtde wait for replies without a timeout and hold the Python interpreter. A controller that
accepts connections and stays silent would block all threads for ever. Therefore this module checks with timeouts
whether it answers, and reads its state. The vendor's dashboard client lacks `unlock protective stop` in Python, and its
`isProgramSaved` is always false.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2; "Dashboard Server e-Series".
"""

import contextlib
import ipaddress
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from haptether.slave.ur.state import Numbers, RuntimeState
from haptether.slave.ur.worker import TimedWorker

RTDE_PORT: Final = 30004
DASHBOARD_PORT: Final = 29999
SCRIPT_PORT: Final = 30003
"""Port of the Real-Time Client interface, to which ur_rtde sends its control script."""
RESOLVE_S: Final = 3.0
CONNECT_S: Final = 2.0
"""Timeout of a connection to dashboard server or script port, same as ur_rtde's for its dashboard server."""
REPLY_S: Final = 2.5
"""Timeout of each line of the dashboard server, same as ur_rtde."""
REQUEST_VERSION, CONTROLLER_VERSION, PACKAGE, OUTPUTS, INPUTS, START = b"VvUOIS"
FRAME: Final = struct.Struct(">HB")
NAMES: Final = (
    "timestamp",
    "robot_mode",
    "safety_mode",
    "safety_status_bits",
    "runtime_state",
    "actual_q",
    "actual_TCP_pose",
    "target_speed_fraction",
)
COMMAND: Final = "input_int_register_0"
"""Register from which the control script takes its commands."""
READY: Final = 1
"""Answer of the control script while the command is 0."""
STOP_SCRIPT: Final = 255
"""Command that ends the control script."""
SCRIPT_NAMES: Final = ("runtime_state", "output_int_register_0")
SETTLED: Final = 10
"""Packages after a command that may precede its effect."""
SCRIPT_END_S: Final = 2.0
"""Timeout for ending a control script over RTDE."""
PROGRAM_END_S: Final = SCRIPT_END_S + CONNECT_S + 2.0 * REPLY_S + SCRIPT_END_S
"""Timeout of `end_program`: RTDE, the dashboard server with greeting and one answer, RTDE again; normally 30 ms."""
ANSWERED_S: Final = 0.4
"""Timeout of the control script's answer, and of its end; longer than the longest watchdog period."""
RELEASED_S: Final = 0.5
"""Timeout for the register of a client that was just killed."""
POLL_S: Final = 0.02
FORMATS: Final = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR6D": "6d"}
PACKAGES: Final = 5
"""Number of packages awaited to check that time advances."""
UNLOCKED: Final = "Protective stop releasing"
STOPPED: Final = "Stopped"
STILL_PLAYS: Final = "a program still plays: stop it on the pendant"


class ProbeError(RuntimeError):
    """No controller, or no answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """State that a controller reports."""

    version: tuple[int, int, int, int]
    """Major, minor, bugfix, build."""
    robot_mode: int
    safety_mode: int
    safety_bits: int
    runtime_state: int
    q: Numbers
    """Joint angles in rad."""
    pose: Numbers
    """Tool pose, x y z rx ry rz in m and rad."""
    rate_hz: float
    """Package rate by the controller's clock."""
    speed_fraction: float
    """Position of the speed slider, 0 to 1."""

    @property
    def version_text(self) -> str:
        """Version in the usual form."""
        return ".".join(map(str, self.version[:3]))


def resolved(host: str, limit_s: float = RESOLVE_S) -> str:
    """Resolve a host to IPv4 once, because a name server may be slow when the arm must be stopped.

    Raises:
        ProbeError: There is no address, or none within the timeout in s.
    """
    try:
        return str(ipaddress.IPv4Address(host))
    except ValueError:
        pass
    resolver = TimedWorker("ur-resolver")
    try:
        found = resolver.run(
            "look-up", lambda: socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM), limit_s
        )
    except Exception as error:  # errors of the system's resolver, or a timeout
        message = f"{host}: {getattr(error, 'strerror', None) or error}"
        raise ProbeError(message) from None
    finally:
        resolver.end()
    return str(found[0][4][0])


def probe(host: str, limit_s: float = 5.0) -> Probe:
    """Query the controller at `host` within a time in s.

    Raises:
        ProbeError: There is no controller, or its answers are invalid.
    """
    wire = _Wire(host, time.monotonic() + limit_s)
    with _answering(wire):
        return _query(wire)


def end_control_script(host: str, limit_s: float = SCRIPT_END_S) -> bool:
    """End a ur_rtde control script without a client; return True if no program plays afterwards.

    The command stays in its register, so a script that starts later ends in its first control cycle. ur_rtde clears the
    register before it uploads a script. Any other program continues, with the register at 0.

    Raises:
        ProbeError: There is no controller or no answer, or another client controls the script.
    """
    wire = _Wire(host, time.monotonic() + limit_s)
    with _answering(wire):
        return _end_control_script(wire)


def check_script_port(host: str) -> None:
    """Check that the controller accepts a connection for scripts.

    Raises:
        ProbeError: The connection is refused.
    """
    try:
        socket.create_connection((host, SCRIPT_PORT), timeout=CONNECT_S).close()
    except OSError as error:
        message = f"{host}:{SCRIPT_PORT}: {error.strerror or error}"
        raise ProbeError(message) from None


@contextlib.contextmanager
def _answering(wire: "_Wire") -> Iterator[None]:
    """Convert errors of network or controller to `ProbeError`, and close the connection."""
    try:
        yield
    except (OSError, struct.error) as error:
        seen = getattr(error, "strerror", None) or str(error)
        message = f"{wire.host}:{RTDE_PORT}: {wire.doing}: {seen}"
        raise ProbeError(message) from None
    finally:
        wire.close()


class _Wire:
    def __init__(self, host: str, end_s: float) -> None:
        self.host = host
        self.doing = "connect"
        self._end_s = end_s
        self._socket: socket.socket | None = None
        self._received = b""

    def open(self) -> None:
        self._socket = socket.create_connection((self.host, RTDE_PORT), timeout=self._left_s())
        if self.request("protocol version 2", REQUEST_VERSION, struct.pack(">H", 2)) != b"\x01":
            raise OSError("is refused")

    def version(self) -> tuple[int, int, int, int]:
        """Return the controller version: major, minor, bugfix, build."""
        major, minor, bugfix, build = struct.unpack(">4I", self.request("version", CONTROLLER_VERSION))
        return major, minor, bugfix, build

    def start(self, names: tuple[str, ...], rate_hz: float) -> struct.Struct:
        """Start packages with these outputs; return their layout, recipe id first."""
        answer = self.request("outputs", OUTPUTS, struct.pack(">d", rate_hz) + ",".join(names).encode())
        kinds = answer[1:].decode("ascii", "replace").split(",")
        if len(kinds) != len(names) or not all(kind in FORMATS for kind in kinds):
            raise OSError(f"{dict(zip(names, kinds, strict=False))}")
        if self.request("start", START) != b"\x01":
            raise OSError("is refused")
        self.doing = "packages"
        return struct.Struct(">B" + "".join(FORMATS[kind] for kind in kinds))

    def request(self, doing: str, kind: int, payload: bytes = b"") -> bytes:
        self.doing = doing
        self.send(kind, payload)
        return self.reply(kind)

    def send(self, kind: int, payload: bytes) -> None:
        assert self._socket is not None
        self._socket.sendall(FRAME.pack(FRAME.size + len(payload), kind) + payload)

    def reply(self, kind: int) -> bytes:
        while True:
            size, got = FRAME.unpack(self._bytes(FRAME.size))
            if size < FRAME.size:
                raise OSError(f"a frame of {size} bytes: no RTDE")
            payload = self._bytes(size - FRAME.size)
            # Packages and messages may precede the reply.
            if got == kind:
                return payload

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _bytes(self, count: int) -> bytes:
        assert self._socket is not None
        while len(self._received) < count:
            self._socket.settimeout(self._left_s())
            part = self._socket.recv(4096)
            if not part:
                raise OSError("the connection was closed")
            self._received += part
        taken, self._received = self._received[:count], self._received[count:]
        return taken

    def _left_s(self) -> float:
        left = self._end_s - time.monotonic()
        if left <= 0.0:
            raise OSError("no answer in time")
        return left


def _query(wire: _Wire) -> Probe:
    wire.open()
    version = wire.version()
    layout = wire.start(NAMES, _rate_hz(version))
    times: list[float] = []
    values: tuple[float, ...] = ()
    while len(times) < PACKAGES:
        _, *values = layout.unpack(wire.reply(PACKAGE))  # type: ignore[assignment]  # numbers all
        times.append(values[0])
    elapsed_s = times[-1] - times[0]
    if elapsed_s <= 0.0:
        raise OSError("its time stands still")
    return Probe(
        version=version,
        robot_mode=int(values[1]),
        safety_mode=int(values[2]),
        safety_bits=int(values[3]),
        runtime_state=int(values[4]),
        q=tuple(values[5:11]),
        pose=tuple(values[11:17]),
        rate_hz=(PACKAGES - 1) / elapsed_s,
        speed_fraction=values[17],
    )


def _end_control_script(wire: _Wire) -> bool:
    wire.open()
    rate_hz = _rate_hz(wire.version())
    end_s = time.monotonic() + RELEASED_S
    while (answer := wire.request("command register", INPUTS, COMMAND.encode()))[1:] == b"IN_USE":
        if time.monotonic() > end_s:
            raise OSError("another client leads the program that plays: end that client")
        time.sleep(POLL_S)
    if answer[1:] != b"INT32":
        raise OSError(answer[1:].decode("ascii", "replace"))
    layout = wire.start(SCRIPT_NAMES, rate_hz)

    def command(number: int, *, ready: bool) -> bool:
        """Write a command; return True if no program plays or, with `ready`, the control script has answered."""
        wire.send(PACKAGE, struct.pack(">Bi", answer[0], number))
        end_s, count = time.monotonic() + ANSWERED_S, 0
        while time.monotonic() < end_s:
            _, runtime_state, said = layout.unpack(wire.reply(PACKAGE))
            count += 1
            if count >= SETTLED and (runtime_state != RuntimeState.PLAYING or (ready and said == READY)):
                return True
        return False

    # A script within a command takes the next one only after 0.
    if not command(0, ready=True):
        return False
    ended = command(STOP_SCRIPT, ready=False)
    if not ended:
        command(0, ready=True)
    return ended


def _rate_hz(version: tuple[int, int, int, int]) -> float:
    return 125.0 if version[0] <= 3 else 500.0


class DashboardError(RuntimeError):
    """The dashboard did not answer, or refused."""


def query_dashboard(host: str, *lines: str, connect_s: float = CONNECT_S, reply_s: float = REPLY_S) -> list[str]:
    """Return the answers to some lines over a separate connection.

    Args:
        host: Host of the controller.
        lines: Commands of the dashboard server.
        connect_s: Time limit of the connection, in s.
        reply_s: Time limit of the greeting and of each answer, in s.

    Raises:
        DashboardError: The connection fails, or there is no answer in time.
    """
    try:
        with socket.create_connection((host, DASHBOARD_PORT), timeout=connect_s) as connection:
            received = b""
            answers: list[str] = []
            # The first line is the greeting.
            for line in ("", *lines):
                if line:
                    connection.sendall(f"{line}\n".encode())
                end_s = time.monotonic() + reply_s
                while b"\n" not in received:
                    connection.settimeout(max(1e-3, end_s - time.monotonic()))
                    part = connection.recv(4096)
                    if not part:
                        raise ConnectionError("closed")
                    received += part
                    if time.monotonic() > end_s:
                        raise TimeoutError("timed out")
                answer, _, received = received.partition(b"\n")
                answers.append(answer.decode("utf-8", "replace").strip())
            with contextlib.suppress(OSError):
                connection.sendall(b"quit\n")
    except OSError as error:
        message = f"dashboard {host}:{DASHBOARD_PORT}: {error.strerror or error}"
        raise DashboardError(message) from None
    return answers[1:]


def stop_program(host: str) -> None:
    """End the playing program through the dashboard server.

    Raises:
        DashboardError: The program did not end.
    """
    (answer,) = query_dashboard(host, "stop")
    if answer != STOPPED:
        message = f"dashboard: stop: {answer}"
        raise DashboardError(message)


def end_program(host: str) -> None:
    """End the playing program, and a control script that is still starting: the second way to stop an arm.

    Uses RTDE first, then the dashboard server if a program still plays, then RTDE again to end a script that starts
    later.

    Raises:
        DashboardError: RTDE or a dashboard server that was needed did not succeed, or a program still plays.
    """
    failed: list[str] = []
    try:
        if end_control_script(host):
            return
    except ProbeError as error:
        failed.append(str(error))
    try:
        stop_program(host)
        if not failed and not end_control_script(host):
            failed.append(STILL_PLAYS)
    except (DashboardError, ProbeError) as error:
        failed.append(str(error))
    if failed:
        raise DashboardError("; ".join(failed))


def unlock_protective_stop(host: str) -> None:
    """Unlock a protective stop and close its popup on the pendant.

    Raises:
        DashboardError: The controller refuses.
    """
    answer, _ = query_dashboard(host, "unlock protective stop", "close safety popup")
    if answer != UNLOCKED:
        message = f"dashboard: unlock protective stop: {answer}"
        raise DashboardError(message)


def is_in_remote_control(host: str) -> bool:
    """Return True if the controller accepts remote scripts; e-Series from 5.6 on.

    Raises:
        DashboardError: No answer.
    """
    (answer,) = query_dashboard(host, "is in remote control")
    return "true" in answer.lower()
