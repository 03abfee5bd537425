"""Calls of a vendor's library that may never return, on a thread of their own and never waited for beyond a limit."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from haptether.slave.ur.priority import ask_little_realtime

ABANDONED: list[object] = []
"""What a call still holds that never returned: to let go of it could block whoever does."""


class OverdueError(RuntimeError):
    """A call has not returned within its limit."""


class Call:
    """One call: not begun, running, or over."""

    def __init__(self, name: str, function: Callable[[], Any], limit_s: float) -> None:
        self.name = name
        self.limit_s = limit_s
        self.result: Any = None
        self.error: Exception | None = None
        self.begun_s: float | None = None
        self._function = function
        self._over = threading.Event()

    @property
    def over(self) -> bool:
        """Whether it has returned, or never will be called."""
        return self._over.is_set()

    @property
    def failed(self) -> str | None:
        """Why it did not do what it should; none while it runs and where it did."""
        if not self.over:
            return None
        if self.error is not None:
            return f"{self.name}: {self.error}"
        return f"{self.name} was refused" if self.result is False else None

    def wait(self, limit_s: float) -> bool:
        """Waits until it is over, but no longer than that; whether it is."""
        return self._over.wait(limit_s)

    def give_up(self, why: str) -> None:
        """Ends it without calling it."""
        self.error = OverdueError(why)
        self._over.set()

    def perform(self) -> None:
        """Calls it, on the thread of this worker."""
        self.begun_s = time.monotonic()
        try:
            self.result = self._function()
        except Exception as error:  # of a library of somebody else
            self.error = error
        self._over.set()


class Idle(NamedTuple):
    """What is called where nothing else has been asked for."""

    after_s: float
    name: str
    function: Callable[[], Any]
    limit_s: float


class Bounded:
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
        """The newest of the streamed calls that is over."""
        self.idled: Call | None = None
        """What was called last because nothing more was streamed."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def start(self, name: str, function: Callable[[], Any], limit_s: float) -> Call:
        """Queues a call, and drops what was streamed and has not begun; does not wait."""
        call = Call(name, function, limit_s)
        with self._changed:
            if self._ended or self.stuck is not None:
                call.give_up(f"{self._name}: does not answer")
                return call
            self._newest = self._idle = None
            self._calls.append(call)
            self._changed.notify()
        return call

    def run(self, name: str, function: Callable[[], Any], limit_s: float) -> Any:  # noqa: ANN401  # what it gives
        """Makes a call and waits for it.

        Raises:
            OverdueError: It did not return in time; its connection must not be used again.
            Exception: What it raised.
        """
        call = self.start(name, function, limit_s)
        if not call.wait(limit_s):
            with self._changed:
                self._stuck = self._stuck or call
            message = f"{name}: has not returned within {limit_s:g} s"
            raise OverdueError(message)
        if call.error is not None:
            raise call.error
        return call.result

    def stream(self, name: str, function: Callable[[], Any], limit_s: float, idle: "Idle | None" = None) -> None:
        """Has a call made as soon as the thread is free, instead of the streamed one that has not begun.

        With `idle` another one follows if nothing else is asked for within a time: also where the thread that streams
        hangs.
        """
        with self._changed:
            if not self._ended and self._stuck is None:
                self._newest = Call(name, function, limit_s)
                self._idle = idle
                self._changed.notify()

    @property
    def stuck(self) -> Call | None:
        """The call that did not return in time; once there is one the thread is never used again."""
        running = self._running
        if self._stuck is None and running is not None and not running.over:
            begun_s = running.begun_s
            if begun_s is not None and time.monotonic() - begun_s > running.limit_s:
                self._stuck = running
        return self._stuck

    def end(self, *held: object) -> None:
        """Lets the thread end after what it does now; `held` is kept for ever where a call never returned."""
        if self.stuck is not None:
            ABANDONED.extend(held)
        with self._changed:
            self._ended, self._newest, self._idle = True, None, None
            while self._calls:
                self._calls.popleft().give_up(f"{self._name}: ended")
            self._changed.notify()

    def _run(self) -> None:
        ask_little_realtime()
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
                call.begun_s = time.monotonic()
                self._running = call
            call.perform()
            self._running = None
            if streamed:
                self.streamed = call
            if self._stuck is not None:
                # Too late: whoever waited has gone on without it.
                return
