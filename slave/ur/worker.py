"""Calls of a vendor's library that may never return: on a thread with a time limit each, in a process to be killed.

Once a connection is lost, a thread of ur_rtde 1.6.5 connects again by itself, without end: each time it uploads the
control script anew, which clears the watchdog and stops whatever plays. To disconnect, to reconnect or to destroy the
interface meanwhile ends the process with a segmentation fault, and some calls never return. So the control interface
runs where a kill is the end of it and of nothing else; what the library prints goes to standard error.
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
"""What a call still holds that never returned: to let go of it could block whoever does."""
PRIORITY: Final = 1
"""Under SCHED_FIFO."""
PARENT_POLL_S: Final = 0.05
MAX_LINE: Final = 1 << 16


class CallTimeoutError(RuntimeError):
    """A call has not returned within its limit."""


class ControlProcessError(RuntimeError):
    """The library raised, or its process is gone."""


class Call:
    """One call: queued, running, or done."""

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
        """Whether it has returned, or was cancelled."""
        return self._done.is_set()

    @property
    def failure(self) -> str | None:
        """Why it did not do what it should; none while it runs and where it did."""
        if not self.done:
            return None
        if self.error is not None:
            return f"{self.name}: {self.error}"
        return f"{self.name} was refused" if self.result is False else None

    def wait(self, limit_s: float) -> bool:
        """Waits until it is done, but no longer than that; whether it is."""
        return self._done.wait(limit_s)

    def cancel(self, why: str) -> None:
        """Ends it without calling it."""
        self.error = CallTimeoutError(why)
        self._done.set()

    def perform(self) -> None:
        """Calls it, on the thread of this worker."""
        self.started_s = time.monotonic()
        try:
            self.result = self._function()
        except Exception as error:  # of a library of somebody else
            self.error = error
        self._done.set()


class Idle(NamedTuple):
    """What is called after a time in s without another request."""

    after_s: float
    name: str
    function: Callable[[], Any]
    limit_s: float


class TimedWorker:
    """A thread that makes one call after another; of those that are streamed only the newest counts.

    Args:
        name: Of the thread.
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
        """The newest of the streamed calls that is done; for others to read only, as the next."""
        self.idled: Call | None = None
        """The last call that was made because nothing more was streamed."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def start(self, name: str, function: Callable[[], Any], limit_s: float) -> Call:
        """Queues a call, and drops what was streamed and has not started; does not wait."""
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
        """Makes a call and waits for it.

        Raises:
            CallTimeoutError: It did not return in time; its connection must not be used again.
            Exception: What it raised.
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
        """Has a call made as soon as the thread is free, instead of the streamed one that has not started.

        With `idle` another one follows if nothing else is requested within a time: also where the thread that streams
        hangs.
        """
        with self._changed:
            if not self._ended and self._stuck is None:
                self._newest = Call(name, function, limit_s)
                self._idle = idle
                self._changed.notify()

    @property
    def stuck(self) -> Call | None:
        """The call that timed out; once there is one the thread is never used again."""
        running = self._running
        if self._stuck is None and running is not None and not running.done:
            started_s = running.started_s
            if started_s is not None and time.monotonic() - started_s > running.limit_s:
                self._stuck = running
        return self._stuck

    def end(self, *held: object) -> None:
        """Lets the thread end after what it does now; `held` is kept for ever where a call never returned."""
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
                # Too late: whoever waited has gone on without it.
                return


class ControlProcess:
    """Calls as on an `rtde_control.RTDEControlInterface`, for one thread at a time; `kill` ends one from another.

    Args:
        host: The controller.
        rate_hz: Of the packages that the library takes.

    It is there at once, so that it can be killed while it connects.
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
                # A Ctrl-C is for the bridge, which then stops the arm through this process.
                start_new_session=True,
            )
        self._lines = self._socket.makefile("rb")

    def connect(self) -> None:
        """Waits until the library has connected, and its script plays.

        Raises:
            ControlProcessError: It could not.
        """
        self._answer("connect")

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """A call of the library."""
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: self._call(name, arguments)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """Ends the process, in the middle of a call if need be, and with it its connections."""
        self._process.kill()
        # Whoever waits for an answer wakes up.
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
    """What the process of the control interface does: one call after another, until its socket is closed."""
    descriptor, host, rate, parent = sys.argv[1:]
    request_lowest_realtime()
    # An argument, and not os.getppid(): whoever started this process may have ended by now.
    threading.Thread(target=_end_with, args=(int(parent),), daemon=True).start()
    with socket.socket(fileno=int(descriptor)) as requests:
        lines = requests.makefile("rb")

        def answer(error: str | None, result: object = None) -> None:
            requests.sendall(json.dumps((error, result)).encode() + b"\n")

        interface = import_module("rtde_control").RTDEControlInterface
        try:
            # An external force sensor through RTDE does not work in this library, and another client may have one.
            control = interface(host, float(rate), interface.FLAG_UPLOAD_SCRIPT | interface.FLAG_NO_EXT_FT)
        except Exception as error:  # of the library
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
    """Ends this process with the one that started it, also in the middle of a call."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(0)


def request_lowest_realtime() -> None:
    """Requests real time of the lowest priority for the calling thread and what it starts; goes on without.

    Above what does not care for time, or a busy machine would starve the commands, and the watchdog of the controller
    would end its program; below the loops of bridge and emulated controller, because the vendor's library waits without
    sleeping.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


if __name__ == "__main__":
    main()
