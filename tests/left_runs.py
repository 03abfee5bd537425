"""Loops of drivers that a test has left running: where it failed nobody ended them, and later tests would suffer."""

import threading
import weakref

from haptether.bridge.devices.loop import DeviceRun

_GIVEN_UP: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
"""Threads of drivers that hang: nothing ends them."""


def end_left_runs() -> int:
    """End them, so that the interpreter and its threads are as before the first; how many there were."""
    left = [thread for thread in threading.enumerate() if thread.name == "haptether-loop" and thread not in _GIVEN_UP]
    for thread in left:
        run = getattr(getattr(thread, "_target", None), "__self__", None)
        if isinstance(run, DeviceRun):
            run.give_up()
        _GIVEN_UP.add(thread)
    return len(left)
