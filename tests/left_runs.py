"""Driver loops that a failed test has left running: nothing else ends them, and they would disturb later tests."""

import threading
import weakref

from haptether.bridge.devices.loop import DeviceRun

_GIVEN_UP: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
"""Threads of drivers that hang: nothing can end them."""


def end_left_runs() -> int:
    """End these loops, so that the interpreter and its threads are as before the first; return their number."""
    left = [thread for thread in threading.enumerate() if thread.name == "haptether-loop" and thread not in _GIVEN_UP]
    for thread in left:
        run = getattr(getattr(thread, "_target", None), "__self__", None)
        if isinstance(run, DeviceRun):
            run.give_up()
        _GIVEN_UP.add(thread)
    return len(left)
