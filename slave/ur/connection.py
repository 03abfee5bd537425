"""The connections to a UR controller: the vendor's library, each of its calls within a time limit."""

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
"""An `rtde_control.RTDEControlInterface`; the library has no types."""
Order: TypeAlias = Callable[[Control], bool]
"""Calls of the library, to be made on its thread."""

START_S: Final = 5.5
"""For the start of the control script: the library waits for 5 s and the time that its naps take longer."""
CONNECT_S: Final = DASHBOARD_S + 6.0 * REPLY_S + 5.0 + START_S + 2.0
"""The library's own limits together: dashboard with six lines, synchronisation, start of the control script."""
RECEIVE_S: Final = 4.0
SETTING_S: Final = 2.0
"""For a command that the control script acknowledges; two control cycles as a rule."""
STREAM_S: Final = 0.1
"""For a command that is sent on and not acknowledged; 0.2 ms as a rule."""
UPLOAD_S: Final = 8.0
END_S: Final = 0.8
"""For `stopScript`, and for the disconnection."""
LAST_STOP_S: Final = PROGRAM_END_S + 0.5
"""For the program to be ended without the library, at the end: longer than its own limits together."""
POLL_S: Final = 0.005


class RtdeConnectionError(RuntimeError):
    """A call of the library failed or timed out, or the controller refused it."""


def vendor_module() -> Any:  # noqa: ANN401  # it has no types
    """`rtde_receive`, once `rtde_control` is there as well.

    Raises:
        RtdeConnectionError: They are not installed.
    """
    try:
        # Only whoever has such an arm; it has no types.
        import_module("rtde_control")
        module = import_module("rtde_receive")
    except ImportError as error:
        raise RtdeConnectionError(str(missing("the driver ur", "rtde_control", error))) from None
    return module


class RtdeConnection:
    """Control and receive interface of one controller. What moves the arm goes through `worker` alone.

    Args:
        options: Of the driver.
        version: Of the controller.
    """

    def __init__(self, options: UrOptions, version: tuple[int, ...]) -> None:
        self._options = options
        self._module = vendor_module()
        self._raw_wrench = options.force_source == "raw"
        self._default_rate = 500.0 if version[0] > 3 else 125.0
        self.worker = TimedWorker("ur-control")
        self._receiver = TimedWorker("ur-receive")
        self.control: Control = None
        """None where it is not connected, or was cut."""
        self.receive: Any = None
        self._closed = False
        self._uploads = False
        """True if a control script was sent, or may have been."""

    @property
    def rate_hz(self) -> float:
        """Packages a second that were requested."""
        return float(self._options.frequency or self._default_rate)

    @property
    def broken(self) -> bool:
        """Whether the control interface does not answer any more, so that it can only be cut."""
        return self.worker.stuck is not None or not self.control.alive

    # -------------------------------------------------------------------------------------------------- connect

    def connect(self) -> None:
        """Connects what is not connected, uploads the control script and waits until it plays.

        The constructor of the receive interface holds the interpreter and has no time limit: call `probe` before, so
        that it finds somebody who answers.

        Raises:
            RtdeConnectionError: No connection, inputs that another client has, or a script that does not start.
        """
        self._check_open()
        host, rate = self._options.host, self.rate_hz
        if self.receive is None or not self.receive.isConnected() or not self._receives():
            # Never the old one again: to reconnect it may hang, to disconnect it may end this process.
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
                # Closed just now, or from here on by whoever closes it.
                self._check_open()
                self._run(self.worker, "connect (control)", self.control.connect, CONNECT_S)
            except RtdeConnectionError:
                # It would go on, and upload its script whenever that comes through.
                self.cut()
                raise
        self.upload()

    def upload(self) -> None:
        """Has the control script play, anew where it does not.

        Raises:
            RtdeConnectionError: It does not start.
        """
        if self.state().runtime_state != RuntimeState.PLAYING:
            self.setting("upload of the control script", self.control.reuploadScript, UPLOAD_S)
        self.await_state("the control script plays", lambda state: state.runtime_state == RuntimeState.PLAYING, START_S)

    def _check_open(self) -> None:
        if self._closed:
            message = "closed meanwhile"
            raise RtdeConnectionError(message)

    def _receives(self) -> bool:
        """Whether packages come."""
        before, end_s = self.receive.getTimestamp(), time.monotonic() + 0.1
        while time.monotonic() < end_s:
            if self.receive.getTimestamp() != before:
                return True
            time.sleep(POLL_S)
        return False

    # -------------------------------------------------------------------------------------- packages and commands

    def state(self) -> UrState:
        """The newest package."""
        return read_state(self.receive, raw_wrench=self._raw_wrench)

    def await_state(self, what: str, holds: Callable[[UrState], bool], limit_s: float) -> UrState:
        """The first state in which something holds.

        Raises:
            RtdeConnectionError: It has not come to that in time.
        """
        end_s = time.monotonic() + limit_s
        while not holds(state := self.state()):
            if time.monotonic() > end_s:
                message = f"{what}: not within {limit_s:g} s"
                raise RtdeConnectionError(message)
            time.sleep(POLL_S)
        return state

    def setting(self, name: str, function: Callable[[], Any], limit_s: float = SETTING_S) -> Any:  # noqa: ANN401
        """Makes a call that the controller acknowledges, and returns its result.

        Raises:
            RtdeConnectionError: It failed or was refused.
        """
        result = self._run(self.worker, name, function, limit_s)
        if result is False:
            message = f"{name}: refused by the controller"
            raise RtdeConnectionError(message)
        return result

    def start(self, name: str, order: Order, limit_s: float) -> Call:
        """Queues an order and drops what was streamed and has not started; does not wait."""
        control = self.control
        return self.worker.start(name, lambda: order(control), limit_s)

    def stream(self, name: str, order: Order, idle: Idle | None = None) -> None:
        """Has an order made as soon as the library is free, instead of the streamed one that has not started.

        `idle` follows where nothing else is requested within its time.
        """
        control = self.control
        self.worker.stream(name, lambda: order(control), STREAM_S, idle)

    # ----------------------------------------------------------------------------------------------------- end

    def cut(self) -> None:
        """Ends the control interface, whatever it does: nothing of this side moves the arm any more."""
        if self.control is not None:
            self.control.kill()
            self.worker.end()
            self.control, self.worker = None, TimedWorker("ur-control")

    def close(self) -> list[str]:
        """Ends the script and both connections; what of that failed.

        Within `LAST_STOP_S` and 2 s where the controller does not answer; within a second as a rule.
        """
        failed: list[str] = []
        self._closed = True
        control, receive, host = self.control, self.receive, self._options.host
        last_stop: Callable[[str], object] | None = end_control_script if self._uploads else None
        if control is not None:
            try:
                # The library stops no script that does not play yet.
                plays = self.state().runtime_state == RuntimeState.PLAYING
                self.worker.run("stopScript", control.stopScript, END_S)
                last_stop = None if plays else last_stop
            except Exception as error:  # of the library
                failed.append(f"stopScript: {error}")
                last_stop = end_program
        self.cut()
        if last_stop is not None:
            # The script may play on, or start later without a watchdog.
            try:
                ended = self.worker.run("end of the program", lambda: last_stop(host), LAST_STOP_S)
                failed = [STILL_PLAYS] if ended is False else []
            except Exception as error:  # of the network
                failed.append(str(error))
        if receive is not None and receive.isConnected():
            with contextlib.suppress(Exception):
                self._receiver.run("disconnect (receive)", receive.disconnect, END_S)
        self.worker.end()
        self._receiver.end(receive)
        return failed

    def _run(self, worker: TimedWorker, name: str, function: Callable[[], Any], limit_s: float) -> Any:  # noqa: ANN401
        try:
            return worker.run(name, function, limit_s)
        except CallTimeoutError:
            message = f"{name}: has not returned within {limit_s:g} s"
        except Exception as error:  # of the library
            message = f"{name}: {' '.join(str(error).split())}"
        raise RtdeConnectionError(message)


def _never_destroyed(interface: Any) -> Any:  # noqa: ANN401  # rtde_receive.RTDEReceiveInterface
    """One more reference than anybody lets go of: its destructor disconnects, and where that fails ends the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(interface))
    return interface
