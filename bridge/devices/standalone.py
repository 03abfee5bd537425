"""Driver run without a peer or a coupling, with the times of all calls recorded."""

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
    await_closed,
    failure,
    give_up,
    leave_blocked,
    opened,
)
from haptether.bridge.interpreter import TUNING

Written = tuple[tuple[float, ...], ...]
"""Arguments of a driver's `write`: force, and torque for a pose."""
LEAVE_S = 5.0
"""Time in s that the end waits for a driver to begin its close."""
PRIORITY = 80
"""SCHED_FIFO priority, if the system grants it; same as the loops of both sides."""
SHORTEST_S = 1e-4
"""Lower bound in s on the period of any device."""
STAGES = ("open", "read", "write", "write_trigger", "stop", "hold", "close")
RestBy = Literal["stop", "hold"]


class Tick(NamedTuple):
    """One cycle of the loop; times by `time.monotonic`."""

    asked_s: float
    """Time at which `read` was called."""
    read_s: float
    """Time at which `read` returned."""
    written_s: float
    """Time at which `write` returned, or at which the lead decided not to write."""
    sample: object
    """Return value of `read`."""
    force: Written | None
    """Written force, or None."""


class Lead(Protocol):
    """Strategy that decides the output of a device for each sample."""

    def step(self, sample: object, at_s: float) -> Written | None:
        """Return the output for a sample that was read at a time in s; None writes nothing.

        Raises:
            EndOfRunError: The run is over.
        """


class EndOfRunError(Exception):
    """Raised by a lead to bring the device to rest and close it."""


class WatchedDevice:
    """Driver wrapper that records duration and outcome of each method; exceptions name the driver and the line."""

    def __init__(self, device: object) -> None:
        self.device = device
        self.failed: dict[str, DeviceError] = {}
        """First exception of each method."""
        self.took_s: dict[str, float] = {}
        """Duration of the last call of each method in s."""
        self.stage: str | None = None
        """Method that has not returned yet."""
        self.since_s = 0.0

    @property
    def paces(self) -> bool:
        """True if `read` waits for the next sample."""
        return bool(getattr(self.device, "paces", False))

    @property
    def cycle_s(self) -> float | None:
        """Shortest bus cycle in s, or None if the driver does not know it."""
        return getattr(self.device, "cycle_s", None)

    @property
    def close_s(self) -> float | None:
        """Time in s for which `close` lowers an arm, or None if the driver does not say."""
        return getattr(self.device, "close_s", None)

    def has(self, method: str) -> bool:
        """True if the driver has an optional method."""
        return callable(getattr(self.device, method, None))

    def call(self, method: str, *arguments: object) -> object:
        """Call a method of the driver and return its result.

        Raises:
            DeviceError: The method raised an exception of any type.
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

    # Methods that `opened` calls.

    def open(self) -> None:
        """Open the device."""
        self.call("open")

    def read(self) -> object:
        """Read a sample."""
        return self.call("read")

    def write(self, *force: tuple[float, ...]) -> None:
        """Write a force."""
        self.call("write", *force)

    def stop(self) -> None:
        """Stop an arm."""
        self.call("stop")

    def close(self) -> None:
        """Close the device."""
        self.call("close")


class StandaloneRun:
    """Driver opened, stepped, brought to rest and closed on a separate thread that nothing else delays.

    Starts on construction. Ends by its lead, by a driver exception, by `stop` or with the process. At the end a device
    that was written to gets zero; an arm is stopped, a gripper held.

    Args:
        device: Driver to run.
        lead: Strategy that decides the output.
        period_s: Loop period in s, if the device does not pace the loop.
        rest_by: Method that brings the device to rest: `stop` of an arm, `hold` of a gripper; None writes zero.
        stopped: Additional condition that ends the run in the current tick.
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
        """Exception that ended the run, or None."""
        self.failed_at: str | None = None
        """Driver method that ended the run; None without one, or if the lead failed."""
        self.is_open = False
        self.has_real_time = False
        self.rests: bool | None = None
        """True if the device accepted zero or stop at the end; None if it was never open or never written to."""
        self.ticks: list[Tick] = []
        self.period_s: float | None = None
        """Period that the driver declares, once it is open."""
        self._lead = lead
        self._loop_period_s = period_s
        self._rest_by = rest_by
        self._stopped = stopped
        self._rest: Written | None = None
        self._stopping = threading.Event()
        self._quieted = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="haptether-standalone", daemon=True)
        TUNING.begin()
        # At process exit, bring the device to rest before its thread is killed.
        atexit.register(self._leave)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """True if the run has ended and its device is closed."""
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Request the end: the current tick writes zero."""
        self._stopping.set()

    def blocked_in(self, longer_than_s: float) -> str | None:
        """Return the driver method that has not returned for longer than the given time."""
        stage, since_s = self.watched.stage, self.watched.since_s
        return stage if stage is not None and time.monotonic() - since_s > longer_than_s else None

    def end(self) -> bool:
        """End the run and return True on success; if a driver call blocks, close the device here.

        A blocked device may continue to exert its last force.
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
        # Executed once: at the end of the run, or when the run is given up.
        if self._quieted.acquire(blocking=False):
            TUNING.end()

    def _leave(self) -> None:
        self._stopping.set()
        if self.watched.stage == "open":
            give_up(self.watched.device)
        self._thread.join(LEAVE_S)
        await_closed(self._thread, self.watched, self.notes)

    def _run(self) -> None:
        try:
            if self._ends():
                # Ended before the thread ran: do not open the device.
                return
            period_s = None if self.watched.paces else self._loop_period_s
            with opened(self.watched, self.notes, "period_s", period_s):  # type: ignore[arg-type]  # it calls those of the driver
                self.period_s = getattr(self.watched.device, "period_s", None)
                with contextlib.suppress(OSError, AttributeError):
                    # Applies to this thread; `opened` reverts it.
                    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
                    self.has_real_time = True
                    TUNING.prioritise()
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
            # An error of the lead over the driver's samples is reported as a driver failure.
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
                    # A driver that does not wait as declared would starve all other threads in real time.
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
    """Wait for a condition and return True if it holds in time."""
    end_s = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end_s:
            return False
        time.sleep(0.005)
    return True
