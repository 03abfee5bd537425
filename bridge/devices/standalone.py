"""A driver run by itself, to look at it: no other side, no coupling, and the times of all its calls kept."""

import atexit
import contextlib
import os
import threading
import time
from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol

from haptether.bridge.devices.open import (
    DeviceError,
    DeviceNotes,
    failure,
    leave_blocked,
    opened,
)
from haptether.bridge.interpreter import QUIET

Written = tuple[tuple[float, ...], ...]
"""What `write` of a driver is called with: force, of a pose force and torque."""
LEAVE_S = 5.0
"""How long the end waits for a driver that blocks, and a driver may take to close."""
PRIORITY = 80
"""Under SCHED_FIFO, where the system gives it, as of the loops of both sides."""
SHORTEST_S = 1e-4
"""No device has a period so short."""
STAGES = ("open", "read", "write", "write_trigger", "stop", "hold", "close")
RestBy = Literal["stop", "hold"]


class Tick(NamedTuple):
    """One turn of the loop, with times of `time.monotonic`."""

    asked_s: float
    """When `read` was called."""
    read_s: float
    """When it returned."""
    written_s: float
    """When `write` returned; where nothing was written, when it was decided."""
    sample: object
    """What `read` returned."""
    force: Written | None
    """What was written."""


class Lead(Protocol):
    """What decides, sample by sample, what a device is to exert."""

    def step(self, sample: object, at_s: float) -> Written | None:
        """What to write after a sample that was read at a time in s; none for nothing.

        Raises:
            EndOfRunError: It is over.
        """


class EndOfRunError(Exception):
    """Raised by a lead: the device comes to rest and is closed."""


class WatchedDevice:
    """A driver, and for how long and how each of its methods was called; their exceptions name it and the line."""

    def __init__(self, device: object) -> None:
        self.device = device
        self.failed: dict[str, DeviceError] = {}
        """The first exception of each method."""
        self.took_s: dict[str, float] = {}
        """How long the last call of each method took."""
        self.stage: str | None = None
        """The method that has not returned yet."""
        self.since_s = 0.0

    @property
    def paces(self) -> bool:
        """Whether `read` waits for the next sample."""
        return bool(getattr(self.device, "paces", False))

    @property
    def cycle_s(self) -> float | None:
        """Least time in s of a cycle on its bus; none where the driver does not know it."""
        return getattr(self.device, "cycle_s", None)

    def has(self, method: str) -> bool:
        """Whether the driver has a method that it need not have."""
        return callable(getattr(self.device, method, None))

    def call(self, method: str, *arguments: object) -> object:
        """What the driver's method returns.

        Raises:
            DeviceError: It raised an exception, whatever it was.
        """
        self.since_s = time.monotonic()
        self.stage = method
        try:
            return getattr(self.device, method)(*arguments)
        except BaseException as error:
            failed = failure(self.device, error)
            self.failed.setdefault(method, failed)
            raise failed from error
        finally:
            self.took_s[method] = time.monotonic() - self.since_s
            self.stage = None

    # What `opened` calls.

    def open(self) -> None:
        """Opens it."""
        self.call("open")

    def read(self) -> object:
        """Reads it."""
        return self.call("read")

    def write(self, *force: tuple[float, ...]) -> None:
        """Writes to it."""
        self.call("write", *force)

    def stop(self) -> None:
        """Stops it, where it is an arm."""
        self.call("stop")

    def close(self) -> None:
        """Closes it."""
        self.call("close")


class StandaloneRun:
    """A driver that is opened, led, brought to rest and closed on a thread of its own, which nothing else holds up.

    It begins when it is made, and ends where its lead says so, by an exception of the driver, by `stop`, or with the
    process. Whatever ended it, a device whose driver was written to is then written zero, an arm stopped, a gripper
    held.

    Args:
        device: What is run.
        lead: What decides what is written.
        period_s: Of the loop in s, where the device does not pace it.
        rest_by: The method that brings it to rest, `stop` of an arm, `hold` of a gripper; none where zero is written.
        stopped: Ends it, too, in the tick that runs.
    """

    def __init__(
        self,
        device: object,
        lead: Lead,
        *,
        period_s: float = 1e-3,
        rest_by: RestBy | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.watched = WatchedDevice(device)
        self.notes = DeviceNotes(come_to_rest=self._come_to_rest)
        self.error: DeviceError | None = None
        """What ended it, if anything did."""
        self.failed_at: str | None = None
        """The driver's method that ended it; none of one that did not, and of an error of the lead."""
        self.is_open = False
        self.has_real_time = False
        self.rests: bool | None = None
        """Whether it took zero, or its stop, at the end; none where it was never open or never written to."""
        self.ticks: list[Tick] = []
        self.period_s: float | None = None
        """What the driver says of itself, once it is open."""
        self._lead = lead
        self._loop_period_s = period_s
        self._rest_by = rest_by
        self._stopped = stopped
        self._rest: Written | None = None
        self._stopping = threading.Event()
        self._quieted = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="haptether-standalone", daemon=True)
        QUIET.begin()
        # Whatever ends this process, the device is left at rest before its thread is.
        atexit.register(self._leave)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether it has ended, its device closed."""
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Requests its end: zero is written in the tick that runs."""
        self._stopping.set()

    def blocked_in(self, longer_than_s: float) -> str | None:
        """The driver's method that has not returned for that long."""
        stage, since_s = self.watched.stage, self.watched.since_s
        return stage if stage is not None and time.monotonic() - since_s > longer_than_s else None

    def end(self) -> bool:
        """Ends it and returns whether it did; where a call of the driver does not return, its device is closed here.

        Whatever such a device was last told to exert, it may go on exerting.
        """
        self._leave()
        atexit.unregister(self._leave)
        if not self._thread.is_alive():
            return True
        self.failed_at = self.watched.stage
        self._unquiet()
        leave_blocked(self.watched, self.notes)  # type: ignore[arg-type]  # it calls those of the driver
        return False

    def _unquiet(self) -> None:
        # Once: by its own end, or by who waits for it no longer.
        if self._quieted.acquire(blocking=False):
            QUIET.end()

    def _leave(self) -> None:
        self._stopping.set()
        self._thread.join(LEAVE_S)

    def _run(self) -> None:
        try:
            if self._ends():
                # Ended before its thread ran: it is not opened.
                return
            period_s = None if self.watched.paces else self._loop_period_s
            with opened(self.watched, self.notes, "period_s", period_s):  # type: ignore[arg-type]  # it calls those of the driver
                self.period_s = getattr(self.watched.device, "period_s", None)
                with contextlib.suppress(OSError, AttributeError):
                    # Of this thread; `opened` takes it back.
                    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
                    self.has_real_time = True
                    QUIET.prioritise()
                self.is_open = True
                self._drive()
        except DeviceError as error:
            self.error = error
            self.failed_at = self.failed_at or next((name for name in STAGES if name in self.watched.failed), None)
        finally:
            self._unquiet()

    def _drive(self) -> None:
        try:
            self._turn()
        except EndOfRunError:
            pass
        except DeviceError as error:
            self.failed_at = next((name for name in STAGES if self.watched.failed.get(name) is error), None)
            raise
        except Exception as error:
            # The lead, of what the driver has read: nothing that a person should have to think about.
            raise failure(self.watched.device, error) from error
        finally:
            if self._rest is not None or self._rest_by is not None:
                self.rests = self.notes.rest()

    def _turn(self) -> None:
        watched, paces = self.watched, self.watched.paces
        due_s = time.monotonic()
        while not self._ends():
            asked_s = time.monotonic()
            sample = watched.read()
            read_s = time.monotonic()
            if self._ends():
                return
            force = self._lead.step(sample, read_s)
            if force is not None:
                self._rest = tuple((0.0,) * len(part) for part in force)
                watched.write(*force)
            self.ticks.append(Tick(asked_s, read_s, time.monotonic(), sample, force))
            if paces:
                if time.monotonic() - asked_s < SHORTEST_S:
                    # One that does not wait, as it says: in real time it would leave nobody else a processor.
                    time.sleep(SHORTEST_S)
            else:
                due_s = max(due_s + self._loop_period_s, time.monotonic() - self._loop_period_s)
                time.sleep(max(0.0, due_s - time.monotonic()))

    def _ends(self) -> bool:
        return self._stopping.is_set() or self._stopped()

    def _come_to_rest(self) -> None:
        if self._rest_by is not None:
            self.watched.call(self._rest_by)
        elif self._rest is not None:
            try:
                self.watched.write(*self._rest)
            finally:
                if self.watched.has("write_trigger"):
                    self.watched.call("write_trigger", 0.0)


def wait_until(done: Callable[[], bool], seconds: float) -> bool:
    """Waits until something is so, and returns whether it is in time."""
    end_s = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end_s:
            return False
        time.sleep(0.005)
    return True
