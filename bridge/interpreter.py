"""Python's interpreter as the loop of a driver needs it."""

import gc
import sys
import threading
from dataclasses import dataclass, field

SWITCH_S = 2e-4
"""How long another thread may keep the interpreter while a loop waits for it; Python's own 5 ms are five ticks."""


@dataclass
class Quiet:
    """No collector that strikes in a tick and short turns of other threads, from the first loop to the last.

    Loops of one process share it: who ends first must not bring back what another still has to be without.
    """

    loops: int = 0
    """How many run."""
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _switch_s: float = 0.0
    _collects: bool = False

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

    def end(self) -> None:
        """One loop less; after the last, all is as before the first."""
        with self._lock:
            self.loops -= 1
            if self.loops > 0:
                return
            sys.setswitchinterval(self._switch_s)
            gc.unfreeze()
            if self._collects:
                gc.enable()


QUIET = Quiet()
"""Of this process."""
