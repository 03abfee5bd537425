"""Settings of the Python interpreter for driver loops."""

import contextlib
import gc
import os
import sys
import threading
from dataclasses import dataclass, field

SWITCH_S = 2e-4
"""Longest time another thread may hold the interpreter while a loop waits; Python's default of 5 ms is five ticks."""
HOLDER_PRIORITY = 1
"""SCHED_FIFO priority of threads that may hold the interpreter beside a real-time loop; below every such loop."""


@dataclass
class InterpreterTuning:
    """Disable garbage collection and shorten the thread switch interval while any loop runs.

    The loops of a process share one instance: the first to end must not restore settings that another still needs.
    """

    loops: int = 0
    """Number of running loops."""
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _switch_s: float = 0.0
    _collects: bool = False
    _raised: set[int] = field(default_factory=set)
    """Native identifiers of threads whose priority must be restored."""

    def begin(self) -> None:
        """Register a loop."""
        with self._lock:
            self.loops += 1
            if self.loops > 1:
                # A collection now would delay the loop that already runs.
                return
            self._switch_s, self._collects = sys.getswitchinterval(), gc.isenabled()
            gc.collect()
            gc.freeze()
            gc.disable()
            sys.setswitchinterval(SWITCH_S)

    def settle(self) -> None:
        """Exclude objects made while a device opened from later collections; no effect if no loop runs.

        Kinematics and vendor modules create 10^5 young objects. A collection of the young generation would hold the
        interpreter
        for 6 ms or more, possibly during engagement.
        """
        with self._lock:
            if self.loops == 1:
                gc.collect()
            if self.loops:
                gc.freeze()

    def prioritise(self) -> None:
        """Raise the other Python threads above ordinary processes if the calling loop has real-time priority.

        A thread that holds the interpreter lock while it waits for a processor delays the loop that waits for the lock.
        The loop's priority does not help, because the lock has no priority inheritance (priority inversion).
        """
        with self._lock, contextlib.suppress(OSError, AttributeError):
            if not self.loops or os.sched_getscheduler(0) != os.SCHED_FIFO:
                return
            for thread in threading.enumerate():
                number = thread.native_id
                if number is not None and os.sched_getscheduler(number) == os.SCHED_OTHER:
                    os.sched_setscheduler(number, os.SCHED_FIFO, os.sched_param(HOLDER_PRIORITY))
                    self._raised.add(number)

    def end(self) -> None:
        """Unregister a loop; after the last one, restore the initial settings."""
        with self._lock:
            self.loops -= 1
            if self.loops > 0:
                return
            sys.setswitchinterval(self._switch_s)
            gc.unfreeze()
            # The identifier of an ended thread may already belong to another process.
            for number in self._raised.intersection(thread.native_id or 0 for thread in threading.enumerate()):
                with contextlib.suppress(OSError):
                    os.sched_setscheduler(number, os.SCHED_OTHER, os.sched_param(0))
            self._raised.clear()
            if self._collects:
                gc.enable()


TUNING = InterpreterTuning()
"""Instance of this process."""
