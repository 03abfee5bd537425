"""Python's interpreter as the loop of a driver needs it."""

import contextlib
import gc
import os
import sys
import threading
from dataclasses import dataclass, field

SWITCH_S = 2e-4
"""How long another thread may keep the interpreter while a loop waits for it; Python's own 5 ms are five ticks."""
HOLDER_PRIORITY = 1
"""Under SCHED_FIFO, of threads that may hold the interpreter beside a loop in real time; below all such loops."""


@dataclass
class Quiet:
    """No garbage collection in a tick, and other threads switched out early, from the first loop to the last.

    Loops of one process share it: who ends first must not bring back what another still has to be without.
    """

    loops: int = 0
    """How many run."""
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _switch_s: float = 0.0
    _collects: bool = False
    _raised: set[int] = field(default_factory=set)
    """System's numbers of the threads whose priority is to be given back."""

    def begin(self) -> None:
        """One loop more."""
        with self._lock:
            self.loops += 1
            if self.loops > 1:
                # To collect all now would hold up the loop that runs.
                return
            self._switch_s, self._collects = sys.getswitchinterval(), gc.isenabled()
            gc.collect()
            gc.freeze()
            gc.disable()
            sys.setswitchinterval(SWITCH_S)

    def settle(self) -> None:
        """Takes what a device made while it opened out of every later collection; nothing where no loop has begun.

        Modules of kinematics and of a vendor are 10^5 objects that are young at first: a collection of the young would
        keep the interpreter for 6 ms and more, just when somebody engages.
        """
        with self._lock:
            if self.loops == 1:
                gc.collect()
            if self.loops:
                gc.freeze()

    def prioritise(self) -> None:
        """Raises the other threads of Python above ordinary processes, where the calling loop has real time.

        A thread that holds the interpreter and waits for a processor holds up the loop that waits for the interpreter,
        whatever the loop's priority: the interpreter's lock passes no priority on (priority inversion).
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
        """One loop less; after the last, all is as before the first."""
        with self._lock:
            self.loops -= 1
            if self.loops > 0:
                return
            sys.setswitchinterval(self._switch_s)
            gc.unfreeze()
            # The number of one that has ended may be another process's by now.
            for number in self._raised.intersection(thread.native_id or 0 for thread in threading.enumerate()):
                with contextlib.suppress(OSError):
                    os.sched_setscheduler(number, os.SCHED_OTHER, os.sched_param(0))
            self._raised.clear()
            if self._collects:
                gc.enable()


QUIET = Quiet()
"""Of this process."""
