"""Connections to a UR controller: vendor library calls with timeouts."""

import contextlib
import ctypes
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, TypeAlias

from haptether.extras import missing
from haptether.slave.ur.options import UrOptions
from haptether.slave.ur.services import CONNECT_S as DASHBOARD_S
from haptether.slave.ur.services import PROGRAM_END_S, REPLY_S, STILL_PLAYS, end_control_script, end_program
from haptether.slave.ur.state import RAW_WRENCH, VARIABLES, RuntimeState, UrState, read_state
from haptether.slave.ur.worker import Call, CallTimeoutError, ControlProcess, Idle, TimedWorker

Control: TypeAlias = Any
"""`rtde_control.RTDEControlInterface`; the library has no types."""
Order: TypeAlias = Callable[[Control], bool]
"""Library calls to be made on its thread."""

START_S: Final = 5.5
"""Timeout of the control script's start: the library waits 5 s plus its own sleeps."""
CONNECT_S: Final = DASHBOARD_S + 6.0 * REPLY_S + 5.0 + START_S + 2.0
"""Sum of the library's timeouts: dashboard with six lines, synchronisation, start of the control script."""
RECEIVE_S: Final = 4.0
SETTING_S: Final = 2.0
"""Timeout of a command acknowledged by the control script; normally two control cycles."""
STREAM_S: Final = 0.1
"""Timeout of an unacknowledged command; normally 0.2 ms."""
UPLOAD_S: Final = 8.0
END_S: Final = 0.8
"""Timeout of `stopScript`, and of the disconnection."""
LAST_STOP_S: Final = PROGRAM_END_S + 0.5
"""Timeout of the last program end without the library; longer than the sum of its own timeouts."""
POLL_S: Final = 0.005


class RtdeConnectionError(RuntimeError):
    """A library call failed or timed out, or the controller refused it."""


class ClosedError(RuntimeError):
    """The driver was closed or given up meanwhile, which is no fault of the arm."""

    def __init__(self) -> None:
        super().__init__("closed before it was open")


def vendor_module() -> Any:  # noqa: ANN401  # it has no types
    """Return `rtde_receive` after checking for `rtde_control`.

    Raises:
        RtdeConnectionError: The modules are not installed.
    """
    try:
        # Imported only for such an arm; it has no types.
        import_module("rtde_control")
        module = import_module("rtde_receive")
    except ImportError as error:
        raise RtdeConnectionError(str(missing("the driver ur", "rtde_control", error))) from None
    return module


class RtdeConnection:
    """Control and receive interface of one controller. All motion goes through `worker`.

    Args:
        options: Options of the driver.
        version: Version of the controller.
    """

    def __init__(self, options: UrOptions, version: tuple[int, ...]) -> None:
        self._options = options
        self._module = vendor_module()
        self._raw_wrench = options.force_source == "raw"
        self._default_rate = 500.0 if version[0] > 3 else 125.0
        self.worker = TimedWorker("ur-control")
        self._receiver = TimedWorker("ur-receive")
        self.control: Control = None
        """None if not connected, or cut."""
        self.receive: Any = None
        self._closed = False
        self._uploads = False
        """True if a control script was sent, or may have been."""

    @property
    def rate_hz(self) -> float:
        """Requested packages per second."""
        return float(self._options.frequency or self._default_rate)

    @property
    def broken(self) -> bool:
        """True if the control interface no longer answers and can only be cut."""
        return self.worker.stuck is not None or not self.control.alive

    # -------------------------------------------------------------------------------------------------- connect

    def connect(self) -> None:
        """Connect missing connections, upload the control script and wait until it plays.

        The constructor of the receive interface holds the interpreter without a timeout. Call `probe` first to verify
        that the controller answers.

        Raises:
            RtdeConnectionError: No connection, inputs in use by another client, or a script that does not start.
            ClosedError: Another thread has closed or given up.
        """
        self._check_open()
        host, rate = self._options.host, self.rate_hz
        if self.receive is None or not self.receive.isConnected() or not self._receives():
            # Never reuse an old interface: reconnecting may hang, and disconnecting may end this process.
            if self._receiver.stuck is not None:
                self._receiver = TimedWorker("ur-receive")
            names = [*VARIABLES, *([RAW_WRENCH] if self._raw_wrench else [])]
            self.receive = self._run(
                self._receiver, "connect (receive)",
                lambda: _never_destroyed(self._module.RTDEReceiveInterface(host, rate, names)), RECEIVE_S,
            )  # fmt: skip
        if self.control is None:
            self._check_open()
            self._uploads = True
            self.control = ControlProcess(host, rate)
            try:
                # Recheck, because another thread may close from here on.
                self._check_open()
                self._run(self.worker, "connect (control)", self.control.connect, CONNECT_S)
            except (RtdeConnectionError, ClosedError):
                # Otherwise the library continues, and may upload its script later.
                self.cut()
                raise
        self.upload()

    def upload(self) -> None:
        """Make the control script play; upload it again if it does not.

        Raises:
            RtdeConnectionError: The script does not start.
        """
        if self.state().runtime_state != RuntimeState.PLAYING:
            self.setting("upload of the control script", self.control.reuploadScript, UPLOAD_S)
        self.await_state("the control script plays", lambda state: state.runtime_state == RuntimeState.PLAYING, START_S)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError

    def _receives(self) -> bool:
        """Return True if packages arrive."""
        before, end_s = self.receive.getTimestamp(), time.monotonic() + 0.1
        while time.monotonic() < end_s:
            if self.receive.getTimestamp() != before:
                return True
            time.sleep(POLL_S)
        return False

    # -------------------------------------------------------------------------------------- packages and commands

    def state(self) -> UrState:
        """Return the latest package."""
        return read_state(self.receive, raw_wrench=self._raw_wrench)

    def await_state(self, what: str, holds: Callable[[UrState], bool], limit_s: float) -> UrState:
        """Wait for the first state that satisfies a condition.

        Raises:
            RtdeConnectionError: The condition is not satisfied in time.
        """
        end_s = time.monotonic() + limit_s
        while not holds(state := self.state()):
            self._check_open()
            if time.monotonic() > end_s:
                message = f"{what}: not within {limit_s:g} s"
                raise RtdeConnectionError(message)
            time.sleep(POLL_S)
        return state

    def setting(self, name: str, function: Callable[[], Any], limit_s: float = SETTING_S) -> Any:  # noqa: ANN401
        """Make a call that the controller acknowledges, and return its result.

        Raises:
            RtdeConnectionError: The call failed or was refused.
        """
        result = self._run(self.worker, name, function, limit_s)
        if result is False:
            message = f"{name}: refused by the controller"
            raise RtdeConnectionError(message)
        return result

    def start(self, name: str, order: Order, limit_s: float) -> Call:
        """Queue an order without waiting; drop streamed orders that have not started."""
        control = self.control
        return self.worker.start(name, lambda: order(control), limit_s)

    def stream(self, name: str, order: Order, idle: Idle | None = None) -> None:
        """Execute an order as soon as the library is free, replacing a streamed order that has not started.

        `idle` is called if nothing else is requested within its time.
        """
        control = self.control
        self.worker.stream(name, lambda: order(control), STREAM_S, idle)

    # ----------------------------------------------------------------------------------------------------- end

    def give_up(self) -> None:
        """Make waiting and later calls raise `ClosedError`, from any thread; `close` then ends the program."""
        self._closed = True
        if (control := self.control) is not None:
            control.kill()

    def cut(self) -> None:
        """End the control interface in any state; this side cannot move the arm any more."""
        if self.control is not None:
            self.control.kill()
            self.worker.end()
            self.control, self.worker = None, TimedWorker("ur-control")

    def close(self) -> list[str]:
        """End the script and both connections; return the failures.

        Takes `LAST_STOP_S` plus 2 s if the controller does not answer, normally less than a second.
        """
        failed: list[str] = []
        self._closed = True
        control, receive, host = self.control, self.receive, self._options.host
        last_stop: Callable[[str], object] | None = end_control_script if self._uploads else None
        if control is not None:
            try:
                # The library does not stop a script that is not playing yet.
                plays = self.state().runtime_state == RuntimeState.PLAYING
                self.worker.run("stopScript", control.stopScript, END_S)
                last_stop = None if plays else last_stop
            except Exception as error:  # errors of the library
                failed.append(f"stopScript: {error}")
                last_stop = end_program
        self.cut()
        if last_stop is not None:
            # The script may still play, or start later without a watchdog.
            try:
                ended = self.worker.run("end of the program", lambda: last_stop(host), LAST_STOP_S)
                failed = [STILL_PLAYS] if ended is False else []
            except Exception as error:  # errors of the network
                failed.append(str(error))
        if receive is not None and receive.isConnected():
            with contextlib.suppress(Exception):
                self._receiver.run("disconnect (receive)", receive.disconnect, END_S)
        self.worker.end()
        self._receiver.end(receive)
        return failed

    def _run(self, worker: TimedWorker, name: str, function: Callable[[], Any], limit_s: float) -> Any:  # noqa: ANN401
        self._check_open()
        try:
            return worker.run(name, function, limit_s)
        except CallTimeoutError as error:
            message = str(error)
        except Exception as error:  # errors of the library
            message = f"{name}: {' '.join(str(error).split())}"
        # The call may have failed because another thread has killed its process.
        self._check_open()
        raise RtdeConnectionError(message)


def _never_destroyed(interface: Any) -> Any:  # noqa: ANN401  # rtde_receive.RTDEReceiveInterface
    """Add a reference that is never released: the destructor disconnects, and on failure ends the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(interface))
    return interface
