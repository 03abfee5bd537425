"""Vendor library calls that may never return: on a thread with timeouts, in a process that can be killed.

After a lost connection, a thread of ur_rtde 1.6.5 reconnects endlessly. Each time it uploads the control script, which
clears the watchdog and stops any playing program. Disconnecting, reconnecting or destroying the interface meanwhile
causes a segmentation fault, and some calls never return. Therefore the control interface runs in a process whose kill
affects nothing else. The library's output goes to standard error.
"""

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, NamedTuple

from haptether.child import child_environment, module_command

ABANDONED: list[object] = []
"""Objects of calls that never returned; releasing them could block."""
PRIORITY: Final = 1
"""SCHED_FIFO priority."""
PARENT_POLL_S: Final = 0.05
MAX_LINE: Final = 1 << 16


class CallTimeoutError(RuntimeError):
    """A call has not returned within its timeout."""


class ControlProcessError(RuntimeError):
    """The library raised an exception, or its process is gone."""


class Call:
    """One call: queued, running or done."""

    def __init__(self, name: str, function: Callable[[], Any], limit_s: float) -> None:
        self.name = name
        self.limit_s = limit_s
        self.result: Any = None
        self.error: Exception | None = None
        self.started_s: float | None = None
        self._function = function
        self._done = threading.Event()

    @property
    def done(self) -> bool:
        """True if the call has returned or was cancelled."""
        return self._done.is_set()

    @property
    def failure(self) -> str | None:
        """Reason of failure; None while running and on success."""
        if not self.done:
            return None
        if self.error is not None:
            return f"{self.name}: {self.error}"
        return f"{self.name} was refused" if self.result is False else None

    def wait(self, limit_s: float) -> bool:
        """Wait with a timeout; return True if done."""
        return self._done.wait(limit_s)

    def cancel(self, why: str) -> None:
        """End without calling."""
        self.error = CallTimeoutError(why)
        self._done.set()

    def perform(self) -> None:
        """Execute the call on the worker thread."""
        self.started_s = time.monotonic()
        try:
            self.result = self._function()
        except Exception as error:  # errors of a vendor library
            self.error = error
        self._done.set()


class Idle(NamedTuple):
    """Call made after a time in s without another request."""

    after_s: float
    name: str
    function: Callable[[], Any]
    limit_s: float


class TimedWorker:
    """Thread that executes calls in sequence; only the latest streamed call counts.

    Args:
        name: Name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._changed = threading.Condition()
        self._calls: deque[Call] = deque()
        self._newest: Call | None = None
        self._running: Call | None = None
        self._stuck: Call | None = None
        self._ended = False
        self._idle: Idle | None = None
        self.streamed: Call | None = None
        """Latest finished streamed call; read only for others, like the next field."""
        self.idled: Call | None = None
        """Last call made because the stream stopped."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def start(self, name: str, function: Callable[[], Any], limit_s: float) -> Call:
        """Queue a call without waiting; drop streamed calls that have not started."""
        call = Call(name, function, limit_s)
        with self._changed:
            if self._ended or self.stuck is not None:
                call.cancel(f"{self._name}: does not answer")
                return call
            self._newest = self._idle = None
            self._calls.append(call)
            self._changed.notify()
        return call

    def run(self, name: str, function: Callable[[], Any], limit_s: float) -> Any:  # noqa: ANN401  # its result
        """Make a call and wait for it.

        Raises:
            CallTimeoutError: A timeout; the connection must not be used again.
            Exception: Exception of the call.
        """
        call = self.start(name, function, limit_s)
        if not call.wait(limit_s):
            with self._changed:
                self._stuck = self._stuck or call
            message = f"{name}: has not returned within {limit_s:g} s"
            raise CallTimeoutError(message)
        if call.error is not None:
            raise call.error
        return call.result

    def stream(self, name: str, function: Callable[[], Any], limit_s: float, idle: Idle | None = None) -> None:
        """Execute a call as soon as the thread is free, replacing a streamed call that has not started.

        With `idle` another call follows if nothing else is requested in time, even if the streaming thread hangs.
        """
        with self._changed:
            if not self._ended and self._stuck is None:
                self._newest = Call(name, function, limit_s)
                self._idle = idle
                self._changed.notify()

    @property
    def stuck(self) -> Call | None:
        """Call that timed out; the thread is then never used again."""
        running = self._running
        if self._stuck is None and running is not None and not running.done:
            started_s = running.started_s
            if started_s is not None and time.monotonic() - started_s > running.limit_s:
                self._stuck = running
        return self._stuck

    def end(self, *held: object) -> None:
        """End the thread after its current call; `held` is kept for ever if a call never returned."""
        if self.stuck is not None:
            ABANDONED.extend(held)
        with self._changed:
            self._ended, self._newest, self._idle = True, None, None
            while self._calls:
                self._calls.popleft().cancel(f"{self._name}: ended")
            self._changed.notify()

    def _run(self) -> None:
        request_lowest_realtime()
        while True:
            with self._changed:
                while not (self._ended or self._calls or self._newest):
                    idle = self._idle
                    if not self._changed.wait(idle.after_s if idle else None) and idle is not None:
                        self._idle = None
                        self.idled = Call(idle.name, idle.function, idle.limit_s)
                        self._calls.append(self.idled)
                if self._ended:
                    return
                streamed = not self._calls
                call = self._newest if streamed else self._calls.popleft()
                if streamed:
                    self._newest = None
                if call is None:
                    continue
                call.started_s = time.monotonic()
                self._running = call
            call.perform()
            self._running = None
            if streamed:
                self.streamed = call
            if self._stuck is not None:
                # Too late: the waiting thread has continued without it.
                return


class ControlProcess:
    """Calls of an `rtde_control.RTDEControlInterface` in a process, for one thread at a time; another may `kill`.

    Args:
        host: Host of the controller.
        rate_hz: Package rate of the library.

    The process exists at once, so that it can be killed while it connects.
    """

    def __init__(self, host: str, rate_hz: float) -> None:
        self._socket, theirs = socket.socketpair()
        with theirs:
            arguments = str(theirs.fileno()), host, repr(rate_hz), str(os.getpid())
            self._process = subprocess.Popen(
                module_command("haptether.slave.ur.worker", *arguments),
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=2,
                env=child_environment(),
                # Ctrl-C is for the bridge, which then stops the arm through this process.
                start_new_session=True,
            )
        self._lines = self._socket.makefile("rb")

    def connect(self) -> None:
        """Wait until the library has connected and its script plays.

        Raises:
            ControlProcessError: The connection failed.
        """
        self._answer("connect")

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return a call of the library."""
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: self._call(name, arguments)

    @property
    def alive(self) -> bool:
        """True if the process runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """Kill the process and its connections, even within a call."""
        self._process.kill()
        # Wake a thread that waits for an answer.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        threading.Thread(target=self._leave, daemon=True).start()

    def _leave(self) -> None:
        self._process.wait()
        self._lines.close()
        self._socket.close()

    def _call(self, name: str, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401  # what the library returns
        try:
            self._socket.sendall(json.dumps((name, arguments)).encode() + b"\n")
        except OSError:
            raise self._gone(name) from None
        return self._answer(name)

    def _answer(self, name: str) -> Any:  # noqa: ANN401
        try:
            line = self._lines.readline(MAX_LINE)
        except (OSError, ValueError):
            line = b""
        if not line:
            raise self._gone(name)
        error, result = json.loads(line)
        if error is not None:
            raise ControlProcessError(error)
        return result

    def _gone(self, name: str) -> ControlProcessError:
        status = self._process.poll()
        ended = f"ended with {status}" if status is not None else "is gone"
        return ControlProcessError(f"the process of ur_rtde {ended} during {name}")


def main() -> None:
    """Main function of the control process: execute calls until its socket is closed."""
    descriptor, host, rate, parent = sys.argv[1:]
    request_lowest_realtime()
    # An argument, because os.getppid() is invalid if the parent has already ended.
    threading.Thread(target=_end_with, args=(int(parent),), daemon=True).start()
    with socket.socket(fileno=int(descriptor)) as requests:
        lines = requests.makefile("rb")

        def answer(error: str | None, result: object = None) -> None:
            requests.sendall(json.dumps((error, result)).encode() + b"\n")

        interface = import_module("rtde_control").RTDEControlInterface
        try:
            # RTDE input of an external force sensor does not work in this library, and another client may use one.
            control = interface(host, float(rate), interface.FLAG_UPLOAD_SCRIPT | interface.FLAG_NO_EXT_FT)
        except Exception as error:  # errors of the library
            answer(str(error))
            os._exit(1)
        answer(None)
        for line in lines:
            name, arguments = json.loads(line)
            try:
                result = getattr(control, name)(*arguments)
            except Exception as error:
                answer(str(error))
            else:
                answer(None, result)
    # Its destructor would wait, or worse.
    os._exit(0)


def _end_with(parent: int) -> None:
    """End this process with its parent, even within a call."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(0)


def request_lowest_realtime() -> None:
    """Request the lowest real-time priority for the calling thread and its children; continue without it on failure.

    Above ordinary processes, because a busy machine would otherwise starve the commands and the controller's watchdog
    would end its program. Below the loops of bridge and emulated controller, because the vendor's library busy-waits.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


if __name__ == "__main__":
    main()
